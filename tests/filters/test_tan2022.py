import copy
import dataclasses
import pickle
import warnings

import pytest
import torch
from layered import BACK, disk_scene

from torchblur.errors import FrameError
from torchblur.filters.tan2022 import Tan2022Blur, tan2022
from torchblur.frame import Frame
from torchblur.io import read_frame, read_image
from torchblur.metrics import evaluate
from torchblur.testing.contract import FilterContract
from torchblur.testing.frames import moving_square

QUIET = {"noise": "none", "shutter": 1.0}


@pytest.mark.filterwarnings("ignore:tan2022. no layer:UserWarning")
class TestTan2022(FilterContract):
    filter_class = Tan2022Blur
    function = staticmethod(tan2022)
    plain = {"noise": "none", "shutter_position": "centered"}
    acts_with = {"early_out": {"tile_size": 2}}

    def test_invalid_pixels_lend_no_color(self):
        # Those of neither layer, of which the revealed one is as white as the other.
        frame = moving_square()
        valid = torch.ones(1, 1, *frame.size, dtype=torch.bool)
        valid[..., 8:12, 8:12] = False
        white = torch.where(valid, torch.ones_like(frame.color), 0.0)
        frame = dataclasses.replace(
            frame,
            color=white,
            valid=valid,
            revealed=dataclasses.replace(frame.revealed, color=white, valid=valid),
        )
        blurred = tan2022(frame)
        assert torch.allclose(blurred[valid.expand_as(blurred)], torch.ones(()), atol=1e-5)


def bar(columns=(40, 70), speed=20.0, width=110):
    """A bar, depth 2, moves right before a still background, depth 6; one color each.

    The background is green, the revealed one blue, the bar red, so that a result tells the sums
    of weights.
    """
    inside = torch.zeros(1, 1, 6, width, dtype=torch.bool)
    inside[..., columns[0] : columns[1]] = True

    def paint(*rgb):
        return torch.tensor(rgb).view(1, 3, 1, 1).expand(1, 3, 6, width)

    zeros = torch.zeros(1, 1, 6, width)
    still = torch.cat((zeros, zeros), 1)
    behind = Frame(color=paint(0.0, 0, 1), velocity=still, depth=zeros + BACK)
    return Frame(
        color=torch.where(inside, paint(1.0, 0, 0), paint(0.0, 1, 0)),
        velocity=torch.cat((torch.where(inside, speed, 0.0), zeros), 1),
        depth=torch.where(inside, 2.0, BACK),
        object_id=inside.int(),
        normal=torch.cat((zeros, zeros, zeros - 1), 1),
        revealed=behind,
    )


def color_at(frame, column, **params):
    with torch.no_grad():
        image = Tan2022Blur(**(QUIET | params))(frame)
    return image[0, :, 3, column].tolist()


def shares(red, green, blue):
    total = red + green + blue
    return pytest.approx([red / total, green / total, blue / total], abs=1e-5)


def test_the_defaults_are_those_of_the_paper():
    config = Tan2022Blur().config
    assert (config.tile_size, config.num_samples, config.edge_threshold) == (40, 15, 0.9)
    assert (config.foreground_magnifier, config.mask_magnifier) == (30, 3)
    assert (config.soft_depth_extent, config.shutter_position) == (0.03, "leading")


# -- the weights, by hand --------------------------------------------------------------------------


def test_inner_blur_by_hand():
    # Two taps at 5 and 15 px of 20. The pixel lies 10 px within the trailing edge: the first tap
    # hits the bar, f = b = 1: cones 1 − 5/20 each, cylinders 2. The second hits the background:
    # only b · cone(15, 20) = 1/4. The pixel itself: 1/20.
    frame = bar()
    red, green = 0.75 + 0.75 + 2 + 0.05, 0.25
    given = {"num_samples": 2, "shutter_position": "leading"}
    assert color_at(frame, 49, **given) == shares(red / 3, 0, green * 3)
    assert color_at(frame, 49, **given, mask_magnifier=1.0) == shares(red, 0, green)
    # without the layer, the raster's background, and no magnifier
    bare = dataclasses.replace(frame, revealed=None)
    with pytest.warns(UserWarning, match="`revealed`"):
        assert color_at(bare, 49, **given) == shares(red, green, 0)
    mask = Tan2022Blur(**QUIET).layers(frame)["ray_mask"][0, 0, 3] > 0
    assert set(mask.nonzero().flatten().tolist()) in ({*range(40, 61)}, {*range(40, 62)})
    # trailing is the same at the leading edge
    assert color_at(frame, 60, **(given | {"shutter_position": "trailing"})) == shares(
        red / 3, 0, green * 3
    )


