"""Weights of a pair of taps on both sides of a pixel: depth shares, spread, mirror filter."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchblur.ops.weights import DepthWeights, saturate

__all__ = ["Mirror", "SpreadForm", "TapPair", "depth_shares", "mirror", "spread_weight"]

SpreadForm = Literal["slides", "static_zero"]
Mirror = Literal["ports", "strict", "none"]


def depth_shares(
    pixel: Tensor,
    sample: Tensor,
    scale: float | Tensor,
    *,
    level: float | Tensor = 0.5,
    relative: bool = False,
    softness: float = 0.0,
) -> DepthWeights:
    """Return the shares of a sample that are foreground and background; they add up to 1.

    ``background = sat(level + scale · (Z_S − Z_p))``, and the foreground is the rest.

    Args:
        pixel: Z_p, positive depth of the pixel, scene units, finite.
        sample: Z_S, positive depth of the sample, scene units, finite.
        scale: κ, 1 / scene unit, or (relative) 1 / (nearer depth).
        level: Share of the background where both depths are level, in [0, 1].
        relative: Divide the difference by the nearer depth.
        softness: See `saturate`.

    Differentiable: yes.
    Reference: Jimenez 2014 (DepthCmp), as in public ports. We differ: the share at level depths
        is a parameter (1/2 there), and depth may be relative.
    """
    difference = sample - pixel
    if relative:
        difference = difference / torch.minimum(pixel, sample)
    background = saturate(level + scale * difference, softness)
    return DepthWeights(1 - background, background)


def spread_weight(
    distance: Tensor,
    reach: Tensor,
    *,
    offset: float | Tensor = 1.0,
    slope: float | Tensor = 1.0,
    form: SpreadForm = "slides",
    softness: float = 0.0,
) -> Tensor:
    """Return how far a blur reaches a sample: 1 inside, falling to 0 over about one sample.

    ``sat(slope · (reach − distance + offset))`` in the slides;
    ``sat(slope · (reach − max(distance − offset, 0)))`` as "static_zero", which differs only
    within `offset` of the pixel: there something static (reach 0) has the weight 0.

    Args:
        distance: From pixel to sample along the blur, in samples, >= 0.
        reach: Half spread of whichever of the two blurs, in samples, >= 0.
        offset: How far beyond its reach a blur still counts, in samples.
        slope: Fall per sample.
        form: "slides" or "static_zero".
        softness: See `saturate`.

    Differentiable: yes.
    Reference: Jimenez 2014 (SpreadCmp), as in public ports. We differ: offset and slope are
        parameters (both 1 there).
    """
    if form == "slides":
        return saturate(slope * (reach - distance + offset), softness)
    return saturate(slope * (reach - (distance - offset).clamp_min(0)), softness)


class TapPair(NamedTuple):
    """The same plane of two taps, at equal times after and before the middle of the exposure."""

    later: Tensor
    earlier: Tensor


def mirror(
    weights: tuple[tuple[Tensor, ...], tuple[Tensor, ...]],
    depths: TapPair,
    lengths: TapPair,
    rule: Mirror = "ports",
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Copy the weights of the nearer and faster of two taps to the other.

    Beside a moving object one tap of a pair falls on it and the other on the background. With
    the object's weight for both, what shows through the blur is the background around the
    pixel, as smooth as the blur, and not the pixel's own color alone.

    Args:
        weights: Those of the later and of the earlier tap, (B, 1, H, W) each.
        depths: Z of both, scene units.
        lengths: Half spread |V| of both, px.
        rule: "ports": the earlier tap counts as nearer if strictly so, and as faster if strictly
            so; with both its weights are taken for both taps, with neither the later one's (so
            ties depend on the order of the two). "strict": only where one tap is strictly
            nearer and strictly faster. "none": the weights as they are.

    Differentiable: in the weights; the choice is a threshold.
    Reference: Jimenez 2014, as in public ports; Unity HDRP takes the nearer and slower instead.
    """
    if rule == "none":
        return weights
    nearer, faster = depths.later > depths.earlier, lengths.earlier > lengths.later
    if rule == "ports":
        not_nearer, not_faster = ~nearer, ~faster
    else:
        not_nearer, not_faster = depths.later < depths.earlier, lengths.earlier < lengths.later
    take_earlier, take_later = nearer & faster, not_nearer & not_faster
    pairs = list(zip(*weights, strict=True))
    return (
        tuple(torch.where(take_earlier, b, a) for a, b in pairs),
        tuple(torch.where(take_later, a, b) for a, b in pairs),
    )
