"""One tap of a sum, or some: forward, and backward by computing it again; eager or compiled.

A compiled backward adds the gradient of a texture in place: what a tap reads has a probe added,
whose gradient is that of what was read, and which goes where it was read. On a GPU the kernel adds
it; on a CPU its threads would need atomic additions, which cost ten times what `scatter` takes.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchblur.ops.compiling import compile_alone

__all__ = [
    "Added",
    "Engine",
    "Inputs",
    "Kernel",
    "Lookups",
    "Moved",
    "Part",
    "Planes",
    "Reads",
    "Room",
    "TapFunction",
    "flat",
    "floating",
    "kernel_of",
    "reads_of",
    "room_for",
    "scatter",
]

Engine = Literal["eager", "compiled"]
Inputs = dict[str, Tensor]
Planes = tuple[Tensor, ...]
Added = tuple[Tensor | Planes, ...]
"""What a tap adds to each accumulator: a tensor, or planes that belong together."""
TapFunction = Callable[[Tensor, Tensor, Inputs, Any], Added]
"""``tap(index, count, inputs, options)``: index and count are 0-d float tensors."""

Moved = tuple[tuple[Tensor, Planes], ...]
"""Of each lookup in a texture: where, and each channel's gradient, (P * M,) each."""
Reads = tuple[tuple[tuple[int, int, int], ...], ...]
"""Of each texture, each lookup's first channel, number of channels, and parameter sets."""


_OPTIONS = {"cpu": {"max_fusion_size": 512}}
"""Of the compiler: steps of one loop, of which a tap's gradient has more than the usual 64."""
_APART = ("cpu",)  # devices on which gradients of textures are added outside of the kernel


class Lookups:
    """A texture whose gradient is wanted, seen by a tap: notes where it is read.

    To what is read a probe is added, 0, whose gradient is that of what was read.

    Args:
        texture: Images, (C, rows, W).
        probes: Planes (P, 1, 1, M) for each lookup, in their order; None: none are added.
        read: Where each lookup's first channel, number of channels and place are noted.
        least: The first channel whose gradient is wanted; that of the ones before it is not.
        first: The texture's own first channel.
    """

    def __init__(
        self,
        texture: Tensor,
        probes: Sequence[Planes] | None,
        read: list[tuple[int, int, Tensor]],
        least: int,
        first: int = 0,
    ) -> None:
        self.texture, self.probes, self.read = texture, probes, read
        self.least, self.first = least, first

    @property
    def shape(self) -> torch.Size:
        """Channels, rows and columns."""
        return self.texture.shape

    def __getitem__(self, channels: slice) -> Lookups:
        """Return some channels."""
        start = self.first + (channels.start or 0)
        return Lookups(self.texture[channels], self.probes, self.read, self.least, start)

    def probed(self, planes: Planes, place: Tensor) -> Planes:
        """Return what was read at a place, (P, 1, 1, M) each, with its probe."""
        without = max(self.least - self.first, 0)
        if without >= len(planes):
            return planes
        self.read.append((self.first + without, len(planes) - without, place))
        if self.probes is None:
            return planes
        probe = self.probes[len(self.read) - 1]
        added = tuple(p + zero for p, zero in zip(planes[without:], probe, strict=True))
        return planes[:without] + added


def flat(added: Added) -> Planes:
    """Return all planes that a tap adds, one after the other."""
    planes: list[Tensor] = []
    for part in added:
        planes += part if isinstance(part, tuple) else (part,)
    return tuple(planes)


def floating(inputs: Inputs) -> Tensor:
    """Return the first floating tensor of the widest type: the sums are like it."""
    tensors = [tensor for tensor in inputs.values() if tensor.is_floating_point()]
    return max(tensors, key=lambda tensor: tensor.element_size())


@functools.lru_cache(maxsize=256)
def reads_of(
    tap: TapFunction,
    options: Hashable,
    signature: tuple[tuple[str, torch.Size, torch.dtype], ...],
    names: tuple[str, ...],
    color_from: int,
) -> Reads:
    """Find out how a tap reads textures, by calling it with tensors that have no values.

    Args:
        tap: The tap function.
        options: Its switches.
        signature: Names, shapes and types of its inputs.
        names: The textures whose gradients are wanted.
        color_from: Of the channels of "texture" before this one they are not.
    """
    inputs: dict[str, Any] = {
        name: torch.empty(shape, dtype=dtype, device="meta") for name, shape, dtype in signature
    }
    index = torch.empty((), dtype=floating(inputs).dtype, device="meta")
    notes: list[list[tuple[int, int, Tensor]]] = [[] for _ in names]
    for name, read in zip(names, notes, strict=True):
        inputs[name] = _lookups(name, inputs[name], None, read, color_from)
    tap(index, index, inputs, options)
    return tuple(
        tuple((first, count, place.shape[0]) for first, count, place in read) for read in notes
    )


