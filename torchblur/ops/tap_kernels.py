"""One tap of a sum, or some: forward, and backward by computing it again; eager or compiled.

A compiled backward adds the gradient of a texture in place: what a tap reads has a probe added,
whose gradient is that of what was read, and which goes where it was read. On a GPU the kernel adds
it; on a CPU its threads would need atomic additions, which cost ten times what `scatter` takes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Sequence
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
    "TapFunction",
    "flat",
    "floating",
    "kernel_of",
    "reads_of",
    "scatter",
]

Engine = Literal["eager", "compiled"]
Inputs = dict[str, Tensor]
Planes = tuple[Tensor, ...]
Added = tuple[Tensor | Planes, ...]
"""What a tap adds to each accumulator: a tensor, or planes that belong together."""
TapFunction = Callable[[Tensor, Tensor, Inputs, Any], Added]
"""``tap(index, count, inputs, options)``: index and count are 0-d float tensors."""

Moved = tuple[tuple[int, Tensor, Planes], ...]
"""Of each lookup in a texture: its first channel, where, (P * M,), and each channel's gradient."""
Reads = tuple[tuple[tuple[int, int, int], ...], ...]
"""Of each texture, each lookup's first channel, number of channels, and parameter sets."""


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
    """Inputs whose gradient is returned."""
    others: Inputs
    grads: Planes
    """Of each accumulator."""
    peaks: Planes
    """The accumulators that are maxima."""
    scattered: Inputs
    """Gradients of textures, (C, rows * W), which are added to in place."""


@dataclass(frozen=True)
class Kernel:
    """Some taps, forward and backward, eager or compiled.

    Args:
        tap: The tap function.
        options: Its switches.
        engine: How it runs. Only a compiled backward adds to `Part.scattered`.
        add: ``add(sums, indices, count, inputs)``: the sums with these taps added.
        pull: ``pull(totals, taken, indices, count, part, reads, color_from)``: gradients with those
            of these taps added, where each maximum has been given its gradient, and what each tap
            leaves to `scatter`, texture by texture.
    """

    tap: TapFunction
    options: Hashable
    engine: Engine
    add: Callable[[Planes, Planes, Tensor, Inputs], Planes]
    pull: Callable[..., tuple[Inputs, Planes, list[list[Moved]]]]


@functools.lru_cache(maxsize=128)
def kernel_of(tap: TapFunction, options: Hashable, engine: Engine, num_summed: int) -> Kernel:
    """Return the functions of some taps; one object for each structure.

    Args:
        tap: The tap function.
        options: Its switches.
        engine: "eager" or "compiled".
        num_summed: Number of planes that are sums; the rest are maxima.
    """

    def add(sums: Planes, indices: Planes, count: Tensor, inputs: Inputs) -> Planes:
        for index in indices:
            pairs = tuple(zip(sums, flat(tap(index, count, inputs, options)), strict=True))
            total = tuple(s + a for s, a in pairs[:num_summed])
            sums = total + tuple(torch.maximum(s, a) for s, a in pairs[num_summed:])
        return sums

    def pull(
        totals: Inputs,
        taken: Planes,
        indices: Planes,
        count: Tensor,
        part: Part,
        reads: Reads,
        color_from: int,
    ) -> tuple[Inputs, Planes, list[list[Moved]]]:
        left: list[list[Moved]] = []
        for index in indices:

            def one_tap(inputs: dict[str, Any], index: Tensor = index) -> Planes:
                return flat(tap(index, count, inputs, options))

            parts, taken, moved = _pull_one(one_tap, taken, part, reads, num_summed, color_from)
            totals = {name: totals[name] + parts[name] for name in totals}
            if part.grads[0].device.type in _APART:
                left.append(moved)
            else:
                for name, lookups in zip(part.scattered, moved, strict=True):
                    _scatter_in_kernel(part.scattered[name], part.others[name], lookups)
        return totals, taken, left

    if engine == "compiled":
        add, pull = compile_alone(add, dynamic=True), compile_alone(pull, dynamic=True)
    return Kernel(tap, options, engine, add, pull)


def _pull_one(
    tap: Callable[[dict[str, Any]], Planes],
    taken: Planes,
    part: Part,
    reads: Reads,
    num_summed: int,
    color_from: int,
) -> tuple[Inputs, Planes, list[Moved]]:
    """Return the gradients of one tap, where maxima have been given theirs, and of what it read."""
    grads = part.grads

    def probed(leaves: Inputs, probes: list[list[Planes]]) -> tuple[Planes, list[list[Tensor]]]:
        notes: list[list[tuple[int, int, Tensor]]] = [[] for _ in probes]
        inputs: dict[str, Any] = part.others | leaves
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
    values, vjp, places = torch.func.vjp(probed, part.wanted, probes, has_aux=True)  # type: ignore[misc]
    first = []
    for value, peak, before in zip(values[num_summed:], part.peaks, taken, strict=True):
        # Recomputed by another graph, a value may differ in its last bits.
        first.append((value >= peak - 1e-6 * peak.abs()) & ~before)
    due = [g * f for g, f in zip(grads[num_summed:], first, strict=True)]
    parts, moved = vjp(grads[:num_summed] + tuple(due))
    lookups = [
        tuple(
            (start, place.flatten().long(), tuple(gradient.flatten() for gradient in gradients))
            for (start, _, _), place, gradients in zip(*texture, strict=True)
        )
        for texture in zip(reads, places, moved, strict=True)
    ]
    return parts, tuple(t | f for t, f in zip(taken, first, strict=True)), lookups


def _lookups(
    name: str,
    texture: Tensor,
    probes: Sequence[Planes] | None,
    read: list[tuple[int, int, Tensor]],
    color_from: int,
) -> Lookups:
    return Lookups(texture, probes, read, color_from if name == "texture" else 0)


def scatter(total: Tensor, moved: Moved) -> None:
    """Add the gradients of what was read to that of a texture, in place.

    Args:
        total: Gradient of the texture, (C, rows * W).
        moved: What lookups leave.
    """
    for start, place, gradients in moved:
        for channel, gradient in zip(total[start:], gradients, strict=False):
            channel.scatter_add_(0, place, gradient.to(total.dtype))


def _scatter_in_kernel(total: Tensor, texture: Tensor, moved: Moved) -> None:
    size = texture.shape[1] * texture.shape[2]
    for start, place, gradients in moved:
        for channel, gradient in enumerate(gradients, start):
            total.view(-1).index_put_((place + channel * size,), gradient, accumulate=True)
