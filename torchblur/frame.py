"""The tensors of a frame, and the conventions that all of torchblur agrees on.

======================  ==========================================================================
tensors                 float32, NCHW, batch first; float64 for gradient checks
color                   (B, 3, H, W) scene-linear radiance, not tone-mapped
depth                   (B, 1, H, W) positive distance along the view axis, larger is farther;
                        the background is a large finite value or +inf
velocity                (B, 2, H, W) screen displacement in **pixels per frame, forward in time,
                        x right, y down**; the full displacement, not half of it
shutter                 open time in frames (0.5 is 180 degrees), and its position. Half spread of a
                        centered shutter: ``V = shutter * velocity / 2``
pixel centers           pixel (x, y) has its center at (x + 1/2, y + 1/2): `align_corners=False`
borders                 replicate
======================  ==========================================================================

Other programs' units, signs and axes are converted where files are read (`torchblur.io`), never
in a filter. `tests/test_conventions.py` executes this table.
"""

from __future__ import annotations

import dataclasses
import math
from collections import abc
from collections.abc import Callable, Iterator
from dataclasses import InitVar, dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from torchblur.errors import FrameError
from torchblur.layers import CHANNELS, check_agreement, shaped, without_bad_values

__all__ = ["FAR_DEPTH", "LONGEST_SHUTTER", "Frame", "FrameSequence", "Shutter", "ShutterPosition"]

ShutterPosition = Literal["centered", "leading", "trailing"]

FAR_DEPTH = 1e10
"""Depth that stands for the background in arithmetic, scene units; +inf is replaced by it."""

LONGEST_SHUTTER = 8.0
"""Longest open time of a shutter, in frames.

Above 1 it is no film camera but a game: 1/60 s at 100 to 300 frames a second (Tan 2022, section 4)
are 1.7 to 5 frames.
"""


