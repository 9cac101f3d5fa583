"""The gather of the filters: a sum over taps around every pixel of a batch of images.

A filter is a *tap function*, which returns what one tap adds to each accumulator, and a
*resolve*, which turns the accumulators into an image. Inside a tap all planes are lists of
pixels, (P, C, 1, M), as `ops.pixels` says, so that one compiled kernel serves any size, batch and
share of active pixels. What a tap reads comes plane by plane, so that the compiler makes one loop
of the whole tap.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.ops.pixels import PixelList, positions, takes_all_pixels
from torchblur.ops.tap_kernels import Lookups
from torchblur.ops.taps import Engine, Inputs, Lists, Planes, TapFunction, sum_taps

__all__ = [
    "Engine",
    "Inputs",
    "Lookup",
    "Planes",
    "Storage",
    "TapFunction",
    "components",
    "gather",
    "gather_lists",
    "gather_some",
    "lookup",
    "pixel_grid",
    "read",
    "stored_as",
    "vector",
    "weighted",
]

Lookup = Literal["nearest", "bilinear"]
Storage = Literal["full", "half"]

_MOST_ROWS = 4096  # of all images of a batch; with more, normalized float32 rows lose accuracy
_storage: ContextVar[Storage] = ContextVar("storage", default="full")


@contextmanager
def stored_as(storage: Storage) -> Iterator[None]:
    """Let gathers keep what taps read in 16 bits ("half"), or as it comes ("full").

    Half takes half of the memory's bandwidth, where that is the limit. All arithmetic, sums and
    gradients stay as they are; what is read is rounded to 11 bits, 0.05 %, and limited to 65504.
    """
    before = _storage.set(storage)
    try:
        yield
    finally:
        _storage.reset(before)


def gather(  # noqa: PLR0913 - a sum has as many parts
    tap: TapFunction,
    options: Hashable,
    num_samples: int,
    inputs: Mapping[str, Tensor],
    engine: Engine = "eager",
    *,
    num_maxima: int = 0,
    active: PixelList | None = None,
    color_from: int = 0,
) -> tuple[Tensor, ...]:
    """Return the sums over ``num_samples`` taps of what the tap function returns.

    Args:
        tap: A module-level function of plain torch operations on planes (P, C, 1, M). It may use
            nothing but its arguments: whatever needs a gradient must be in `inputs`. It looks up
            with `read`. A tuple of planes among what it returns is one accumulator with so many
            channels.
        options: Switches for the tap function, hashable; each set is compiled once.
        num_samples: Number of taps, N >= 1.
        inputs: Tensors by name: "texture" (B, C, H, W), what is looked up, and others whose names
            begin so; planes (B, C, H, W) and parameters that broadcast to them. If the texture
            has a batch of one, planes and parameters with a batch of P are P parameter sets,
            which share all that they can.
        engine: "eager", or "compiled" to compile the tap function with `torch.compile`; without
            a compiler there is one warning and the eager result.
        num_maxima: So many accumulators, the last ones, are maxima over the taps, not sums.
        active: The pixels that are wanted, all if left out; the others are 0 and cost nothing.
        color_from: Of the channels of "texture" before this one no gradient is wanted.

    Returns:
        The accumulators (B or P, C, H, W), in the tap's order.

    Differentiable: once, in all floating `inputs`, with memory independent of N. Backward costs
        about one forward and backward of each tap. The gradient of a maximum goes to the first
        tap that reaches it.

    Raises:
        ConfigError: if the engine has another name.
    """
    pixels = PixelList.all(inputs["texture"]) if active is None else active
    lists = pixels.lists(inputs)
    sums = gather_lists(
        tap,
        options,
        num_samples,
        lists,
        pixels,
        engine,
        num_maxima=num_maxima,
        color_from=color_from,
    )
    return tuple(pixels.unpack(total) for total in sums)


def gather_lists(  # noqa: PLR0913 - what `gather` takes, and the pixels
    tap: TapFunction,
    options: Hashable,
    num_samples: int,
    lists: Mapping[str, Tensor],
    pixels: PixelList,
    engine: Engine = "eager",
    *,
    num_maxima: int = 0,
    color_from: int = 0,
) -> tuple[Tensor, ...]:
    """Return the same as `gather` from lists of pixels, as lists (P, C, 1, M).

    Args:
        tap: As in `gather`.
        options: Likewise.
        num_samples: Likewise.
        lists: The inputs; all but the textures are lists of the pixels, or parameters as
            `PixelList.pack` returns them.
        pixels: The pixels.
        engine: As in `gather`.
        num_maxima: Likewise.
        color_from: Likewise.

    Differentiable: as `gather`.
    """
    inputs = pixels.with_textures(lists)
    count = None if takes_all_pixels() else pixels.count  # parts would make a graph very long
    kind = Lists(count, color_from, torch.half if _storage.get() == "half" else None)
    return sum_taps(tap, options, num_samples, inputs, engine, num_maxima=num_maxima, lists=kind)


def gather_some(  # noqa: PLR0913 - what `gather_lists` takes, and which pixels
    tap: TapFunction,
    options: Hashable,
    num_samples: int,
    lists: Mapping[str, Tensor],
    pixels: PixelList,
    wanted: Tensor,
    engine: Engine = "eager",
    *,
    num_maxima: int = 0,
    color_from: int = 0,
) -> tuple[Tensor, ...]:
    """Return the same as `gather_lists` for some pixels of the lists, and 0 for the others.

    Args:
        tap: As in `gather`.
        options: Likewise.
        num_samples: Likewise.
        lists: As in `gather_lists`.
        pixels: Those of the lists.
        wanted: Which of them, bool, (P, 1, 1, M); what no set wants costs nothing.
        engine: As in `gather`.
        num_maxima: Likewise.
        color_from: Likewise.

    Differentiable: as `gather`.
    """
    chosen = positions(wanted)
    if chosen is not None:
        lists = pixels.some_of(lists, chosen)
    part = pixels if chosen is None else pixels.some(chosen)
    sums = gather_lists(
        tap, options, num_samples, lists, part, engine, num_maxima=num_maxima, color_from=color_from
    )
    if chosen is not None:
        sums = tuple(
            new.new_zeros(*new.shape[:3], pixels.count).index_copy(3, chosen, new) for new in sums
        )
    return tuple(torch.where(wanted, plane, 0.0) for plane in sums)


def read(
    inputs: Inputs,
    x: Tensor,
    y: Tensor,
    mode: Lookup = "nearest",
    channels: slice = slice(None),
    name: str = "texture",
    *,
    linear: Tensor | None = None,
) -> Planes:
    """Return a tap's view of the texture at positions in pixel indices; for tap functions.

    Args:
        inputs: The tap's inputs.
        x: Columns, px; 0 is the center of the first pixel, (P, 1, 1, M).
        y: Rows, px, likewise.
        mode: "nearest" (ties to even) or "bilinear".
        channels: Those of the texture that are wanted.
        name: Which texture.
        linear: Where a bilinear lookup is one, bool, (P, 1, 1, M); elsewhere it is nearest. None:
            everywhere.

    Returns:
        One plane (P, 1, 1, M) per channel.

    Border: replicated.
    Differentiable: in the texture; in the positions with "bilinear" only.
    """
    texture = inputs[name][channels]
    x = torch.minimum(x.clamp(min=0), inputs["width"] - 1)
    y = torch.minimum(y.clamp(min=0), inputs["height"] - 1)
    first_row, first_column = inputs["first_row"], inputs["first_column"]
    if mode == "nearest":
        return _split(_at(texture, x.round() + first_column, y.round() + first_row))
    compiling = torch.compiler.is_dynamo_compiling() or isinstance(texture, Lookups)
    as_is = not compiling and texture.dtype == x.dtype
    if as_is and texture.shape[1] <= _MOST_ROWS:
        fine = _sampled(texture, x + first_column, y + first_row)
        if linear is None:
            return fine
        near = _split(_at(texture, x.round() + first_column, y.round() + first_row))
        return tuple(torch.where(linear, f, n) for f, n in zip(fine, near, strict=True))
    if linear is not None:  # at a pixel's center a bilinear lookup is that pixel
        x, y = torch.where(linear, x, x.round()), torch.where(linear, y, y.round())
    left, top = x.detach().floor(), y.detach().floor()
    right = torch.minimum(left + 1, inputs["width"] - 1)
    bottom = torch.minimum(top + 1, inputs["height"] - 1)
    dx, dy = x - left, y - top
    rows = []
    columns = left + first_column, right + first_column
    for row in (top + first_row, bottom + first_row):
        pairs = zip(*(_at(texture, column, row) for column in columns), strict=True)
        rows.append([torch.lerp(a, b, dx) for a, b in pairs])
    return _split(tuple(torch.lerp(a, b, dy) for a, b in zip(*rows, strict=True)))


def components(name: str, plane: Tensor) -> Inputs:
    """Return a vector as two inputs of a gather, which taps get by `vector`.

    Two channels of one input would be taken apart in each tap, and the compiler would make a loop
    of its own of putting their gradients together.

    Args:
        name: Of the vector.
        plane: Its x and y, (B, 2, H, W).
    """
    x, y = plane.split(1, 1)
    return {f"{name}_x": x, f"{name}_y": y}


def vector(inputs: Inputs, name: str) -> tuple[Tensor, Tensor]:
    """Return x and y of a vector among the inputs of a tap, (P, 1, 1, M) each."""
    return inputs[f"{name}_x"], inputs[f"{name}_y"]


def weighted(weight: Tensor, planes: Planes) -> Planes:
    """Return each plane times the weight."""
    return tuple(weight * plane for plane in planes)


def _sampled(texture: Tensor, x: Tensor, y: Tensor) -> Planes:
    """Return bilinear values by torch's own function, which is fast where nothing is compiled."""
    height, width = texture.shape[1:]
    grid = torch.stack(((2 * x + 1) / width - 1, (2 * y + 1) / height - 1), dim=-1)
    grid = grid.reshape(1, x.shape[0], -1, 2)
    values = F.grid_sample(texture[None], grid, padding_mode="border", align_corners=False)
    return values.reshape(texture.shape[0], *x.shape).unbind(0)


