"""How close the results of a filter come to references, beside baselines or its own input."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur.errors import FrameError
from torchblur.filters import BlurFilter
from torchblur.frame import Frame
from torchblur.metrics import border_band, evaluate, prepare_flip_ldr
from torchblur.presets import create_filter
from tuning.scoring.sequences import FrameByFrame

__all__ = ["BASELINES", "Scores", "SequenceJudge", "asked_name", "judge", "mean_scores"]

BASELINES = ("line", "mcguire2012", "guertin2014")
"""Filters that a result is compared with, at their papers' settings."""

_OF_SEQUENCES = ("flip", "flip_median", "psnr", "ssim", "temporal", "flip_band")


@dataclass(frozen=True)
class Scores:
    """How close filters come to the references, mean over the frames.

    Args:
        by_name: What `judge` returns.
        asked: Name of the filter that was asked for.
    """

    by_name: Mapping[str, Mapping[str, float]]
    asked: str


@torch.no_grad()
def judge(
    blur: BlurFilter, frame: Frame, color: Tensor, reference: Tensor
) -> dict[str, dict[str, float]]:
    """Compare a result, the sharp frame and the baselines with a reference.

    All filters get the shutter of the asked one; the rest of a baseline is its paper's.

    Args:
        blur: The filter that was asked for.
        frame: The frame, batch size 1, on the CPU.
        color: Its result, (1, 3, H, W).
        reference: The frame with true motion blur, (1, 3, H, W).

    Returns:
        By name, what `evaluate` returns over the image and over "band", the pixels that moving
        borders sweep. The asked filter stands under its name, with "(asked)" if it is a baseline
        with other settings. A baseline that needs a layer which the frame lacks is left out, with
        a warning.

    Raises:
        FrameError: sizes that differ.
    """
    band = {"band": border_band(frame, blur.shutter_setting)}
    asked = asked_name(blur)
    images = {"sharp": frame.color}
    for name in BASELINES:
        try:
            images[name] = color if name == asked else _with_shutter_of(blur, name)(frame)
        except FrameError as error:
            warnings.warn(f"{name} is left out of the comparison: {error}", stacklevel=2)
    images.setdefault(asked, color)
    return {
        name: {k: float(v) for k, v in evaluate(image, reference, masks=band).items()}
        for name, image in images.items()
    }


class SequenceJudge:
    """Compares the results of a filter with a memory with their references, frame after frame.

    Args:
        blur: The filter.
    """

    def __init__(self, blur: BlurFilter) -> None:
        self._blur = blur
        self._frames: dict[str, FrameByFrame] = {}

    @torch.no_grad()
    def judge(
        self, samples: Sequence[Frame], color: Tensor, reference: Tensor
    ) -> dict[str, dict[str, float]]:
        """Compare a result, and what the filter was given, with a reference.

        Filters without a memory would need sharp frames, which a stream is not; so there are no
        baselines.

        Args:
            samples: What was filtered, of batch size 1, on the CPU.
            color: The result, (1, 3, H, W).
            reference: The frame with true motion blur, (1, 3, H, W).

        Returns:
            By name, "input" for the mean of the samples: "flip", "psnr", "ssim" and "flip_band" as
            `judge` returns them; "flip_median", the weighted median of the FLIP map; and
            "temporal", the error of the change from the frame before, NaN for the first one.
        """
        mean = torch.stack([frame.color for frame in samples]).mean(dim=0)
        images = {"input": mean, asked_name(self._blur): color}
        band = {"band": border_band(samples[0], self._blur.shutter_setting)}
        prepared = prepare_flip_ldr(reference)
        scores = {}
        for name, image in images.items():
            frames = self._frames.setdefault(name, FrameByFrame())
            found = frames.figures(image, reference, masks=band, prepared=prepared)
            scores[name] = {key: found[key] for key in _OF_SEQUENCES}
        return scores


def asked_name(blur: BlurFilter) -> str:
    """Return the name under which `judge` lists the asked filter."""
    is_plain = _with_shutter_of(blur, blur.name).config == blur.current_config()
    return blur.name if is_plain or blur.name not in BASELINES else f"{blur.name} (asked)"


def mean_scores(scores: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    """Return the mean over frames of what `judge` returned; frames with an empty band don't count.

    Args:
        scores: One entry per frame; names that not all of them have are left out.
    """
    return {
        name: {key: _mean([frame[name][key] for frame in scores]) for key in scores[0][name]}
        for name in scores[0]
        if all(name in frame for frame in scores)
    }


def _with_shutter_of(blur: BlurFilter, name: str) -> BlurFilter:
    config = blur.config
    return create_filter(name, shutter=config.shutter, shutter_position=config.shutter_position)


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan
