"""From the losses of single windows to one loss: the mean, the worst share of them, the worst."""

from __future__ import annotations

import torch
from torch import Tensor

from tuning.config.objective import ObjectiveSpec

__all__ = ["tail_weights"]

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
