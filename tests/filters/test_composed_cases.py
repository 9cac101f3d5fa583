"""Published filters are special cases of the composed one."""

import dataclasses

import pytest
import torch

from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.filters.composed import ComposedBlur
from torchblur.filters.composed.cases import SPECIAL_CASES, special_case
from torchblur.frame import Frame
from torchblur.io import read_frame
from torchblur.testing.frames import constant_motion, moving_square, random_frame

ONE = {"directions": "one", "depth_level": 0.5, "direction_weights": False}
GAPS = {"num_samples": 4, "shutter": 1.5}
CASES = {
    "mcguire2012": [
        {},
        {"reach": "frame", "tile_size": 4, "tap_spacing": 1.0, "shutter": 1.5},
        {"noise": "none", "num_samples": 8, "tile_size": 7},
        {"noise": "gradient", "skip_middle_tap": False, "tile_size": 11, "softness": 0.2},
        {"shutter_position": "leading", "jitter": 1.7, "cone_slope": 0.6, "cone_exponent": 0.3},
        {"third_gain": 7.0, "foreground_gain": 0.5, "background_gain": 3.0, "center_gain": 5.0},
        {"shutter_position": "trailing", "cylinder_inner": 0.4, "cylinder_outer": 1.9},
        {"background": "revealed", "background_depth": 0.6, "color_lookup": "bilinear"},
    ],
    "guertin2014": [
        {},
        {"reach": "frame", "tile_size": 4, "tap_spacing": 1.0, "shutter": 1.5, "num_samples": 6},
        {"num_samples": 12, "tile_size": 9, "seed": 3},
        {"noise": "gradient", "tile_size": 7, "tau": 1.8, "neighbor_culling": False},
        {"directions": "one", "tile_size": 8},
        {"direction_weights": False, "tile_size": 8},
        {"own_direction_against": "tile", "direction_exponent": 2.5, "tile_size": 6},
        {"tap_length": "own", "tile_size": 10, "gamma": 4.0},
        {"stochastic_tiles": False, "center_weight": False, "color_lookup": "bilinear"},
        {"depth_compare": "absolute", "soft_depth_extent": 0.7, "depth_level": 0.5},
        {"velocity_encoding": "uint8", "tile_size": 12, "relative_depth_extent": 0.1},
        {"shutter_position": "trailing", "third_gain": 9.0, "kappa": 5.0, "eta": 0.3},
        {"background": "revealed", "min_length": 1.5, "early_out": 2.0, "phi": 60.0},
    ],
    "jimenez2014": [
        {},
        {"reach": "frame", "tile_size": 3, "tap_spacing": 1.0, "shutter": 1.5, "num_samples": 6},
        {"num_samples": 9, "tile_size": 7, "mirror_filter": "strict"},
        {"noise": "gradient", "tile_size": 6, "tile_jitter": 1.7, "seed": 3},
        {"noise": "halton", "jitter": 1.6, "mirror_filter": "none", "depth_scale": 0.3},
        {"depth_compare": "relative", "depth_level": 0.8, "spread_compare": "static_zero"},
        {"spread_offset": 1.8, "spread_slope": 0.4, "tile_encoding": "uint8"},
        {"tile_classes": False, "neighbor_culling": True, "tile_size": 5},
        {"fast_ratio": 0.3, "early_out": 1.2, "tile_size": 3, "color_lookup": "bilinear"},
        {"shutter_position": "leading", "tile_size": 16, "background": "revealed"},
    ],
    "notes2025": [
        {},
        {
            "reach": "frame",
            "tile_size": 3,
            "tap_spacing": 1.0,
            "shutter": 1.5,
            "post_filter": False,
        },
        ONE,
        {"post_filter": False, "accurate_alpha": False, "double_samples": False},
        ONE | {"separate_sums": False, "post_filter": False},
        ONE | {"spread_compare": "slides", "mirror_filter": "none"},
        {"separate_sums": False, "num_samples": 5, "tile_size": 7},
        {"tile_size": 5, "direction_reduction": "hierarchical", "min_angle": 25.0},
        {"tile_size": 6, "neighbor_culling": True, "secondary_exponent": 0.5},
        {"tile_size": 7, "tile_jitter": 1.5, "noise": "halton", "jitter": 1.7, "seed": 3},
        {"depth_compare": "relative", "relative_depth_range": 0.4, "mirror_filter": "strict"},
        {"alpha_combination": "mean", "area_slope": 0.6, "alpha_gain": 2.5, "early_out": 2.0},
        {"center_weight": 0.7, "background_fade": 0.4, "post_alpha": "output"},
        GAPS | {"post_alpha": "output", "post_edges": False, "post_radius": 1.1},
        GAPS | {"post_acceptance": "soft", "post_tau": 0.4, "post_zero_alpha": 0.2},
        {"tile_size": 3, "bilinear_min": 0.4, "color_lookup": "nearest"},
        {"shutter_position": "leading", "direction_exponent": 0.7, "background": "revealed"},
    ],
}


