"""Lists of pixels: the planes of a batch of images as (P, C, 1, M), and back.

M pixels of all images of the batch, or only those that are wanted; P is 1, or the number of
parameter sets that share one image. To elementwise code a list is an image of one row. Work on
lists costs what their pixels cost, and one compiled kernel serves any size, batch and share of
wanted pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace

import torch
from torch import Tensor

__all__ = ["PixelList", "all_pixels", "positions", "select", "takes_all_pixels"]

_DENSE = 0.8  # share of wanted pixels from which all are done: packing costs, too
_ALMOST_ALL = 0.95  # the same of a list: from here on a choice costs more than it saves
_takes_all: ContextVar[bool] = ContextVar("takes_all", default=False)


@contextmanager
def all_pixels() -> Iterator[None]:
    """Let filters work on all pixels, also on those that stand still.

    No size and no branch then depends on what is in the image, as a graph that is recorded once
    (`torch.export`, CUDA graphs) needs it. The result is the same but for rounding, and that long
    paths have `num_samples` taps, whatever `tap_spacing` asks for.
    """
    before = _takes_all.set(True)
    try:
        yield
    finally:
        _takes_all.reset(before)


def takes_all_pixels() -> bool:
    """Return whether this is inside of `all_pixels`."""
    return _takes_all.get()


def positions(wanted: Tensor) -> Tensor | None:
    """Return which pixels of a list any set wants, int64, (m,); None: all may be taken.

    Args:
        wanted: bool, (P, 1, 1, M).
    """
    if takes_all_pixels():
        return None
    some = wanted.any(0).flatten()
    return None if int(some.sum()) > _ALMOST_ALL * some.shape[0] else some.nonzero()[:, 0]


def select(packed: Tensor, chosen: Tensor) -> Tensor:
    """Return some pixels of a list, (P, C, 1, m).

    Args:
        packed: The list, (P, C, 1, M).
        chosen: Positions, int64, (m,).
    """
    flat = packed.reshape(-1, packed.shape[3])
    # Twice as fast as `index_select`.
    return flat.gather(1, chosen.expand(flat.shape[0], -1)).view(*packed.shape[:3], -1)


@dataclass(frozen=True, eq=False)
class PixelList:
    """Which pixels of a batch of images are in a list.

    Args:
        batch_size: B, number of images.
        size: Height and width of an image, px.
        index: Positions in the flattened batch, int64, (M,); None: all of them.
        origin: First row and column of each image that textures have, px.
    """

    batch_size: int
    size: tuple[int, int]
    index: Tensor | None = None
    origin: tuple[int, int] = (0, 0)

    @classmethod
    def all(cls, like: Tensor) -> PixelList:
        """Return the list of all pixels.

        Args:
            like: Any tensor of the images' size, (B, C, H, W).
        """
        return cls(like.shape[0], (like.shape[2], like.shape[3]))

    @classmethod
    def in_tiles(cls, wanted: Tensor, like: Tensor, tile_size: int) -> PixelList:
        """Return the list of the pixels in some tiles; all of them if that is nearly all.

        Args:
            wanted: Tiles, bool, (B, 1, Ty, Tx); with B = 1 also (P, 1, Ty, Tx): any set counts.
            like: Any tensor of the images' size, (B, C, H, W).
            tile_size: Edge of a tile, px.
        """
        height, width = like.shape[-2:]
        if like.shape[0] == 1:
            wanted = wanted.any(0, keepdim=True)
        rows = wanted.repeat_interleave(tile_size, 2)[:, :, :height]
        return cls.where(rows.repeat_interleave(tile_size, 3)[..., :width])

    @classmethod
    def where(cls, wanted: Tensor) -> PixelList:
        """Return the list of the wanted pixels; all of them if that is nearly all.

        Args:
            wanted: bool, (B, 1, H, W).
        """
        whole = cls.all(wanted)
        if takes_all_pixels():
            return whole
        index = wanted.flatten().nonzero()[:, 0]
        return whole if index.shape[0] > _DENSE * whole.count else cls(*whole.shape, index)

    def some(self, chosen: Tensor) -> PixelList:
        """Return the list of some of these pixels.

        Args:
            chosen: Positions in this list, int64, (m,).
        """
        index = chosen if self.index is None else self.index[chosen]
        return replace(self, index=index)

    @property
    def shape(self) -> tuple[int, tuple[int, int]]:
        """Number and size of the images."""
        return self.batch_size, self.size

    @property
    def count(self) -> int:
        """Number of pixels, M."""
        height, width = self.size
        return self.batch_size * height * width if self.index is None else self.index.shape[0]

    def grid(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return column and row of each pixel in its own image, (1, 1, 1, M) each.

        Args:
            like: A tensor of the wanted type and device.
        """
        height, width = self.size
        if self.index is not None:
            places = self.index.int()  # half the cost of 64 bits
            row = torch.div(places, width, rounding_mode="floor")
            column = places - row * width
            row = row if self.batch_size == 1 else row % height
            return column.to(like.dtype).view(1, 1, 1, -1), row.to(like.dtype).view(1, 1, 1, -1)
        x = torch.arange(width, device=like.device, dtype=like.dtype).view(1, 1, 1, width)
        y = torch.arange(height, device=like.device, dtype=like.dtype).view(1, 1, height, 1)
        image = (self.batch_size, 1, height, width)
        return self._listed(x.expand(image)), self._listed(y.expand(image))

    def image(self, like: Tensor) -> Tensor:
        """Return which image of the batch each pixel is of, (1, 1, 1, M).

        Args:
            like: A tensor of the wanted type and device.
        """
        height, width = self.size
        number = torch.div(self._places(like), height * width, rounding_mode="floor")
        return number.to(like.dtype).view(1, 1, 1, -1)

    def _places(self, like: Tensor) -> Tensor:
        if self.index is not None:
            return self.index
        return torch.arange(self.count, device=like.device)

    def pack(self, plane: Tensor) -> Tensor:
        """Return a plane's pixels, (P, C, 1, M); what has no pixels of its own stays as it is.

        Args:
            plane: Broadcasts to (B, C, H, W), or with B = 1 to (P, C, H, W); or 0-d.

        Differentiable: yes.
        """
        if plane.ndim == 0 or (plane.numel() == 1 and self.size != (1, 1)):
            return plane.reshape(())
        if plane.shape[-2:] == (1, 1) and (self.batch_size == 1 or plane.shape[0] == 1):
            return plane
        return self._listed(plane.expand(-1, -1, *self.size))

    def _listed(self, images: Tensor) -> Tensor:
        if self.batch_size > 1:
            images = images.expand(self.batch_size, -1, -1, -1).transpose(0, 1)
            packed = images.reshape(1, images.shape[0], 1, -1)
        else:
            packed = images.reshape(*images.shape[:2], 1, -1)
        return packed if self.index is None else select(packed, self.index)

    def unpack(self, packed: Tensor, over: Tensor | float = 0.0) -> Tensor:
        """Return the images of a list, (B, C, H, W) or (P, C, H, W).

        Args:
            packed: Broadcasts to (P, C, 1, M).
            over: What all other pixels have: a number, or images that broadcast to the result.

        Differentiable: yes.
        """
        height, width = self.size
        packed = packed.expand(-1, -1, 1, self.count)
        sets, channels = packed.shape[:2]
        if self.count == 0 and isinstance(over, Tensor) and over.shape[0] >= sets:
            return over
        if self.index is not None:
            places = self.index.view(1, 1, 1, -1).expand(packed.shape)
            packed = self._whole(packed, over).scatter(3, places, packed)
        if self.batch_size > 1:
            return packed.reshape(channels, self.batch_size, height, width).transpose(0, 1)
        return packed.reshape(sets, channels, height, width)

    def _whole(self, packed: Tensor, over: Tensor | float) -> Tensor:
        """Return `over` as a list of all pixels, (P, C, 1, B * H * W)."""
        whole = PixelList(*self.shape)
        shape = (*packed.shape[:3], whole.count)
        if not isinstance(over, Tensor):
            return packed.new_full((), over).expand(shape)  # `scatter` copies it: one write in all
        return whole.pack(over).expand(shape)

    def texture(self, texture: Tensor) -> Tensor:
        """Return the images of a batch (B, C, H, W) below each other, (C, B * H, W)."""
        return texture.transpose(0, 1).reshape(texture.shape[1], -1, texture.shape[3])

    def rows(self, like: Tensor) -> dict[str, Tensor]:
        """Return where in a texture the pixels' own images lie, and their size.

        Args:
            like: A texture before `texture` made it flat, (B, C, h, w).

        Returns:
            "first_row", that of each pixel's image, (1, 1, 1, M), and "first_column", "height" and
            "width" of all images, 0-d. Where the texture has only a part of each image, the first
            row and column are those that the image would have.
        """
        numbers = (-self.origin[1], *self.size)
        names = ("first_column", "height", "width")
        whole = {n: like.new_full((), float(v)) for n, v in zip(names, numbers, strict=True)}
        if self.batch_size > 1:
            return whole | {"first_row": self.image(like) * like.shape[2] - self.origin[0]}
        shape = (1, 1, 1, self.count)
        return whole | {"first_row": like.new_full(shape, float(-self.origin[0]))}

    def lists(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the inputs of a gather, textures as they are and all else as lists."""
        return {
            name: plane if name.startswith("texture") else self.pack(plane)
            for name, plane in inputs.items()
        }

    def some_of(self, lists: Mapping[str, Tensor], chosen: Tensor) -> dict[str, Tensor]:
        """Return lists with some of these pixels; textures and parameters stay as they are.

        Args:
            lists: Lists of these pixels, textures and parameters by name.
            chosen: Positions in this list, int64, (m,).
        """
        return {
            name: select(plane, chosen)
            if not name.startswith("texture") and plane.shape[3:] == (self.count,)
            else plane
            for name, plane in lists.items()
        }

    def with_textures(self, lists: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return lists with their textures as `texture` has them, and the `rows`."""
        stacked = {
            name: self.texture(plane) if name.startswith("texture") else plane
            for name, plane in lists.items()
        }
        return stacked | self.rows(lists["texture"])
