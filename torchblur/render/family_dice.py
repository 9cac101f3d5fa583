"""Random numbers that have names: a new draw changes none of the others."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

__all__ = ["Dice"]

Key = TypeVar("Key", bound=str)


@dataclass(frozen=True)
class Dice:
    """Random numbers by name, from SHA-256 of seed and name: alike on all machines and versions.

    Args:
        seed: Any integer.
        path: Name of this set, before the names in it.
    """

    seed: int
    path: str = ""

    def of(self, name: str | int) -> Dice:
        """Return a set of its own for a part, such as one body."""
        return Dice(self.seed, f"{self.path}{name}/")

    def chance(self, name: str) -> float:
        """Return a number in [0, 1)."""
        digest = hashlib.sha256(f"{self.seed}:{self.path}{name}".encode()).digest()
        return (int.from_bytes(digest[:8], "big") >> 11) * 2.0**-53

    def between(self, name: str, limits: tuple[float, float]) -> float:
        """Return a number of a range, evenly."""
        low, high = limits
        return low + (high - low) * self.chance(name)

    def log_between(self, name: str, limits: tuple[float, float]) -> float:
        """Return a number of a positive range, evenly on a log scale."""
        low, high = limits
        drawn = low * math.exp(math.log(high / low) * self.chance(name))
        return min(max(drawn, low), high)

    def whole(self, name: str, limits: tuple[int, int]) -> int:
        """Return an integer of a range, both ends included."""
        low, high = limits
        return low + int((high - low + 1) * self.chance(name))

    def sign(self, name: str) -> float:
        """Return 1 or -1."""
        return 1.0 if self.chance(name) < 0.5 else -1.0

    def pick(self, name: str, weights: Mapping[Key, float]) -> Key:
        """Return a key, by weight; the order of the keys does not matter."""
        keys = sorted(key for key, weight in weights.items() if weight > 0)
        left = self.chance(name) * sum(weights[key] for key in keys)
        for key in keys:
            left -= weights[key]
            if left < 0:
                return key
        return keys[-1]
