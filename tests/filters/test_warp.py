import dataclasses

import pytest
import torch
from layered import disk_scene

from torchblur.errors import FrameError
from torchblur.filters.line import LineBlur
from torchblur.filters.warp import WarpBlur, warp
from torchblur.frame import Frame, Shutter
from torchblur.io import read_frame, read_image
from torchblur.metrics import border_band, evaluate
from torchblur.testing.contract import FilterContract
from torchblur.testing.frames import constant_motion, moving_square


class TestWarp(FilterContract):
    filter_class = WarpBlur
    function = staticmethod(warp)
    # The contract's frames have no acceleration and are smaller than the reach of the guess, and
    # the other value of 1 is 1; below, each of the three has a test of its own.
    inert = ("curved", "supersampling", "background_reach")
    box_tolerance = 0.004

    def long_reach(self):
        return {"sharpening": 0.0}  # the box blur of the contract has bilinear taps


def blur(frame, **params):
    with torch.no_grad():
        return WarpBlur(**params)(frame)


def squared_error(image, reference, where):
    return float((image - reference).square().mean(1, keepdim=True)[where].mean())


def bar(speed=16.0, flow=0.0, width=60):
    """A red bar, columns 20 to 39, depth 2, moves right before a background of two colors."""
    inside = torch.zeros(1, 1, 5, width, dtype=torch.bool)
    inside[..., 20:40] = True
    right = torch.arange(width).view(1, 1, 1, width).expand(1, 1, 5, width) >= 30

    def paint(*rgb):
        return torch.tensor(rgb).view(1, 3, 1, 1)

    zeros = torch.zeros(1, 1, 5, width)
    return Frame(
        color=torch.where(
            inside, paint(1.0, 0, 0), torch.where(right, paint(0.0, 0, 1), paint(0.0, 1, 0))
        ),
        velocity=torch.cat((torch.where(inside, speed, flow), zeros), 1),
        depth=torch.where(inside, 2.0, 6.0),
    )


# -- by hand ---------------------------------------------------------------------------------------


def test_a_bar_by_hand():
    # A shutter of 1 and 16 px: four moments at −6, −2, 2, 6 px. Column 17 is covered by the bar
    # at −6; 23 is uncovered at 6, 37 at −6, and 42 is covered at 6.
    image = blur(bar(), shutter=1.0, num_samples=4)[0, :, 2]
    assert image[:, 17].tolist() == pytest.approx([0.25, 0.75, 0], abs=1e-5)
    assert image[:, 23].tolist() == pytest.approx([0.75, 0.25, 0], abs=1e-5)
    assert image[:, 30].tolist() == pytest.approx([1, 0, 0], abs=1e-5)
    assert image[:, 37].tolist() == pytest.approx([0.75, 0, 0.25], abs=1e-5)
    assert image[:, 42].tolist() == pytest.approx([0.25, 0, 0.75], abs=1e-5)
    ahead = blur(bar(), shutter=1.0, num_samples=4, shutter_position="leading")[0, :, 2]
    # 2, 6, 10, 14 px: 33 px stay red, and column 41 is covered at all but the first
    assert ahead[:, 41].tolist() == pytest.approx([1, 0, 0], abs=1e-5)
    assert ahead[:, 47].tolist() == pytest.approx([0.5, 0, 0.5], abs=1e-5)
    assert ahead[:, 23].tolist() == pytest.approx([0.25, 0.75, 0], abs=1e-5)


def test_half_a_pixel_is_half_covered():
    # One moment, half a pixel on: the bar covers 20.5 to 40.5, times the gain of coverage.
    for gain, share in ((1.0, 0.5), (1.6, 0.8), (3.0, 1.0)):
        params = {"shutter": 1.0, "num_samples": 1, "shutter_position": "leading"}
        image = blur(bar(speed=1.0), coverage_gain=gain, **params)[0, :, 2]
        assert float(image[0, 40]) == pytest.approx(share, abs=1e-5)
        assert float(image[0, 20]) == pytest.approx(share, abs=1e-5)
        assert image[:, 30].tolist() == pytest.approx([1, 0, 0], abs=1e-5)


def test_a_background_that_moves_comes_out_from_behind():
    # The bar stands still, the background moves right: at 6 px its green edge is 6 px on, hidden.
    frame = bar(speed=0.0, flow=16.0)
    image = blur(frame, shutter=1.0, num_samples=4)[0, :, 2]
    assert torch.allclose(image[:, 20:40], frame.color[0, :, 2, 20:40])
    assert torch.allclose(image[:, 40:], frame.color[0, :, 2, 40:])
    # without a guess, the moments at which nothing is known are left out, and so it is here
    again = blur(frame, shutter=1.0, num_samples=4, background="none")[0, :, 2]
    assert torch.allclose(again, image, atol=1e-5)


