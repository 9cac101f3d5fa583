"""Finding a channel: by the end of its name, whatever the view layer, the part or the view.

Files name the same thing in many ways: `ViewLayer.Vector.X`, part `forward_left` with channel
`forward.u`, or `forward.left.u` in one part. A `Catalog` is the channels of one view under names
without the view, so that `Vector.X` or `forward.u` finds them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchblur.errors import FileFormatError, nearest_name
from torchblur.io.exr import ExrFile, ExrPart, Window

__all__ = ["Catalog", "Plane", "views_of"]

_MAIN_PARTS = ("", "rgba", "rgb", "beauty", "color", "c")


@dataclass(frozen=True, eq=False)
class Plane:
    """One channel of a file.

    Args:
        name: Its name without view and chosen layer; what a suffix is compared with.
        long_name: The same with the part's name before it.
        label: Its name in the file, and the part if there are several; for messages.
        part: Where it is.
        key: Its name in the part.
        view: Its stereo view, or "".
    """

    name: str
    long_name: str
    label: str
    part: ExrPart
    key: str
    view: str

    def ends_with(self, suffix: str) -> bool:
        """Whether the name ends with a dotted suffix; upper and lower case are alike.

        A suffix of one word ("Z") must be the whole name.
        """
        wanted = suffix.lower()
        if "." not in wanted:
            return self.name.lower() == wanted
        return any(
            f".{name.lower()}".endswith(f".{wanted}") for name in (self.name, self.long_name)
        )

    def tensor(self, window: Window, fill: float = 0.0) -> Tensor:
        """Return the channel as (1, 1, H, W), cut or extended to a window of the image.

        Args:
            window: The pixels wanted.
            fill: Value where the file has no pixels.

        Returns:
            float32; int64 for uint channels.
        """
        array = self.part.channels[self.key]
        array = array.astype(np.int64 if array.dtype == np.uint32 else np.float32)
        if self.part.window != window:
            placed = np.full((window.height, window.width), fill, dtype=array.dtype)
            target, source = self._overlap(window)
            placed[target] = array[source]
            array = placed
        return torch.from_numpy(array)[None, None]

    def covers(self, window: Window) -> Tensor:
        """Return where in a window of the image the file has pixels, bool, (1, 1, H, W)."""
        mask = torch.zeros(1, 1, window.height, window.width, dtype=torch.bool)
        mask[(0, 0, *self._overlap(window)[0])] = True
        return mask

    def _overlap(self, window: Window) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Return rows and columns that both have: in the window, and in the stored pixels."""
        have = self.part.window
        left, top = max(have.x, window.x), max(have.y, window.y)
        right = max(left, min(have.x + have.width, window.x + window.width))
        bottom = max(top, min(have.y + have.height, window.y + window.height))
        target, source = (
            (slice(top - w.y, bottom - w.y), slice(left - w.x, right - w.x)) for w in (window, have)
        )
        return target, source


@dataclass(frozen=True, eq=False)
class Catalog:
    """The channels of one view (and, if one was named, one layer) of a file.

    Args:
        path: The file, for messages.
        view: The view, or "" if the file has none.
        planes: The channels.
    """

    path: Path
    view: str
    planes: tuple[Plane, ...]

    @classmethod
    def of(cls, file: ExrFile, view: str | None = None, layer: str | None = None) -> Catalog:
        """List the channels of a view and layer.

        Args:
            file: What `read_exr` returned.
            view: "left", "right", …; the file's default view if left out.
            layer: Only channels whose name, or whose part's name, begins with it.

        Raises:
            FileFormatError: if the file has no such view or layer.
        """
        views = views_of(file)
        if view is not None and view not in views:
            raise FileFormatError(
                f"{file.path} has no view `{view}`; views: {', '.join(views) or 'none'}"
            )
        chosen = view if view is not None else (views[0] if views else "")
        planes = [plane for plane in _planes(file, views) if plane.view in ("", chosen)]
        if layer:
            planes = _only_layer(file, planes, layer)
        return cls(path=file.path, view=chosen, planes=tuple(planes))

    @property
    def labels(self) -> list[str]:
        """Names of all channels, for messages."""
        return [plane.label for plane in self.planes]

    def find(self, suffix: str) -> Plane | None:
        """Return the channel whose name ends with a suffix, or None.

        Raises:
            FileFormatError: if several do, and none is named exactly so.
        """
        found = [plane for plane in self.planes if plane.ends_with(suffix)]
        for narrower in (
            [p for p in found if p.label == suffix],
            [p for p in found if suffix.lower() in (p.name.lower(), p.long_name.lower())],
            [p for p in found if p.long_name.rpartition(".")[0].lower() in _MAIN_PARTS],
        ):
            if len(narrower) == 1:
                return narrower[0]
        if len(found) > 1:
            raise FileFormatError(
                f"{self.path}: several channels fit `{suffix}`: "
                f'{", ".join(p.label for p in found)}; choose one with layer="..." or by its '
                "full name"
            )
        return found[0] if found else None

    def find_group(self, groups: Iterable[Sequence[str]]) -> tuple[Plane, ...] | None:
        """Return the channels of the first group of suffixes that is there completely, or None.

        Raises:
            FileFormatError: if several channels fit a suffix.
        """
        for group in groups:
            planes = [self.find(suffix) for suffix in group]
            if all(planes):
                return tuple(plane for plane in planes if plane is not None)
        return None


def views_of(file: ExrFile) -> list[str]:
    """Return the stereo views of a file, the default one first."""
    views: dict[str, None] = {}
    for part in file.parts:
        names = part.attributes.get("multiView") or ([part.view] if part.view else [])
        views.update(dict.fromkeys(names))
    return list(views)


def _planes(file: ExrFile, views: Sequence[str]) -> Iterable[Plane]:
    several = len(file.parts) > 1
    for part in file.parts:
        part_name = _without_view(part.name, views) if several else ""
        multi_view = part.attributes.get("multiView") or []
        for key in part.channels:
            name, view = _split_view(key, multi_view)
            yield Plane(
                name=name,
                long_name=name
                if f"{name}.".startswith(f"{part_name}.") or not part_name
                else f"{part_name}.{name}",
                label=f"{part.name}:{key}" if several else key,
                part=part,
                key=key,
                view=part.view or view,
            )


def _split_view(key: str, views: Sequence[str]) -> tuple[str, str]:
    """Take the view out of a channel's name: "forward.left.u" is "forward.u" of the left.

    In a file of several views in one part, a name without a layer is of the default view.
    """
    *layers, last = key.split(".")
    if layers and layers[-1] in views:
        return ".".join([*layers[:-1], last]), layers[-1]
    return key, views[0] if views and not layers else ""


def _without_view(name: str, views: Sequence[str]) -> str:
    for view in views:
        for end in (f"_{view}", f".{view}"):
            if name.endswith(end):
                return name.removesuffix(end)
    return name


def _only_layer(file: ExrFile, planes: Sequence[Plane], layer: str) -> list[Plane]:
    kept = []
    for plane in planes:
        for name in (plane.name, plane.long_name):
            if name.startswith(f"{layer}."):
                short = name.removeprefix(f"{layer}.")
                kept.append(Plane(short, short, plane.label, plane.part, plane.key, plane.view))
                break
    if not kept:
        words = [plane.long_name.split(".")[:-1] for plane in planes]
        layers = sorted({".".join(w[:n]) for w in words for n in range(1, len(w) + 1)})
        hint = nearest_name(layer, layers)
        raise FileFormatError(
            f"{file.path} has no layer `{layer}`{hint}; layers: {', '.join(layers) or 'none'}"
        )
    return kept
