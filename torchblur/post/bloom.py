"""Bloom: a chain of downsampled images, added up again on the way back."""

from __future__ import annotations

from typing import Annotated, Any

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.errors import ConfigError, FrameError
from torchblur.ops.color import luma
from torchblur.params import Config, Param
from torchblur.post.base import Effect, Values, check_plane

__all__ = ["Bloom", "BloomConfig", "bloom", "downsample13", "upsample_tent"]

_SOURCE = "Jimenez 2014"


# fmt: off
class BloomConfig(Config):
    """Parameters of the bloom."""

    intensity: Annotated[
        float,
        Param(low=0.0, high=1.0, grad="smooth", source="torchblur",
              meaning="share of the light that is scattered; 0 leaves the image"),
    ] = 0.05
    scatter: Annotated[
        float,
        Param(low=0.0, high=1.0, grad="smooth", source="torchblur",
              meaning="share of each level that comes from the coarser ones: higher is wider"),
    ] = 0.7
    num_levels: Annotated[
        int,
        Param(unit="levels", low=1, high=12, grad="discrete", source=_SOURCE,
              meaning="how often the image is halved, at most until it is one pixel"),
    ] = 6
    firefly_suppression: Annotated[
        bool,
        Param(grad="discrete", source="Karis, in Jimenez 2014",
              meaning="weigh bright taps down in the first downsampling"),
    ] = True
    firefly_level: Annotated[
        float,
        Param(low=1e-3, high=1e3, scale="log", grad="smooth", source="Karis, in Jimenez 2014",
              meaning="luma whose weight in the first downsampling is one half"),
    ] = 1.0
    center_weight: Annotated[
        float,
        Param(low=0.0, high=1.0, grad="smooth", source=_SOURCE,
              meaning="share of the inner four of the 13 taps; the outer boxes share the rest"),
    ] = 0.5
# fmt: on


def bloom(
    color: Tensor,
    half_color: Tensor | None = None,
    config: BloomConfig | None = None,
    **params: Any,
) -> Tensor:
    """Scatter a share of the light over a wide neighborhood.

    ``out = (1 − i) · C + i · U₁``, with ``U_k = (1 − s) · D_k + s · up(U_{k+1})`` from the
    coarsest level up, and D_k the image halved k times. There is no threshold: light is scattered
    by its amount, and a constant image stays.

    Args:
        color: Scene-linear, (B, 3, H, W).
        half_color: The image at half the size, (B, 3, ⌈H/2⌉, ⌈W/2⌉), in place of the first
            downsampling: the half-resolution result of a blur.
        config: Parameters; the defaults if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, (B, 3, H, W).

    Differentiable: in both images and all numbers.
    Border: replicated.
    Reference: Jimenez 2014: 13 taps down with Karis' weights in the first level, a 3x3 tent up;
        2025 notes, section on half resolution, for `half_color`. We differ: levels are mixed, not
        added, so that light is neither gained nor lost; Karis' weights are normalized within each
        box and apply to the first downsampling that is done, also when `half_color` replaces one.
    Raises: ConfigError for a bad parameter, FrameError for a bad shape.
    """
    result: Tensor = Bloom(config, **params)(color, half_color)
    return result


class Bloom(Effect):
    """Bloom as a Module. See `bloom`.

    `layers` returns "color" and "bloom", the scattered light alone, (B, 3, H, W).
    """

    name = "bloom"
    config_class = BloomConfig

    def layers(
        self, color: Tensor, half_color: Tensor | None = None, **overrides: Any
    ) -> dict[str, Tensor]:
        """Return "color" and "bloom"; arguments as for `bloom`."""
        check_plane("color", color, 3)
        if half_color is not None:
            _check_half(half_color, color)
        values, planes = self.prepare(overrides, color=color, half_color=half_color)
        glow = _glow(planes[0], planes[1] if len(planes) > 1 else None, values)
        return {"color": torch.lerp(planes[0], glow, values.intensity), "bloom": glow}

    def _override(self, key: str, value: Any, color: Tensor) -> Any:
        value = super()._override(key, value, color)
        if isinstance(value, Tensor) and value.ndim > 1 and value.shape[-2:].numel() > 1:
            raise ConfigError(
                f"`{key}` of the bloom must be one number per image, (B, 1, 1, 1), as its levels "
                f"have sizes of their own; got shape {tuple(value.shape)}"
            )
        return value

    def forward(self, color: Tensor, half_color: Tensor | None = None, **overrides: Any) -> Tensor:
        """Return the color with bloom, (B, 3, H, W); arguments as for `bloom`."""
        return self.layers(color, half_color, **overrides)["color"]


