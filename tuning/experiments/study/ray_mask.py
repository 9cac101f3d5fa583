"""The ray mask of Tan 2022 in a study: where it asks, whether it is right, what its passes cost."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchblur.filters import BlurFilter, get_filter
from torchblur.filters.parts.base import Values
from torchblur.filters.parts.spreads import spread_of
from torchblur.frame import Frame, Shutter
from torchblur.ops.raymask import edge_strength, ray_mask, uncovered
from torchblur.render import render_revealed
from tuning.experiments.study.config import StudyExr, StudyScene
from tuning.experiments.study.frames import Moment, scene_of
from tuning.experiments.study.scores import agreement, hidden_mask

__all__ = ["ray_facts", "ray_mask_of", "shutter_values", "with_revealed"]

_FILTER = "tan2022"
_T = TypeVar("_T")


def ray_mask_of(moment: Moment, params: Mapping[str, Any]) -> Tensor:
    """Return where Tan 2022 asks for rays, bool, (1, 1, H, W).

    Args:
        moment: The frame.
        params: Parameters of tan2022.
    """
    return _asked(get_filter(_FILTER)(**params), moment.sharp, moment.shutter)["ray_mask"] > 0.5


def with_revealed(moment: Moment, mask: Tensor | None) -> Frame:
    """Return the sharp frame with what lies behind, everywhere or in a mask alone."""
    layer = moment.revealed
    assert layer is not None
    if mask is not None:
        valid = torch.ones_like(mask) if layer.valid is None else layer.valid.bool()
        layer = replace(layer, valid=valid & mask)
    return replace(moment.sharp, revealed=layer)


def ray_facts(
    item: StudyScene | StudyExr, moment: Moment, params: Mapping[str, Any]
) -> dict[str, float | None]:
    """Return how good the ray mask is, how many rays it takes, and CPU-seconds of each pass.

    The passes are timed one after the other in this process: "mask" (edges, candidates, range
    check), "trace" (the rays in the mask, for scenes), "tiles" (maxima), "gather" (all else).

    Args:
        item: The data.
        moment: The frame, with a revealed layer.
        params: Parameters of tan2022.

    Returns:
        "mask_share", "hidden_share" (of the image's pixels), "recall" and "precision" against
        `hidden_mask`, "recall_1px" and "precision_1px" against it and the mask grown by a pixel,
        "rays" and "rays_per_px" (for scenes), and "seconds_<pass>".
    """
    blur = get_filter(_FILTER)(**params)
    mask, truth = ray_mask_of(moment, params), hidden_mask(moment)
    facts = agreement(mask, truth)
    facts["recall_1px"] = agreement(_grown(mask), truth)["recall"]
    facts["precision_1px"] = agreement(mask, _grown(truth))["precision"]
    if isinstance(item, StudyScene):
        found, facts["seconds_trace"] = _timed(
            lambda: render_revealed(
                scene_of(item),
                item.height_width,
                frame=item.first + moment.index,
                mask=mask,
                color_spp=item.revealed_spp,
                seed=item.seed,
            )
        )
        facts["rays"] = float(found.rays)
        facts["rays_per_px"] = found.rays / mask.numel()
        facts["color_rays"] = float(found.color_rays)
    return facts | _passes(blur, with_revealed(moment, mask), moment.shutter)


def shutter_values(shutter: Shutter) -> dict[str, Any]:
    """Return a shutter as parameters of a filter."""
    return {"shutter": shutter.open, "shutter_position": shutter.position}


def _passes(blur: BlurFilter, frame: Frame, shutter: Shutter) -> dict[str, float | None]:
    values = blur.values_for(frame.color, shutter_values(shutter))
    (spread, _), tiles = _timed(lambda: spread_of(frame, values))
    _, mask = _timed(lambda: _mask_pass(frame, spread.half, values))
    _, whole = _timed(lambda: _asked(blur, frame, shutter))
    return {
        "seconds_mask": mask,
        "seconds_tiles": 2 * tiles,  # of the raster and of the revealed layer
        "seconds_gather": whole - mask - 2 * tiles,
    }


def _mask_pass(frame: Frame, half: Tensor, values: Values) -> None:
    """Do what the filter does for its mask: edges once, the rest once for each side it looks to."""
    depth = frame.finite_depth()
    edges = edge_strength(depth, frame.normal, values.depth_edge_gain, values.normal_edge_gain)
    for way in (-1, 1) if values.shutter_position == "centered" else (2,):
        there = way * half
        candidates = uncovered(there, depth, frame.object_id, values.soft_depth_extent)
        ray_mask(there, edges, candidates, values.edge_threshold, values.mask_samples)


@torch.no_grad()
def _asked(blur: BlurFilter, frame: Frame, shutter: Shutter) -> dict[str, Tensor]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no revealed layer: it is what is asked for
        return blur.layers(frame, **shutter_values(shutter))


@torch.no_grad()
def _timed(function: Callable[[], _T]) -> tuple[_T, float]:
    function()
    began = time.process_time()
    result = function()
    return result, time.process_time() - began


def _grown(mask: Tensor) -> Tensor:
    return torch.nn.functional.max_pool2d(mask.float(), 3, stride=1, padding=1) > 0
