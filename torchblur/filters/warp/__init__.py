"""A forward warp: every pixel is splatted to where it is at each of many moments."""

from torchblur.filters.warp.config import WarpConfig
from torchblur.filters.warp.filter import WarpBlur, warp

__all__ = ["WarpBlur", "WarpConfig", "warp"]
