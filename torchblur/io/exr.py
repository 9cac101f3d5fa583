"""OpenEXR files as arrays: every channel with its own type, or one clear error.

A thin guard around the OpenEXR package, which accepts arrays that it then writes wrongly, changes
the dicts that it is given, and reports damaged pixels on the console instead of raising.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from torchblur.errors import FileFormatError, OutputError
from torchblur.io.exr_blocks import check_complete
from torchblur.io.paths import input_file, output_file

__all__ = [
    "HALF_MAX",
    "ExrFile",
    "ExrPart",
    "Window",
    "read_exr",
    "read_metadata",
    "read_size",
    "to_half",
    "write_exr",
]

HALF_MAX = 65504.0
"""Largest finite value of half float."""

METADATA_KEY = "torchblur"
"""Name of the header attribute that holds our metadata, as JSON."""

_LOSSLESS = ("none", "rle", "zips", "zip", "piz", "zstd")
_TYPES = {"float16": "half", "float32": "float", "uint32": "uint"}


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels: position of its upper left pixel, and its size, in px."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True, kw_only=True, eq=False)
class ExrPart:
    """One part of a file: channels of one size.

    Args:
        channels: Arrays (H, W) of float16, float32 or uint32 by channel name.
        name: Name of the part; needed, and different, if a file has several.
        view: Stereo view ("left", "right"), or "".
        data_window: Where the pixels lie; the whole image if left out.
        display_window: The image; the data window if left out.
        compression: "none", "rle", "zips", "zip", "piz" or "zstd" (3.5 and later read it).
        attributes: The header's other attributes, as plain data. They are read, not written.
    """

    channels: Mapping[str, NDArray[Any]]
    name: str = ""
    view: str = ""
    data_window: Window | None = None
    display_window: Window | None = None
    compression: str = "zip"
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def window(self) -> Window:
        """Where the pixels lie."""
        if self.data_window is not None:
            return self.data_window
        height, width = next(iter(self.channels.values())).shape
        return Window(0, 0, width, height)

    @property
    def image_window(self) -> Window:
        """The image, of which the pixels may cover less or more."""
        return self.display_window or self.window


@dataclass(frozen=True, kw_only=True, eq=False)
class ExrFile:
    """A file that was read: its parts, and where it lies."""

    path: Path
    parts: tuple[ExrPart, ...]

    @property
    def metadata(self) -> dict[str, Any]:
        """What `write_exr` was given as metadata; empty for files of other programs."""
        return _metadata(self.path, (part.attributes for part in self.parts))


def read_exr(path: str | Path) -> ExrFile:
    """Read all parts and channels of an OpenEXR file: scanline or tiled, half, float or uint.

    Args:
        path: The file.

    Returns:
        The parts in the order of the file; arrays are contiguous, (H, W), row 0 at the top, in
        the type that the file has.

    Raises:
        FileFormatError: if the file is missing, empty, a folder, no OpenEXR file, truncated,
            damaged, deep, or has subsampled channels.
    """
    path = _whole_file(path)
    try:
        header = OpenEXR.File(str(path), header_only=True)
        file = OpenEXR.File(str(path), separate_channels=True)
    except Exception as error:
        raise FileFormatError(f"{path} is damaged: {error}") from error
    # Parts with damaged pixels are left out without an error, and later ones move up.
    if len(file.parts) != len(header.parts):
        raise FileFormatError(
            f"{path} is damaged: the pixels of {len(header.parts) - len(file.parts)} of "
            f"{len(header.parts)} parts cannot be decoded"
        )
    return ExrFile(path=path, parts=tuple(_read_part(path, part) for part in file.parts))


def read_metadata(path: str | Path) -> dict[str, Any]:
    """Read what `write_exr` was given as metadata, without decoding the pixels.

    Args:
        path: The file.

    Returns:
        The metadata; empty for files of other programs.

    Raises:
        FileFormatError: if the file is missing, empty, a folder, no OpenEXR file or truncated, or
            its header is damaged.
    """
    return _metadata(Path(path), _headers(path))


def read_size(path: str | Path) -> tuple[int, int]:
    """Read height and width in px of a file's first part, without decoding the pixels.

    Args:
        path: The file.

    Raises:
        FileFormatError: as `read_metadata`.
    """
    window = _window(_headers(path)[0]["dataWindow"])
    return window.height, window.width


def write_exr(
    path: str | Path,
    content: Mapping[str, NDArray[Any]] | Sequence[ExrPart],
    *,
    metadata: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Write an OpenEXR file; it appears whole or not at all.

    Args:
        path: The file to write.
        content: Channels (H, W) of float16, float32 or uint32 by name, or one or more parts.
        metadata: Anything JSON can hold; it goes into one text attribute, `torchblur`.
        overwrite: Replace an existing file.

    Raises:
        OutputError: if a channel has another type or size, the parts' names are not distinct,
            the metadata are not JSON, the file exists, or its folder cannot be written to.
    """
    if isinstance(content, Mapping):
        content = [ExrPart(channels=content)]
    _check_parts(path, content)
    text = _to_json(path, metadata)
    # OpenEXR changes the dicts that it gets and misreads arrays that are not contiguous.
    parts = [
        OpenEXR.Part(
            _header(path, part, text),
            {name: np.ascontiguousarray(array) for name, array in part.channels.items()},
            part.name,
        )
        for part in content
    ]
    with output_file(path, overwrite=overwrite) as temporary:
        try:
            OpenEXR.File(parts).write(str(temporary))
        except RuntimeError as error:
            raise OutputError(f"cannot write {path}: {error}") from error


