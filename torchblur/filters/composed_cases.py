"""Published filters as sets of parameters of torchblur's own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torchblur.errors import ConfigError
from torchblur.filters.base import FilterConfig
from torchblur.filters.composed_config import ComposedConfig
from torchblur.filters.guertin2014_config import Guertin2014Config
from torchblur.filters.jimenez2014_config import Jimenez2014Config
from torchblur.filters.mcguire2012 import McGuire2012Config
from torchblur.filters.notes2025_config import Notes2025Config
from torchblur.filters.reconstruction import WEIGHT_PARAMETERS, ReconstructionConfig
from torchblur.filters.registry import get_filter
from torchblur.params import build

__all__ = ["SPECIAL_CASES", "special_case"]

_ALL = (
    "shutter",
    "shutter_position",
    "background",
    "background_depth",
    "num_samples",
    "tile_size",
    "early_out",
    "softness",
    "color_lookup",
    "noise",
    "seed",
    "depth_level",
    "reach",
    "max_reach",
    "tap_spacing",
    "max_samples",
)
_RAMP = ("spread_offset", "spread_slope", "spread_compare", "mirror_filter")


def special_case(name: str, config: FilterConfig | None = None, **params: Any) -> ComposedConfig:
    """Return the parameters with which the composed filter is a published one.

    The color is the same to rounding, whatever the published filter's parameters, but for 8-bit
    velocities of the 2025 notes, which may differ by a step.

    Args:
        name: A name in `SPECIAL_CASES`.
        config: Parameters of the published filter; its defaults if left out.
        **params: Single ones over those.

    Raises:
        ConfigError: no such case, or a parameter that the composed filter does not have: taps
            assigned by variance (guertin2014), half resolution (notes2025).

    Example:
        >>> special_case("guertin2014", kappa=20.0).kappa
        20.0
    """
    if name not in SPECIAL_CASES:
        known = ", ".join(sorted(SPECIAL_CASES))
        raise ConfigError(f"the special cases of the composed filter are {known}, got `{name}`")
    kind = get_filter(name).config_class
    start = {} if config is None else config.model_dump()
    published = build(kind, start | params, name)
    return build(ComposedConfig, SPECIAL_CASES[name](published), f"composed, as {name}")


def _shared(config: FilterConfig, *names: str) -> dict[str, Any]:
    common = {"edge_motion": "own", "own_direction": False, "second_direction": False}
    return common | {key: getattr(config, key) for key in (*_ALL, *names)}


def _tapered(config: ReconstructionConfig) -> dict[str, Any]:
    """Return what McGuire 2012 and Guertin 2014 have in common."""
    return _shared(config, *WEIGHT_PARAMETERS) | {
        "sampling": "alternate",
        "depth_classes": "independent",
        "spread": "cone",
        "resolve": "normalized",
    }


def _mcguire2012(config: McGuire2012Config) -> dict[str, Any]:
    return _tapered(config) | {
        "third_form": "product",
        "depth_compare": "absolute",
        "soft_depth_extent": config.soft_depth_extent,
        "direction_weights": False,
        "center_weight": True,
        "kappa": config.num_samples / config.center_gain,
        "jitter": config.jitter,
        "skip_middle_tap": config.skip_middle_tap,
    }


def _guertin2014(config: Guertin2014Config) -> dict[str, Any]:
    if config.sample_assignment != "even":
        raise ConfigError(
            "`sample_assignment` must be 'even' for the composed filter, got "
            f"{config.sample_assignment!r}"
        )
    same = (
        "kappa",
        "gamma",
        "direction_exponent",
        "relative_depth_extent",
        "soft_depth_extent",
        "depth_compare",
        "direction_weights",
        "own_direction_against",
        "tap_length",
        "neighbor_culling",
        "center_weight",
        "velocity_encoding",
    )
    return (
        _tapered(config)
        | {key: getattr(config, key) for key in same}
        | {
            "own_direction": config.directions == "two",
            "center_direction": "blend",
            "third_form": "shorter",
            "jitter": 2 * config.eta * config.phi / config.num_samples,
            "tile_jitter": config.tau if config.stochastic_tiles else 0.0,
        }
    )


def _jimenez2014(config: Jimenez2014Config) -> dict[str, Any]:
    extent = 1 / config.depth_scale
    same = ("jitter", "tile_jitter", "tile_classes", "fast_ratio", "neighbor_culling")
    return _shared(config, *_RAMP, *same, "depth_compare") | {
        "sampling": "pairs",
        "spread": "ramp",
        "third_form": "none",
        "direction_weights": False,
        "soft_depth_extent": extent,
        "relative_depth_extent": extent,
        "velocity_encoding": "tiles" if config.tile_encoding == "uint8" else "float",
        "resolve": "over_center",
    }


def _notes2025(config: Notes2025Config) -> dict[str, Any]:
    if config.resolution != "full":
        raise ConfigError(
            f"`resolution` must be 'full' for the composed filter, got {config.resolution!r}"
        )
    if config.tile_classes:  # the composed filter's ask for other conditions
        raise ConfigError("`tile_classes` of notes2025 must be off for the composed filter")
    same = (
        "jitter",
        "tile_jitter",
        "depth_compare",
        "velocity_encoding",
        "background_fade",
        "direction_reduction",
        "secondary_exponent",
        "neighbor_culling",
        "min_angle",
        "direction_weights",
        "direction_exponent",
        "alpha_combination",
        "accurate_alpha",
        "area_slope",
        "alpha_gain",
        "bilinear_min",
        "double_samples",
    )
    post = [key for key in Notes2025Config.model_fields if key.startswith("post_")]
    return _shared(config, *_RAMP, *same, *post) | {
        "sampling": "pairs",
        "second_direction": config.directions == "two",
        "spread": "ramp",
        "third_form": "none",
        "soft_depth_extent": config.depth_range,
        "relative_depth_extent": config.relative_depth_range,
        "center_taps": config.center_weight,
        "resolve": "separate" if config.separate_sums else "over_center",
        "missing_background": "center",
    }


SPECIAL_CASES: dict[str, Callable[[Any], dict[str, Any]]] = {
    "mcguire2012": _mcguire2012,
    "guertin2014": _guertin2014,
    "jimenez2014": _jimenez2014,
    "notes2025": _notes2025,
}
"""Names of filters that the composed one can be, and how."""
