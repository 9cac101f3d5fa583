"""A filter as a `torch.export` program: a graph without Python, for AOTInductor and the like."""

from __future__ import annotations

import copy
import io
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.export import ExportedProgram

from torchblur.errors import ConfigError, ReachWarning
from torchblur.filters import BlurFilter
from torchblur.frame import Frame
from torchblur.io.paths import output_file
from torchblur.ops.pixels import all_pixels

__all__ = ["EXPORTABLE", "export_program", "save_program"]

EXPORTABLE = (
    "guertin2014",
    "jimenez2014",
    "line",
    "mcguire2012",
    "notes2025",
    "sousa2013",
    "tan2022",
    "torchblur",
)
"""Filters of which a graph can be recorded: what they do does not depend on the frame's values, but
for the taps of long paths (`tap_spacing`), which a graph does not have."""


class _FrameFilter(nn.Module):
    """A filter of tensors: (color, velocity, depth) to color."""

    def __init__(self, blur: BlurFilter) -> None:
        super().__init__()
        self.blur = blur

    def forward(self, color: Tensor, velocity: Tensor, depth: Tensor) -> Tensor:
        """Return the blurred color, without a gradient."""
        layers = {"color": color, "velocity": velocity, "depth": depth}
        frame = Frame.unchecked(**{name: plane.detach() for name, plane in layers.items()})
        with all_pixels():
            blurred: Tensor = self.blur(frame)
        return blurred


def export_program(blur: BlurFilter, frame: Frame) -> ExportedProgram:
    """Return a filter, with the values that its parameters have now, as a graph of torch operators.

    ``program.module()(color, velocity, depth)`` returns the blurred color, (B, 3, H, W), for
    frames of the example's batch, size, type and device. Values are not checked: color and
    velocity must be finite, depth above 0 (+inf allowed). Smooth and weak parameters are part of
    the program's state, as "blur.kappa"; all others are fixed in the graph, which has each tap
    once, so that 40 taps take four times as long to export as 10.

    Args:
        blur: One of `EXPORTABLE`.
        frame: An example with depth; its values do not matter.

    Raises:
        ConfigError: a filter that decides by the frame's values what to do, or that needs more
            layers than color, velocity and depth.
        FrameError: the example has no depth.

    A graph has `num_samples` taps on every path; with `tap_spacing` the filter itself takes more on
    long ones, and a warning says so: give more `num_samples` for such frames.

    Differentiable: no; the result is for inference.
    """
    if blur.name not in EXPORTABLE:
        raise ConfigError(
            f"`{blur.name}` cannot be exported as a program: it keeps a history, or what it does "
            f"depends on the frame's values; filters that can: {', '.join(EXPORTABLE)}"
        )
    if getattr(blur.config, "background", "guessed") == "revealed":
        raise ConfigError(
            "`background` must be 'guessed' in a program, which takes color, velocity and depth "
            "alone, got 'revealed'"
        )
    if getattr(blur.config, "tap_spacing", 0.0) > 0:
        samples = getattr(blur.config, "num_samples", 0)
        warnings.warn(
            f"a program of `{blur.name}` has {samples} taps on every path, also on those that are "
            "so long that `tap_spacing` would give them more; give more `num_samples` for them, or "
            "`tap_spacing` 0",
            ReachWarning,
            stacklevel=2,
        )
    planes = tuple(t.detach() for t in (frame.color, frame.velocity, frame.require("depth")))
    own = copy.deepcopy(blur).requires_grad_(False).eval()
    own.engine = "eager"
    module = _FrameFilter(own)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no revealed layer, and torch's own
        module(*planes)  # what the filter keeps between calls is made outside of the graph
        program = torch.export.export(module, planes, strict=False)
    _forget_places(program)
    return program


def save_program(
    path: str | Path,
    program: ExportedProgram,
    *,
    notes: dict[str, str] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a program so that `torch.export.load` reads it; whole or not at all.

    Args:
        path: The file, by custom with the ending .pt2.
        program: What `export_program` returned.
        notes: Texts that are kept in the file by name: ``load(path, extra_files={name: ""})``.
        overwrite: Replace an existing file.

    Raises:
        OutputError: the file exists and `overwrite` is off, or it cannot be written.
    """
    buffer = io.BytesIO()
    with output_file(path, overwrite=overwrite) as temporary:
        torch.export.save(program, buffer, extra_files=dict(notes or {}))
        temporary.write_bytes(buffer.getvalue())


def _forget_places(program: ExportedProgram) -> None:
    """Remove which line of which file each operator comes from: paths of this machine."""
    for module in program.graph_module.modules():
        if isinstance(module, torch.fx.GraphModule):
            for node in module.graph.nodes:
                node.meta.pop("stack_trace", None)
