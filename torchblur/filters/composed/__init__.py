"""The published filters in one: every part of theirs is a parameter, and they are sets of them."""

from torchblur.filters.composed.config import ComposedConfig
from torchblur.filters.composed.filter import ComposedBlur, composed

__all__ = ["ComposedBlur", "ComposedConfig", "composed"]