def _at(texture: Tensor | Lookups, column: Tensor, row: Tensor) -> Planes:
    """Return values at whole pixels: one by one to the compiler, which joins them in one loop.

    Returns:
        One plane (P, 1, 1, M) per channel, or without a compiler all in one (C, P, 1, 1, M).
    """
    index = row.to(torch.int32) * texture.shape[2] + column.to(torch.int32)
    if isinstance(texture, Lookups):
        return texture.probed(_split(_at(texture.texture, column, row)), index)
    flat = texture.flatten(1)
    kind = torch.promote_types(texture.dtype, column.dtype)  # half is how it is kept, no more
    if not torch.compiler.is_dynamo_compiling():
        values = flat.index_select(1, index.flatten()).to(kind)
        return (values.reshape(texture.shape[0], *index.shape),)
    sets = index.shape[0]
    where = index.reshape(sets, -1).long()
    planes = [flat[c].expand(sets, -1).gather(1, where) for c in range(texture.shape[0])]
    return tuple(plane.reshape(index.shape).to(kind) for plane in planes)


def _split(planes: Planes) -> Planes:
    """Return planes (P, 1, 1, M)."""
    return planes if planes[0].ndim == 4 else planes[0].unbind(0)


# -- lookups ---------------------------------------------------------------------------------------


