"""Lists of pixels: the planes of a batch of images as (P, C, 1, M), and back.

M pixels of all images of the batch, or only those that are wanted; P is 1, or the number of
parameter sets that share one image. Work on lists costs what their pixels cost, and one compiled
kernel serves any size, batch and share of wanted pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["PixelList"]

_DENSE = 0.8  # share of wanted pixels from which all are done: packing costs, too


@dataclass(frozen=True, eq=False)
class PixelList:
    """Which pixels of a batch of images are in a list.

    Args:
        batch_size: B, number of images.
        size: Height and width of an image, px.
        index: Positions in the flattened batch, int64, (M,); None: all of them.
    """

    batch_size: int
    size: tuple[int, int]
    index: Tensor | None = None

    @classmethod
    def where(cls, like: Tensor, wanted: Tensor | None = None) -> PixelList:
        """Return the list of the wanted pixels; all of them if that is nearly all.

        Args:
            like: Any tensor of the images' size, (B, C, H, W).
            wanted: bool, (B, 1, H, W); with B = 1 also (P, 1, H, W): any set's wish counts.
        """
        height, width = like.shape[-2:]
        index = None
        if wanted is not None:
            if like.shape[0] == 1:
                wanted = wanted.any(0, keepdim=True)
            found = wanted.expand(like.shape[0], -1, height, width).flatten().nonzero()[:, 0]
            if found.shape[0] < _DENSE * like.shape[0] * height * width:
                index = found
        return cls(like.shape[0], (height, width), index)

    @property
    def count(self) -> int:
        """Number of pixels, M."""
        height, width = self.size
        return self.batch_size * height * width if self.index is None else self.index.shape[0]

    def pack(self, plane: Tensor) -> Tensor:
        """Return a plane's pixels, (P, C, 1, M); what has no pixels of its own stays as it is.

        Args:
            plane: Broadcasts to (B, C, H, W), or with B = 1 to (P, C, H, W); or 0-d.

        Differentiable: yes.
        """
        if plane.ndim == 0 or plane.numel() == 1:
            return plane.reshape(())
        height, width = self.size
        if self.batch_size > 1:
            if plane.shape[0] == 1 and plane.shape[-2:] == (1, 1):
                return plane
            plane = plane.expand(self.batch_size, -1, height, width).transpose(0, 1)
            packed = plane.reshape(1, plane.shape[0], 1, -1)
        elif plane.shape[-2:] == (1, 1):
            return plane
        else:
            packed = plane.expand(-1, -1, height, width).reshape(*plane.shape[:2], 1, -1)
        return packed if self.index is None else packed[..., self.index]

    def unpack(self, packed: Tensor) -> Tensor:
        """Return the images of a list, (B, C, H, W) or (P, C, H, W); 0 at all other pixels.

        Args:
            packed: (P, C, 1, M).

        Differentiable: yes.
        """
        height, width = self.size
        sets, channels = packed.shape[:2]
        if self.index is not None:
            pixels = self.batch_size * height * width
            whole = packed.new_zeros(sets, channels, 1, pixels)
            packed = whole.index_copy(3, self.index, packed.expand(-1, -1, 1, self.count))
        if self.batch_size > 1:
            return packed.reshape(channels, self.batch_size, height, width).transpose(0, 1)
        return packed.reshape(sets, channels, height, width)

    def texture(self, texture: Tensor) -> Tensor:
        """Return the images of a batch (B, C, H, W) below each other, (C, B * H, W)."""
        return texture.transpose(0, 1).reshape(texture.shape[1], -1, texture.shape[3])

    def rows(self, like: Tensor) -> dict[str, Tensor]:
        """Return where the pixels' own images lie in a texture.

        Args:
            like: A tensor of the wanted type and device.

        Returns:
            "first_row" of each pixel's image, (1, 1, 1, M), and the "height" of all, 0-d.
        """
        height, width = self.size
        rows = torch.arange(self.batch_size, device=like.device).to(like.dtype) * height
        first_row = rows.repeat_interleave(height * width).view(1, 1, 1, -1)
        return {
            "first_row": first_row if self.index is None else first_row[..., self.index],
            "height": torch.tensor(float(height), dtype=like.dtype, device=like.device),
        }

    def lists(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return all inputs of a gather: textures as `texture` has them, all else as lists."""
        lists = {
            name: self.texture(plane) if name.startswith("texture") else self.pack(plane)
            for name, plane in inputs.items()
        }
        return lists | self.rows(inputs["texture"])
