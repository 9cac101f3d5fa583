"""Oberberger 2022: motion blur from a stochastic stream of one sample per pixel."""

from torchblur.filters.oberberger2022.config import Oberberger2022Config
from torchblur.filters.oberberger2022.filter import Oberberger2022Blur, oberberger2022

__all__ = ["Oberberger2022Blur", "Oberberger2022Config", "oberberger2022"]
