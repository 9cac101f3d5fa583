"""What every method of a fit works on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tuning.objective.space import Space

__all__ = ["MethodJob"]


@dataclass(frozen=True, kw_only=True, eq=False)
class MethodJob:
    """What a method works on.

    Args:
        index: Its position among the methods.
        name: Its name in results.
        space: The parameters that it fits.
        fixed: Values of the free parameters that it does not fit.
        first: Points to begin with, before the random or drawn ones.
        seed: Seed of the run.
    """

    index: int
    name: str
    space: Space
    fixed: Mapping[str, Any]
    first: tuple[Mapping[str, Any], ...]
    seed: int