SIZE = (23, 31)


def still():
    return random_frame(*SIZE, speed=0.0, dtype=torch.float64)


def frames(revealed):
    """Frames by name: those with a revealed layer, or a batch of all kinds and one with holes."""
    square = moving_square(*SIZE, dtype=torch.float64)
    valid = torch.ones(1, 1, *SIZE, dtype=torch.bool)
    valid[..., 8:12, 8:12] = False
    holes = dataclasses.replace(square, valid=valid)
    if revealed:
        return {"square": square, "holes": holes}
    uniform = constant_motion((13.0, -6.0), *SIZE).to(dtype=torch.float64)
    noise = random_frame(*SIZE, batch_size=2, dtype=torch.float64)
    return {"batch": Frame.stack([noise, square, still(), uniform]), "holes": holes}


def apart(name, params, frame):
    """Return the share of pixels in which the composed filter differs, of each image."""
    published = get_filter(name)(**params)(frame).detach()
    composed = ComposedBlur(special_case(name, **params))(frame).detach()
    return ((composed - published).abs() > 1e-5).any(1).double().mean((1, 2))


@pytest.mark.parametrize(
    ("name", "params"), [(n, p) for n, cases in CASES.items() for p in cases], ids=str
)
def test_a_published_filter_is_a_special_case(name, params):
    for label, frame in frames(params.get("background") == "revealed").items():
        # Sums in another order: half-way positions may take another pixel, once in a while.
        assert float(apart(name, params, frame).max()) <= 0.002, label


@pytest.mark.parametrize("name", SPECIAL_CASES)
def test_so_it_is_where_nothing_moves(name):
    assert apart(name, {}, still()) == 0


@pytest.mark.parametrize("name", SPECIAL_CASES)
def test_the_comparison_can_fail(name):
    frame = moving_square(dtype=torch.float64)
    published = get_filter(name)()(frame).detach()
    other = ComposedBlur(special_case(name, tile_size=9))(frame).detach()
    assert float(((other - published).abs() > 1e-5).any(1).double().mean()) > 0.3


@pytest.mark.shared
@pytest.mark.parametrize("name", SPECIAL_CASES)
def test_on_frames_of_another_renderer(name, shared_data):
    frame = read_frame(shared_data / "vase" / "sharp.exr", "blender").crop(120, 200, 120, 160)
    frame = Frame(color=frame.color, depth=frame.depth, velocity=frame.velocity).to(
        dtype=torch.float64
    )
    assert float(apart(name, {}, frame)) <= 0.002


def test_a_config_is_taken_over_with_changes():
    config = get_filter("guertin2014")(kappa=12.0).config
    case = special_case("guertin2014", config, tau=0.3)
    assert (case.kappa, case.tile_jitter, case.sampling) == (12.0, 0.3, "alternate")


@pytest.mark.parametrize(
    ("name", "params", "message"),
    [
        ("sousa2013", {}, "guertin2014, jimenez2014, mcguire2012, notes2025, got `sousa2013`"),
        ("guertin2014", {"sample_assignment": "variance"}, "`sample_assignment`.*'variance'"),
        ("notes2025", {"resolution": "half"}, "`resolution` must be 'full'.*'half'"),
        ("notes2025", {"tile_classes": True}, "`tile_classes` of notes2025 must be off"),
        ("guertin2014", {"kapa": 3}, "`kapa`.*did you mean `kappa`"),
        ("guertin2014", {"num_samples": 1, "phi": 90.0}, r"`jitter` must lie in .*got 171"),
    ],
)
def test_what_is_no_special_case(name, params, message):
    with pytest.raises(ConfigError, match=message):
        special_case(name, **params)
