from torchblur.filters.composed import ComposedBlur, composed
from torchblur.testing.contract import FilterContract

ALTERNATE = {"sampling": "alternate", "resolve": "normalized"}
PAIRS = {"sampling": "pairs"}
RAMP = PAIRS | {"spread": "ramp"}
NOTES = RAMP | {
    "third_form": "none",
    "own_direction": False,
    "edge_motion": "own",
    "missing_background": "center",
}
GAPS = NOTES | {"post_filter": True, "num_samples": 4, "shutter": 1.5}
BLEND = ALTERNATE | {"center_direction": "blend"}


class TestComposed(FilterContract):
    filter_class = ComposedBlur
    function = staticmethod(composed)
    plain = {"num_samples": 7}  # few lookups half way between pixels, where rounding decides
    one_structure = ALTERNATE
    acts_with = {
        "background_depth": {"background": "revealed"},
        "early_out": {"tile_size": 2},
        "foreground_gain": {"resolve": "normalized"},
        "background_gain": {"resolve": "normalized"},
        "cone_slope": ALTERNATE,
        "cone_exponent": ALTERNATE,
        "cylinder_inner": ALTERNATE,
        "cylinder_outer": ALTERNATE,
        "third_gain": ALTERNATE,
        "third_form": ALTERNATE,
        "min_length": ALTERNATE,
        "spread": PAIRS,
        "spread_offset": RAMP,
        "spread_slope": RAMP,
        "spread_compare": RAMP | {"spread_offset": 2.0},
        "direction_weights": ALTERNATE,
        "direction_exponent": ALTERNATE,
        "center_direction": ALTERNATE,
        "gamma": BLEND,
        "own_direction_against": ALTERNATE,
        "tap_length": ALTERNATE,
        "mirror_filter": PAIRS,
        "skip_middle_tap": ALTERNATE | {"num_samples": 7},
        "soft_depth_extent": {"depth_compare": "absolute"},
        "seed": {"noise": "halton"},
        "jitter": {"noise": "halton"},
        "tile_jitter": {"noise": "halton", "tile_size": 8},
        "noise": {"tile_size": 8},
        "neighbor_culling": {"tile_size": 5, "reach": "tile"},
        "direction_reduction": PAIRS | {"tile_size": 5, "edge_motion": "own", "reach": "tile"},
        "secondary_exponent": PAIRS | {"tile_size": 8, "own_direction": False},
        "min_angle": PAIRS | {"tile_size": 4, "own_direction": False},
        "bilinear_min": {"tile_size": 2, "color_lookup": "opportunistic"},
        "color_lookup": {"tile_size": 4},
        "double_samples": PAIRS | {"tile_size": 4},
        "tile_classes": PAIRS | {"tile_size": 2, "shutter": 0.8},
        "fast_ratio": PAIRS | {"tile_size": 2, "shutter": 0.8, "tile_classes": True},
        "center_weight": {"resolve": "normalized"},
        "kappa": {"resolve": "normalized", "center_weight": True},
        "alpha_combination": PAIRS,
        "accurate_alpha": PAIRS,
        "area_slope": PAIRS,
        "missing_background": {"spread": "ramp", "third_form": "none"},
        "background_fade": {"spread": "ramp", "third_form": "none"},
        **{f"post_{name}": GAPS for name in ("samples", "radius", "alpha", "acceptance")},
        "post_filter": NOTES | {"num_samples": 4, "shutter": 1.5},
        "post_threshold": GAPS,
        "post_zero_alpha": GAPS,
        "post_edges": GAPS | {"tap_spacing": 0.0},
        "post_tau": GAPS | {"post_acceptance": "soft"},
        "post_center_weight": GAPS,
    }
