"""FLIP: how visible the difference is when two images are flipped at a given viewing distance.

`flip_ldr` compares what a standard display shows; `flip_hdr` takes the worst of several exposures.
One reference serves many candidates without being filtered again: prepare it once with
`prepare_flip_ldr` or `prepare_flip_hdr` and ask `FlipReference.error` for each batch.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur.errors import FrameError
from torchblur.metrics.images import check_agreement, check_image, check_pair
from torchblur.metrics.vision import Kernels, View, make_kernels, perceive, visible_error
from torchblur.ops.color import luma

__all__ = [
    "DEFAULT_PPD",
    "FlipReference",
    "exposure_range",
    "flip_hdr",
    "flip_ldr",
    "prepare_flip_hdr",
    "prepare_flip_ldr",
]

DEFAULT_PPD = 0.7 * 3840 / 0.7 * math.pi / 180
"""Pixels per degree: a 0.7 m wide display of 3840 pixels seen from 0.7 m, 67.02."""

# ACES with its pre-exposure of 0.6 canceled (HDR paper, section 4): (x² p0 + x p1 + p2) / (x² …).
_ACES = (0.6 * 0.6 * 2.51, 0.6 * 0.03, 0.0, 0.6 * 0.6 * 2.43, 0.6 * 0.59, 0.14)
_ACES_SATURATED = 1e3  # far above 12.1, where the curve passes 1: keeps x² finite
_EXPOSED_LEVEL = 0.85  # start and stop map the maximum and the median luminance to this
_MIN_EXPOSURES = 2

_CHUNK_PIXELS = 2**16  # a CPU is up to six times as fast when the planes of a part fit its cache


def flip_ldr(image: Tensor, reference: Tensor, *, pixels_per_degree: float = DEFAULT_PPD) -> Tensor:
    """Return the FLIP error of each pixel as seen on a standard display.

    Works on scene-linear color clipped to [0, 1], which is what the published metric decodes an
    sRGB image to. Symmetric in its two images.

    Args:
        image: Scene-linear radiance to judge, (B, 3, H, W); clipped to [0, 1].
        reference: Scene-linear radiance, (B, 3, H, W) or (1, 3, H, W); clipped to [0, 1].
        pixels_per_degree: Resolution at the eye, px per degree of visual angle, above 0.

    Returns:
        Error in [0, 1], 0 where nothing can be seen, shape (B, 1, H, W).

    Differentiable: yes, finite everywhere, zero where the images are equal.
    Border: replicate.
    Reference: Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images", with
        the separable kernels of the authors' code. We differ: the powers 0.7, 0.5 and 1 - f are
        continued by a line next to zero, where their slope is infinite (below 3e-5 in the error).

    Raises:
        FrameError: images that cannot be compared, or a `pixels_per_degree` not above 0.

    Example:
        >>> flip_ldr(torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 8)).max()
        tensor(0.)
    """
    check_pair(image, reference)
    return prepare_flip_ldr(reference, pixels_per_degree=pixels_per_degree)._compare(image)


def flip_hdr(
    image: Tensor,
    reference: Tensor,
    *,
    pixels_per_degree: float = DEFAULT_PPD,
    start_exposure: float | None = None,
    stop_exposure: float | None = None,
    num_exposures: int | None = None,
) -> Tensor:
    """Return the greatest FLIP error of each pixel over a range of exposures.

    Works on scene-linear radiance of any range, tone-mapped with the ACES curve at each exposure.
    Not symmetric: the exposures are those of the reference.

    Args:
        image: Scene-linear radiance to judge, (B, 3, H, W); negative values count as 0.
        reference: Scene-linear radiance, (B, 3, H, W) or (1, 3, H, W).
        pixels_per_degree: Resolution at the eye, px per degree of visual angle, above 0.
        start_exposure: Least exposure in stops; from the reference if None.
        stop_exposure: Greatest exposure in stops; from the reference if None.
        num_exposures: Number of exposures, at least 2; max(2, ceil(stop - start)) if None.

    Returns:
        Error in [0, 1], shape (B, 1, H, W). Give start and stop to compare between frames: those
        taken from the reference differ from frame to frame.

    Differentiable: yes, finite everywhere, zero where the images are equal; the choice of the
        exposure has no gradient.
    Border: replicate.
    Reference: Andersson et al. 2021, "Visualizing Errors in Rendered High Dynamic Range Images".
        We differ: as `flip_ldr` and `exposure_range`; negative radiance is clipped before
        tone mapping.

    Raises:
        FrameError: images that cannot be compared, or settings out of range.
    """
    check_pair(image, reference)
    return prepare_flip_hdr(
        reference,
        pixels_per_degree=pixels_per_degree,
        start_exposure=start_exposure,
        stop_exposure=stop_exposure,
        num_exposures=num_exposures,
    )._compare(image)


@dataclass(frozen=True, eq=False)
class FlipReference:
    """A reference that is filtered once and compared with many images.

    Made by `prepare_flip_ldr` and `prepare_flip_hdr`.

    Args:
        reference: The reference as given, scene-linear, (B, 3, H, W).
        exposures: Stops per image and exposure, (B, N); None for the comparison without exposure.
        kernels: The separable kernels of the viewing condition.
        views: What the eye makes of the reference at each exposure.
    """

    reference: Tensor
    exposures: Tensor | None
    kernels: Kernels
    views: tuple[View, ...]

    def error(self, image: Tensor) -> Tensor:
        """Return the FLIP error of each pixel.

        Args:
            image: Scene-linear radiance, (B, 3, H, W); B is that of the reference, or any if the
                reference has a batch of 1.

        Returns:
            Error in [0, 1], shape (B, 1, H, W).

        Differentiable: as `flip_ldr` and `flip_hdr`.

        Raises:
            FrameError: if the image cannot be compared with the reference.
        """
        check_image("image", image)
        if image.shape[1:] != self.reference.shape[1:] or self.reference.shape[0] not in (
            1,
            image.shape[0],
        ):
            raise FrameError(
                "`image` must have the shape of the prepared reference (which may have a batch "
                f"of 1), got {tuple(image.shape)} and {tuple(self.reference.shape)}"
            )
        check_agreement(image, self.reference)
        return self._compare(image)

    def _compare(self, image: Tensor) -> Tensor:
        batch, _, height, width = image.shape
        at_once = batch if image.is_cuda else max(1, _CHUNK_PIXELS // (height * width))
        parts = image.split(at_once)
        errors = [
            self._compare_part(part, slice(i * at_once, (i + 1) * at_once))
            for i, part in enumerate(parts)
        ]
        return torch.cat(errors)

    def _compare_part(self, image: Tensor, part: slice) -> Tensor:
        exposures = None if self.exposures is None else _rows(self.exposures, part)
        errors = [
            visible_error(perceive(shown, self.kernels), view.map(lambda t: _rows(t, part)))
            for shown, view in zip(_shown(image, exposures), self.views, strict=True)
        ]
        return functools.reduce(torch.maximum, errors).to(image.dtype)


def _rows(tensor: Tensor, part: slice) -> Tensor:
    return tensor if tensor.shape[0] == 1 else tensor[part]


def prepare_flip_ldr(reference: Tensor, *, pixels_per_degree: float = DEFAULT_PPD) -> FlipReference:
    """Filter a reference once, for `flip_ldr` against many images.

    Args:
        reference: Scene-linear radiance, (B, 3, H, W); clipped to [0, 1].
        pixels_per_degree: Resolution at the eye, px per degree of visual angle, above 0.

    Returns:
        The prepared reference: ``prepare_flip_ldr(r).error(x) == flip_ldr(x, r)``.

    Differentiable: yes, in the reference too.

    Raises:
        FrameError: if it is no finite image, or `pixels_per_degree` is not above 0.
    """
    check_image("reference", reference)
    return _prepare(reference, None, pixels_per_degree)


def prepare_flip_hdr(
    reference: Tensor,
    *,
    pixels_per_degree: float = DEFAULT_PPD,
    start_exposure: float | None = None,
    stop_exposure: float | None = None,
    num_exposures: int | None = None,
) -> FlipReference:
    """Expose and filter a reference once, for `flip_hdr` against many images.

    Args:
        reference: Scene-linear radiance, (B, 3, H, W).
        pixels_per_degree: Resolution at the eye, px per degree of visual angle, above 0.
        start_exposure: As in `flip_hdr`.
        stop_exposure: As in `flip_hdr`.
        num_exposures: As in `flip_hdr`.

    Returns:
        The prepared reference: ``prepare_flip_hdr(r).error(x) == flip_hdr(x, r)``.

    Differentiable: as `flip_hdr`.

    Raises:
        FrameError: if it is no finite image, or a setting is out of range.
    """
    check_image("reference", reference)
    start, stop = exposure_range(reference)
    start = start if start_exposure is None else torch.full_like(start, start_exposure)
    stop = stop if stop_exposure is None else torch.full_like(stop, stop_exposure)
    exposures = _exposures(start, stop, num_exposures)
    return _prepare(reference, exposures, pixels_per_degree)


def exposure_range(reference: Tensor) -> tuple[Tensor, Tensor]:
    """Return the exposures at which the brightest and the median pixel reach 0.85 on a display.

    ``start = log2(x / max Y)``, ``stop = log2(x / median Y)``, with x the radiance that the tone
    curve maps to 0.85. Computed in float32 whatever the type, so that the number of exposures
    does not depend on it.

    Args:
        reference: Scene-linear radiance, (B, 3, H, W).

    Returns:
        Start and stop in stops, each (B,), float32.

    Differentiable: no; the exposures are settings.
    Reference: Andersson et al. 2021, section 4.2. We differ: where the median is black, it is the
        median of the pixels that are not; a black image counts as luminance 1. The formula
        gives an infinite exposure for both.
    """
    levels = luma(reference.detach().float()).flatten(1).clamp_min(0)
    tiny = torch.finfo(torch.float32).tiny
    pairs = [_brightness(level[level > tiny], level) for level in levels]
    brightest = torch.stack([pair[0] for pair in pairs])
    median = torch.stack([pair[1] for pair in pairs])
    level = _inverse_aces(_EXPOSED_LEVEL)
    return torch.log2(level / brightest), torch.log2(level / median)


def _brightness(lit: Tensor, level: Tensor) -> tuple[Tensor, Tensor]:
    """Return greatest and median luminance of one image; `lit` are the levels above 0."""
    if lit.numel() == 0:
        return level.new_ones(()), level.new_ones(())
    median = _upper_median(level)
    return lit.max(), median if bool(median > 0) else _upper_median(lit)


def _upper_median(values: Tensor) -> Tensor:
    return values.kthvalue(values.numel() // 2 + 1).values


def _inverse_aces(level: float) -> float:
    """Return the radiance that the tone curve maps to a level: the greater root."""
    a, b, c = (_ACES[i] - level * _ACES[i + 3] for i in range(3))
    return (-b + math.sqrt(b * b - 4 * a * c)) / (2 * a)


def _exposures(start: Tensor, stop: Tensor, count: int | None) -> Tensor:
    """Return the exposures of each image, (B, N); shorter ranges repeat their last one."""
    if bool((start > stop).any()):
        b = int((start > stop).nonzero()[0])
        raise FrameError(
            f"`start_exposure` must not exceed `stop_exposure`, got {float(start[b]):g} and "
            f"{float(stop[b]):g} stops for image {b}"
        )
    if count is not None and count < _MIN_EXPOSURES:
        raise FrameError(f"`num_exposures` must be at least {_MIN_EXPOSURES}, got {count}")
    own = torch.ceil(stop - start).clamp_min(_MIN_EXPOSURES)
    counts = own if count is None else torch.full_like(own, count)
    steps = torch.arange(int(counts.max()), device=start.device, dtype=start.dtype)
    fraction = (steps / (counts[:, None] - 1)).clamp_max(1)
    return start[:, None] + fraction * (stop - start)[:, None]


def _prepare(
    reference: Tensor, exposures: Tensor | None, pixels_per_degree: float
) -> FlipReference:
    if not (math.isfinite(pixels_per_degree) and pixels_per_degree > 0):
        raise FrameError(f"`pixels_per_degree` must be above 0, got {pixels_per_degree}")
    shown = _shown(reference, exposures)
    kernels = make_kernels(pixels_per_degree, shown[0])
    views = tuple(perceive(s, kernels) for s in shown)
    return FlipReference(reference, exposures, kernels, views)


def _shown(color: Tensor, exposures: Tensor | None) -> list[Tensor]:
    """Return the linear color in [0, 1] that a display shows, per exposure."""
    color = color if color.dtype == torch.float64 else color.float()
    if exposures is None:
        return [color.clamp(0, 1)]
    gains = torch.exp2(exposures.to(color.dtype))[:, :, None, None, None]
    return [_tone_map(color * gains[:, n]) for n in range(gains.shape[1])]


def _tone_map(color: Tensor) -> Tensor:
    x = color.clamp(0, _ACES_SATURATED)
    p0, p1, p2, q0, q1, q2 = _ACES
    return (((p0 * x + p1) * x + p2) / ((q0 * x + q1) * x + q2)).clamp(0, 1)
