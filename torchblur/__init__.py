"""torchblur: differentiable, batched motion-blur filters in PyTorch.

::

    import torchblur

    frame = torchblur.read_frame("sharp.0001.exr")
    blur = torchblur.create_filter("guertin2014", shutter=0.5)
    color = blur(frame)                       # (B, 3, H, W), scene-linear, differentiable

The names here are the stable ones; docs/stability.md says how they may change.
"""

from typing import TYPE_CHECKING

from torchblur.batching import collate
from torchblur.deprecation import old_names
from torchblur.errors import (
    ConfigError,
    FileFormatError,
    FrameError,
    OutputError,
    ReachWarning,
    TorchblurError,
)
from torchblur.filters import (
    BlurFilter,
    FilterConfig,
    History,
    TemporalBlur,
    get_filter,
    list_filters,
    register_filter,
)
from torchblur.filters import registered_filters as registered_filters
from torchblur.frame import Frame, FrameSequence, Shutter
from torchblur.io import read_frame, read_image, read_sequence, write_frame, write_image
from torchblur.params import Param
from torchblur.pipelines import create_pipeline
from torchblur.presets import Preset, create_filter, load_preset, save_preset
from torchblur.version import __version__ as __version__

__all__ = [
    "BlurFilter",
    "ConfigError",
    "FileFormatError",
    "FilterConfig",
    "Frame",
    "FrameError",
    "FrameSequence",
    "History",
    "OutputError",
    "Param",
    "Preset",
    "ReachWarning",
    "Shutter",
    "TemporalBlur",
    "TorchblurError",
    "collate",
    "create_filter",
    "create_pipeline",
    "get_filter",
    "list_filters",
    "load_preset",
    "read_frame",
    "read_image",
    "read_sequence",
    "register_filter",
    "save_preset",
    "write_frame",
    "write_image",
]

if not TYPE_CHECKING:  # a type checker would take every name
    __getattr__ = old_names(__name__, since="0.2", Sequence="FrameSequence")
