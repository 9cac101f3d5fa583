"""The calls that are measured: frames of which a share moves, through a filter."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.filters import BlurFilter, History, TemporalBlur
from torchblur.frame import Frame
from torchblur.params import declared
from torchblur.presets import create_filter
from tuning.bench.cases import Case

__all__ = ["bench_frame", "has_taps", "make_call", "make_filter", "refuse_unknown", "sets_of"]

_SPEED = (20.0, 80.0)  # px/frame: half spreads of 5 to 20 px at the default shutter
_PLANES_IN, _PLANES_OUT = 6, 3


def make_call(case: Case) -> Callable[[], object]:
    """Return what is measured of a case, as a function without arguments.

    Raises:
        ConfigError: unknown filter or parameter, or a filter that has no taps.
    """
    return _copy(case) if case.kind == "copy" else _blur(case)


def make_filter(case: Case) -> BlurFilter:
    """Return the filter of a case on its device.

    Raises:
        ConfigError: unknown filter or parameter, or `num_samples` of a filter that has none.
    """
    params = dict(case.params)
    if case.num_samples is not None:
        params["num_samples"] = case.num_samples
    blur = create_filter(case.filter, engine=case.engine, storage=case.storage, **params)
    return blur.to(torch.device(case.device))


def has_taps(blur: BlurFilter | type[BlurFilter]) -> bool:
    """Whether a filter has the parameter `num_samples`."""
    return "num_samples" in blur.config_class.model_fields


# -- one call --------------------------------------------------------------------------------------


def _copy(case: Case) -> Callable[[], object]:
    """Return a copy that reads and writes as many bytes as the planes of the frames have."""
    planes = (_PLANES_IN + _PLANES_OUT) / 2 * case.batch
    source = torch.rand(math.ceil(planes * case.pixels), device=case.device)
    target = torch.empty_like(source)
    return lambda: target.copy_(source)


def _blur(case: Case) -> Callable[[], object]:
    blur = make_filter(case)
    frame = bench_frame(case)
    sets = sets_of(blur, case.sets, frame.color, case.shared) if case.sets > 1 else {}
    history = _history(blur, frame)
    if case.apart:
        calls = [
            _one_call(case, blur, f, h, s)
            for f, h, s in zip(
                _frames(frame, case), _histories(history, case), _values(sets, case), strict=True
            )
        ]
        return lambda: [call() for call in calls]
    if case.sets > 1 and history is not None:
        history = _expanded(history, case.sets)
    return _one_call(case, blur, frame, history, sets)


def _one_call(
    case: Case, blur: BlurFilter, frame: Frame, history: History | None, sets: dict[str, Tensor]
) -> Callable[[], object]:
    given: dict[str, Any] = sets if history is None else {"history": history, **sets}
    color = frame.color.requires_grad_(case.what == "backward")
    free = [*blur.parameters(), *sets.values()]
    leaves = [leaf.requires_grad_(case.what != "forward") for leaf in free]

    def forward() -> Tensor:
        with torch.no_grad():
            return _color(blur(frame, **given))

    def backward() -> None:
        for leaf in (color, *leaves):
            leaf.grad = None
        result = _color(blur(frame, **given))
        # A gradient that differs from pixel to pixel, as that of a loss does, and costs nothing.
        result.backward(result.detach())

    return forward if case.what == "forward" else backward


def _color(result: Tensor | tuple[Tensor, History]) -> Tensor:
    """Return the image; a filter with a memory returns that too."""
    return result if isinstance(result, Tensor) else result[0]


def _history(blur: BlurFilter, frame: Frame) -> History | None:
    """Return the memory of a filter in the middle of a sequence."""
    if not isinstance(blur, TemporalBlur):
        return None
    with torch.no_grad():
        return blur.step(frame)[1].detach()


# -- batches, and the same one by one --------------------------------------------------------------


def sets_of(
    blur: BlurFilter, count: int, like: Tensor, shared: Sequence[str] = ()
) -> dict[str, Tensor]:
    """Return values of all smooth parameters, (count, 1, 1, 1) each.

    They lie around the defaults; parameters at 0 or 1, where a filter may leave work out, stay.

    Args:
        blur: The filter.
        count: Number of sets.
        like: Whose type and device they take.
        shared: Parameters that stay.
    """
    now = blur.config
    names = [
        name
        for name, spec in declared(blur.config_class).items()
        if spec.grad == "smooth"
        and name not in shared
        and getattr(now, name) not in (0.0, 1.0, *spec.bounds)
    ] or ["shutter"]
    sets = {}
    for name in names:
        low, high = declared(blur.config_class)[name].bounds
        steps = torch.linspace(0.9, 1.1, count, device=like.device, dtype=like.dtype)
        sets[name] = (getattr(now, name) * steps).clamp(low, high).view(-1, 1, 1, 1)
    return sets


def _frames(frame: Frame, case: Case) -> list[Frame]:
    if case.batch == 1:
        return [frame] * case.sets
    return [frame.map(partial(_picked, index=index)) for index in range(case.batch)]


def _picked(plane: Tensor, index: int) -> Tensor:
    return plane[index : index + 1].clone()


def _histories(history: History | None, case: Case) -> list[History | None]:
    if history is None or case.batch == 1:
        return [history] * max(case.batch, case.sets)
    return [
        History({name: plane[i : i + 1] for name, plane in history.planes.items()})
        for i in range(case.batch)
    ]


def _values(sets: dict[str, Tensor], case: Case) -> list[dict[str, Tensor]]:
    if not sets:
        return [{}] * case.batch
    return [{n: v[i : i + 1].clone() for n, v in sets.items()} for i in range(case.sets)]


def _expanded(history: History, count: int) -> History:
    planes = {n: p.expand(count, *p.shape[1:]) for n, p in history.planes.items()}
    return History(planes)


# -- frames ----------------------------------------------------------------------------------------


def bench_frame(case: Case, seed: int = 0) -> Frame:
    """Return frames whose middle moves: a rectangle with the case's share of the area.

    There, speeds from 20 to 80 px/frame and directions change smoothly; color, normal, time and
    depth are noise. All layers that a filter may ask for are there, with a still layer behind.

    Args:
        case: Size, batch, share, device.
        seed: Another frame for another seed.
    """
    generator = torch.Generator().manual_seed(seed)
    size = (case.height, case.width)

    def noise(channels: int) -> Tensor:
        return torch.rand(case.batch, channels, *size, generator=generator)

    coarse = torch.rand(case.batch, 2, 9, 16, generator=generator)
    smooth = torch.nn.functional.interpolate(coarse, size, mode="bilinear", align_corners=False)
    speed = _SPEED[0] + (_SPEED[1] - _SPEED[0]) * smooth[:, :1]
    angle = 2 * math.pi * smooth[:, 1:]
    mask = _moving_mask(case)
    velocity = torch.cat((speed * angle.cos(), speed * angle.sin()), 1) * mask
    frame = Frame(
        color=noise(3),
        velocity=velocity,
        depth=noise(1) + 1,
        normal=torch.nn.functional.normalize(noise(3) - 0.5, dim=1),
        time=noise(1),
        object_id=mask.to(torch.int32).expand(case.batch, -1, -1, -1),
        revealed=Frame(
            color=noise(3), velocity=torch.zeros_like(velocity), depth=noise(1) + 3, time=noise(1)
        ),
    )
    return frame.map(lambda plane: plane.to(case.device))


def _moving_mask(case: Case) -> Tensor:
    """Return 1 inside the moving rectangle, (1, 1, H, W)."""
    mask = torch.zeros(1, 1, case.height, case.width)
    share = math.sqrt(case.moving / 100)
    height, width = round(case.height * share), round(case.width * share)
    top, left = (case.height - height) // 2, (case.width - width) // 2
    mask[..., top : top + height, left : left + width] = 1
    return mask


def refuse_unknown(names: Sequence[str], params: Mapping[str, Any]) -> None:
    """Refuse filters and parameters that there are not, before anything is measured.

    Raises:
        ConfigError: neither a filter nor a preset, an unknown parameter, or a value out of range.
    """
    for name in names:
        try:
            create_filter(name, **params)
        except ConfigError as error:
            raise ConfigError(f"{error} (--filter {name})") from error
