"""Figures of a case from sums over parts of its images, and how far they go when parts are drawn.

The parts (tiles) are what a bootstrap draws again: neighboring pixels err together, tiles hardly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from torchblur.metrics import flip_ldr, ssim
from tuning.data.cases import AnyCase, Case
from tuning.data.variants import Variant, render, render_frames
from tuning.experiments.crossfit.config import Bootstrap

__all__ = ["GAINS", "METRICS", "Figure", "Sums", "draws_of", "figures_of", "summarize", "tile_sums"]

METRICS = ("flip", "psnr", "ssim", "flip_band", "psnr_band", "ssim_band")
"""Figures of an image against its reference."""

GAINS = ("flip_ratio", "flip_band_ratio", "psnr_gain", "psnr_band_gain")
"""Figures against those of `line`: FLIP divided by its FLIP, PSNR minus its PSNR."""

_SUMS = ("count", "flip", "square", "ssim")
_Array = NDArray[np.float64]


@dataclass(frozen=True)
class Figure:
    """A value with its interval; None where there is none.

    Args:
        value: Over all tiles.
        low: Lower end.
        high: Upper end.
    """

    value: float | None
    low: float | None
    high: float | None


class Sums:
    """Sums over each tile of all frames of a case.

    Args:
        arrays: By "count", "flip", "square" (squared error, mean of the channels) and "ssim", and
            the same with "_band": the sums over a tile's pixels, (T,).
    """

    def __init__(self, arrays: Mapping[str, Sequence[float] | _Array]) -> None:
        self.arrays = {name: np.asarray(values, np.float64) for name, values in arrays.items()}

    def __len__(self) -> int:
        return len(self.arrays["count"])

    @classmethod
    def joined(cls, parts: Sequence[Sums]) -> Sums:
        """Return the sums over the tiles of all parts, of which there is at least one."""
        return cls({n: np.concatenate([p.arrays[n] for p in parts]) for n in parts[0].arrays})

    def plain(self) -> dict[str, list[float]]:
        """Return lists, as JSON has them."""
        return {name: values.tolist() for name, values in self.arrays.items()}

    def metrics(self, counts: _Array) -> dict[str, _Array]:
        """Return the figures of draws, NaN where nothing is in the band, inf for equal images.

        Args:
            counts: How often each draw has each tile, (B, T).
        """
        found = {}
        for suffix in ("", "_band"):
            totals = {name: counts @ self.arrays[f"{name}{suffix}"] for name in _SUMS}
            with np.errstate(divide="ignore", invalid="ignore"):
                means = {name: totals[name] / totals["count"] for name in _SUMS[1:]}
                found[f"flip{suffix}"] = means["flip"]
                found[f"psnr{suffix}"] = -10 * np.log10(means["square"])
                found[f"ssim{suffix}"] = means["ssim"]
        return found


@torch.no_grad()
def tile_sums(cases: Sequence[AnyCase], variant: Variant, tile: int) -> Sums:
    """Return the sums over tiles of what a variant makes of all frames of a case.

    Tiles do not overlap and begin at the top left; those at the right and the bottom may be cut.

    Args:
        cases: Frames and sequences; warm-up frames are left out.
        variant: What is scored; where it fits no frame there are no tiles.
        tile: Edge, px.
    """
    parts: dict[str, list[float]] = {f"{n}{s}": [] for s in ("", "_band") for n in _SUMS}
    for image, reference, band in _images(cases, variant):
        square = ((image - reference) ** 2).mean(dim=1, keepdim=True)
        maps = {"flip": flip_ldr(image, reference), "square": square}
        maps |= {"ssim": ssim(image, reference), "count": torch.ones_like(square)}
        for name, values in maps.items():
            for suffix, mask in (("", torch.ones_like(band)), ("_band", band)):
                parts[name + suffix] += _over_tiles(torch.where(mask, values, 0.0), tile)
    return Sums(parts)


def draws_of(size: int, bootstrap: Bootstrap, seed: Sequence[int]) -> _Array:
    """Return how often each of `size` tiles is in each draw with replacement, (draws, size).

    The first row is the image as it is: each tile once.

    Args:
        size: Number of tiles.
        bootstrap: Number of draws.
        seed: Of these draws; equal seeds and sizes give equal draws, so that differences between
            filters are between their figures on the same tiles.
    """
    generator = np.random.default_rng([bootstrap.seed, *seed])
    counts = generator.multinomial(size, np.full(size, 1 / size), size=bootstrap.draws)
    return np.vstack([np.ones(size), counts]).astype(np.float64)


def figures_of(sums: Sums, line: Sums, draws: _Array) -> dict[str, _Array]:
    """Return all figures of a variant at each draw: its own, and against `line`.

    Args:
        sums: Of the variant.
        line: Of the filter `line` on the same tiles.
        draws: What `draws_of` returned.
    """
    own, other = sums.metrics(draws), line.metrics(draws)
    with np.errstate(divide="ignore", invalid="ignore"):
        for suffix in ("", "_band"):
            own[f"flip{suffix}_ratio"] = own[f"flip{suffix}"] / other[f"flip{suffix}"]
            own[f"psnr{suffix}_gain"] = own[f"psnr{suffix}"] - other[f"psnr{suffix}"]
    return own


def summarize(values: _Array, level: float) -> Figure:
    """Return the figure of the whole image, and the percentile interval over the draws.

    Args:
        values: The whole image's first, then each draw's; draws without a finite one do not count.
        level: Share of the draws within the interval.
    """
    value = float(values[0])
    finite = values[1:][np.isfinite(values[1:])]
    if not math.isfinite(value) or not finite.size:
        return Figure(value if math.isfinite(value) else None, None, None)
    low, high = np.quantile(finite, [(1 - level) / 2, (1 + level) / 2])
    return Figure(value, float(low), float(high))


def _images(cases: Sequence[AnyCase], variant: Variant) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield image, reference and band of each scored frame."""
    for case in cases:
        if not variant.fits(case):
            continue
        if isinstance(case, Case):
            yield render(variant, case), case.reference, case.band
            continue
        images = render_frames(variant, case)
        every: Any = list(zip(images, case.references, case.bands, strict=True))
        yield from every[case.warm_up :]


def _over_tiles(values: Tensor, tile: int) -> list[float]:
    height, width = values.shape[-2:]
    padded = F.pad(values.double(), (0, -width % tile, 0, -height % tile))
    sums: list[float] = (F.avg_pool2d(padded, tile) * tile**2).flatten().tolist()
    return sums
