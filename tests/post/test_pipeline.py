import dataclasses
from itertools import permutations

import pytest
import torch
from torch import nn

from torchblur.errors import ConfigError, FrameError
from torchblur.filters import get_filter
from torchblur.frame import Frame
from torchblur.ops.noise import checkerboard
from torchblur.pipelines import FrameConfig, create_pipeline
from torchblur.post.bloom import Bloom, bloom, downsample13
from torchblur.post.depth_of_field import DepthOfField, depth_of_field
from torchblur.post.fxaa import Fxaa, fxaa
from torchblur.post.pipeline import FramePipeline, PipelineConfig
from torchblur.testing.frames import moving_square, random_frame

STEPS = ("blur", "depth_of_field", "fxaa", "bloom")
SHARP = {"depth_of_field": {"focus_distance": 2.2, "infinity_radius": 4.0, "max_radius": 4}}


class Darken(nn.Module):
    """A blur that is easy to follow: halves the color, passes luma and a half-size image on."""

    def layers(self, frame):
        half = torch.zeros_like(downsample13(frame.color))
        return {"color": frame.color / 2, "luma": checkerboard(frame.color), "half_color": half}


class Brighten(nn.Module):
    """A blur that only has `forward`."""

    def forward(self, frame):
        return frame.color + 1


def pipeline(steps, blur=None, **params):
    return FramePipeline(
        PipelineConfig.model_validate(SHARP | {"steps": list(steps)} | params), blur
    )


def with_color(frame, color):
    return dataclasses.replace(frame, color=color)


@pytest.mark.parametrize("order", list(permutations(STEPS)), ids="-".join)
def test_any_order_is_the_steps_one_after_the_other(order):
    frame = moving_square()
    blur = get_filter("line")()
    run = {
        "blur": lambda f: blur(f),
        "depth_of_field": lambda f: depth_of_field(f.color, f.depth, **SHARP["depth_of_field"]),
        "fxaa": lambda f: fxaa(f.color),
        "bloom": lambda f: bloom(f.color),
    }
    layers = pipeline(order, blur).layers(frame)
    for name in order:
        frame = with_color(frame, run[name](frame))
        assert torch.equal(layers[name], frame.color), name
    assert torch.equal(layers["color"], frame.color)


def test_order_of_blur_and_depth_of_field_matters_and_repeats_nothing():
    frame, blur = moving_square(), get_filter("guertin2014")()
    first = pipeline(["blur", "depth_of_field"], blur)(frame)
    second = pipeline(["depth_of_field", "blur"], blur)(frame)
    assert not torch.allclose(first, second, atol=0.01)
    assert torch.equal(pipeline(["blur"], blur)(frame), blur(frame))


def test_fxaa_gets_the_luma_of_the_blur_while_it_holds():
    frame = moving_square()
    half = frame.color / 2
    board = fxaa(half, checkerboard(half))
    assert torch.equal(pipeline(["blur", "fxaa"], Darken())(frame), board)
    assert torch.equal(pipeline(["blur", "fxaa"], Darken(), fxaa_luma="color")(frame), fxaa(half))
    soft = bloom(half)
    stale = pipeline(["blur", "bloom", "fxaa"], Darken(), bloom_input="color")
    assert torch.equal(stale(frame), fxaa(soft))
    kept = pipeline(["blur", "bloom", "fxaa"], Darken(), bloom_input="color", fxaa_luma="blur")
    assert torch.equal(kept(frame), fxaa(soft, checkerboard(soft)))
    assert not torch.equal(kept(frame), stale(frame))


def test_bloom_gets_the_half_resolution_color_of_the_blur():
    frame = moving_square()
    half = frame.color / 2
    black = torch.zeros_like(downsample13(half))
    assert torch.equal(pipeline(["blur", "bloom"], Darken())(frame), bloom(half, black))
    full = pipeline(["blur", "bloom"], Darken(), bloom_input="color")
    assert torch.equal(full(frame), bloom(half))
    late = pipeline(["blur", "fxaa", "bloom"], Darken())
    assert torch.equal(late(frame), bloom(fxaa(half, checkerboard(half))))


def test_a_blur_with_nothing_but_forward():
    frame = moving_square()
    assert torch.equal(pipeline(["blur", "fxaa"], Brighten())(frame), fxaa(frame.color + 1))


def test_constant_image_stays_constant():
    frame = random_frame()
    flat = with_color(frame, torch.full_like(frame.color, 0.3))
    out = pipeline(STEPS, get_filter("guertin2014")())(flat)
    assert torch.allclose(out, flat.color, atol=1e-5)


def test_gradients_reach_every_step():
    frame = moving_square(dtype=torch.float64)
    color = frame.color.clone().requires_grad_()
    whole = pipeline(STEPS, get_filter("guertin2014")(num_samples=9))
    whole(with_color(frame, color)).square().mean().backward()
    assert float(color.grad.abs().sum()) > 0
    grads = {name: p.grad for name, p in whole.named_parameters() if p.grad is not None}
    for name in ("blur.kappa", "depth_of_field.focus_distance", "bloom.intensity"):
        assert float(grads[f"steps.{name}"].abs()) > 0, name
    assert all(bool(torch.isfinite(g).all()) for g in grads.values())


