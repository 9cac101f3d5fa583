"""Files: OpenEXR frames of torchblur and of other programs, sequences, and YAML."""

from torchblur.io.conventions import CONVENTIONS, Convention, ConventionOverrides, get_convention
from torchblur.io.exr import ExrFile, ExrPart, Window, read_exr, read_metadata, write_exr
from torchblur.io.frames import read_channels, read_frame, read_image
from torchblur.io.inspect import Inspection, inspect_file
from torchblur.io.readsequence import read_sequence
from torchblur.io.sequences import FrameFiles, find_frames
from torchblur.io.writing import write_frame, write_image
from torchblur.io.yaml import line_of, load_yaml, save_yaml

__all__ = [
    "CONVENTIONS",
    "Convention",
    "ConventionOverrides",
    "ExrFile",
    "ExrPart",
    "FrameFiles",
    "Inspection",
    "Window",
    "find_frames",
    "get_convention",
    "inspect_file",
    "line_of",
    "load_yaml",
    "read_channels",
    "read_exr",
    "read_frame",
    "read_image",
    "read_metadata",
    "read_sequence",
    "save_yaml",
    "write_exr",
    "write_frame",
    "write_image",
]