def test_outer_blur_by_hand():
    # 10 px ahead of the bar the first tap hits the background at 5 px, beyond any cone of a still
    # pixel (half a px); the second the bar at 15 px: f · cone(15, 20), magnified. The pixel: 1/½.
    frame = bar()
    given = {"num_samples": 2, "shutter_position": "leading"}
    assert color_at(frame, 79, **given) == shares(30 * 0.25, 2, 0)
    assert color_at(frame, 79, **given, foreground_magnifier=4.0) == shares(4 * 0.25, 2, 0)
    # a bar that is nearer by less than the extent is not magnified; f is 1 all the same
    assert color_at(frame, 79, **given, soft_depth_extent=4.5) == shares(0.25, 2, 0)
    # behind the bar there is nothing to see of it
    assert color_at(frame, 35, **given) == shares(0, 1, 0)


def test_centered_samples_both_sides_by_half():
    frame = bar()
    # 2 taps at −5 and +5 px of ±10, on both sides of the pixel 3 px within the bar
    red = (1 - 5 / 10) * 2 + 2 + 1 / 10
    for column in (42, 67):
        got = color_at(frame, column, num_samples=2, shutter_position="centered")
        assert got == shares(red / 3, 0, 3 * (1 - 5 / 10))
    layers = Tan2022Blur(shutter_position="centered", **QUIET).layers(frame)
    masked = (layers["ray_mask"][0, 0, 3] > 0).nonzero().flatten().tolist()
    assert set(masked) >= {*range(40, 50), *range(60, 70)}
    assert 54 not in masked


def test_long_motion_is_cut_to_a_tile():
    frame = bar(columns=(10, 60), speed=200.0, width=130)
    layers = Tan2022Blur(**QUIET).layers(frame)
    columns = (layers["ray_mask"][0, 0, 3] > 0).nonzero().flatten().tolist()
    assert columns == []  # 40 px to the left of the bar's first 50 px lies outside or on the bar
    layers = Tan2022Blur(**QUIET).layers(bar(columns=(60, 120), speed=200.0, width=130))
    columns = (layers["ray_mask"][0, 0, 3] > 0).nonzero().flatten().tolist()
    assert set(range(60, 100)) <= set(columns) <= set(range(60, 102))


# -- the layers ------------------------------------------------------------------------------------


def test_the_hybrid_restores_an_edge_behind_a_disk():
    frame, reference = disk_scene("trailing")
    masked = Tan2022Blur(shutter_position="trailing", **QUIET).layers(frame)
    where = masked["ray_mask"] > 0
    assert 50 < int(where.sum()) < 1200

    def error(image):
        return float((image - reference).square().mean(1, keepdim=True)[where].mean())

    bare = dataclasses.replace(frame, revealed=None)
    with pytest.warns(UserWarning, match="`revealed`"):
        fallback = tan2022(bare, shutter_position="trailing", **QUIET)
    assert error(masked["color"]) < 0.3 * error(fallback)


def test_the_revealed_layer_is_blurred_by_its_own_motion():
    frame, _ = disk_scene("leading", flow=14.0)
    with torch.no_grad():
        layers = Tan2022Blur(**QUIET).layers(frame)
        with pytest.warns(UserWarning, match="no layer"):
            alone = Tan2022Blur(**QUIET)(frame.revealed)
    assert torch.equal(layers["background"], alone)
    assert not torch.allclose(alone, frame.revealed.color, atol=0.1)


def test_layers_for_debug_views():
    frame = moving_square()
    layers = Tan2022Blur(tile_size=8).layers(frame)
    planes = ("ray_mask", "edge_mask", "candidates", "hybrid")
    for name in (*planes, "foreground_weight", "background_weight"):
        assert layers[name].shape == (1, 1, 21, 27)
    for name in planes:
        assert set(layers[name].unique().tolist()) == {0, 1}, name
    assert bool((layers["edge_mask"] <= layers["candidates"]).all())
    assert bool((layers["hybrid"] <= layers["ray_mask"]).all())
    assert layers["tile_max"].shape == layers["neighbor_max"].shape == (1, 2, 3, 4)


