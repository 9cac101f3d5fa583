"""How much each window counts in the objective, where the data give their items weights."""

from __future__ import annotations

from collections.abc import Sequence

from tuning.data.cases import AnyCase

__all__ = ["window_weights"]


def window_weights(cases: Sequence[AnyCase], counts: Sequence[int]) -> list[float]:
    """Return the weight of each window of each case; over all windows their mean is 1.

    An item of the data counts by its weight, however many frames and windows it has, and each of
    its windows by the same share of it. Without any weights all windows count alike.

    Args:
        cases: The training frames and sequences; an item without a weight has 1 beside items that
            have one.
        counts: Number of windows of each case.
    """
    if all(case.weight is None for case in cases):
        return [1.0] * len(cases)
    shares: dict[str, float] = {}
    windows: dict[str, int] = {}
    for case, count in zip(cases, counts, strict=True):
        shares[case.item] = 1.0 if case.weight is None else case.weight
        windows[case.item] = windows.get(case.item, 0) + count
    scale = sum(windows.values()) / sum(shares.values())
    return [scale * shares[case.item] / windows[case.item] for case in cases]
