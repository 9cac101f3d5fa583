"""The contract's tests of gradients: right where they are promised, finite everywhere."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from torchblur.testing.case import FilterCase
from torchblur.testing.frames import moving_square, random_frame
from torchblur.testing.probes import inside, numbers

__all__ = ["GradientContract"]

_STEP = 0.1  # finite difference of a weak parameter, as a share of its range


class GradientContract(FilterCase):
    """Gradients in the layers of the frame and in the parameters."""

    def test_gradcheck_of_the_layers(self) -> None:
        frame = self.given(moving_square(7, 8, dtype=torch.float64))
        blur = self.blur(**self.few_taps())

        def run(color: Tensor, velocity: Tensor, depth: Tensor) -> Any:
            changed = dataclasses.replace(frame, color=color, velocity=velocity, depth=depth)
            return self.image(blur, changed)

        layers = (frame.color, frame.velocity, frame.require("depth"))
        assert torch.autograd.gradcheck(
            run,
            [t.clone().requires_grad_() for t in layers],
            eps=1e-7,
            atol=1e-5,
            rtol=1e-4,
            fast_mode=True,
        )

    def test_smooth_parameters_pass_gradcheck_and_act(self) -> None:
        frame = self.given(moving_square(dtype=torch.float64))
        for name, spec in numbers(self.filter_class):
            if spec.grad != "smooth":
                continue
            blur = self.blur(**(self.few_taps() | self.acts_with.get(name, {})))
            value = inside(spec, getattr(blur.config, name)).requires_grad_()
            run = self.as_function_of(blur, frame, name)
            assert torch.autograd.gradcheck(
                run, (value,), eps=1e-7, atol=1e-5, rtol=1e-3, fast_mode=True
            ), name
            (grad,) = torch.autograd.grad(run(value).square().mean(), value)
            assert float(grad.abs()) > 1e-7, f"{name} has no gradient"

    def test_weak_parameters_act_where_autograd_is_wrong(self) -> None:
        frame = self.given(moving_square(dtype=torch.float64))
        for name, spec in numbers(self.filter_class):
            if spec.grad != "weak":
                continue
            blur = self.filter_class(**self.acts_with.get(name, {}))
            middle = spec.to_unit(inside(spec, getattr(blur.config, name)))
            run = self.as_function_of(blur, frame, name)
            unit = middle.clone().requires_grad_()
            value = run(spec.from_unit(unit)).square().mean()
            grad = 0.0
            if value.requires_grad:
                (slope,) = torch.autograd.grad(value, unit, allow_unused=True)
                grad = 0.0 if slope is None else float(slope)
            with torch.no_grad():
                below, above = (
                    float(run(spec.from_unit(middle + step)).square().mean())
                    for step in (-_STEP, _STEP)
                )
            difference = (above - below) / (2 * _STEP)
            assert difference != 0, f"{name} does nothing"
            wrong = abs(grad - difference) / abs(difference)
            assert wrong > 0.05, f"{name} is called weak, yet its gradient is right to {wrong:.1%}"

    @pytest.mark.parametrize("case", ["still", "level depths", "background", "ties"])
    def test_gradients_are_finite(self, case: str) -> None:
        frame = self.given(random_frame())
        velocity, depth = frame.velocity, frame.require("depth")
        if case == "still":
            velocity = velocity.clone()
            velocity[..., :16] = 0
        elif case == "level depths":
            depth = torch.full_like(depth, 4.0)
        elif case == "background":
            depth = depth.clone()
            depth[..., 5:] = torch.inf
        elif case == "ties":
            velocity = torch.ones_like(velocity) * 8
        leaves = [t.clone().requires_grad_() for t in (frame.color, velocity, depth)]
        blur = self.filter_class()
        changed = dataclasses.replace(frame, color=leaves[0], velocity=leaves[1], depth=leaves[2])
        result = self.image(blur, changed)
        result.square().sum().backward()
        assert bool(torch.isfinite(result).all())
        for leaf in (*leaves, *blur.parameters()):
            assert leaf.grad is None or bool(torch.isfinite(leaf.grad).all())
        assert leaves[0].grad is not None
        assert float(leaves[0].grad.abs().sum()) > 0
