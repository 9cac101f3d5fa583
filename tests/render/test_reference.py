"""References: closed forms, statistics against their own variance, seeds, engines, bad input."""

import math
import warnings

import pytest
import torch
from scipy.stats import norm
from torch._dynamo.exc import BackendCompilerFailed
from torch._dynamo.utils import counters

from torchblur.errors import ConfigError
from torchblur.frame import Shutter
from torchblur.render import Renderer, load_scene, render_frame, render_reference

PX = 4 / 32  # scene units per pixel at depth 4 and width 32
SIZE = (8, 32)


def bar(glow, speed, **others):
    """A white half plane whose edge is at the middle of the image at frame 0, speed in px."""
    wide = {"kind": "plane", "size": [40.0, 40.0], "position": [-20.0, 0, 0]}
    return wide | {"velocity": [speed * PX, 0, 0]} | glow(1, 1, 1) | others


def ramp(start, end):
    """Mean over pixels and time of a step whose edge goes from start to end, px; (32,)."""

    def twice_integrated(x):
        return torch.clamp(x, min=0) ** 2 / 2

    left = torch.arange(32, dtype=torch.float64) - 16
    spans = [
        twice_integrated(end - left - a) - twice_integrated(start - left - a) for a in (0.0, 1.0)
    ]
    return ((spans[0] - spans[1]) / (end - start)).float()


@pytest.mark.parametrize(
    ("position", "start", "end"),
    [("centered", -4.0, 4.0), ("leading", 0.0, 8.0), ("trailing", -8.0, 0.0)],
)
def test_moving_edge_is_a_ramp(make_scene, glow, position, start, end):
    scene = make_scene(bar(glow, 16.0), sky={"kind": "solid", "color": [0, 0, 0]})
    reference = render_reference(scene, SIZE, spp=256, shutter=Shutter(0.5, position), seed=3)
    error = reference.mean[0, 1] - ramp(start, end)
    assert error.abs().max() < 0.02  # five samples of 256
    assert error.mean().abs() < 3e-4
    assert (error.abs() <= 5 * reference.variance[0, 1].sqrt() + 1e-6).all()


@pytest.mark.parametrize(
    ("position", "start", "end"),
    [("centered", -5.0, 5.0), ("leading", 0.0, 10.0), ("trailing", -10.0, 0.0)],
)
def test_exposure_of_several_frames_is_a_long_ramp(make_scene, glow, position, start, end):
    """1/60 s at 300 frames a second: five frames of 2 px each."""
    scene = make_scene(bar(glow, 2.0), sky={"kind": "solid", "color": [0, 0, 0]})
    shutter = Shutter.from_exposure(1 / 60, 300, position)
    reference = render_reference(scene, SIZE, spp=256, shutter=shutter, seed=3)
    assert (reference.mean[0, 1] - ramp(start, end)).abs().max() < 0.02


def test_time_passes_with_the_frame(make_scene, glow):
    scene = make_scene(bar(glow, 4.0), sky={"kind": "solid", "color": [0, 0, 0]})
    reference = render_reference(scene, SIZE, spp=256, shutter=Shutter(1.0), frame=2.0)
    assert (reference.mean[0, 0] - ramp(6.0, 10.0)).abs().max() < 0.02  # five samples of 256


def test_still_scene_does_not_depend_on_the_shutter(make_scene):
    texture = {"kind": "checker", "size": 0.4, "color": [1, 1, 1], "background": [0, 0, 0]}
    ball = {"kind": "sphere", "radius": 1.2, "rotation": [10, 20, 30], "texture": texture}
    scene = make_scene(ball, {"kind": "plane", "position": [0, 0, -3], "texture": texture})
    closed, half, full = (
        render_reference(scene, (24, 32), spp=16, shutter=Shutter(t), seed=5) for t in (0, 0.5, 2)
    )
    assert torch.equal(closed.mean, half.mean)
    assert torch.equal(closed.mean, full.mean)
    assert torch.equal(closed.variance, full.variance)


def test_still_surface_of_one_color_has_no_variance(make_scene, glow):
    scene = make_scene({"kind": "plane", "spin": 30.0} | glow(0.5, 2.0, 7.0))
    reference = render_reference(scene, SIZE, spp=8)
    assert not reference.variance.any()
    assert reference.mean[0, :, 0, 0].tolist() == [0.5, 2.0, 7.0]


