"""A tuned filter for other programs: its constants as JSON, HLSL or GLSL, and itself as a graph."""

from torchblur.export.constants import Constant, constants_of, constants_text, write_constants
from torchblur.export.program import EXPORTABLE, export_program, save_program

__all__ = [
    "EXPORTABLE",
    "Constant",
    "constants_of",
    "constants_text",
    "export_program",
    "save_program",
    "write_constants",
]