def test_batches_of_frames_and_of_parameters():
    frames = [random_frame(seed=seed) for seed in range(3)]
    whole = pipeline(STEPS, get_filter("guertin2014")())
    single = torch.cat([whole(frame) for frame in frames])
    assert torch.allclose(whole(Frame.stack(frames)), single, atol=1e-5)
    kappas = torch.tensor([5.0, 40.0, 200.0]).view(3, 1, 1, 1)
    together = whole(frames[0], blur={"kappa": kappas}, bloom={"intensity": 0.3})
    single = [whole(frames[0], blur={"kappa": float(k)}, bloom={"intensity": 0.3}) for k in kappas]
    assert torch.allclose(together, torch.cat(single), atol=1e-5)
    single = whole(frames[0].to(dtype=torch.float64))
    assert single.dtype == torch.float64


def test_state_and_config_of_the_parts():
    whole = pipeline(STEPS, get_filter("line")(), bloom={"intensity": 0.4})
    other = pipeline(STEPS, get_filter("line")())
    other.load_state_dict(whole.state_dict())
    frame = moving_square()
    assert torch.equal(other(frame), whole(frame))
    kinds = [type(step) for step in whole.steps.values()]
    assert kinds[1:] == [DepthOfField, Fxaa, Bloom]
    config = whole.config
    assert PipelineConfig.model_validate_json(config.model_dump_json()) == config


# -- from files ------------------------------------------------------------------------------


def test_every_pipeline_loads_and_runs(repository):
    paths = sorted((repository / "configs" / "pipelines").rglob("*.yaml"))
    assert {"blur-dof-fxaa-bloom", "dof-blur-fxaa"} <= {path.stem for path in paths}
    for path in paths:
        whole = create_pipeline(path)
        assert "-".join(whole.steps).replace("depth_of_field", "dof") == path.stem
        out = whole(moving_square())
        assert bool(torch.isfinite(out).all())
        assert not torch.allclose(out, moving_square().color, atol=0.05)


def test_pipeline_from_a_file_a_mapping_and_a_config(tmp_path):
    (tmp_path / "fast.yaml").write_text("filter: line\nparams: {num_samples: 5}\n")
    path = tmp_path / "frame.yaml"
    path.write_text("blur: fast.yaml\nsteps: [blur, bloom]\nbloom: {intensity: 0.5}\n")
    data = {
        "blur": {"filter": "line", "params": {"num_samples": 5}},
        "steps": ["blur", "bloom"],
        "bloom": {"intensity": 0.5},
    }
    frame = moving_square()
    expected = bloom(get_filter("line")(num_samples=5)(frame), intensity=0.5)
    for source in (path, str(path), data, FrameConfig.model_validate(data)):
        assert torch.equal(create_pipeline(source)(frame), expected)
    for data in ({"steps": ["fxaa"]}, {"steps": ["fxaa"], "blur": "line"}):
        assert torch.equal(create_pipeline(data)(frame), fxaa(frame.color))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("steps: [blur, blom]\nblur: line\n", r"'blom'.*f\.yaml: steps"),
        ("steps: [fxaa, fxaa]\n", r"`steps`: must name .* at most once, got \['fxaa', 'fxaa'\]"),
        ("steps: []\n", r"`steps`: must name at least one step"),
        ("steps: [blur, fxaa]\n", r"`steps` are blur, fxaa, and no blur is given \(.*f\.yaml"),
        ("steps: [fxaa]\nblur: lines\n", r"unknown filter `lines`.*f\.yaml"),
        ("blur: lines\n", r"unknown filter `lines` \(did you mean `line`"),
        ("blur: {filter: line, params: {shuter: 1}}\n", r"`shuter` \(did you mean `shutter`"),
        ("bloom: {intensty: 1}\n", r"unknown key `intensty` \(did you mean `intensity`.*bloom"),
        ("blom: {}\n", r"unknown key `blom` \(did you mean `bloom`"),
        ("fxaa: {subpix: 2.0}\n", r"`subpix` must lie in \[0, 1\], got 2 .*f\.yaml: fxaa"),
    ],
)
def test_bad_files(tmp_path, text, message):
    path = tmp_path / "f.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        create_pipeline(path)


def test_bad_calls():
    whole = pipeline(["depth_of_field", "bloom"])
    frame = moving_square()
    with pytest.raises(ConfigError, match=r"no step `blom` \(did you mean `bloom`\?\); steps: dep"):
        whole(frame, blom={"intensity": 0.1})
    with pytest.raises(ConfigError, match=r"`intensity` must lie in \[0, 1\], got 7"):
        whole(frame, bloom={"intensity": 7.0})
    with pytest.raises(ConfigError, match=r"`steps` are fxaa, and a Darken is given"):
        pipeline(["fxaa"], Darken())
    flat = Frame(color=frame.color, velocity=frame.velocity)
    with pytest.raises(FrameError, match="`depth` is needed and is missing"):
        whole(flat)


def test_a_state_brings_the_order_of_the_steps():
    steps = ("bloom", "fxaa")
    whole = FramePipeline(PipelineConfig(steps=steps, fxaa_luma="color"))
    other = FramePipeline(PipelineConfig(steps=steps[::-1]))
    other.load_state_dict(whole.state_dict())
    frame = moving_square()
    assert other.config == whole.config
    assert torch.equal(other(frame), whole(frame))
    with pytest.raises(ConfigError, match=r"of its steps, bloom, fxaa, got fxaa$"):
        FramePipeline(PipelineConfig(steps=("fxaa",))).load_state_dict(whole.state_dict())
    old = {k: v for k, v in whole.state_dict().items() if k != "_extra_state"}
    kept = FramePipeline(PipelineConfig(steps=steps[::-1]))
    kept.load_state_dict(old)
    assert kept.config.steps == steps[::-1]
