"""What one gradient step of a fit costs, part by part, and what a new crop costs beside it."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchblur.filters import BlurFilter, TemporalBlur
from torchblur.frame import Frame, Shutter
from torchblur.metrics import FlipReference, prepare_flip_ldr
from torchblur.render import Renderer, load_scene
from tuning.bench.calls import bench_frame, make_filter
from tuning.bench.cases import Case
from tuning.render.scene import find_scene

__all__ = ["METRIC_PARTS", "RENDER_SCENE", "STEP_PARTS", "Step", "median_parts", "render_parts"]

STEP_PARTS = ("filter forward", "loss forward", "loss backward", "filter backward", "optimizer")
METRIC_PARTS = ("loss forward", "loss backward")
RENDER_SCENE = "overlapping_rotations"

_COLOR_SPP, _SPP = 16, 64
_RATE = 1e-3


class Step:
    """A filter, crops, references and an optimizer: everything that a gradient step needs.

    The references are the filter's own result with other values of its smooth parameters, so that
    the loss and its gradient are neither zero nor special.

    Args:
        case: Filter, size and number of the crops, taps.
    """

    def __init__(self, case: Case) -> None:
        self.device = torch.device(case.device)
        self.blur: BlurFilter = make_filter(case)
        self.frame: Frame = bench_frame(case)
        self.reference: FlipReference = prepare_flip_ldr(self._other_result(case))
        leaves = [p.requires_grad_(True) for p in self.blur.parameters()]
        self.optimizer = torch.optim.Adam(leaves, lr=_RATE) if leaves else None

    def parts(self) -> dict[str, float]:
        """Do one step and return the seconds of each part; on a GPU each part is waited for."""
        clock = _Clock(self.device)
        image = self._blurred()
        clock.stop("filter forward")
        loss = self.reference.error(image).mean()
        clock.stop("loss forward")
        (gradient,) = torch.autograd.grad(loss, image)
        clock.stop("loss backward")
        torch.autograd.backward(image, gradient)
        clock.stop("filter backward")
        self._move()
        clock.stop("optimizer")
        return clock.seconds

    def whole(self) -> None:
        """Do one step as a fit does it, in one piece."""
        self.reference.error(self._blurred()).mean().backward()
        self._move()

    def _blurred(self) -> Tensor:
        image = self.blur.layers(self.frame)["color"]
        # Without smooth parameters (`line`) the gradient goes to the image alone.
        return image if image.requires_grad else image.detach().requires_grad_(True)

    def _move(self) -> None:
        if self.optimizer is not None:
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
        self.blur.project_()

    @torch.no_grad()
    def _other_result(self, case: Case) -> Tensor:
        other = make_filter(case)
        for leaf in other.parameters():
            leaf.mul_(0.8)
        frame = self.frame
        layers = other.project_().layers(frame)
        if isinstance(other, TemporalBlur):
            layers = other.layers(frame, history=other.step(frame)[1])
        return layers["color"].clone()


def render_parts(case: Case, spp: int = _SPP) -> dict[str, float]:
    """Render one new crop and return the seconds of its sharp frame and of its reference.

    Args:
        case: Size, engine and device.
        spp: Samples per pixel of the reference; a tuning run takes 256 unless told otherwise.

    Raises:
        ConfigError: the scene is not there.
    """
    scene, size = load_scene(find_scene(RENDER_SCENE)), (case.height, case.width)
    renderer = Renderer(scene, engine=case.engine, device=case.device)
    clock = _Clock(torch.device(case.device))
    renderer.frame(size, color_spp=_COLOR_SPP)
    clock.stop(f"sharp frame, {_COLOR_SPP} spp")
    renderer.reference(size, spp=spp, shutter=Shutter(0.5))
    clock.stop(f"reference, {spp} spp")
    return clock.seconds


def median_parts(
    once: Callable[[], Mapping[str, float]], runs: int, seconds: float
) -> dict[str, float]:
    """Return the medians of each part over several runs; the caller has warmed up.

    Args:
        once: Does one run and returns its parts.
        runs: How many.
        seconds: After so long no new run begins.
    """
    began = time.perf_counter()
    found: list[Mapping[str, Any]] = []
    while len(found) < runs and (not found or time.perf_counter() - began < seconds):
        found.append(once())
    return {name: statistics.median(f[name] for f in found) for name in found[0]}


class _Clock:
    """Times of the parts of a program, one after the other."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.seconds: dict[str, float] = {}
        self._last = self._now()

    def stop(self, name: str) -> None:
        """End a part."""
        now = self._now()
        self.seconds[name] = now - self._last
        self._last = now

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()
