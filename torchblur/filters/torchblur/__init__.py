"""torchblur's own filter: taps are times, and samples that arrive then compete."""

from torchblur.filters.torchblur.config import TorchblurConfig
from torchblur.filters.torchblur.filter import TorchblurBlur, torchblur

__all__ = ["TorchblurBlur", "TorchblurConfig", "torchblur"]
