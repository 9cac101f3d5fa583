"""Frames out of OpenEXR files.

All conversion of units, signs and axes happens here; what comes out follows `torchblur.frame`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from torchblur.errors import FileFormatError, FrameError
from torchblur.frame import Frame
from torchblur.io.channels import Catalog, Plane
from torchblur.io.conventions import (
    CHANNEL_FIELDS,
    CONVENTIONS,
    Convention,
    ConventionOverrides,
    resolve_convention,
)
from torchblur.io.convert import (
    depth_to_distance,
    mean_and_change,
    time_to_shutter,
    velocity_to_pixels,
)
from torchblur.io.exr import Window, read_exr
from torchblur.io.sequences import FrameFiles, find_frames
from torchblur.params import build

__all__ = ["read_channels", "read_frame", "read_image"]

OnInvalid = Literal["raise", "mask"]
WindowChoice = Literal["display", "data"]


def read_frame(
    path: str | Path | FrameFiles,
    convention: str | Convention = "auto",
    *,
    layer: str | None = None,
    view: str | None = None,
    gbuffer: str | Path | None = None,
    window: WindowChoice = "display",
    on_invalid: OnInvalid = "raise",
    **overrides: Any,
) -> Frame:
    """Read color, velocity and what else there is of one frame.

    Args:
        path: An OpenEXR file; an entry of `find_frames`, or a folder with one frame, which bring
            their `gbuffer` and `revealed` files with them.
        convention: A name in `CONVENTIONS`, "auto" to find it by the channels, or an entry.
        layer: Only channels of this layer ("ViewLayer", "beauty"), where several fit.
        view: Stereo view, "left" or "right"; the file's default one if left out.
        gbuffer: A second file that holds all layers but the color. Renderers average velocity
            over a pixel; a file with one sample per pixel keeps edges clean.
        window: "display": the image as framed, so that all files of a shot have one size; pixels
            that the file lacks are black and infinitely far. "data": all pixels the file has of
            the color, overscan included.
        on_invalid: "raise", or "mask" to replace NaN and inf (see `Frame`).
        **overrides: Fields of `ConventionOverrides`: ``velocity=("u", "v")``, ``depth=...``,
            ``velocity_scale=...``, ``velocity_y="down"``, ``time_start=-0.5`` … If no convention
            is known for the file, they start from torchblur's own.

    Returns:
        A frame of batch size 1, float32; object ids int64.

    Raises:
        FileFormatError: a file is missing or damaged, no convention fits or several do, a channel
            is missing (with those present), or two files differ in size.
        FrameError: NaN or inf, or depth that is not positive; with file, channel, count and
            position.
        ConfigError: unknown convention or override.
    """
    if isinstance(path, (str, Path)) and Path(path).is_dir():
        path = _only_frame(Path(path))
    files = path if isinstance(path, FrameFiles) else FrameFiles(number=1, path=Path(path))
    options = {"layer": layer, "view": view, "window": window, "on_invalid": on_invalid}
    changed = build(ConventionOverrides, overrides, "read_frame")
    layers = _open(files.path, gbuffer or files.gbuffer, convention, changed, options)
    revealed = layers.revealed()
    if files.revealed is not None and revealed is None:
        revealed = _open(
            files.revealed, files.revealed_gbuffer, convention, changed, options
        ).frame(None)
    return layers.frame(revealed)


def read_image(
    path: str | Path,
    *,
    layer: str | None = None,
    view: str | None = None,
    window: WindowChoice = "display",
) -> Tensor:
    """Read the color of an OpenEXR file of any known convention.

    Args:
        path: The file.
        layer: As in `read_frame`.
        view: As in `read_frame`.
        window: As in `read_frame`.

    Returns:
        Scene-linear radiance, (1, 3, H, W), float32.

    Raises:
        FileFormatError: as `read_frame`; no color channels.
        FrameError: NaN or inf, with file, channel, count and position.
    """
    catalog = Catalog.of(read_exr(path), view, layer)
    planes = _color_planes(catalog, CONVENTIONS["torchblur"])
    return _stack(catalog.path, planes, _window(planes[0], window), "raise")


def read_channels(
    path: str | Path,
    *names: str,
    layer: str | None = None,
    view: str | None = None,
    window: WindowChoice = "display",
) -> Tensor:
    """Read channels by name, as they are.

    Args:
        path: The file.
        *names: Full names or ends of names ("variance.R", "A").
        layer: As in `read_frame`.
        view: As in `read_frame`.
        window: As in `read_frame`.

    Returns:
        (1, C, H, W), float32; NaN and inf are kept.

    Raises:
        FileFormatError: a channel is missing, or several fit a name.
    """
    catalog = Catalog.of(read_exr(path), view, layer)
    planes = [_required(catalog, name) for name in names]
    box = _window(planes[0], window)
    return torch.cat([plane.tensor(box).float() for plane in planes], dim=1)


# -- reading -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Layers:
    """Where the layers of a frame are: color in one file, the others in the same or another."""

    color: Catalog
    data: Catalog
    convention: Convention
    window: Window
    on_invalid: OnInvalid

    def frame(self, revealed: Frame | None) -> Frame:
        convention, data = self.convention, self.data
        velocity, acceleration = self._velocity()
        return Frame(
            color=_stack(
                self.color.path, _color_planes(self.color, convention), self.window, self.on_invalid
            ),
            velocity=velocity,
            depth=self._depth(),
            normal=self._read(data.find_group(convention.normal)),
            object_id=self._ids(),
            time=self._time(),
            albedo=self._read(data.find_group(convention.albedo)),
            acceleration=acceleration,
            revealed=revealed,
            valid=self._valid(),
            source=str(data.path),
            on_invalid=self.on_invalid,
        )

    def revealed(self) -> Frame | None:
        """Return the layer `revealed` of torchblur's own layout, if it is there."""
        planes = [p for p in self.data.planes if p.name.startswith("revealed.")]
        if self.convention.name != "torchblur" or not planes:
            return None
        short = [
            Plane(name := p.name.removeprefix("revealed."), name, p.label, p.part, p.key, p.view)
            for p in planes
        ]
        catalog = Catalog(self.data.path, self.data.view, tuple(short))
        return _Layers(catalog, catalog, self.convention, self.window, self.on_invalid).frame(None)

    def _read(self, planes: tuple[Plane, ...] | None, fill: float = 0.0) -> Tensor | None:
        if planes is None:
            return None
        return _stack(self.data.path, planes, self.window, self.on_invalid, fill)

    def _velocity(self) -> tuple[Tensor, Tensor | None]:
        convention, data = self.convention, self.data
        following = self._motion(convention.velocity, convention.velocity_sign)
        previous = self._motion(convention.velocity_previous, convention.velocity_previous_sign)
        if following is None and previous is None:
            wanted = [*convention.velocity, *convention.velocity_previous]
            raise _missing(data, " or ".join("/".join(pair) for pair in wanted), convention)
        velocity, acceleration = mean_and_change(following, previous)
        stored = self._read(data.find_group(convention.acceleration))
        return velocity, acceleration if stored is None else stored

    def _motion(self, pairs: tuple[tuple[str, str], ...], sign: int) -> Tensor | None:
        planes = self.data.find_group(pairs)
        stored = self._read(planes, self.convention.velocity_bias)
        if planes is None or stored is None:
            return None
        if self.convention.velocity_premultiplied:
            alpha = self._read(self.data.find_group((n,) for n in self.convention.alpha))
            if alpha is not None:
                stored = torch.where(alpha > 0, stored / alpha, stored)
        image = planes[0].part.image_window
        return velocity_to_pixels(
            stored, self.convention, sign=sign, image_size=(image.height, image.width)
        )

    def _depth(self) -> Tensor | None:
        planes = self.data.find_group((name,) for name in self.convention.depth)
        if planes is None:
            return None
        stored = planes[0].tensor(self.window).float()
        distance = depth_to_distance(stored, self.convention)
        distance = torch.where(planes[0].covers(self.window), distance, torch.inf)
        bad = ~(distance > 0)
        if self.on_invalid == "raise" and bool(bad.any()):
            raise FrameError(
                _bad_values(self.data.path, planes[0], stored, bad, "be a positive distance")
                + '; depth_zero="background", depth_scale=-1 or depth_kind=... may fit the file'
            )
        return distance

    def _time(self) -> Tensor | None:
        convention = self.convention
        planes = self.data.find_group((name,) for name in convention.time)
        stored = self._read(planes, convention.time_start)
        return None if stored is None else time_to_shutter(stored, convention)

    def _ids(self) -> Tensor | None:
        planes = self.data.find_group((name,) for name in self.convention.object_id)
        if planes is None:
            return None
        stored = planes[0].tensor(self.window)
        bad = stored != stored.round() if stored.is_floating_point() else torch.tensor(False)
        if bool(bad.any()):
            raise FrameError(
                _bad_values(self.data.path, planes[0], stored, bad, "hold whole numbers")
                + "; object_id=None leaves it out"
            )
        return stored.long()

    def _valid(self) -> Tensor | None:
        plane = self.data.find("valid") if self.convention.name == "torchblur" else None
        return None if plane is None else plane.tensor(self.window) != 0