@dataclass(frozen=True)
class Shutter:
    """When the shutter is open, relative to the frame's own time 0.

    Args:
        open: Open time in frames, in [0, `LONGEST_SHUTTER`] = [0, 8]; 0.5 is a 180 degree
            shutter.
        position: "centered": open in [-open/2, open/2]. "leading": opens at the frame,
            [0, open]. "trailing": closes at the frame, [-open, 0].

    Raises:
        FrameError: if `open` is outside [0, 8] or the position has another name.
    """

    open: float = 0.5
    position: ShutterPosition = "centered"

    def __post_init__(self) -> None:
        if not 0 <= self.open <= LONGEST_SHUTTER:
            raise FrameError(f"`open` must lie in [0, {LONGEST_SHUTTER:g}] frames, got {self.open}")
        if self.position not in ("centered", "leading", "trailing"):
            raise FrameError(
                f"`position` must be 'centered', 'leading' or 'trailing', got {self.position!r}"
            )

    @classmethod
    def from_angle(cls, degrees: float, position: ShutterPosition = "centered") -> Shutter:
        """Make a shutter from its angle: 180 degrees are half a frame."""
        return cls(degrees / 360, position)

    @classmethod
    def from_exposure(
        cls, exposure: float, frame_rate: float, position: ShutterPosition = "centered"
    ) -> Shutter:
        """Make a shutter from the exposure time: ``open = exposure * frame_rate``.

        Args:
            exposure: Open time in seconds, at least 0; 1/60 at 24 frames a second are 0.4 frames,
                at 300 they are 5.
            frame_rate: Frames per second, above 0.
            position: As in the class.

        Raises:
            FrameError: if either is out of range, or the shutter is open for more than 8 frames.

        Reference: Tan 2022, section 3.1: the vector between two frames times frame rate and
            exposure time. There it ends at the frame: `position` "trailing".
        """
        if not (math.isfinite(exposure) and exposure >= 0):
            raise FrameError(f"`exposure` must be at least 0 seconds, got {exposure}")
        if not (math.isfinite(frame_rate) and frame_rate > 0):
            raise FrameError(f"`frame_rate` must be above 0 frames per second, got {frame_rate}")
        frames = exposure * frame_rate
        if frames > LONGEST_SHUTTER:
            raise FrameError(
                f"a shutter is open for at most {LONGEST_SHUTTER:g} frames, got {frames:g}: "
                f"{exposure:g} s at {frame_rate:g} frames per second"
            )
        return cls(frames, position)

    @property
    def interval(self) -> tuple[float, float]:
        """Opening and closing time, in frames, relative to the frame."""
        start = (self.center - 1) * self.open / 2
        return start, start + self.open

    @property
    def center(self) -> int:
        """Middle of the open interval in units of half its length: 0, +1 leading, -1 trailing."""
        return {"centered": 0, "leading": 1, "trailing": -1}[self.position]


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One batch of frames: color, depth, velocity and optional layers, checked on construction.

    A tensor with three dimensions gets a batch dimension. All layers have one size, one device,
    and (but for `object_id` and `valid`) one floating type.

    Args:
        color: Scene-linear radiance, (B, 3, H, W).
        velocity: Displacement in px/frame, forward in time, x right, y down, (B, 2, H, W).
        depth: Positive distance along the view axis in scene units, (B, 1, H, W); +inf allowed.
        normal: Surface normals, (B, 3, H, W).
        object_id: Integer object numbers, (B, 1, H, W).
        time: Time of each pixel's sample over the shutter, 0 opening, 1 closing, (B, 1, H, W).
        acceleration: Change of velocity, px/frame², (B, 2, H, W).
        albedo: Color of the surfaces without their light, (B, 3, H, W).
        revealed: A second frame: what lies behind the moving objects.
        valid: Pixels that can be trusted, bool, (B, 1, H, W).
        source: Where the data came from (a file name); it is named in errors.
        on_invalid: "raise" refuses NaN and inf; "mask" replaces them (color and velocity by 0,
            depth by +inf), marks those pixels in `valid`, and warns how many there are.

    Raises:
        FrameError: wrong shape, mixed sizes, types or devices, NaN or inf in color or velocity,
            NaN or a value not above 0 in depth; with layer, count, first position and source.
    """

    color: Tensor
    velocity: Tensor
    depth: Tensor | None = None
    normal: Tensor | None = None
    object_id: Tensor | None = None
    time: Tensor | None = None
    acceleration: Tensor | None = None
    albedo: Tensor | None = None
    revealed: Frame | None = None
    valid: Tensor | None = None
    source: str = ""
    on_invalid: InitVar[Literal["raise", "mask"]] = "raise"

    def __post_init__(self, on_invalid: Literal["raise", "mask"]) -> None:
        if on_invalid not in ("raise", "mask"):
            raise FrameError(f"`on_invalid` must be 'raise' or 'mask', got {on_invalid!r}")
        for name in CHANNELS:
            layer = getattr(self, name)
            if layer is not None:
                self._set(name, shaped(name, layer, self._place()))
        check_agreement(self.layers(), self._place())
        self._check_revealed()
        usable = without_bad_values(self.layers(), on_invalid, self._place())
        for name, layer in usable.items():
            self._set(name, layer)

    @classmethod
    def unchecked(cls, **fields: Any) -> Frame:
        """Return a frame of layers that are known to be right: no value of them is looked at.

        Args:
            **fields: As of `Frame`, layers with four dimensions.
        """
        frame = object.__new__(cls)
        empty = dict.fromkeys(field.name for field in dataclasses.fields(cls))
        for name, value in (empty | {"source": ""} | fields).items():
            object.__setattr__(frame, name, value)
        return frame

    # -- sizes ---------------------------------------------------------------------------------

    @property
    def batch_size(self) -> int:
        """Number of frames in the batch, B."""
        return self.color.shape[0]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.color.shape[2], self.color.shape[3]

    @property
    def dtype(self) -> torch.dtype:
        """Floating type of the color."""
        return self.color.dtype

    @property
    def device(self) -> torch.device:
        """Device of all layers."""
        return self.color.device

    # -- what filters ask for ------------------------------------------------------------------

    def finite_depth(self) -> Tensor:
        """Return the depth with the background at most `FAR_DEPTH`, (B, 1, H, W).

        Differentiable: yes; zero gradient at the background.

        Raises:
            FrameError: if the frame has no depth.
        """
        depth = self.require("depth")
        return depth.clamp(max=min(FAR_DEPTH, torch.finfo(depth.dtype).max / 4))

    def require(self, name: str) -> Tensor:
        """Return a layer, or refuse with the names of those that are there.

        Raises:
            FrameError: if the layer is missing.
        """
        layer = getattr(self, name)
        if layer is None:
            raise FrameError(
                f"the layer `{name}` is needed and is missing{self._place()}; "
                f"present: {', '.join(self.layers())}"
            )
        return layer  # type: ignore[no-any-return]

    def layers(self) -> dict[str, Tensor]:
        """Return the tensors that are present, by name (without `revealed`)."""
        return {name: t for name in CHANNELS if (t := getattr(self, name)) is not None}

    # -- other frames --------------------------------------------------------------------------

    def replaced(self, **layers: Tensor) -> Frame:
        """Return the frame with other layers, which are known to be right and not checked."""
        kept = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return Frame.unchecked(**(kept | layers))

    def only(self, *names: str) -> Frame:
        """Return the frame with these layers of it alone, and color and velocity."""
        frame = object.__new__(Frame)
        kept = {"color", "velocity", "source", *names}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name) if field.name in kept else None
            object.__setattr__(frame, field.name, value)
        return frame

    def map(self, function: Callable[[Tensor], Tensor]) -> Frame:
        """Return the frame with a function applied to each layer, `revealed` included.

        Args:
            function: Takes and returns one layer; it must treat all of them alike (a crop, a
                move to a device), as values are not converted.
        """
        # The values were checked when the frame was made; checking again would cost a pass.
        frame = object.__new__(Frame)
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                value = function(value)
            elif isinstance(value, Frame):
                value = value.map(function)
            object.__setattr__(frame, field.name, value)
        return frame

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Frame:
        """Return the frame on another device and, for floating layers, of another type."""
        return self.map(
            lambda t: t.to(device=device, dtype=dtype if t.is_floating_point() else None)
        )

    def crop(self, top: int, left: int, height: int, width: int) -> Frame:
        """Return a window of the frame; positions and sizes in px.

        Raises:
            FrameError: if the window does not lie within the frame.
        """
        rows, columns = self.size
        if (
            min(top, left) < 0
            or min(height, width) < 1
            or top + height > rows
            or left + width > columns
        ):
            raise FrameError(
                f"a window must lie within the frame of {columns}x{rows}, got "
                f"{width}x{height} at ({left}, {top}){self._place()}"
            )
        return self.map(lambda t: t[..., top : top + height, left : left + width])

    def expand(self, batch_size: int) -> Frame:
        """Return a frame of one repeated to a batch, without a copy.

        Raises:
            FrameError: if the frame is a batch of another size already.
        """
        if self.batch_size not in (1, batch_size):
            raise FrameError(
                f"a batch of {self.batch_size} cannot be expanded to {batch_size}{self._place()}"
            )
        return self.map(lambda t: t.expand(batch_size, -1, -1, -1))

    @staticmethod
    def stack(frames: abc.Sequence[Frame]) -> Frame:
        """Join frames of one size into a batch; layers that not all of them have are left out.

        Raises:
            FrameError: if there is no frame, or the sizes differ.
        """
        if not frames:
            raise FrameError("a batch needs at least one frame, got none")
        sizes = {frame.size for frame in frames}
        if len(sizes) > 1:
            names = ", ".join(f"{w}x{h}" for h, w in sorted(sizes))
            raise FrameError(f"the frames of a batch must have one size, got {names}")
        common = [n for n in CHANNELS if all(getattr(f, n) is not None for f in frames)]
        layers = {name: torch.cat([getattr(f, name) for f in frames]) for name in common}
        revealed = [f.revealed for f in frames if f.revealed is not None]
        return Frame(
            **layers,  # type: ignore[arg-type]
            revealed=Frame.stack(revealed) if len(revealed) == len(frames) else None,
            source=", ".join(f.source for f in frames if f.source),
        )

    # -- checks --------------------------------------------------------------------------------

    def _set(self, name: str, value: Tensor) -> None:
        object.__setattr__(self, name, value)

    def _place(self) -> str:
        return f" ({self.source})" if self.source else ""

    def _check_revealed(self) -> None:
        if self.revealed is not None and self.revealed.size != self.size:
            raise FrameError(
                f"`revealed` must have the size of the frame, {self.size}, "
                f"got {self.revealed.size}{self._place()}"
            )


@dataclass(frozen=True, eq=False)
class FrameSequence:
    """Consecutive frames of one size, and where a new shot begins.

    Args:
        frames: One frame per time step, at least one; each may be a batch of B (B sequences that
            are filtered side by side).
        cuts: Positions of frames that begin a new shot, in [0, number of frames); what a filter
            remembers of the frames before is forgotten there. The first frame needs no mark.

    Raises:
        FrameError: no frame, mixed sizes or batches, or a cut outside the sequence.
    """

    frames: tuple[Frame, ...]
    cuts: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "frames", tuple(self.frames))
        object.__setattr__(self, "cuts", tuple(sorted(set(self.cuts))))
        if not self.frames:
            raise FrameError("a sequence needs at least one frame, got none")
        first = self.frames[0]
        for index, frame in enumerate(self.frames):
            if (frame.size, frame.batch_size) != (first.size, first.batch_size):
                raise FrameError(
                    f"the frames of a sequence must have one size and batch, "
                    f"{first.batch_size} of {first.size} as in frame 0, got {frame.batch_size} of "
                    f"{frame.size} in frame {index}{frame._place()}"
                )
        bad = [cut for cut in self.cuts if not 0 <= cut < len(self.frames)]
        if bad:
            raise FrameError(f"`cuts` must lie in [0, {len(self.frames) - 1}], got {bad[0]}")

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)

    def __getitem__(self, index: int) -> Frame:
        return self.frames[index]

    def map(self, function: Callable[[Frame], Frame]) -> FrameSequence:
        """Return the sequence with a function applied to each frame (a crop, a move)."""
        return FrameSequence(tuple(function(frame) for frame in self.frames), self.cuts)
