"""torchblur's own filter against its slow twin, and the twin against what is known."""

import pytest
import torch
from twins.torchblur import DEFAULTS, torchblur

from torchblur.filters.torchblur import TorchblurBlur
from torchblur.ops.noise import noise_plane
from torchblur.testing.frames import moving_square, random_frame

FEW = {"num_samples": 6}
BLEND, DROP = FEW | {"arrivals": "blend"}, FEW | {"hidden_times": "drop"}
TILES = {"reach": "tile", "tile_size": 20, "tap_spacing": 0.0, "early_out": 0.505}
OF_TILES = [
    {},
    BLEND,
    DROP,
    BLEND | DROP,
    {"background_gain": 2.0, "depth_level": 0.7, "relative_depth_extent": 0.3, "num_samples": 9},
    BLEND | {"background_gain": 0.5, "depth_classes": "independent", "shutter_position": "leading"},
    {"num_samples": 5, "tile_size": 7, "refinements": 0},
    FEW | {"match_tolerance": 3.0, "match_slope": 0.2, "refinements": 1, "edge_motion": "own"},
    FEW | {"edge_motion": "surface", "edge_depth": 0.1, "depth_compare": "absolute"},
    FEW | {"center_taps": 0.7, "background_gain": 3.0},
    FEW | {"missing_background": "center", "background_fade": 0.5, "center_taps": 1.5},
    FEW | {"background_fade": 0.3, "alpha_gain": 0.6, "depth_level": 0.8},
    FEW | {"depth_classes": "independent", "soft_depth_extent": 0.5, "relative_depth_extent": 0.3},
    FEW | {"first_direction": False, "second_direction": False, "color_lookup": "bilinear"},
    {"reversed_direction": False, "num_samples": 6},
    FEW | {"own_direction": False, "neighbor_culling": True, "tile_size": 5},
    FEW | {"shutter_position": "leading", "noise": "halton", "seed": 2},
    FEW | {"shutter_position": "trailing", "tile_jitter": 1.5, "noise": "gradient", "tile_size": 9},
    FEW | {"direction_reduction": "hierarchical", "secondary_exponent": 0.6, "tile_size": 6},
    FEW | {"color_lookup": "nearest", "early_out": 1.8, "tile_size": 4},
]
FAR = [
    {},
    FEW | {"tile_size": 2},
    FEW | {"tile_size": 3, "shutter_position": "leading"},
    FEW | {"tile_size": 2, "shutter_position": "trailing", "secondary_exponent": 0.7},
    {"num_samples": 3, "tile_size": 4, "tap_spacing": 0.7, "max_samples": 17, "shutter": 1.5},
    {"num_samples": 4, "tile_size": 4, "tap_spacing": 1.0, "second_direction": False},
]
CASES = [TILES | case for case in OF_TILES] + FAR


def both(frame, params):
    blur = TorchblurBlur(**params)
    planes = [
        noise_plane(blur.config.noise, frame.color, stream, blur.config.seed)[0, 0].numpy()
        for stream in (0, 1)
    ]
    arrays = [plane[0].numpy() for plane in (frame.color, frame.depth, frame.velocity)]
    settings = blur.config.model_dump(include=set(DEFAULTS))
    return blur.layers(frame), torchblur(
        *arrays, tap_noise=planes[0], tile_noise=planes[1], **settings
    )


def slowed(frame, params):
    """The frame at speeds within the tiles' reach: the filter chooses before it clamps."""
    if "reach" not in params:
        return frame
    reach = params["tile_size"] / (1 if "shutter_position" not in params else 2)
    longest = float(frame.velocity.square().sum(1).sqrt().max()) / 4
    scale = min(1.0, 0.95 * reach / longest)
    return frame.map(lambda t: t * scale if t.shape[1] == 2 else t)


@pytest.mark.parametrize("params", CASES, ids=str)
@pytest.mark.parametrize("make_frame", [random_frame, moving_square], ids=["random", "square"])
def test_filter_equals_its_twin(params, make_frame):
    frame = slowed(make_frame(10, 13, dtype=torch.float64), params)
    layers, twin = both(frame, params)
    for key in ("color", "alpha"):
        expected = torch.from_numpy(twin[key])[None]
        # float32 parameters and half-way roundings: a few pixels may take another neighbor.
        wrong = ((layers[key].detach() - expected).abs() > 2e-5).any(1)
        assert float(wrong.double().mean()) <= 0.01, key
    assert not torch.allclose(layers["color"].detach(), frame.color, atol=0.01)


def test_the_comparison_can_fail():
    frame = random_frame(13, 16, dtype=torch.float64)
    layers, _ = both(frame, {})
    other = TorchblurBlur(match_tolerance=1.3)(frame).detach()
    wrong = ((other - layers["color"].detach()).abs() > 2e-5).any(1)
    assert float(wrong.double().mean()) > 0.3


def test_the_twin_has_the_defaults_of_the_filter():
    config = TorchblurBlur().config.model_dump()
    assert {key: config[key] for key in DEFAULTS} == DEFAULTS
