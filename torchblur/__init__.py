"""torchblur: differentiable, batched motion-blur filters in PyTorch.

::

    import torchblur

    frame = torchblur.read_frame("sharp.0001.exr")
    blur = torchblur.create_filter("guertin2014", shutter=0.5)
    color = blur(frame)                       # (B, 3, H, W), scene-linear, differentiable
"""

from torchblur.errors import ConfigError, FileFormatError, FrameError, OutputError, TorchblurError
from torchblur.filters import BlurFilter, get_filter, registered_filters
from torchblur.frame import Frame, Sequence, Shutter
from torchblur.io import read_frame, read_image, write_frame, write_image
from torchblur.pipelines import create_pipeline
from torchblur.presets import Preset, create_filter, load_preset, save_preset

__version__ = "0.1.0"

__all__ = [
    "BlurFilter",
    "ConfigError",
    "FileFormatError",
    "Frame",
    "FrameError",
    "OutputError",
    "Preset",
    "Sequence",
    "Shutter",
    "TorchblurError",
    "create_filter",
    "create_pipeline",
    "get_filter",
    "load_preset",
    "read_frame",
    "read_image",
    "registered_filters",
    "save_preset",
    "write_frame",
    "write_image",
]
