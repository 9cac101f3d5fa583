import pytest
import torch

from torchblur.filters.torchblur import TorchblurBlur, torchblur
from torchblur.frame import Frame
from torchblur.testing.contract import FilterContract
from torchblur.testing.frames import moving_square


class TestTorchblur(FilterContract):
    filter_class = TorchblurBlur
    function = staticmethod(torchblur)
    plain = {"num_samples": 7}  # few lookups half way between pixels, where rounding decides
    one_structure = {  # all directions with what they find take minutes to compile
        "first_direction": False,
        "second_direction": False,
        "reversed_direction": False,
        "refinements": 1,
    }
    acts_with = {
        "depth_classes": {"arrivals": "blend", "hidden_times": "drop"},
        "background_depth": {"background": "revealed"},
        "early_out": {"tile_size": 2},
        "background_gain": {"center_taps": 1.0},
        "soft_depth_extent": {"depth_compare": "absolute"},
        "seed": {"noise": "halton"},
        "jitter": {"noise": "halton"},
        "tile_jitter": {"noise": "halton", "tile_size": 8},
        "noise": {"tile_size": 8},
        "neighbor_culling": {"tile_size": 5, "reach": "tile"},
        "direction_reduction": {"tile_size": 5, "edge_motion": "own", "reach": "tile"},
        "secondary_exponent": {"tile_size": 8, "own_direction": False},
        "color_lookup": {"tile_size": 4},
        "missing_background": {"tile_size": 8},
        "background_fade": {"tile_size": 8},
    }


def strip(front=(0.0, 0.0), back=(0.0, 0.0), columns=(24, 40), size=(24, 64)):
    """A white strip at depth 1 before a dark background at depth 9; velocities in px/frame."""
    inside = torch.zeros(1, 1, *size, dtype=torch.bool)
    inside[..., columns[0] : columns[1]] = True
    motion = torch.where(
        inside, torch.tensor(front).view(1, 2, 1, 1), torch.tensor(back).view(1, 2, 1, 1)
    )
    return Frame(
        color=inside.expand(1, 3, *size).float(),
        velocity=motion,
        depth=torch.where(inside, 1.0, 9.0),
    )


def row(frame, **params):
    return TorchblurBlur(num_samples=96, **params)(frame).detach()[0, 0, 12]


def ramp(reach, columns=(24, 40), width=64):
    """The share of the time at which a strip of that half spread covers each column."""
    x = torch.arange(width) + 0.5
    left = ((x - columns[0]) / (2 * reach) + 0.5).clamp(0, 1)
    right = ((columns[1] - x) / (2 * reach) + 0.5).clamp(0, 1)
    return (left + right - 1).clamp(0, 1)


@pytest.mark.parametrize("back", [(0.0, 0.0), (40.0, 0.0), (0.0, 40.0)])
def test_a_strip_over_a_background_is_a_ramp(back):
    # Half spread 4 px, also where the background moves faster, with the strip or across.
    found = row(strip((16.0, 0.0), back), edge_motion="own")
    assert float((found - ramp(4.0)).abs().max()) < 0.04


def test_what_moves_slower_against_the_dominant_motion_needs_the_other_side():
    frame = strip((16.0, 0.0), (-40.0, 0.0))
    found, without = (
        row(frame, reversed_direction=on, edge_motion="own")[40:44] for on in (True, False)
    )
    assert float(without.max()) < 0.02
    assert float((found - ramp(4.0)[40:44]).abs().max()) < 0.04


def test_hidden_times_are_filled_with_the_background():
    frame = strip((16.0, 0.0), (-40.0, 0.0))
    errors = {
        kind: float((row(frame, hidden_times=kind, edge_motion="own") - ramp(4.0)).abs().max())
        for kind in ("fill", "drop")
    }
    assert errors["fill"] < 0.04
    assert errors["drop"] > 0.3


def test_a_still_front_stays_sharp_before_a_fast_background():
    frame = strip((0.0, 0.0), (40.0, 0.0))
    found = row(frame)
    assert torch.equal(found[24:40], torch.ones(16))
    assert float(found[:24].max()) < 0.05
    assert float(found[40:].max()) < 0.05


def test_averaged_motion_at_an_edge_makes_holes_that_the_nearest_motion_closes():
    frame = strip((24.0, 0.0))
    velocity = frame.velocity.clone()
    velocity[:, 0, :, 23] = velocity[:, 0, :, 40] = 12.0  # as a renderer averages it
    frame = Frame(color=frame.color, velocity=velocity, depth=frame.depth)
    errors = {
        kind: float((row(frame, edge_motion=kind) - ramp(6.0)).abs().mean())
        for kind in ("own", "nearest")
    }
    assert errors["nearest"] < 0.05
    assert errors["own"] > 0.0


def test_motion_that_grows_with_the_distance_needs_refinements():
    # Everything moves away from the middle by its distance: at time t a pixel p shows p / (1 + kt).
    y, x = torch.meshgrid(torch.arange(64) - 31.5, torch.arange(64) - 31.5, indexing="ij")
    half = 0.2
    velocity = torch.stack((x, y))[None] * half * 4

    def waves(u, v):
        return (0.5 + 0.5 * torch.sin(1.3 * u) * torch.sin(1.1 * v)).expand(1, 3, 64, 64)

    frame = Frame(color=waves(x, y), velocity=velocity, depth=torch.full_like(velocity[:, :1], 3.0))
    scales = [1 + half * ((2 * i + 1) / 48 - 1) for i in range(48)]
    truth = torch.stack([waves(x / scale, y / scale) for scale in scales]).mean(0)
    inner = (..., slice(12, -12), slice(12, -12))
    blur = TorchblurBlur(num_samples=48, arrivals="blend", hidden_times="drop")
    errors = [float((blur(frame, refinements=n) - truth)[inner].abs().mean()) for n in (0, 1, 2)]
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < errors[1]


def test_cubic_lookups_keep_detail_and_the_range():
    frame = moving_square()
    bright = Frame(color=frame.color**8 * 1000, velocity=frame.velocity, depth=frame.depth)
    blurred = {
        kind: TorchblurBlur(color_lookup=kind)(bright).detach() for kind in ("bilinear", "cubic")
    }
    assert float(blurred["cubic"].min()) >= 0.0
    assert float(blurred["cubic"].std()) > float(blurred["bilinear"].std())
