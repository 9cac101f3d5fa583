"""Images that are written for people and read back: EXR, and PNG for screens."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin, UnidentifiedImageError
from torch import Tensor

from torchblur.errors import FileFormatError, OutputError
from torchblur.io import read_image, write_image
from torchblur.io import read_metadata as read_exr_metadata
from torchblur.io.paths import input_file, output_file
from torchblur.metrics import display_encode
from torchblur.ops.color import srgb_to_linear

__all__ = ["IMAGE_TYPES", "read_color", "read_metadata", "write_color"]

IMAGE_TYPES = (".exr", ".png")
"""Endings of the files that can be written."""

_METADATA_KEY = "torchblur"


def read_color(path: str | Path) -> Tensor:
    """Read the color of an image as scene-linear radiance.

    Args:
        path: An OpenEXR file, or a PNG, whose values are decoded from sRGB.

    Returns:
        (1, 3, H, W), float32.

    Raises:
        FileFormatError: no such file, damaged, or without color.
        FrameError: NaN or inf.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        return read_image(path)
    values = torch.from_numpy(_png_values(path))
    return srgb_to_linear(values.permute(2, 0, 1)[None].contiguous())


def write_color(
    path: str | Path,
    color: Tensor,
    *,
    layers: Mapping[str, Tensor] | None = None,
    half: bool = True,
    metadata: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Write an image; it appears whole or not at all.

    Args:
        path: `.exr` for scene-linear values, `.png` for 8-bit sRGB, clipped to [0, 1].
        color: Scene-linear radiance, (1, 3, H, W).
        layers: More layers by name, (1, C, H, W); EXR only.
        half: EXR: 16-bit color.
        metadata: Anything JSON can hold; `read_metadata` gives it back.
        overwrite: Replace an existing file.

    Raises:
        OutputError: another ending, layers in a PNG, the file exists, or cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() == ".exr":
        write_image(path, color, layers=layers, half=half, metadata=metadata, overwrite=overwrite)
        return
    if path.suffix.lower() != ".png":
        raise OutputError(f"{path} must end in {' or '.join(IMAGE_TYPES)}")
    if layers:
        raise OutputError(f"{path}: a PNG holds color alone, not {', '.join(layers)}; use .exr")
    values = display_encode(color.detach().cpu())[0].permute(1, 2, 0)
    image = Image.fromarray((values * 255).round().to(torch.uint8).numpy())
    text = PngImagePlugin.PngInfo()
    if metadata is not None:
        text.add_itxt(_METADATA_KEY, json.dumps(metadata, ensure_ascii=False))
    with output_file(path, overwrite=overwrite) as temporary:
        image.save(temporary, format="PNG", pnginfo=text)


def read_metadata(path: str | Path) -> dict[str, Any]:
    """Read what `write_color` was given as metadata, and check that the file is complete.

    Args:
        path: An EXR or PNG file.

    Returns:
        The metadata; empty for files of other programs.

    Raises:
        FileFormatError: the file is damaged or truncated.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        return read_exr_metadata(path)
    try:
        with Image.open(path) as image:
            image.load()
            return dict(json.loads(image.text.get(_METADATA_KEY, "{}")))  # type: ignore[attr-defined]
    except (OSError, SyntaxError, ValueError) as error:
        raise FileFormatError(f"{path} is damaged: {error}") from error


def _png_values(path: Path) -> NDArray[np.float32]:
    """Return values in [0, 1], (H, W, 3)."""
    try:
        with Image.open(input_file(path)) as image:
            if image.mode not in ("RGB", "RGBA", "L"):
                raise FileFormatError(f"{path}: an 8-bit RGB image is needed, got {image.mode}")
            return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255)
    except UnidentifiedImageError as error:
        raise FileFormatError(f"{path} is not a PNG file") from error
    except OSError as error:
        raise FileFormatError(f"{path} is damaged: {error}") from error
