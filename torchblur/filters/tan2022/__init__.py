"""Tan 2022: hybrid motion blur, a gather over the raster and over a ray-traced background."""

from torchblur.filters.tan2022.config import Tan2022Config
from torchblur.filters.tan2022.filter import Tan2022Blur, tan2022

__all__ = ["Tan2022Blur", "Tan2022Config", "tan2022"]