def pixel_grid(like: Tensor, pixels: PixelList | None = None) -> tuple[Tensor, Tensor]:
    """Return column and row indices of all pixels, shapes (1, 1, 1, W) and (1, 1, H, 1).

    Args:
        like: A tensor (B, C, H, W) whose size, device and type they take.
        pixels: Only those; `like` then tells device and type alone, and both are (1, 1, 1, M).
    """
    if pixels is not None:
        return pixels.grid(like)
    height, width = like.shape[-2:]
    x = torch.arange(width, device=like.device, dtype=like.dtype)
    y = torch.arange(height, device=like.device, dtype=like.dtype)
    return x.view(1, 1, 1, width), y.view(1, 1, height, 1)


def lookup(texture: Tensor, x: Tensor, y: Tensor, mode: Lookup = "nearest") -> Tensor:
    """Return a texture's values at positions in pixel indices.

    Args:
        texture: Planes, (B, C, H, W); one texture serves any batch of positions.
        x: Columns, px; 0 is the center of the first pixel. Broadcasts to (B, 1, H', W').
        y: Rows, px, likewise.
        mode: "nearest" (ties to even) or "bilinear".

    Returns:
        Values, (B, C, H', W').

    Border: replicated.
    Differentiable: in the texture; in the positions with "bilinear" only.
    """
    height, width = texture.shape[-2:]
    x, y = torch.broadcast_tensors(x, y)
    texture = texture.expand(max(texture.shape[0], x.shape[0]), -1, -1, -1)
    if mode == "bilinear":
        grid = torch.stack(((2 * x + 1) / width - 1, (2 * y + 1) / height - 1), dim=-1)[:, 0]
        grid = grid.expand(texture.shape[0], -1, -1, -1)
        return F.grid_sample(texture, grid, mode, padding_mode="border", align_corners=False)
    columns = x.round().clamp(0, width - 1)
    rows = y.round().clamp(0, height - 1)
    index = (rows.long() * width + columns.long()).expand(texture.shape[0], 1, -1, -1)
    channels = texture.shape[1]
    flat = texture.reshape(*texture.shape[:2], height * width)
    values = flat.gather(2, index.reshape(index.shape[0], 1, -1).expand(-1, channels, -1))
    return values.reshape(-1, channels, *index.shape[-2:])