class Part(NamedTuple):
    """What a backward pass works on: some pixels, or all."""

    wanted: Inputs
    """Inputs whose gradient is wanted."""
    parameters: Inputs
    """Others of which it is wanted, as a plane: the sum over its pixels is theirs.

    Among all that a tap does, a sum over pixels would end the loop: the compiler writes what lies
    before it to memory, and reads it in the next."""
    others: Inputs
    totals: Inputs
    """Gradients of `wanted` and `parameters`, which are added to in place."""
    grads: Planes
    """Of each accumulator."""
    peaks: Planes
    """The accumulators that are maxima."""
    taken: Planes
    """Where each of them has been given its gradient, bool, kept up in place."""
    scattered: Inputs
    """Gradients of textures, (C, rows * W), which are added to in place."""
    moved: tuple[Moved, ...]
    """Of each texture, what a tap leaves to `scatter`: `Room.planes`."""


@dataclass(frozen=True)
class Kernel:
    """Some taps, forward and backward, eager or compiled.

    Args:
        tap: The tap function.
        options: Its switches.
        engine: How it runs. Only a compiled backward adds to `Part.scattered`.
        add: ``add(sums, indices, count, inputs)`` adds these taps to the sums, in place.
        pull: ``pull(indices, count, part, reads, color_from)`` adds the gradients of these taps to
            the part's, in place. Where it leaves some to `scatter`, there must be one tap.
    """

    tap: TapFunction
    options: Hashable
    engine: Engine
    add: Callable[[Planes, Planes, Tensor, Inputs], None]
    pull: Callable[[Planes, Tensor, Part, Reads, int], None]


@functools.lru_cache(maxsize=128)
def kernel_of(
    tap: TapFunction, options: Hashable, engine: Engine, num_summed: int, device: str
) -> Kernel:
    """Return the functions of some taps; one object for each structure.

    Args:
        tap: The tap function.
        options: Its switches.
        engine: "eager" or "compiled".
        num_summed: Number of planes that are sums; the rest are maxima.
        device: Type of the inputs' device.
    """

    def add(sums: Planes, indices: Planes, count: Tensor, inputs: Inputs) -> None:
        for index in indices:
            pairs = tuple(zip(sums, flat(tap(index, count, inputs, options)), strict=True))
            for total, added in pairs[:num_summed]:
                total += added
            for peak, value in pairs[num_summed:]:
                peak.copy_(torch.maximum(peak, value))

    def pull(indices: Planes, count: Tensor, part: Part, reads: Reads, color_from: int) -> None:
        for index in indices:

            def one_tap(inputs: dict[str, Any], index: Tensor = index) -> Planes:
                return flat(tap(index, count, inputs, options))

            moved = _pull_one(one_tap, part, reads, num_summed, color_from)
            if part.moved:
                _keep(part.moved, moved)
            else:
                _scatter_in_kernel(part, reads, moved)

    if engine == "compiled":
        own = _OPTIONS.get(device)
        add, pull = (compile_alone(f, dynamic=True, options=own) for f in (add, pull))
    return Kernel(tap, options, engine, add, pull)


def _pull_one(
    tap: Callable[[dict[str, Any]], Planes],
    part: Part,
    reads: Reads,
    num_summed: int,
    color_from: int,
) -> list[Moved]:
    """Add the gradients of one tap, and return those of what it read in textures."""
    grads = part.grads

    def probed(
        leaves: Inputs, zeros: Inputs, probes: list[list[Planes]]
    ) -> tuple[Planes, list[list[Tensor]]]:
        notes: list[list[tuple[int, int, Tensor]]] = [[] for _ in probes]
        inputs: dict[str, Any] = part.others | leaves
        inputs |= {name: part.parameters[name] + zero for name, zero in zeros.items()}
        for name, probe, read in zip(part.scattered, probes, notes, strict=True):
            inputs[name] = _lookups(name, inputs[name], probe, read, color_from)
        added = tuple(a.expand_as(g) for a, g in zip(tap(inputs), grads, strict=True))
        return added, [[place for _, _, place in read] for read in notes]

    pixels = grads[0].shape[-1]
    # One for each plane: what the compiler makes of slices of one is another loop.
    probes = [
        [
            tuple(grads[0].new_zeros(sets, 1, 1, pixels) for _ in range(channels))
            for _, channels, sets in each
        ]
        for each in reads
    ]
    zeros = {name: torch.zeros_like(part.totals[name]) for name in part.parameters}
    values, vjp, places = torch.func.vjp(probed, part.wanted, zeros, probes, has_aux=True)  # type: ignore[misc]
    first = []
    for value, peak, before in zip(values[num_summed:], part.peaks, part.taken, strict=True):
        # Recomputed by another graph, a value may differ in its last bits.
        first.append((value >= peak - 1e-6 * peak.abs()) & ~before)
    due = [g * f for g, f in zip(grads[num_summed:], first, strict=True)]
    of_wanted, of_parameters, moved = vjp(grads[:num_summed] + tuple(due))
    for name, gradient in (of_wanted | of_parameters).items():
        part.totals[name].add_(gradient)
    for before, now in zip(part.taken, first, strict=True):
        before.logical_or_(now)
    return [
        tuple(
            (place.flatten().long(), tuple(plane.flatten() for plane in planes))
            for place, planes in zip(*texture, strict=True)
        )
        for texture in zip(places, moved, strict=True)
    ]


