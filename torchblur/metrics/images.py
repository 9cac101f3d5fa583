"""What all metrics ask of their images, and the display encoding that some of them work in."""

from __future__ import annotations

import torch
from torch import Tensor

from torchblur.errors import FrameError
from torchblur.ops.color import linear_to_srgb

__all__ = ["check_image", "check_pair", "display_encode"]


def display_encode(color: Tensor) -> Tensor:
    """Return what an 8-bit display would be sent: clipped to [0, 1] and sRGB-encoded, unrounded.

    For metrics that are reported on encoded images: ``psnr(display_encode(a), display_encode(b))``.

    Args:
        color: Scene-linear radiance, any range, shape (B, C, H, W).

    Returns:
        Encoded values in [0, 1], same shape.

    Differentiable: yes; zero gradient where the radiance is clipped.
    """
    return linear_to_srgb(color.clamp(0, 1))


def check_pair(image: Tensor, reference: Tensor, channels: int | None = 3) -> None:
    """Refuse a pair of images that cannot be compared.

    Args:
        image: The image to judge, (B, C, H, W), floating point, finite.
        reference: What it should be, (B, C, H, W), or a batch of 1 for all images.
        channels: The number of channels that both must have, or None for any.

    Raises:
        FrameError: wrong shape or channels, sizes, types or devices that differ, NaN or inf;
            it names the tensor, and for values the count and the first position.
    """
    check_image("image", image, channels)
    check_image("reference", reference, channels)
    if image.shape[1:] != reference.shape[1:] or reference.shape[0] not in (1, image.shape[0]):
        raise FrameError(
            "`image` and `reference` must have one shape (or a reference with a batch of 1), "
            f"got {tuple(image.shape)} and {tuple(reference.shape)}"
        )
    check_agreement(image, reference)


def check_agreement(image: Tensor, reference: Tensor) -> None:
    """Refuse an image and a reference of different types or on different devices.

    Raises:
        FrameError: if they differ.
    """
    for what in ("dtype", "device"):
        ours, theirs = getattr(image, what), getattr(reference, what)
        if ours != theirs:
            raise FrameError(
                f"`image` and `reference` must have one {what}, got {ours} and {theirs}"
            )


def check_image(name: str, image: Tensor, channels: int | None = 3) -> None:
    """Refuse a tensor that is no finite image.

    Args:
        name: Name for the message.
        image: Tensor that should be (B, C, H, W) and floating point.
        channels: The number of channels that it must have, or None for any.

    Raises:
        FrameError: wrong shape, channels or type; NaN or inf.
    """
    if not isinstance(image, Tensor):
        raise FrameError(f"`{name}` must be a tensor, got {type(image).__name__}")
    wrong = channels is not None and image.ndim == 4 and image.shape[1] != channels
    if image.ndim != 4 or wrong or 0 in image.shape:
        raise FrameError(
            f"`{name}` must have shape (B, {channels or 'C'}, H, W), got {tuple(image.shape)}"
        )
    if not image.is_floating_point():
        raise FrameError(f"`{name}` must be floating point, got {image.dtype}")
    bad = ~torch.isfinite(image)
    if bool(bad.any()):
        b, c, y, x = (int(i) for i in bad.nonzero()[0])
        raise FrameError(
            f"`{name}` must be finite, got {int(bad.sum())} values that are not, the first "
            f"{float(image[b, c, y, x])} in channel {c} at x={x}, y={y} of image {b}"
        )
