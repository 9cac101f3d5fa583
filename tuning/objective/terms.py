"""The error that a fit makes small: weighted maps, averaged over the image and over the band."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchblur.metrics import (
    FlipReference,
    display_encode,
    masked_mean,
    prepare_flip_hdr,
    prepare_flip_ldr,
    ssim,
    temporal_error,
)
from tuning.config.objective import ObjectiveSpec

__all__ = ["PreparedObjective", "tail_weights"]

_RELATIVE_FLOOR = 0.01  # radiance² below which a relative error becomes absolute
_BEST_MSE = 1e-6  # 60 dB: better than that is hardly told apart, and log(0) has no gradient


class PreparedObjective:
    """An objective against one batch of references, filtered once and compared many times.

    Args:
        spec: Terms of the image and of the band, color space, share of the band.
        reference: Scene-linear radiance, (M, 3, H, W).
        band: Band at moving borders, bool, (M, 1, H, W).
    """

    def __init__(self, spec: ObjectiveSpec, reference: Tensor, band: Tensor) -> None:
        self.spec = spec
        self._reference = reference
        self._encoded = _encode(reference, spec.color_space)
        self._flip: dict[str, FlipReference] = {}
        named = {**spec.terms, **spec.band}
        if "flip" in named:
            self._flip["flip"] = prepare_flip_ldr(reference)
        if "flip_hdr" in named:
            self._flip["flip_hdr"] = prepare_flip_hdr(reference)
        self._weights = _weights(band, spec.band_weight)
        self._inside = _weights(band, 1.0) if spec.band else None

    def __call__(self, image: Tensor) -> Tensor:
        """Return the objective of each image, (K,), at least 0.

        Args:
            image: Scene-linear radiance, (K, 3, H, W); K is that of the references, or any if
                there is one reference.

        Differentiable: yes.
        """
        total = image.new_zeros(image.shape[0])
        for metric in dict.fromkeys((*self.spec.terms, *self.spec.band)):
            map = self._map(metric, image)
            for weights, mask in ((self.spec.terms, self._weights), (self.spec.band, self._inside)):
                if metric in weights:
                    total = total + weights[metric] * _pooled(metric, masked_mean(map, mask))
        return total

    def change(self, image: Tensor, before: Tensor, previous: PreparedObjective) -> Tensor:
        """Return the mean error of the change from the frame before, (K,), at least 0.

        Args:
            image: Scene-linear radiance of this frame, (K, 3, H, W).
            before: The same of the frame before.
            previous: The objective of the frame before.

        Differentiable: yes.
        """
        map = temporal_error(
            image, before, self._reference, previous._reference, space=self.spec.color_space
        )
        return masked_mean(map, self._weights)

    def _map(self, metric: str, image: Tensor) -> Tensor:
        if metric in self._flip:
            return self._flip[metric].error(image)
        reference = self._reference.expand_as(image)
        if metric == "ssim":
            return 1 - ssim(image, reference)
        return _DIFFERENCES[metric](_encode(image, self.spec.color_space), self._encoded)


def _encode(image: Tensor, space: str) -> Tensor:
    if space == "srgb":
        return display_encode(image)
    return torch.log1p(image.clamp_min(0)) if space == "log" else image


def _weights(band: Tensor, share: float) -> Tensor | None:
    """Return weights (M, 1, H, W) of mean 1: `share` of them spread over the band."""
    if share == 0:
        return None
    inside = band.to(torch.float32)
    mean = inside.mean(dim=(1, 2, 3), keepdim=True)
    # Where nothing moves there is no band, and its share goes to the image.
    return torch.where(mean > 0, (1 - share) + share * inside / mean.clamp_min(1e-12), 1.0)


def _pooled(metric: str, mean: Tensor) -> Tensor:
    """Return a term from the mean of its map: the mean itself, or of squares a logarithm."""
    return torch.log10(1 + mean / _BEST_MSE) if metric == "psnr" else mean


def _squared(image: Tensor, reference: Tensor) -> Tensor:
    return ((image - reference) ** 2).mean(dim=1, keepdim=True)


_DIFFERENCES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "l1": lambda image, reference: (image - reference).abs().mean(dim=1, keepdim=True),
    "mse": _squared,
    "psnr": _squared,
    "relative_l2": lambda image, reference: (
        (image - reference) ** 2 / (reference**2 + _RELATIVE_FLOOR)
    ).mean(dim=1, keepdim=True),
}


_DIGITS = 9  # so that 0.1 of 30 windows is 3 of them, whatever float64 makes of it


def tail_weights(losses: Tensor, objective: ObjectiveSpec) -> Tensor:
    """Return what each window counts: the reduced loss is the sum of weight times loss.

    "cvar" is the conditional value at risk: the mean of the worst ``tail · n`` windows, of which
    the last counts by the fraction that is left, and at least the worst one. The weights are
    constant wherever no two windows change their places, so the sum of weight times gradient is
    the gradient of the reduced loss there.

    Args:
        losses: Of n windows for K parameter sets, (n, K); NaN counts as the worst.
        objective: `reduction` and `tail`.

    Returns:
        Weights (n, K) of each set's own order; each column sums to 1. Of equal losses the first
        comes first.

    Differentiable: no.
    Reference: Rockafellar and Uryasev 2000 (optimization of conditional value-at-risk), for n
        equally likely outcomes.
    """
    count = losses.shape[0]
    if objective.reduction == "mean":
        return torch.full_like(losses, 1 / count)
    size = 1.0
    if objective.reduction == "cvar":
        size = max(round(objective.tail * count, _DIGITS), 1.0)
    ranks = torch.arange(count, device=losses.device, dtype=losses.dtype)
    by_rank = ((size - ranks).clamp(0, 1) / size)[:, None].expand_as(losses)
    order = losses.detach().sort(dim=0, descending=True, stable=True).indices
    return torch.zeros_like(losses).scatter(0, order, by_rank)