def test_texture_moved_by_a_whole_period_is_its_mean(make_scene):
    """A box blur as long as the period leaves nothing of a pattern."""
    stripes = {"kind": "stripes", "size": 3 * PX, "color": [1, 1, 1], "background": [0, 0, 0]}
    body = {"kind": "plane", "velocity": [12 * PX, 0, 0], "texture": stripes, "emissive": True}
    reference = render_reference(make_scene(body), SIZE, spp=256, shutter=Shutter(0.5))
    assert (reference.mean - 0.5).abs().max() < 0.02
    half = render_reference(make_scene(body), SIZE, spp=256, shutter=Shutter(0.25))
    assert half.mean.std() > 0.1


def test_moving_texture_is_the_mean_of_its_sharp_images(make_scene):
    """Uniform motion is a box blur: the mean of the sharp images over the open shutter."""
    bricks = {"kind": "brick", "size": [0.9, 0.4], "color": [1, 0.5, 0], "background": [0, 0, 0.3]}
    body = {"kind": "plane", "velocity": [1, 0.5, 0], "texture": bricks | {"variation": 0.8}}
    scene = make_scene(body)
    blurred = render_reference(scene, (24, 32), spp=512, shutter=Shutter(0.5))
    times = [(k + 0.5) / 128 - 0.25 for k in range(64)]
    sharp = [
        render_reference(scene, (24, 32), spp=8, shutter=Shutter(0), frame=t, seed=k + 1).mean
        for k, t in enumerate(times)
    ]
    error = blurred.mean - torch.stack(sharp).mean(0)
    assert error.abs().max() < 0.03
    assert error.mean().abs() < 1e-3


@pytest.fixture(scope="module")
def replicates(repository):
    """Many small references of one scene, and a good one from another seed."""
    renderer = Renderer(load_scene(repository / "configs/scenes/crossing_spheres.yaml"))
    many = [renderer.reference((27, 48), spp=16, seed=seed) for seed in range(1, 41)]
    return many, renderer.reference((27, 48), spp=1024, seed=777)


def test_mean_agrees_with_an_independent_reference_within_its_variance(replicates):
    many, good = replicates
    mean = torch.cat([r.mean for r in many]).mean(0)
    variance = torch.cat([r.variance for r in many]).mean(0) / len(many)
    difference = (mean - good.mean[0]).abs()
    deviation = (variance + good.variance[0]).sqrt()
    z = difference / (deviation + 1e-4)
    significance = 1 - (1 - 0.01) ** (1 / z.numel())  # Sidak: 1 % for all pixels together
    assert z.max() < norm.isf(significance / 2)
    moving = deviation > 1e-3
    assert moving.double().mean() > 0.2
    shifted = (mean.roll(1, -1) - good.mean[0]).abs() / (deviation + 1e-4)
    assert shifted.max() > norm.isf(significance / 2), "the test sees an error of a pixel"


def test_variance_is_conservative_and_not_idle(replicates):
    many, _ = replicates
    means = torch.cat([r.mean for r in many])
    claimed = torch.cat([r.variance for r in many]).mean(0)
    actual = means.var(0)
    assert 1.0 < float(claimed.sum() / actual.sum()) < 4.0
    blocks = torch.nn.functional.avg_pool2d(torch.stack((claimed, actual)), 4)
    busy = blocks[1] > blocks[1].quantile(0.5)
    assert (blocks[0] / blocks[1])[busy].min() > 0.75  # 16 pixels of 40 replicates: 6 % noise


def test_error_falls_faster_than_independent_samples(repository, replicates):
    _, good = replicates
    renderer = Renderer(load_scene(repository / "configs/scenes/crossing_spheres.yaml"))
    counts = (4, 16, 64)
    errors = [
        float((renderer.reference((27, 48), spp=n, seed=9).mean - good.mean).square().mean().sqrt())
        for n in counts
    ]
    slope = math.log(errors[2] / errors[0]) / math.log(counts[2] / counts[0])
    assert -1.5 < slope < -0.5
    assert errors[0] > errors[1] > errors[2]


def test_same_seed_same_bits_other_seed_other_image(repository):
    scene = load_scene(repository / "configs/scenes/thin_pole.yaml")
    first, again, other = (render_reference(scene, (18, 32), spp=4, seed=s) for s in (1, 1, 2))
    assert torch.equal(first.mean, again.mean)
    assert torch.equal(first.variance, again.variance)
    assert (first.mean != other.mean).double().mean() > 0.5
    frames = [render_frame(scene, (18, 32), color_spp=4, seed=s).color for s in (1, 1, 2)]
    assert torch.equal(frames[0], frames[1])
    assert not torch.equal(frames[0], frames[2])


def test_sharp_color_is_the_reference_of_a_closed_shutter(repository):
    scene = load_scene(repository / "configs/scenes/fence.yaml")
    frame = render_frame(scene, (18, 32), color_spp=9, frame=0.5, seed=4)
    closed = render_reference(scene, (18, 32), spp=9, shutter=Shutter(0), frame=0.5, seed=4)
    assert torch.equal(frame.color, closed.mean)


