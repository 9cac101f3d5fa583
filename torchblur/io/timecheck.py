"""Is a frame a stochastic stream? What its time layer tells."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["TimeInfo", "about_time", "check_time"]

_ROUNDING = 1e-5
_FAR_FROM_UNIFORM = 0.1
_ALIKE = 0.5


@dataclass(frozen=True)
class TimeInfo:
    """The times of a frame's pixels over the shutter, 0 the opening, 1 the closing.

    Args:
        minimum: Least.
        mean: Mean; 0.5 in a stream.
        maximum: Greatest.
        outside: Share of the pixels outside [0, 1].
        distance: Greatest difference between the share of pixels up to a time and that time
            (Kolmogorov and Smirnov's distance to uniform times): near 0 in a stream, 0.5 and more
            where all times are one.
        neighbors: Correlation of pixels side by side and above each other, whichever is the
            greater: near 0 in a stream; 0 where all times are one.
    """

    minimum: float
    mean: float
    maximum: float
    outside: float
    distance: float
    neighbors: float

    @property
    def is_stream(self) -> bool:
        """Whether the pixels were seen at different times."""
        return self.maximum > self.minimum


def check_time(time: Tensor) -> TimeInfo:
    """Describe a time layer.

    Args:
        time: Times over the shutter, (1, 1, H, W).
    """
    values = time[0, 0].double()
    ordered = values.flatten().sort().values.clamp(0, 1)
    rank = torch.arange(ordered.numel() + 1, dtype=torch.float64) / ordered.numel()
    distance = torch.maximum(rank[1:] - ordered, ordered - rank[:-1]).max()
    outside = (values < -_ROUNDING) | (values > 1 + _ROUNDING)
    beside = _correlation(values[:, 1:], values[:, :-1])
    above = _correlation(values[1:], values[:-1])
    return TimeInfo(
        minimum=float(values.min()),
        mean=float(values.mean()),
        maximum=float(values.max()),
        outside=float(outside.double().mean()),
        distance=float(distance),
        neighbors=max(beside, above, key=abs),
    )


def about_time(label: str, info: TimeInfo) -> Iterable[str]:
    """Say what looks wrong about the times of a file.

    Args:
        label: Name of the channel.
        info: What `check_time` found.
    """
    if not info.is_stream:
        yield (
            f"the time `{label}` is {info.minimum:g} everywhere: a frame seen at one time, and no "
            "stream"
        )
    if info.outside > 0:
        yield (
            f"the time `{label}` lies outside [0, 1] in {info.outside:.1%} of the pixels "
            f"({info.minimum:g} to {info.maximum:g}): 0 is the opening of the shutter and 1 its "
            "closing; time_start=... and time_end=... convert other times"
        )
    elif info.is_stream and info.distance > _FAR_FROM_UNIFORM:
        yield (
            f"the time `{label}` is far from uniform over the shutter ({info.minimum:g} to "
            f"{info.maximum:g}, mean {info.mean:.3f}, distance {info.distance:.2f}): the mean of "
            "such streams is not the blurred frame"
        )
    if info.neighbors > _ALIKE:
        yield (
            f"the time `{label}` is much alike in neighboring pixels (correlation "
            f"{info.neighbors:.2f}): a filter needs independent times"
        )


def _correlation(a: Tensor, b: Tensor) -> float:
    if a.numel() < 2 or a.min() == a.max() or b.min() == b.max():
        return 0.0
    return float(torch.corrcoef(torch.stack((a.flatten(), b.flatten())))[0, 1])
