import dataclasses

import pytest
import torch
from layered import disk_scene

from torchblur.errors import FrameError
from torchblur.filters import get_filter
from torchblur.filters.parts.revealed import behind_slope, share_behind
from torchblur.frame import Frame, Shutter
from torchblur.io import read_frame, read_image
from torchblur.metrics import border_band, evaluate
from torchblur.testing.frames import moving_square

FILTERS = ("guertin2014", "jimenez2014", "mcguire2012", "notes2025")
QUIET = {"noise": "none", "num_samples": 31, "tile_size": 28, "shutter": 1.0}


def blur(name, frame, **params):
    with torch.no_grad():
        return get_filter(name)(**(QUIET | params))(frame)


def squared_error(image, reference, where):
    return float((image - reference).square().mean(1, keepdim=True)[where].mean())


@pytest.mark.parametrize("name", FILTERS)
def test_it_shows_the_edge_behind_a_moving_disk(name):
    frame, reference = disk_scene()
    band = border_band(frame, Shutter(1.0)) & (frame.object_id == 7)
    params = {}
    if name in ("guertin2014", "mcguire2012"):
        # Their cones and the third weight let little through; with boxes the color is what counts.
        params = {"cone_exponent": 0.1, "third_gain": 0.0, "depth_level": 0.5}
    guessed = squared_error(blur(name, frame, **params), reference, band)
    known = squared_error(blur(name, frame, background="revealed", **params), reference, band)
    assert known < 0.25 * guessed


@pytest.mark.parametrize("name", FILTERS)
def test_background_that_moves_behind_a_still_disk(name):
    # The first-person case: beside the disk the background comes out from behind it.
    frame, reference = disk_scene(speed=0.0, flow=20.0)
    beside = border_band(frame, Shutter(1.0)) & (frame.object_id != 7)
    guessed = squared_error(blur(name, frame), reference, beside)
    known = squared_error(blur(name, frame, background="revealed"), reference, beside)
    assert known < 0.8 * guessed


@pytest.mark.parametrize("name", FILTERS)
def test_a_layer_that_is_nowhere_valid_changes_nothing(name):
    frame = moving_square()
    nowhere = torch.zeros(1, 1, *frame.size, dtype=torch.bool)
    empty = dataclasses.replace(frame.revealed, valid=nowhere)
    frame = dataclasses.replace(frame, revealed=empty)
    assert torch.equal(blur(name, frame, background="revealed"), blur(name, frame))


@pytest.mark.parametrize("name", FILTERS)
def test_a_layer_is_used_where_it_is_valid(name):
    frame, _ = disk_scene()
    upper = torch.zeros(1, 1, *frame.size, dtype=torch.bool)
    upper[..., :28, :] = True
    traced = upper & (frame.object_id == 7)
    wrong = torch.where(traced, frame.revealed.color, 50.0)  # untraced pixels hold nonsense
    part = dataclasses.replace(frame.revealed, color=wrong, valid=traced)
    partial = dataclasses.replace(frame, revealed=part)
    got = blur(name, partial, background="revealed")
    assert float(got.max()) < 1
    # the tile's taps are horizontal: rows do not mix
    hidden = traced & border_band(frame, Shutter(1.0))
    guessed, known = blur(name, frame), blur(name, frame, background="revealed")
    same = (got - guessed).abs().amax(1, keepdim=True) == 0
    assert bool(same[..., 30:, :].all())
    assert bool(torch.isclose(got, known, atol=1e-6).all(1, keepdim=True)[hidden].all())
    assert not bool(same[hidden].all())


@pytest.mark.parametrize("name", FILTERS)
def test_no_layer_is_an_error_that_names_it(name):
    frame = dataclasses.replace(moving_square(), revealed=None, source="shot.exr")
    with pytest.raises(FrameError, match=r"`revealed` is needed and is missing \(shot\.exr\)"):
        blur(name, frame, background="revealed")
    assert torch.equal(blur(name, frame), blur(name, moving_square()))


def test_a_layer_without_depth_is_an_error():
    frame = moving_square()
    flat = Frame(color=frame.color, velocity=frame.velocity, source="behind.exr")
    with pytest.raises(FrameError, match=r"`depth` is needed and is missing \(behind\.exr\)"):
        blur("guertin2014", dataclasses.replace(frame, revealed=flat), background="revealed")


def test_share_of_a_tap_by_hand():
    frame, _ = disk_scene(size=(12, 12))
    slope = behind_slope(frame, 0.5)
    # at the disk 1 / (½ · (1 − 2/6)); elsewhere nothing is hidden
    assert slope.unique().tolist() == pytest.approx([0, 3])
    depths = torch.tensor([1.0, 2.0, 2.2, 3.0, 6.0])
    share = share_behind(torch.tensor(3.0), torch.tensor(2.0), depths)
    assert share.tolist() == pytest.approx([0, 0, 3 * 0.2 / 2.2, 1, 1])
    sky = dataclasses.replace(
        frame, revealed=dataclasses.replace(frame.revealed, depth=frame.depth * torch.inf)
    )
    assert torch.allclose(behind_slope(sky, 1.0), torch.ones(1, 1, 12, 12))


def test_half_resolution_has_a_revealed_layer_of_its_own():
    frame, reference = disk_scene()
    band = border_band(frame, Shutter(1.0)) & (frame.object_id == 7)
    half = {"resolution": "half"}
    guessed = squared_error(blur("notes2025", frame, **half), reference, band)
    known = blur("notes2025", frame, background="revealed", **half)
    assert squared_error(known, reference, band) < 0.5 * guessed


@pytest.mark.parametrize("name", FILTERS)
def test_gradients_reach_the_revealed_layer(name):
    frame = moving_square()
    layers = [t.clone().requires_grad_() for t in frame.revealed.layers().values()]
    behind = Frame(**dict(zip(frame.revealed.layers(), layers, strict=True)))
    module = get_filter(name)(background="revealed")
    module(dataclasses.replace(frame, revealed=behind)).square().sum().backward()
    for layer in layers:
        assert bool(torch.isfinite(layer.grad).all())
        assert float(layer.grad.abs().sum()) > 0


@pytest.mark.shared
@pytest.mark.parametrize(
    ("case", "name", "gain"),
    [("vase", "jimenez2014", 5.0), ("vase", "guertin2014", 0.2), ("weapon", "mcguire2012", 0.6)],
)
def test_it_comes_nearer_to_a_path_traced_reference(shared_data, case, name, gain):
    frame = read_frame(shared_data / case)
    reference = read_image(shared_data / case / "reference.exr")
    masks = {"band": border_band(frame, Shutter(0.5))}
    make = get_filter(name)
    with torch.no_grad():
        guessed, known = (
            evaluate(make(background=kind)(frame), reference, masks=masks)
            for kind in ("guessed", "revealed")
        )
    assert float(known["psnr_band"]) > float(guessed["psnr_band"]) + gain
    assert float(known["flip_band"]) < float(guessed["flip_band"])
    assert float(known["ssim_band"]) > float(guessed["ssim_band"])


@pytest.mark.parametrize("name", FILTERS)
def test_a_layer_with_holes_does_no_harm_where_the_frame_shows_it(name):
    frame, _ = disk_scene(flow=16.0)
    # Traced in stripes of the background alone: nothing that the disk hides.
    known = ((torch.arange(88) // 4) % 2 == 0).view(1, 1, 1, 88) & (frame.object_id != 7)
    holes = dataclasses.replace(frame.revealed, valid=known)
    guessed = blur(name, frame)
    assert torch.allclose(
        blur(name, dataclasses.replace(frame, revealed=holes), background="revealed"), guessed
    )
