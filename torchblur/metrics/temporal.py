"""How steady a sequence is: its change from frame to frame beside that of the reference.

An image may be near its reference in each frame and still flicker around it. What changes in the
reference too (motion, a light that is switched on) is no error here; an error that stays the same
in both frames is none either, so these figures stand beside those of single frames.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Literal, get_args

import torch
from torch import Tensor

from torchblur.errors import FrameError
from torchblur.metrics.flip import DEFAULT_PPD, flip_ldr
from torchblur.metrics.images import check_image, check_pair, display_encode

__all__ = ["Norm", "Space", "flip_change_error", "temporal_error", "temporal_errors"]

Space = Literal["srgb", "linear", "log"]
"""Values that are compared: clipped to [0, 1] and sRGB-encoded, radiance, or log(1 + radiance)."""

Norm = Literal["l1", "rms"]
"""Mean of the map, or the root of the mean of its square."""


def temporal_error(
    image: Tensor,
    previous: Tensor,
    reference: Tensor,
    previous_reference: Tensor,
    *,
    space: Space = "srgb",
) -> Tensor:
    """Return how far each pixel's change from the frame before is from that of the reference.

    ``E_t = mean over channels of |(I_t - I_{t-1}) - (R_t - R_{t-1})|``, with I the image and R the
    reference in the values of `space`.

    Args:
        image: Scene-linear radiance of this frame, (B, 3, H, W).
        previous: The same of the frame before.
        reference: Scene-linear radiance of this frame's reference, (B, 3, H, W) or (1, 3, H, W).
        previous_reference: The same of the frame before.
        space: What is compared: "srgb" display values (clipped to [0, 1] and encoded), "linear"
            radiance, or "log", log(1 + radiance) with negative radiance as 0.

    Returns:
        Error of at least 0 per pixel, (B, 1, H, W), in the unit of `space`; at most 2 for "srgb".

    Differentiable: yes, finite everywhere; zero where the error is 0.
    Border: each pixel on its own.

    Raises:
        FrameError: images that cannot be compared, or an unknown space.

    Example:
        >>> a, b = torch.rand(2, 1, 3, 8, 8)
        >>> float(temporal_error(a + 0.1, b + 0.1, a, b, space="linear").max()) < 1e-6
        True
    """
    check_pair(image, reference)
    check_pair(previous, previous_reference)
    if previous.shape != image.shape:
        raise FrameError(
            f"`previous` must have the shape of `image`, {tuple(image.shape)}, got "
            f"{tuple(previous.shape)}"
        )
    shown, before, truth, truth_before = (
        _encode(color, space) for color in (image, previous, reference, previous_reference)
    )
    change = (shown - before) - (truth - truth_before)
    return change.abs().mean(dim=1, keepdim=True)


def temporal_errors(
    images: Sequence[Tensor],
    references: Sequence[Tensor],
    *,
    cuts: Collection[int] = (),
    space: Space = "srgb",
    norm: Norm = "l1",
) -> Tensor:
    """Return the temporal error of each frame of a sequence against the frame before it.

    "l1": the mean of `temporal_error` over the pixels. "rms": the root of the mean over pixels
    and channels of ``((I_t - I_{t-1}) - (R_t - R_{t-1}))²``. Independent noise of deviation s in
    each frame gives ``2 s / sqrt(pi)`` and ``sqrt(2) s``.

    Args:
        images: The frames in order, scene-linear radiance, (B, 3, H, W) each.
        references: Their references, (B, 3, H, W) or (1, 3, H, W) each.
        cuts: Positions of frames that begin a new shot; their change is no error.
        space: As in `temporal_error`.
        norm: "l1" or "rms".

    Returns:
        (T, B), NaN for the first frame and at cuts: ``nanmean(dim=0)`` is the mean of a sequence.

    Differentiable: yes, finite; for "rms" zero where a frame has no error.

    Raises:
        FrameError: no frame, lists of different lengths, images that cannot be compared, or an
            unknown space or norm.
    """
    if not images or len(images) != len(references):
        raise FrameError(
            f"there must be one reference for each image, got {len(images)} images and "
            f"{len(references)} references"
        )
    if norm not in get_args(Norm):
        raise FrameError(f"`norm` must be 'l1' or 'rms', got {norm!r}")
    shown = [_encode(image, space) for image in images]
    truth = [_encode(reference, space) for reference in references]
    rows = []
    for index, (image, reference) in enumerate(zip(images, references, strict=True)):
        check_pair(image, reference)
        if index == 0 or index in cuts:
            rows.append(torch.full_like(image[:, 0, 0, 0].detach(), torch.nan))
            continue
        change = (shown[index] - shown[index - 1]) - (truth[index] - truth[index - 1])
        rows.append(_norm(change, norm))
    return torch.stack(rows)


def flip_change_error(
    image: Tensor,
    previous: Tensor,
    reference: Tensor,
    previous_reference: Tensor,
    *,
    pixels_per_degree: float = DEFAULT_PPD,
) -> Tensor:
    """Return by how much a pixel's change is more or less visible than that of the reference.

    ``|FLIP(I_t, I_{t-1}) - FLIP(R_t, R_{t-1})|``: FLIP tells how visible it is when the two frames
    are flipped, which is what playing them does. A change of the right visibility into a wrong
    color is no error here; the error of single frames shows it.

    Args:
        image: Scene-linear radiance of this frame, (B, 3, H, W).
        previous: The same of the frame before.
        reference: Scene-linear radiance of this frame's reference, (B, 3, H, W) or (1, 3, H, W).
        previous_reference: The same of the frame before.
        pixels_per_degree: As in `flip_ldr`.

    Returns:
        Error in [0, 1], (B, 1, H, W).

    Differentiable: as `flip_ldr`.
    Border: replicate.

    Raises:
        FrameError: images that cannot be compared, or a `pixels_per_degree` not above 0.
    """
    check_pair(image, reference)
    seen = flip_ldr(image, previous, pixels_per_degree=pixels_per_degree)
    due = flip_ldr(reference, previous_reference, pixels_per_degree=pixels_per_degree)
    return (seen - due).abs()


def _encode(color: Tensor, space: Space) -> Tensor:
    check_image("image", color)
    if space == "srgb":
        return display_encode(color)
    if space == "log":
        return torch.log1p(color.clamp_min(0))
    if space != "linear":
        raise FrameError(f"`space` must be 'srgb', 'linear' or 'log', got {space!r}")
    return color


def _norm(change: Tensor, norm: Norm) -> Tensor:
    if norm == "l1":
        return change.abs().flatten(1).mean(dim=1)
    square = change.square().flatten(1).mean(dim=1)
    still = square == 0  # the root has no slope there
    return torch.where(still, 0.0, torch.where(still, 1.0, square).sqrt())