def test_a_layer_counts_where_it_was_traced():
    frame, _ = disk_scene("leading")
    full = Tan2022Blur(**QUIET).layers(frame)
    traced = full["ray_mask"] > 0
    traced[..., 28:, :] = False
    nonsense = torch.where(traced, frame.revealed.color, 50.0)
    part = dataclasses.replace(frame.revealed, color=nonsense, valid=traced)
    layers = Tan2022Blur(**QUIET).layers(dataclasses.replace(frame, revealed=part))
    with pytest.warns(UserWarning, match="`revealed`"):
        fallback = tan2022(dataclasses.replace(frame, revealed=None), **QUIET)
    assert torch.equal(layers["hybrid"] > 0, traced)
    assert torch.equal(layers["color"][..., 28:, :], fallback[..., 28:, :])
    assert torch.equal(layers["color"][..., :28, :], full["color"][..., :28, :])


def test_missing_layers_are_told_once_per_module():
    frame = moving_square()
    bare = Frame(color=frame.color, velocity=frame.velocity, depth=frame.depth)
    blur = Tan2022Blur()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        blur(frame)
        assert caught == []
        layers = blur.layers(bare)
        assert [str(w.message).split("`")[1] for w in caught] == ["object_id", "normal", "revealed"]
        for again in (blur, copy.deepcopy(blur), pickle.loads(pickle.dumps(blur))):
            again(bare)
        assert len(caught) == 3
        Tan2022Blur()(bare)
        assert len(caught) == 6
    assert float(layers["hybrid"].sum()) == 0
    assert float(layers["ray_mask"].sum()) > 0  # for a renderer to trace


def test_a_frame_without_depth_is_an_error():
    frame = moving_square()
    with pytest.raises(FrameError, match="`depth` is needed"):
        tan2022(dataclasses.replace(frame, depth=None))
    flat = Frame(color=frame.color, velocity=frame.velocity)
    with pytest.raises(FrameError, match="`depth` is needed"):
        tan2022(dataclasses.replace(frame, revealed=flat))


# -- gradients -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("edge_threshold", 0.85),
        ("soft_depth_extent", 0.4),
        ("foreground_magnifier", 12.0),
        ("mask_magnifier", 2.5),
        ("depth_edge_gain", 0.8),
        ("normal_edge_gain", 0.7),
    ],
)
def test_soft_thresholds_have_gradients(name, value):
    frame = moving_square(dtype=torch.float64)
    blur = Tan2022Blur(threshold_softness=0.5, noise="none", num_samples=5, tile_size=10)

    def run(parameter):
        return blur(frame, **{name: parameter})

    given = torch.tensor(value, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(run, (given,), eps=1e-7, atol=1e-5, rtol=1e-3, fast_mode=True)
    (grad,) = torch.autograd.grad(run(given).square().mean(), given)
    assert float(grad.abs()) > 1e-7


def test_gradients_reach_both_layers():
    frame = moving_square()
    leaves = [frame.color, frame.depth, frame.revealed.color, frame.revealed.depth]
    leaves = [t.clone().requires_grad_() for t in leaves]
    behind = dataclasses.replace(frame.revealed, color=leaves[2], depth=leaves[3])
    frame = dataclasses.replace(frame, color=leaves[0], depth=leaves[1], revealed=behind)
    tan2022(frame, threshold_softness=0.2).square().sum().backward()
    for leaf in leaves:
        assert bool(torch.isfinite(leaf.grad).all())
        assert float(leaf.grad.abs().sum()) > 0


@pytest.mark.shared
def test_the_hybrid_gains_what_the_paper_says_on_the_vase(shared_data):
    # Table 1 of the paper: 24.20 dB of the adapted post-process, 25.69 dB of the hybrid.
    frame = read_frame(shared_data / "vase")
    reference = read_image(shared_data / "vase" / "reference_trailing.exr")
    blur = Tan2022Blur(shutter_position="trailing")
    with torch.no_grad():
        layers = blur.layers(frame)
        with pytest.warns(UserWarning, match="`revealed`"):
            fallback = blur(dataclasses.replace(frame, revealed=None))
        masks = {"mask": layers["ray_mask"]}
        plain, hybrid = (
            evaluate(image, reference, masks=masks) for image in (fallback, layers["color"])
        )
    assert float(hybrid["psnr"] - plain["psnr"]) > 1.5
    assert float(hybrid["ssim"]) > float(plain["ssim"]) + 0.003
    assert float(hybrid["psnr_mask"] - plain["psnr_mask"]) > 6
    assert float(hybrid["flip_mask"]) < 0.6 * float(plain["flip_mask"])
    assert 0.01 < float(layers["ray_mask"].mean()) < 0.04