def downsample13(
    image: Tensor, center_weight: float | Tensor = 0.5, firefly_level: float | Tensor | None = None
) -> Tensor:
    """Halve an image with 13 bilinear taps: a box of four in the middle, four around it.

    Args:
        image: (B, C, H, W); C must be 3 with a `firefly_level`.
        center_weight: Share of the middle box; 1/2 gives each pixel its even share.
        firefly_level: Weigh each tap within its box by ``1 / (1 + luma / level)`` (Rec. 709), so
            that single bright pixels do not flicker; None weighs all alike.

    Returns:
        (B, C, ⌈H/2⌉, ⌈W/2⌉).

    Differentiable: yes.
    Border: replicated.
    Reference: Jimenez 2014.
    """
    height, width = image.shape[-2:]
    padding = (2, 2 + width % 2, 2, 2 + height % 2)
    # A tap lies between pixels: an average of four.
    taps = F.avg_pool2d(F.pad(image, padding, mode="replicate"), 2, 1)
    weights = torch.ones_like(taps[:, :1])
    if firefly_level is not None:
        weights = 1 / (1 + luma(taps).clamp_min(0) / firefly_level)
    rows, columns = -(-height // 2), -(-width // 2)

    def box(top: int, left: int) -> Tensor:
        corners = [(top + y, left + x) for y in (0, 2) for x in (0, 2)]
        parts = [_every_other(taps * weights, y, x, rows, columns) for y, x in corners]
        shares = [_every_other(weights, y, x, rows, columns) for y, x in corners]
        return torch.stack(parts).sum(0) / torch.stack(shares).sum(0)

    outer = torch.stack([box(y, x) for y in (0, 2) for x in (0, 2)]).mean(0)
    return center_weight * box(1, 1) + (1 - center_weight) * outer


def _every_other(plane: Tensor, top: int, left: int, rows: int, columns: int) -> Tensor:
    return plane[..., top : top + 2 * rows : 2, left : left + 2 * columns : 2][..., :rows, :columns]


def upsample_tent(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Double an image with a 3x3 tent of bilinear taps, one coarse pixel apart.

    Args:
        image: (B, C, h, w).
        size: H and W, of which h and w are the half, rounded up.

    Returns:
        (B, C, H, W).

    Differentiable: yes.
    Border: replicated.
    Reference: Jimenez 2014.
    """
    line = image.new_tensor([0.25, 0.5, 0.25])
    kernel = torch.outer(line, line).expand(image.shape[1], 1, 3, 3)
    padded = F.pad(image, (1, 1, 1, 1), mode="replicate")
    soft = F.conv2d(padded, kernel, groups=image.shape[1])
    # The tent is linear and sits on the coarse lattice: smooth there, then interpolate.
    double = F.interpolate(soft, scale_factor=2, mode="bilinear", align_corners=False)
    return double[..., : size[0], : size[1]]


def _check_half(half_color: Tensor, color: Tensor) -> None:
    check_plane("half_color", half_color, 3)
    height, width = color.shape[2:]
    want = (-(-height // 2), -(-width // 2))
    if tuple(half_color.shape[2:]) != want:
        raise FrameError(
            f"`half_color` must have half the size of `color`, rounded up, {want}, got "
            f"{tuple(half_color.shape[2:])}"
        )
    if half_color.shape[0] not in (1, color.shape[0]) or half_color.dtype != color.dtype:
        raise FrameError(
            f"`half_color` must have the batch and type of `color`, {color.shape[0]} of "
            f"{color.dtype}, got {half_color.shape[0]} of {half_color.dtype}"
        )


def _glow(color: Tensor, half_color: Tensor | None, values: Values) -> Tensor:
    """Return the scattered light at full size, (B, 3, H, W)."""
    level = values.firefly_level if values.firefly_suppression else None
    levels = [color] if half_color is None else [color, half_color]
    while len(levels) <= values.num_levels and levels[-1].shape[2:].numel() > 1:
        levels.append(downsample13(levels[-1], values.center_weight, level))
        level = None
    glow = levels.pop()
    while len(levels) > 1:
        finer = levels.pop()
        glow = torch.lerp(finer, _doubled(glow, finer), values.scatter)
    return _doubled(glow, color) if levels else glow


def _doubled(image: Tensor, like: Tensor) -> Tensor:
    return upsample_tent(image, (like.shape[2], like.shape[3]))
