"""The engine of all gathers: a sum over taps whose memory does not grow with their number.

As the accumulators are sums, the incoming gradient is the same for every tap: the backward pass
runs over the taps again and stores nothing per tap. The same tap function runs eagerly or
compiled; its index and their number are tensors, so that neither compiles anew. On a CPU a part of
the pixels goes through all taps before the next: what it needs stays in the cache, and what lies
between forward and backward of a tap is never larger than a part.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.ops.compiling import compiler_errors, compiler_works, give_up_compiling
from torchblur.ops.tap_kernels import (
    Engine,
    Inputs,
    Kernel,
    Part,
    Planes,
    Reads,
    TapFunction,
    flat,
    floating,
    kernel_of,
    reads_of,
    room_for,
    scatter,
)

__all__ = ["Engine", "Inputs", "Lists", "Planes", "TapFunction", "sum_taps"]

_PART = {"eager": 1 << 16, "compiled": 320_000}
"""Pixels that a CPU takes through all taps at once: what they need should stay in its caches, which
is more for an eager tap, and the time of each call should not count (tuned on one Xeon). With sets
of parameters it is their mean number over all planes that counts."""
_LEAST_PART = 1 << 10  # pixels; with fewer, calls cost more than what they do
_TAPS_PER_CALL = {"cpu": 1, "cuda": 4}
"""Taps that one kernel adds: on a GPU each pass over the planes serves several. More of them take
longer to compile."""


class Lists(NamedTuple):
    """Which inputs of a sum are lists of pixels, and what is wanted of its textures."""

    num_pixels: int | None
    """Inputs (P, C, 1, M) with this M are lists. Taps take each pixel on its own, so that they can
    be worked on in parts, and read textures by `ops.gather.read` alone. None: no lists."""
    color_from: int = 0
    """Of the channels of "texture" before this one no gradient is wanted."""
    storage: torch.dtype | None = None
    """Type in which textures are kept while taps read them; None: as they come."""


def sum_taps(
    tap: TapFunction,
    options: Hashable,
    num_samples: int,
    inputs: Mapping[str, Tensor],
    engine: Engine = "eager",
    *,
    num_maxima: int = 0,
    lists: Lists | None = None,
) -> Planes:
    """Return the sums over ``num_samples`` taps of what the tap function returns.

    Args:
        tap: A module-level function of plain torch operations. It may use nothing but its
            arguments: whatever needs a gradient must be in `inputs`.
        options: Switches for the tap function, hashable; each set is compiled once.
        num_samples: Number of taps, N >= 1.
        inputs: Tensors by name, of any shapes that the tap agrees with.
        engine: "eager", or "compiled" to compile the tap function with `torch.compile`; without
            a compiler there is one warning and the eager result.
        num_maxima: So many accumulators, the last ones, are maxima over the taps, not sums.
        lists: Which inputs are lists of pixels; None: there are none.

    Returns:
        The accumulators; where the tap returns a tuple of planes, they are joined along
        dimension 1.

    Differentiable: once, in all floating `inputs`, with memory independent of N. Backward costs
        about one forward and backward of each tap. The gradient of a maximum goes to the first
        tap that reaches it.

    Raises:
        ConfigError: if the engine has another name.
    """
    if engine not in ("eager", "compiled"):
        raise ConfigError(f"`engine` must be 'eager' or 'compiled', got {engine!r}")
    given = dict(inputs)
    signature = tuple((name, t.shape, t.dtype) for name, t in given.items())
    form = _form_of(tap, options, signature, num_maxima)
    # The compiler makes special cases of 0 and 1; so few pixels gain nothing by it.
    if any(0 in shape for shape in form.shapes):
        engine, num_samples = "eager", 0  # nothing to add, but a graph
    elif engine == "compiled" and not compiler_works():
        engine = "eager"
    for candidate in ("compiled", "eager") if engine == "compiled" else ("eager",):
        kernel = kernel_of(tap, options, candidate, form.num_summed, floating(given).device.type)
        try:
            return form.joined(_run(_Sum(kernel, num_samples, form, lists or Lists(None)), given))
        except compiler_errors() as error:
            if candidate == "eager":
                raise
            give_up_compiling(error)
    raise AssertionError("unreachable")


@dataclass(frozen=True)
class _Form:
    """What a tap returns, laid flat.

    Args:
        shapes: Of each plane.
        widths: Number of planes of each accumulator; 0: a tensor, not a tuple of planes.
        num_summed: Number of planes that are sums; the rest are maxima.
    """

    shapes: tuple[torch.Size, ...]
    widths: tuple[int, ...]
    num_summed: int

    def start(self, like: Tensor) -> Planes:
        """Return the accumulators before the first tap."""
        return tuple(
            like.new_full(shape, 0.0 if i < self.num_summed else -math.inf)
            for i, shape in enumerate(self.shapes)
        )

    def joined(self, planes: Sequence[Tensor]) -> Planes:
        """Return one tensor for each accumulator."""
        rest = iter(planes)
        return tuple(
            torch.cat([next(rest) for _ in range(width)], 1) if width else next(rest)
            for width in self.widths
        )


@functools.lru_cache(maxsize=256)
def _form_of(
    tap: TapFunction,
    options: Hashable,
    signature: tuple[tuple[str, torch.Size, torch.dtype], ...],
    num_maxima: int,
) -> _Form:
    """Find out what a tap returns, by calling it with tensors that have no values."""
    inputs = {
        name: torch.empty(shape, dtype=dtype, device="meta") for name, shape, dtype in signature
    }
    index = torch.empty((), dtype=floating(inputs).dtype, device="meta")
    added = tap(index, index, inputs, options)
    widths = tuple(len(part) if isinstance(part, tuple) else 0 for part in added)
    summed = sum(max(width, 1) for width in widths[: len(widths) - num_maxima])
    return _Form(tuple(plane.shape for plane in flat(added)), widths, summed)


@dataclass(frozen=True, eq=False)
class _Sum:
    """One sum over taps: what is added, how often, and over how many pixels."""

    kernel: Kernel
    num_samples: int
    form: _Form
    lists: Lists

    def is_list(self, tensor: Tensor) -> bool:
        """Whether a tensor is a list of pixels, of which a part can be taken."""
        return tensor.ndim == 4 and tensor.shape[-1] == self.lists.num_pixels

    def stored(self, inputs: Inputs) -> Inputs:
        """Return inputs whose textures have the type in which they are kept."""
        storage = self.lists.storage
        if storage is None:
            return inputs
        most = torch.finfo(storage).max  # an infinite depth would be NaN in a difference
        return {
            name: tensor.clamp(-most, most).to(storage)
            if tensor.ndim == 3 and tensor.is_floating_point()
            else tensor
            for name, tensor in inputs.items()
        }

    def parts(self, inputs: Inputs) -> list[slice | None]:
        """Return parts of about equal size; [None] for all pixels at once."""
        pixels = self.lists.num_pixels
        if pixels is None or floating(inputs).device.type != "cpu":
            return [None]
        shapes = [t.shape for t in inputs.values() if self.is_list(t)] + list(self.form.shapes)
        sets = sum(shape[0] * shape[1] for shape in shapes) / sum(shape[1] for shape in shapes)
        count = min(math.ceil(pixels * sets / _PART[self.kernel.engine]), pixels // _LEAST_PART)
        if count <= 1:
            return [None]
        ends = [pixels * i // count for i in range(count + 1)]
        return [slice(start, stop) for start, stop in itertools.pairwise(ends)]

    def part(self, tensor: Tensor, part: slice | None) -> Tensor:
        """Return a copy of a part of a list, and anything else as it is.

        A copy, as sums are kept up in place. It has the strides of its shape, no offset and no
        base: any other layout, even of dimensions of one, would be compiled anew.
        """
        if not self.is_list(tensor):
            return tensor
        piece = tensor if part is None else tensor[..., part].clone()
        flat = piece.reshape(-1)
        return (flat.clone() if flat.storage_offset() else flat).view(piece.shape).data

    def put(self, whole: Tensor, piece: Tensor, part: slice | None) -> Tensor:
        """Write a part of a list into the whole of it; anything else takes its place."""
        if part is None or not self.is_list(whole):
            return piece
        whole[..., part] = piece
        return whole


def _run(job: _Sum, inputs: Inputs) -> Planes:
    if torch.is_grad_enabled() and any(t.requires_grad for t in inputs.values()):
        return _apply(job, tuple(inputs), *inputs.values())
    return _sum(job, job.stored(inputs))


class _SumTaps(torch.autograd.Function):
    """Sum over taps whose backward recomputes each tap."""

    @staticmethod
    def forward(ctx: Any, job: _Sum, names: tuple[str, ...], *tensors: Tensor) -> Planes:
        ctx.job, ctx.names = job, names
        stored = job.stored(dict(zip(names, tensors, strict=True)))
        sums = _sum(job, stored)
        ctx.types = {name: tensor.dtype for name, tensor in zip(names, tensors, strict=True)}
        ctx.save_for_backward(*stored.values(), *sums[job.form.num_summed :])
        return sums

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        job, needed = ctx.job, ctx.needs_input_grad[2:]
        tensors = [tensor.detach() for tensor in ctx.saved_tensors]
        named = dict(zip(ctx.names, tensors[: len(needed)], strict=True))
        wanted = [name for name, needs in zip(ctx.names, needed, strict=True) if needs]
        in_place = job.kernel.engine == "compiled"
        if not in_place:  # a gradient has the type of what it is of: half would lose small ones
            named = {name: tensor.to(ctx.types[name]) for name, tensor in named.items()}
        # Contiguous, whatever the input is: what is scattered goes into a flat view of them.
        totals = {
            name: named[name].new_zeros(named[name].shape, dtype=ctx.types[name]) for name in wanted
        }
        textures = [name for name in wanted if job.lists.num_pixels and named[name].ndim == 3]
        # Any pixel of a texture may be read by any part: its gradient is one sum over all of them.
        whole = bool(textures) and not in_place
        scattered = {name: totals[name].flatten(1) for name in textures if in_place}
        for part in [None] if whole else job.parts(named):
            pieces = {name: job.part(tensor, part) for name, tensor in named.items()}
            rest = [job.part(tensor, part) for tensor in (*tensors[len(needed) :], *grads)]
            pulled = _pull(job, pieces, wanted, scattered, rest)
            for name, piece in pulled.items():
                if part is not None and not job.is_list(totals[name]):
                    piece = totals[name] + piece
                totals[name] = job.put(totals[name], piece, part)
        return (None, None, *(totals.get(name) for name in ctx.names))


_apply: Callable[..., Planes] = _SumTaps.apply


def _pull(
    job: _Sum, named: Inputs, wanted: Sequence[str], scattered: Inputs, rest: Sequence[Tensor]
) -> Inputs:
    """Return the gradients of the wanted inputs, of one part of the pixels.

    Args:
        job: The sum.
        named: All inputs.
        wanted: Names of those whose gradient is wanted.
        scattered: Gradients of textures, (C, rows * W), added to in place and not returned.
        rest: The maxima, then the gradients of all accumulators.
    """
    num_maxima = len(job.form.shapes) - job.form.num_summed
    peaks = tuple(rest[:num_maxima])
    # Views of other tensors would be another case to the compiler for each shape of those.
    grads = tuple(g.clone(memory_format=torch.contiguous_format) for g in rest[num_maxima:])
    leaves = {name: named[name] for name in wanted if name not in scattered}
    # Eager taps take sums over pixels as they come; without lists there is nothing to sum over.
    as_planes = job.kernel.engine == "compiled" and job.lists.num_pixels is not None
    parameters = {n: t for n, t in leaves.items() if as_planes and not job.is_list(t)}
    lists = {name: tensor for name, tensor in leaves.items() if name not in parameters}
    reads: Reads = ()
    if scattered:
        signature = tuple((name, t.shape, t.dtype) for name, t in named.items())
        kernel, names = job.kernel, tuple(scattered)
        reads = reads_of(kernel.tap, kernel.options, signature, names, job.lists.color_from)
    room = room_for(scattered, reads, grads[0])
    part = Part(
        wanted=lists,
        parameters=parameters,
        others={name: tensor for name, tensor in named.items() if name not in leaves},
        totals={name: torch.zeros_like(tensor) for name, tensor in lists.items()}
        | {name: _plane_for(tensor, grads) for name, tensor in parameters.items()},
        grads=grads,
        peaks=peaks,
        taken=tuple(torch.zeros_like(peak, dtype=torch.bool) for peak in peaks),
        scattered=scattered,
        moved=room.planes,
    )
    groups, number = _groups(job.num_samples, floating(named))
    for indices in groups:
        job.kernel.pull(indices, number, part, reads, job.lists.color_from)
        scatter(scattered, room)
    return {name: total.sum_to_size(leaves[name].shape) for name, total in part.totals.items()}


def _plane_for(parameter: Tensor, grads: Planes) -> Tensor:
    shapes = (plane.shape for plane in grads)
    return parameter.new_zeros(torch.broadcast_shapes(parameter.shape, *shapes))


@torch.no_grad()
def _sum(job: _Sum, inputs: Inputs) -> Planes:
    like = floating(inputs)
    inputs = {name: tensor.detach() for name, tensor in inputs.items()}
    groups, number = _groups(job.num_samples, like)
    whole = job.form.start(like)
    for part in job.parts(inputs):
        cut = {name: job.part(tensor, part) for name, tensor in inputs.items()}
        sums = tuple(job.part(plane, part) for plane in whole)
        for indices in groups:
            job.kernel.add(sums, indices, number, cut)
        whole = tuple(job.put(*pair, part) for pair in zip(whole, sums, strict=True))
    return whole


def _groups(num_samples: int, like: Tensor) -> tuple[list[Planes], Tensor]:
    """Return the taps' indices, some at a time, and their number, made without waiting.

    What is left over comes one at a time, so that there are two kernels for any number.
    """
    numbers = torch.arange(num_samples + 1, device=like.device).to(like.dtype)
    indices, size = numbers[:-1].unbind(0), _TAPS_PER_CALL.get(like.device.type, 1)
    full = num_samples - num_samples % size
    groups = [indices[i : i + size] for i in range(0, full, size)]
    return groups + [(index,) for index in indices[full:]], numbers[-1]
