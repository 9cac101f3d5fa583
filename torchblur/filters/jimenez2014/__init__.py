"""Jimenez 2014: the motion blur of Call of Duty: Advanced Warfare."""

from torchblur.filters.jimenez2014.config import Jimenez2014Config
from torchblur.filters.jimenez2014.filter import Jimenez2014Blur, jimenez2014

__all__ = ["Jimenez2014Blur", "Jimenez2014Config", "jimenez2014"]