def test_one_sample_tells_nothing_of_its_error(make_scene, glow):
    reference = render_reference(make_scene(bar(glow, 3.0)), SIZE, spp=1)
    assert torch.isinf(reference.variance).all()
    assert reference.spp == 1


def test_more_samples_than_a_chunk(make_scene, glow):
    scene = make_scene(bar(glow, 1.0), sky={"kind": "solid", "color": [0, 0, 0]})
    reference = render_reference(scene, (1, 1), spp=70_000)
    assert reference.mean.flatten().tolist() == pytest.approx([0.5] * 3, abs=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"spp": 0}, "`spp` must be an integer of at least 1, got 0"),
        ({"spp": 2.5}, "`spp` must be an integer of at least 1, got 2.5"),
        ({"size": (0, 4)}, r"`size` must be \(height, width\).*got \(0, 4\)"),
        ({"size": (4, 4, 4)}, r"`size` must be .*got \(4, 4, 4\)"),
        ({"size": 4}, "`size` must be .*got 4"),
        ({"frame": math.nan}, "`frame` must be a finite number, got nan"),
    ],
)
def test_bad_arguments_are_refused(make_scene, glow, arguments, message):
    scene = make_scene(bar(glow, 1.0))
    with pytest.raises(ConfigError, match=message):
        render_reference(scene, **({"size": SIZE} | arguments))
    arguments = {"color_spp" if k == "spp" else k: v for k, v in arguments.items()}
    with pytest.raises(ConfigError, match=message.replace("`spp`", "`color_spp`")):
        render_frame(scene, **({"size": SIZE} | arguments))


def test_unknown_engine_is_refused(make_scene, glow):
    with pytest.raises(ConfigError, match=r"`engine` must be .auto..*got .fast."):
        Renderer(make_scene(bar(glow, 1.0)), engine="fast")


@pytest.fixture
def broken_compiler(monkeypatch):
    """torch.compile fails as it does on a machine without a C++ compiler."""

    def compile_(function, **options):
        raise BackendCompilerFailed(function, RuntimeError("no C++ compiler"), None)

    monkeypatch.setattr(torch, "compile", compile_)
    monkeypatch.setattr("torchblur.ops.compiling._state", {"works": True, "looked": True})
    monkeypatch.setattr("torchblur.render.compiling._compiled", lambda f: torch.compile(f))


def test_without_a_compiler_there_is_one_notice_and_the_eager_image(
    make_scene, glow, broken_compiler
):
    scene = make_scene(bar(glow, 5.0))
    compiled = Renderer(scene, engine="compiled")
    with pytest.warns(UserWarning, match="torch.compile does not work here") as caught:
        image = compiled.reference(SIZE, spp=4)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        compiled.reference(SIZE, spp=4)
    eager = Renderer(scene, engine="eager").reference(SIZE, spp=4)
    torch.testing.assert_close(image.mean, eager.mean)


@pytest.mark.slow
def test_compiled_equals_eager_and_compiles_once_per_kind(make_scene):
    checker = {"kind": "checker", "size": 0.3, "color": [1, 0.5, 0.2], "background": [0, 0.1, 0.3]}
    noise = {"kind": "noise", "size": 0.7, "color": [1, 1, 1], "background": [0, 0, 0]}

    def scene(radius, spin, *more):
        ball = {"kind": "sphere", "radius": radius, "spin": spin, "texture": checker}
        wall = {"kind": "plane", "position": [0, 0, -2], "velocity": [1, 0, 0], "texture": noise}
        return make_scene(ball, wall, *more, sky=noise)

    for first in (scene(1.0, 30.0), scene(0.4, -80.0, {"kind": "sphere", "radius": 0.3,
                  "position": [1, 0, 0], "texture": noise})):  # fmt: skip
        graphs = counters["stats"]["unique_graphs"]
        compiled = Renderer(first, engine="compiled").reference((36, 64), spp=8, seed=2)
        eager = Renderer(first, engine="eager").reference((36, 64), spp=8, seed=2)
        difference = (compiled.mean - eager.mean).abs()
        assert (difference > 1e-4).double().mean() < 1e-3  # a ray at an edge may go either way
        assert difference.mean() < 1e-5
    assert counters["stats"]["unique_graphs"] == graphs, "another scene compiles nothing anew"
    Renderer(first, engine="compiled").reference((20, 31), spp=5)
    assert counters["stats"]["unique_graphs"] == graphs, "another size compiles nothing anew"