def _open(
    path: Path,
    gbuffer: str | Path | None,
    convention: str | Convention,
    overrides: ConventionOverrides,
    options: Mapping[str, Any],
) -> _Layers:
    color = Catalog.of(read_exr(path), options["view"], options["layer"])
    data = color
    if gbuffer is not None:
        data = Catalog.of(read_exr(gbuffer), options["view"], options["layer"])
        _check_sizes(color, data)
    chosen = resolve_convention(data, convention, overrides)
    _check_named(color, data, chosen, overrides)
    window = _window(_color_planes(color, chosen)[0], options["window"])
    return _Layers(color, data, chosen, window, options["on_invalid"])


def _check_named(
    color: Catalog, data: Catalog, convention: Convention, overrides: ConventionOverrides
) -> None:
    """Refuse a channel that the caller named and the file lacks."""
    for name in CHANNEL_FIELDS:
        if getattr(overrides, name) is None:
            continue
        catalog = color if name == "color" else data
        for group in getattr(convention, name):
            group = (group,) if isinstance(group, str) else group
            if catalog.find_group([group]) is None:
                raise _missing(catalog, "/".join(group), convention)


def _only_frame(folder: Path) -> FrameFiles:
    frames = find_frames(folder)
    if len(frames) > 1:
        raise FileFormatError(
            f"{folder} holds {len(frames)} frames, {frames[0].path.name} to "
            f"{frames[-1].path.name}; find_frames lists them"
        )
    return frames[0]


