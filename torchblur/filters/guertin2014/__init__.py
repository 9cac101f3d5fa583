"""Guertin 2014: a fast and stable feature-aware motion blur filter."""

from torchblur.filters.guertin2014.config import Guertin2014Config
from torchblur.filters.guertin2014.filter import Guertin2014Blur, guertin2014

__all__ = ["Guertin2014Blur", "Guertin2014Config", "guertin2014"]
