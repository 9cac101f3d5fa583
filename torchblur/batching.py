"""Frames in a `DataLoader`: they are collated as tensors are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch.utils.data import default_collate

from torchblur.errors import FrameError
from torchblur.frame import Frame

__all__ = ["collate"]


def collate(items: Sequence[Any]) -> Any:
    """Join the items of a batch as torch's own `default_collate` does, `Frame`s into one frame.

    A `DataLoader` does this by itself; for ``collate_fn=`` where it is given another function.

    Args:
        items: Frames, or tuples, lists and mappings of frames and whatever torch collates.

    Returns:
        A frame of B frames; a list or a dict of them where the items are tuples, lists or mappings.

    Raises:
        FrameError: frames of differing sizes or layers.
    """
    first = items[0]
    if isinstance(first, Frame):
        return _join(items)
    if isinstance(first, Mapping):
        return {key: collate([item[key] for item in items]) for key in first}
    if isinstance(first, (tuple, list)):
        return [collate(column) for column in zip(*items, strict=True)]
    return default_collate(list(items))


def _join(frames: Sequence[Frame], *, collate_fn_map: Any = None) -> Frame:
    """Return the frames as one; torch gives the map of its collating functions along."""
    names = [_layers(frame) for frame in frames]
    for index, has in enumerate(names):
        if has != names[0]:
            name = min(has ^ names[0])
            one, other = (0, index) if name in names[0] else (index, 0)
            raise FrameError(
                f"the frames of a batch must have the same layers: frame {one} has `{name}`, "
                f"frame {other} has not; `frame.only(...)` drops layers"
            )
    return Frame.stack(frames)


def _layers(frame: Frame) -> set[str]:
    behind = set() if frame.revealed is None else _layers(frame.revealed)
    return set(frame.layers()) | {f"revealed.{name}" for name in behind}


def _teach_default_collate() -> None:
    try:  # where torch's documentation of `default_collate` has it, in a private module
        from torch.utils.data._utils.collate import default_collate_fn_map
    except ImportError:  # pragma: no cover
        return
    default_collate_fn_map[Frame] = _join


_teach_default_collate()
