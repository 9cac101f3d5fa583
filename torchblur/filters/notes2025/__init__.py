"""The 2025 notes on motion blur rendering: Jimenez 2014 with two directions and a post-filter."""

from torchblur.filters.notes2025.config import Notes2025Config
from torchblur.filters.notes2025.filter import Notes2025Blur, notes2025

__all__ = ["Notes2025Blur", "Notes2025Config", "notes2025"]
