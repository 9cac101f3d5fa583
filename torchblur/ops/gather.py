"""The gather: a sum over taps, one engine for all filters.

A filter is a *tap function*, which returns what one tap adds to each accumulator, and a
*resolve*, which turns the accumulators into an image. As the accumulators are sums, the incoming
gradient is the same for every tap: the backward pass runs over the taps again and stores nothing
per tap, so memory does not grow with their number. The same tap function runs eagerly or
compiled; its index and their number are tensors, so that neither compiles anew.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Mapping
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.ops.compiling import compiler_errors, load_compiler, warn_no_compiler

__all__ = ["Engine", "Inputs", "Lookup", "TapFunction", "gather", "lookup", "pixel_grid"]

Engine = Literal["eager", "compiled"]
Lookup = Literal["nearest", "bilinear"]
Inputs = dict[str, Tensor]
TapFunction = Callable[[Tensor, Tensor, Inputs, Any], tuple[Tensor, ...]]
"""``tap(index, count, inputs, options)``: index and count are 0-d float tensors."""

_Step = Callable[[tuple[Tensor, ...], Tensor, Tensor, Inputs], tuple[Tensor, ...]]


def gather(
    tap: TapFunction,
    options: Hashable,
    num_samples: int,
    inputs: Mapping[str, Tensor],
    engine: Engine = "eager",
    *,
    num_maxima: int = 0,
) -> tuple[Tensor, ...]:
    """Return the sums over ``num_samples`` taps of what the tap function returns.

    Args:
        tap: A module-level function of plain torch operations. It may use nothing but its
            arguments: whatever needs a gradient must be in `inputs`.
        options: Switches for the tap function, hashable; each set is compiled once.
        num_samples: Number of taps, N >= 1.
        inputs: Tensors by name: planes (B, C, H, W) and parameters that broadcast to them.
        engine: "eager", or "compiled" to compile the tap function with `torch.compile`; without
            a compiler there is one warning and the eager result.
        num_maxima: So many accumulators, the last ones, are maxima over the taps, not sums.

    Returns:
        The accumulators, in the tap's order.

    Differentiable: once, in all floating `inputs`, with memory independent of N. Backward costs
        about one forward and backward of each tap. The gradient of a maximum goes to the first
        tap that reaches it.

    Raises:
        ConfigError: if the engine has another name.
    """
    if engine not in ("eager", "compiled"):
        raise ConfigError(f"`engine` must be 'eager' or 'compiled', got {engine!r}")
    names = tuple(inputs)
    tensors = tuple(inputs.values())
    wanted = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    for candidate in ("compiled", "eager") if engine == "compiled" else ("eager",):
        step = _step(tap, options, candidate, num_maxima)
        try:
            if wanted:
                return _apply(step, num_samples, num_maxima, names, *tensors)
            with torch.no_grad():
                return _sum_taps(step, num_samples, dict(inputs))
        except compiler_errors() as error:
            if candidate == "eager":
                raise
            warn_no_compiler((str(error).splitlines() or [type(error).__name__])[0])
    raise AssertionError("unreachable")


class _Gather(torch.autograd.Function):
    """Sum over taps whose backward recomputes each tap."""

    @staticmethod
    def forward(
        ctx: Any,
        step: _Step,
        num_samples: int,
        num_maxima: int,
        names: tuple[str, ...],
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.step, ctx.num_samples, ctx.names = step, num_samples, names
        totals = _sum_taps(step, num_samples, dict(zip(names, tensors, strict=True)))
        ctx.num_maxima = num_maxima
        ctx.save_for_backward(*tensors, *totals[len(totals) - num_maxima :])
        return totals

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[4:]
        saved, peaks = ctx.saved_tensors[: len(needed)], ctx.saved_tensors[len(needed) :]
        leaves = [t.detach().requires_grad_(n) for t, n in zip(saved, needed, strict=True)]
        taken = [torch.zeros_like(peak, dtype=torch.bool) for peak in peaks]
        wanted = [leaf for leaf, n in zip(leaves, needed, strict=True) if n]
        totals = [torch.zeros_like(leaf) for leaf in wanted]
        inputs = dict(zip(ctx.names, leaves, strict=True))
        count = _scalar(ctx.num_samples, leaves[0])
        for index in range(ctx.num_samples):
            with torch.enable_grad():
                added = ctx.step((), _scalar(index, leaves[0]), count, inputs)
            split = len(added) - ctx.num_maxima
            due = *grads[:split], *_due(added[split:], peaks, taken, grads[split:])
            pairs = [(a, g) for a, g in zip(added, due, strict=True) if a.requires_grad]
            parts = torch.autograd.grad(
                [a for a, _ in pairs], wanted, [g.expand_as(a) for a, g in pairs], allow_unused=True
            )
            for total, part in zip(totals, parts, strict=True):
                if part is not None:
                    total += part
        result = iter(totals)
        return (None, None, None, None, *(next(result) if n else None for n in needed))


def _due(
    added: tuple[Tensor, ...],
    peaks: tuple[Tensor, ...],
    taken: list[Tensor],
    grads: tuple[Tensor, ...],
) -> list[Tensor]:
    """Return the gradients of the maxima where this tap is the first to reach them."""
    due = []
    for value, peak, before, grad in zip(added, peaks, taken, grads, strict=True):
        # Recomputed by another graph, a value may differ in its last bits.
        first = (value.detach() >= peak - 1e-6 * peak.abs()) & ~before
        before |= first
        due.append(grad * first)
    return due


_apply: Callable[..., tuple[Tensor, ...]] = _Gather.apply


def _sum_taps(step: _Step, num_samples: int, inputs: Inputs) -> tuple[Tensor, ...]:
    like = next(iter(inputs.values()))
    count = _scalar(num_samples, like)
    inputs = {name: tensor.detach() for name, tensor in inputs.items()}
    sums: tuple[Tensor, ...] = ()
    for index in range(num_samples):
        sums = step(sums, _scalar(index, like), count, inputs)
    return sums


def _scalar(value: int, like: Tensor) -> Tensor:
    return torch.tensor(float(value), dtype=like.dtype, device=like.device)


@functools.lru_cache(maxsize=64)
def _step(tap: TapFunction, options: Hashable, engine: Engine, num_maxima: int = 0) -> _Step:
    """Return the function that adds one tap to the sums; one object for each structure."""

    def step(
        sums: tuple[Tensor, ...], index: Tensor, count: Tensor, inputs: Inputs
    ) -> tuple[Tensor, ...]:
        added = tap(index, count, inputs, options)
        if not sums:
            return added
        split = len(added) - num_maxima
        total = (s + a for s, a in zip(sums[:split], added[:split], strict=True))
        largest = (torch.maximum(s, a) for s, a in zip(sums[split:], added[split:], strict=True))
        return *total, *largest

    if engine == "compiled":
        load_compiler()
        return torch.compile(step, dynamic=True)
    return step


# -- lookups ---------------------------------------------------------------------------------------


def pixel_grid(like: Tensor) -> tuple[Tensor, Tensor]:
    """Return column and row indices of all pixels, shapes (1, 1, 1, W) and (1, 1, H, 1).

    Args:
        like: A tensor (B, C, H, W) whose size, device and type they take.
    """
    height, width = like.shape[-2:]
    x = torch.arange(width, device=like.device, dtype=like.dtype)
    y = torch.arange(height, device=like.device, dtype=like.dtype)
    return x.view(1, 1, 1, width), y.view(1, 1, height, 1)


def lookup(texture: Tensor, x: Tensor, y: Tensor, mode: Lookup = "nearest") -> Tensor:
    """Return a texture's values at positions in pixel indices.

    Args:
        texture: Planes, (B, C, H, W).
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
