"""The filter of the 2025 notes against its slow twin."""

import pytest
import torch
from twins.notes2025 import DEFAULTS, notes2025
from twins.reconstruction import within_tiles

from torchblur.filters.notes2025 import Notes2025Blur
from torchblur.ops.noise import noise_plane
from torchblur.testing.frames import moving_square, random_frame

ONE = {"directions": "one", "depth_level": 0.5, "direction_weights": False}
HALF = {"resolution": "half"}
OURS = {"background", "background_depth"}  # the revealed background is not in the text
GAPS = {"num_samples": 4, "shutter": 1.5}
CASES = [
    {},
    {"post_filter": False},
    {"post_filter": False, "accurate_alpha": False, "double_samples": False},
    ONE,
    ONE | {"separate_sums": False, "post_filter": False},
    ONE | {"spread_compare": "slides", "mirror_filter": "none", "accurate_alpha": False},
    {"separate_sums": False, "num_samples": 5, "tile_size": 7},
    {"tile_size": 5, "direction_reduction": "hierarchical", "min_angle": 25.0},
    {"tile_size": 8, "direction_reduction": "hierarchical", "neighbor_culling": True},
    {"tile_size": 6, "neighbor_culling": True, "secondary_exponent": 0.5},
    {"tile_size": 7, "tile_jitter": 1.5, "noise": "halton", "jitter": 1.7, "seed": 3},
    {"depth_compare": "relative", "relative_depth_range": 0.4, "mirror_filter": "strict"},
    {"depth_range": 0.3, "spread_offset": 0.4, "spread_slope": 2.5, "direction_exponent": 0.7},
    {"alpha_combination": "mean", "area_slope": 0.6, "alpha_gain": 2.5, "early_out": 2.0},
    {"center_weight": 0.7, "background_fade": 0.4, "post_alpha": "output"},
    GAPS,
    GAPS | {"post_alpha": "output", "post_edges": False, "post_radius": 1.1},
    GAPS | {"post_threshold": 0.3, "post_zero_alpha": 0.1, "post_samples": 12},
    GAPS | {"post_acceptance": "soft", "post_tau": 0.4, "post_zero_alpha": 0.2},
    GAPS | {"post_center_weight": 3.0, "accurate_alpha": False},
    {"color_lookup": "nearest", "noise": "gradient"},
    {"color_lookup": "bilinear", "num_samples": 9},
    {"tile_size": 3, "bilinear_min": 0.4, "shutter": 0.3},
    {"shutter_position": "leading", "tile_size": 20},
    ONE | {"shutter_position": "trailing"},
    {"tile_classes": True, "fast_ratio": 0.3, "tile_size": 3, "min_angle": 40.0},
    ONE | {"tile_classes": True, "fast_ratio": 0.4, "tile_size": 4, "separate_sums": False},
    {
        "tile_classes": True,
        "fast_ratio": 0.2,
        "tile_size": 4,
        "min_angle": 89.0,
        "depth_level": 0.7,
    },
    HALF,
    HALF | ONE,
    HALF | ONE | {"tile_classes": True, "fast_ratio": 0.3, "tile_size": 5},
    HALF | {"tile_size": 4, "early_out": 1.2, "shutter": 0.4},
    HALF | ONE | {"separate_sums": False, "tile_size": 9},
    HALF | GAPS | {"post_alpha": "output", "alpha_fade": False},
    HALF | {"shutter": 0.15, "fade_start": 0.5, "fade_end": 3.0, "fade_min_alpha": 0.2},
    HALF | {"upsample_depth_range": 0.05, "corner_fallback": False, "depth_range": 0.2},
    HALF | {"upsample_depth_range": 0.05, "downsample_depth_range": 0.2},
    HALF | {"upsample_depth_weights": False, "background_fade": 0.5},
    HALF | {"alpha_weighted_color": False, "depth_compare": "relative"},
]


def both(frame, params):
    blur = Notes2025Blur(**params)
    config = blur.config
    kinds = (config.noise if config.noise != "checkerboard" else "none", config.noise)
    kinds = kinds[0], "gradient" if kinds[1] == "checkerboard" else kinds[1]
    planes = [
        noise_plane(kind, frame.color, stream, config.seed)[0, 0].numpy()
        for stream, kind in enumerate(kinds)
    ]
    arrays = [plane[0].numpy() for plane in (frame.color, frame.depth, frame.velocity)]
    settings = config.model_dump(exclude=OURS)
    twin = notes2025(*arrays, tap_noise=planes[0], tile_noise=planes[1], **settings)
    return blur.layers(frame), twin


@pytest.mark.parametrize("params", CASES, ids=str)
@pytest.mark.parametrize("make_frame", [random_frame, moving_square], ids=["random", "square"])
def test_filter_equals_its_twin(params, make_frame):
    # Speeds below the tiles' reach: the filter chooses by the length before the clamp.
    reach = params.get("tile_size", 32) / (1 if "shutter_position" not in params else 2)
    frame = make_frame(13, 16, dtype=torch.float64)
    longest = frame.velocity.square().sum(1).sqrt().max() * params.get("shutter", 0.5) / 2
    scale = min(1.0, 0.95 * reach / float(longest))
    frame = frame.map(lambda t: t * scale if t.shape[1] == 2 else t)
    layers, twin = both(frame, params)
    for key in ("color", "alpha", "output_alpha"):
        expected = torch.from_numpy(twin[key])[None]
        # float32 parameters and half-way roundings: a few pixels may take another neighbor.
        wrong = ((layers[key].detach() - expected).abs() > 2e-5).any(1)
        assert float(wrong.double().mean()) <= 0.005, key
    assert not torch.allclose(layers["color"].detach(), frame.color, atol=0.01)


def test_the_twin_has_the_defaults_of_the_filter():
    assert within_tiles(Notes2025Blur().config.model_dump(exclude=OURS)) == DEFAULTS


def test_the_comparison_can_fail():
    frame = random_frame(13, 16, dtype=torch.float64)
    layers, _ = both(frame, {})
    other = Notes2025Blur(direction_exponent=3.3)(frame).detach()
    wrong = ((other - layers["color"].detach()).abs() > 2e-5).any(1)
    assert float(wrong.double().mean()) > 0.5