def _check_sizes(color: Catalog, data: Catalog) -> None:
    windows = [catalog.planes[0].part.image_window for catalog in (color, data)]
    first, second = [(window.width, window.height) for window in windows]
    if first != second:
        raise FileFormatError(
            f"the files of a frame must have one size: {color.path} is {first[0]}x{first[1]}, "
            f"{data.path} is {second[0]}x{second[1]}"
        )


def _color_planes(catalog: Catalog, convention: Convention) -> tuple[Plane, ...]:
    for entry in (convention, *CONVENTIONS.values()):
        planes = catalog.find_group(entry.color)
        if planes is not None:
            return planes
    raise _missing(catalog, " or ".join("/".join(group) for group in convention.color), convention)


def _required(catalog: Catalog, name: str) -> Plane:
    plane = catalog.find(name)
    if plane is None:
        raise FileFormatError(
            f"{catalog.path} has no channel `{name}`; present: {', '.join(catalog.labels)}"
        )
    return plane


def _missing(catalog: Catalog, wanted: str, convention: Convention) -> FileFormatError:
    return FileFormatError(
        f"{catalog.path} has no channels {wanted} (convention `{convention.name}`); present: "
        f"{', '.join(catalog.labels)}"
    )


def _window(plane: Plane, choice: WindowChoice) -> Window:
    if choice not in ("display", "data"):
        raise FrameError(f"`window` must be 'display' or 'data', got {choice!r}")
    return plane.part.image_window if choice == "display" else plane.part.window


def _stack(
    path: Path, planes: tuple[Plane, ...], window: Window, on_invalid: OnInvalid, fill: float = 0.0
) -> Tensor:
    tensors = [plane.tensor(window, fill).float() for plane in planes]
    for plane, tensor in zip(planes, tensors, strict=True):
        bad = ~torch.isfinite(tensor)
        if on_invalid == "raise" and bool(bad.any()):
            raise FrameError(_bad_values(path, plane, tensor, bad, "be finite"))
    return torch.cat(tensors, dim=1)


def _bad_values(path: Path, plane: Plane, values: Tensor, bad: Tensor, rule: str) -> str:
    y, x = (int(i) for i in bad[0, 0].nonzero()[0])
    return (
        f"channel `{plane.label}` of {path} must {rule}, got {int(bad.sum())} values that are "
        f'not, the first {float(values[0, 0, y, x])} at x={x}, y={y}; on_invalid="mask" '
        "replaces them"
    )