def _lookups(
    name: str,
    texture: Tensor,
    probes: Sequence[Planes] | None,
    read: list[tuple[int, int, Tensor]],
    color_from: int,
) -> Lookups:
    return Lookups(texture, probes, read, color_from if name == "texture" else 0)


class Room(NamedTuple):
    """Memory for what one tap leaves to `scatter`, seen in two ways; the next tap overwrites it.

    Memory that is new to each tap would not be in the caches.
    """

    planes: tuple[Moved, ...]
    """As the kernel writes it. Each plane has a storage of its own: the compiler makes another loop
    of what goes into a part of a tensor."""
    joined: tuple[tuple[str, int, Tensor, Tensor], ...]
    """Texture, first channel, where, (L,), and gradients, (C, L), of lookups that read alike."""


def room_for(names: Iterable[str], reads: Reads, like: Tensor) -> Room:
    """Return room for what a tap leaves; none where its kernel leaves nothing.

    Args:
        names: The textures.
        reads: How the tap reads them.
        like: An accumulator's gradient, (P, 1, 1, M).
    """
    if like.device.type not in _APART:
        return Room((), ())
    planes: list[Moved] = []
    joined: list[tuple[str, int, Tensor, Tensor]] = []
    for name, lookups in zip(names, reads, strict=True):
        moved: dict[int, tuple[Tensor, Planes]] = {}
        for start, count in dict.fromkeys(lookup[:2] for lookup in lookups):
            alike = [i for i, lookup in enumerate(lookups) if lookup[:2] == (start, count)]
            sizes = [lookups[i][2] * like.shape[-1] for i in alike]
            where, (places,) = _in_pieces(1, sizes, torch.long)
            gradients, rows = _in_pieces(count, sizes, like.dtype)
            for i, place, *channels in zip(alike, places, *rows, strict=True):
                moved[i] = place, tuple(channels)
            joined.append((name, start, where[0], gradients))
        planes.append(tuple(moved[i] for i in range(len(lookups))))
    return Room(tuple(planes), tuple(joined))


def _in_pieces(
    rows: int, sizes: list[int], dtype: torch.dtype
) -> tuple[Tensor, list[list[Tensor]]]:
    """Return rows, and the pieces of each: the same memory, but storages of their own."""
    # Large pages, which torch asks for, are for large pieces only.
    memory = torch.empty(rows * sum(sizes) * dtype.itemsize, dtype=torch.uint8).numpy()
    ends = itertools.accumulate(sizes * rows, initial=0)
    pieces = [
        torch.frombuffer(memory, dtype=dtype, count=size, offset=end * dtype.itemsize)
        for end, size in zip(ends, sizes * rows, strict=False)
    ]
    whole = torch.frombuffer(memory, dtype=dtype).view(rows, -1)
    return whole, [pieces[i : i + len(sizes)] for i in range(0, len(pieces), len(sizes))]


def _keep(room: tuple[Moved, ...], moved: list[Moved]) -> None:
    for old, new in zip(itertools.chain(*room), itertools.chain(*moved), strict=True):
        old[0].copy_(new[0])
        for plane, gradient in zip(old[1], new[1], strict=True):
            plane.copy_(gradient)


def scatter(totals: Inputs, room: Room) -> None:
    """Add the gradients of what a tap read to those of the textures, in place.

    Args:
        totals: Gradients of the textures, (C, rows * W).
        room: Where the tap has left them.
    """
    for name, start, where, gradients in room.joined:
        rows = totals[name][start : start + len(gradients)]
        rows.scatter_add_(1, where.expand_as(gradients), gradients.to(rows.dtype))


def _scatter_in_kernel(part: Part, reads: Reads, moved: list[Moved]) -> None:
    for name, lookups, left in zip(part.scattered, reads, moved, strict=True):
        total, (_, height, width) = part.scattered[name], part.others[name].shape
        for (start, _, _), (place, gradients) in zip(lookups, left, strict=True):
            for channel, gradient in enumerate(gradients, start):
                places = place + channel * height * width
                total.view(-1).index_put_((places,), gradient, accumulate=True)