def test_three_depths():
    # At column 30 a front bar lies half over a middle one over the background, at half a pixel.
    frame = bar(speed=1.0)
    depth = frame.depth.clone()
    depth[..., 40:50] = 3.0
    color = frame.color.clone()
    color[..., 40:50] = torch.tensor([1.0, 1, 1]).view(1, 3, 1, 1)
    frame = Frame(color=color, velocity=frame.velocity, depth=depth)
    params = {"shutter": 1.0, "num_samples": 1, "shutter_position": "leading", "coverage_gain": 1.0}
    image = blur(frame, **params)[0, :, 2]
    assert image[:, 40].tolist() == pytest.approx([1, 0.5, 0.5], abs=1e-5)


def test_what_is_still_and_far_from_motion_is_left_alone():
    frame = bar()
    image = blur(frame, shutter=1.0)
    assert torch.equal(image[..., :10], frame.color[..., :10])
    assert torch.equal(image[..., 50:], frame.color[..., 50:])


@pytest.mark.parametrize("position", ["leading", "trailing"])
def test_a_border_shows_what_is_known(position):
    # What comes in from outside is not: the first columns keep the mean of what passed.
    frame = constant_motion((24.0, 0.0), 6, 60)
    layers = WarpBlur(shutter=1.0, shutter_position=position).layers(frame)
    coverage = layers["coverage"][0, 0, 3]
    open_side, far_side = (0, -1) if position == "leading" else (-1, 0)
    assert float(coverage[open_side]) < 0.1
    assert float(coverage[30]) == pytest.approx(1, abs=1e-5)
    assert float(coverage[far_side]) == pytest.approx(1, abs=1e-5)
    expected = frame.color[0, :, 3, open_side]
    assert torch.allclose(layers["color"][0, :, 3, open_side], expected, atol=0.1)


# -- paths, growth, sharpness ----------------------------------------------------------------------


def test_acceleration_bends_the_path():
    # 64 px/frame², half a frame to each side: 8 px down at both ends.
    frame = constant_motion((0.0, 0.0), 40, 20)
    bend = torch.zeros_like(frame.velocity)
    bend[:, 1] = 64.0
    bent = dataclasses.replace(frame, acceleration=bend)
    image = blur(bent, shutter=1.0, num_samples=16)
    times = [(i + 0.5) / 16 - 0.5 for i in range(16)]
    shifted = sum(
        blur(
            dataclasses.replace(frame, velocity=bend * t * t / 2),
            num_samples=1,
            shutter=2.0,
            shutter_position="leading",
        )
        for t in times
    )
    inner = (..., slice(10, -10), slice(2, -2))
    assert torch.allclose(image[inner], (shifted / 16)[inner], atol=1e-5)
    assert torch.equal(blur(bent, shutter=1.0, curved=False), frame.color)


def growing(rate, size=48):
    """A textured plane that grows by `rate` a frame about the middle, before nothing."""
    frame = constant_motion((0.0, 0.0), size, size)
    at = torch.arange(size) - (size - 1) / 2
    grid = torch.stack(torch.meshgrid(at, at, indexing="xy"))[None]
    return dataclasses.replace(frame, velocity=rate * grid)


def test_growth_leaves_no_cracks():
    # Twice as large after half a frame: a mark on every fourth pixel.
    frame = growing(2.0)
    inner = (..., slice(18, 30), slice(18, 30))
    params = {"shutter": 1.0, "num_samples": 1, "shutter_position": "leading"}

    def least(**more):
        return float(WarpBlur(**(params | more)).layers(frame)["coverage"][inner].min())

    assert least(stretch=0.0) < 0.4
    assert least() == pytest.approx(1, abs=1e-5)
    assert least(stretch=0.0, supersampling=2, coverage_gain=4.0) == pytest.approx(1, abs=1e-5)
    fine = blur(growing(6.0), supersampling=4, **params)
    assert not torch.equal(fine, blur(growing(6.0), **params))


def test_supersampling_changes_nothing_where_all_moves_alike():
    frame = constant_motion((7.3, -2.2), 24, 24)
    one, three = (blur(frame, supersampling=s) for s in (1, 3))
    assert torch.allclose(one, three, atol=1e-5)