def to_half(array: NDArray[Any], name: str) -> NDArray[np.float16]:
    """Convert to half float, refusing finite values that would become infinite.

    Args:
        array: Any shape.
        name: Name of the channel, for the message.

    Raises:
        OutputError: if a finite value is beyond 65504.
    """
    over = np.isfinite(array) & (np.abs(array) >= 65520)  # what rounds to inf, not to HALF_MAX
    if over.any():
        raise OutputError(
            f"channel `{name}`: half float holds up to {HALF_MAX:g}, got {int(over.sum())} values "
            f"beyond, up to {np.abs(array[over]).max():g}; half=False writes 32-bit float"
        )
    with np.errstate(over="ignore"):
        return np.asarray(array, dtype=np.float16)


# -- reading -----------------------------------------------------------------------------------


def _whole_file(path: str | Path) -> Path:
    path = input_file(path)
    if not OpenEXR.isOpenExrFile(str(path)):
        raise FileFormatError(f"{path} is not an OpenEXR file; it begins with {_head(path)}")
    check_complete(path)
    return path


def _headers(path: str | Path) -> list[Mapping[str, Any]]:
    """Return the header of each part, without decoding the pixels."""
    path = _whole_file(path)
    try:
        return [part.header for part in OpenEXR.File(str(path), header_only=True).parts]
    except Exception as error:
        raise FileFormatError(f"{path} is damaged: {error}") from error


def _metadata(path: Path, headers: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    for attributes in headers:
        text = attributes.get(METADATA_KEY)
        if isinstance(text, str):
            return _from_json(path, text)
    return {}


def _read_part(path: Path, part: Any) -> ExrPart:
    header = part.header
    kind = header["type"].name
    if kind.startswith("deep"):
        raise FileFormatError(f"{path} holds deep pixels (part `{part.name()}`); flatten it first")
    declared = {channel.name: channel for channel in header["channels"]}
    for name, channel in declared.items():
        if (channel.xSampling, channel.ySampling) != (1, 1):
            raise FileFormatError(f"{path}: channel `{name}` is subsampled; full size is needed")
        if name not in part.channels:
            raise FileFormatError(f"{path} is damaged: channel `{name}` cannot be decoded")
    return ExrPart(
        channels={name: np.ascontiguousarray(c.pixels) for name, c in part.channels.items()},
        name=part.name() or "",
        view=str(header.get("view", "")),
        data_window=_window(header["dataWindow"]),
        display_window=_window(header["displayWindow"]),
        compression=_compression_name(header["compression"].name),
        attributes={key: _plain(value) for key, value in header.items() if key != "channels"},
    )


def _compression_name(name: str) -> str:
    return "none" if name == "NO_COMPRESSION" else name.removesuffix("_COMPRESSION").lower()


def _window(box: tuple[NDArray[np.int32], NDArray[np.int32]]) -> Window:
    (left, top), (right, bottom) = (tuple(int(i) for i in corner) for corner in box)
    return Window(left, top, right - left + 1, bottom - top + 1)


def _plain(value: Any) -> Any:
    if isinstance(value, (str, int, float)):
        return value
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return getattr(value, "name", str(value))


def _head(path: Path) -> str:
    with path.open("rb") as file:
        return repr(file.read(12))


# -- writing -----------------------------------------------------------------------------------


def _check_parts(path: str | Path, parts: Sequence[ExrPart]) -> None:
    names = [part.name for part in parts]
    if not parts or not all(part.channels for part in parts):
        raise OutputError(f"cannot write {path}: a part needs at least one channel")
    if len(parts) > 1 and ("" in names or len(set(names)) < len(names)):
        raise OutputError(f"cannot write {path}: parts need distinct names, got {names}")
    for part in parts:
        shapes = {name: array.shape for name, array in part.channels.items()}
        if len(set(shapes.values())) > 1 or any(len(s) != 2 or 0 in s for s in shapes.values()):
            raise OutputError(
                f"cannot write {path}: channels must have one shape (H, W), got {shapes}"
            )
        if (part.window.height, part.window.width) not in shapes.values():
            raise OutputError(f"cannot write {path}: {part.window} does not fit {shapes}")
        for name, array in part.channels.items():
            if array.dtype.name not in _TYPES:
                raise OutputError(
                    f"cannot write {path}: channel `{name}` must be float16, float32 or uint32, "
                    f"got {array.dtype.name}"
                )


def _header(path: str | Path, part: ExrPart, text: str | None) -> dict[str, Any]:
    if part.compression not in _LOSSLESS:
        raise OutputError(
            f"cannot write {path}: `compression` must be one of {', '.join(_LOSSLESS)} (all "
            f"lossless), got {part.compression!r}"
        )
    header: dict[str, Any] = {
        "compression": getattr(
            OpenEXR,
            "NO_COMPRESSION"
            if part.compression == "none"
            else f"{part.compression.upper()}_COMPRESSION",
        ),
        "type": OpenEXR.scanlineimage,
        "dataWindow": _box(part.window),
        "displayWindow": _box(part.image_window),
    }
    if part.view:
        header["view"] = part.view
    if text is not None:
        header[METADATA_KEY] = text
    return header


def _box(window: Window) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    right, bottom = window.x + window.width - 1, window.y + window.height - 1
    return np.array([window.x, window.y], np.int32), np.array([right, bottom], np.int32)


def _from_json(path: Path, text: str) -> dict[str, Any]:
    try:
        return dict(json.loads(text))
    except (TypeError, ValueError) as error:
        raise FileFormatError(
            f"{path}: the attribute `{METADATA_KEY}` is not a JSON object: {text[:60]!r}"
        ) from error


def _to_json(path: str | Path, metadata: Mapping[str, Any] | None) -> str | None:
    if metadata is None:
        return None
    try:
        return json.dumps(dict(metadata), ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise OutputError(f"cannot write {path}: the metadata are not JSON: {error}") from error