def test_sharpening_takes_back_the_blur_of_the_splat():
    # A wave of 8 px, moved by half a pixel.
    at = torch.arange(64.0)
    frame = constant_motion((1.0, 0.0), 8, 64)

    def wave(shift):
        return (0.5 + 0.4 * ((at - shift) * 2 * torch.pi / 8).sin()).expand(1, 3, 8, 64)

    frame = dataclasses.replace(frame, color=wave(0.0))
    params = {"shutter": 1.0, "num_samples": 1, "shutter_position": "leading"}
    plain, sharp = (
        (blur(frame, sharpening=s, **params) - wave(0.5))[..., 8:-8].abs().mean()
        for s in (0.0, 1.0)
    )
    assert float(plain) > 0.01
    assert float(sharp) < 0.6 * float(plain)


# -- what lies behind ------------------------------------------------------------------------------


@pytest.mark.parametrize(("speed", "flow"), [(24.0, 0.0), (0.0, 20.0)])
def test_the_revealed_layer_is_as_good_as_the_scene(speed, flow):
    frame, reference = disk_scene(speed=speed, flow=flow)
    band = border_band(frame, Shutter(1.0))
    band[..., :12] = band[..., -12:] = False
    errors = {
        kind: squared_error(
            blur(frame, shutter=1.0, num_samples=24, background=kind), reference, band
        )
        for kind in ("none", "guessed", "revealed")
    }
    assert errors["revealed"] < 0.5 * errors["guessed"]
    if speed:  # behind a still object stripes that move are as well left out as guessed
        assert errors["guessed"] < errors["none"]
    assert errors["revealed"] < 1e-3


def test_where_the_revealed_layer_is_not_valid_it_is_guessed():
    frame, _ = disk_scene()
    nowhere = torch.zeros(1, 1, *frame.size, dtype=torch.bool)
    empty = dataclasses.replace(frame, revealed=dataclasses.replace(frame.revealed, valid=nowhere))
    few = {"shutter": 1.0, "num_samples": 8}
    guessed = blur(frame, **few)
    assert torch.equal(blur(empty, **few, background="revealed"), guessed)
    assert not torch.allclose(blur(frame, **few, background="revealed"), guessed, atol=0.1)
    bare = dataclasses.replace(frame, revealed=None, source="shot.exr")
    with pytest.raises(FrameError, match=r"`revealed` is needed and is missing \(shot\.exr\)"):
        blur(bare, background="revealed")


def test_the_guess_reaches_so_far():
    frame, _ = disk_scene()  # of a radius of 18 px
    for reach, known in ((3, 3), (64, 64)):
        layers = WarpBlur(shutter=4.0, num_samples=1, background_reach=reach).layers(frame)
        found = layers["behind_known"][0, 0, 28] > 0
        assert int(found.sum()) == min(2 * known, int((frame.object_id == 7)[0, 0, 28].sum()))


def test_memory_does_not_grow_with_the_moments():
    frame = moving_square(40, 40)
    stored = []
    for count in (2, 32):
        color = frame.color.clone().requires_grad_()
        kept = 0

        def pack(tensor):
            nonlocal kept
            kept += tensor.numel()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            image = WarpBlur(num_samples=count)(dataclasses.replace(frame, color=color))
        image.sum().backward()
        assert float(color.grad.abs().sum()) > 0
        stored.append(kept)
    assert stored[1] <= 1.01 * stored[0]


def test_gradients_reach_the_revealed_layer_and_the_acceleration():
    frame = moving_square()
    bend = torch.full_like(frame.velocity, 3.0)
    leaves = [t.clone().requires_grad_() for t in (*frame.revealed.layers().values(), bend)]
    behind = Frame(color=leaves[0], depth=leaves[1], velocity=leaves[2])
    assert list(frame.revealed.layers()) == ["color", "depth", "velocity"]
    changed = dataclasses.replace(frame, revealed=behind, acceleration=leaves[3])
    warp(changed, background="revealed").square().sum().backward()
    for leaf in leaves:
        assert bool(torch.isfinite(leaf.grad).all())
        assert float(leaf.grad.abs().sum()) > 0


# -- beside path-traced references -----------------------------------------------------------------


@pytest.mark.shared
@pytest.mark.parametrize(
    ("case", "flip", "decibels"),
    [("vase", 0.6, 7.5), ("cars", 0.7, 4.5), ("fan", 0.5, 8.0), ("approach", 0.6, 8.0)],
)
def test_it_comes_nearer_to_a_path_traced_reference_than_lines(shared_data, case, flip, decibels):
    frame = read_frame(shared_data / case)
    reference = read_image(shared_data / case / "reference.exr")
    masks = {"band": border_band(frame, Shutter(0.5))}
    with torch.no_grad():
        lines = evaluate(LineBlur()(frame), reference, masks=masks)
        ours = evaluate(WarpBlur(num_samples=16)(frame), reference, masks=masks)
    assert float(ours["flip"]) < flip * float(lines["flip"])
    assert float(ours["psnr_band"]) > float(lines["psnr_band"]) + decibels
