"""The contract's tests of how a filter runs: compiled, on any size, type and layout."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from torchblur.frame import Frame
from torchblur.testing.case import FilterCase
from torchblur.testing.frames import moving_square, random_frame
from torchblur.testing.kernels import traced_kernels
from torchblur.testing.probes import numbers

__all__ = ["MachineContract"]


class MachineContract(FilterCase):
    """Compiled code, sizes, types, strides, pixels that are not valid."""

    @pytest.mark.slow
    def test_compiled_equals_eager_with_gradients(self) -> None:
        results = []
        for engine in ("eager", "compiled"):
            frame = self.given(moving_square())
            color = frame.color.clone().requires_grad_()
            frame = dataclasses.replace(frame, color=color)
            params = self.few_taps() | self.one_structure
            blur = self.filter_class(None, engine=engine, **params)
            image = self.image(blur, frame)
            image.square().mean().backward()
            used = [p.grad for p in blur.parameters() if p.grad is not None]
            results.append([image, color.grad, *used])
        for eager, compiled in zip(*results, strict=True):
            assert torch.allclose(eager, compiled, atol=1e-5, rtol=1e-4)

    def test_compiled_once_per_structure(self, monkeypatch: pytest.MonkeyPatch) -> None:
        compiled = traced_kernels(monkeypatch)
        frame, other = (self.given(random_frame(40, 44, seed=seed)) for seed in (1, 2))
        params = self.few_taps() | self.one_structure
        blur = self.filter_class(None, engine="compiled", **params)

        def run(frame: Frame, **overrides: Any) -> int:
            leaf = frame.color.clone().requires_grad_()
            blur.requires_grad_(False)
            image = self.image(blur, dataclasses.replace(frame, color=leaf), **overrides)
            image.square().sum().backward()
            return compiled()

        sets: list[dict[str, Tensor]] = [{}, {}]
        for name, spec in numbers(self.filter_class):
            values = spec.from_unit(torch.tensor([0.3, 0.6, 0.7]))
            one, two, _ = values.tolist()
            before = run(frame, **{name: one})  # a special value may be a structure of its own
            assert run(frame, **{name: two}) == before, name
            for given, count in zip(sets, (2, 3), strict=True):
                given[name] = values[:count].view(-1, 1, 1, 1)
        before = run(frame, **sets[0])
        assert run(frame, **sets[1]) == before
        before = run(Frame.stack([frame, other]))
        assert run(Frame.stack([frame, other, frame])) == before
        assert run(self.given(random_frame(50, 60))) == before
        blur = self.filter_class(None, engine="compiled", **(params | {"shutter": 0.8}))
        assert run(frame) == before

    @pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (13, 41)])
    def test_any_size(self, size: tuple[int, int]) -> None:
        frame = self.given(random_frame(*size))
        assert self.image(self.filter_class(), frame).shape == frame.color.shape

    def test_types_and_strides(self) -> None:
        frame = self.given(moving_square())
        blur = self.filter_class()
        strided = frame.map(lambda t: t.transpose(2, 3).contiguous().transpose(2, 3))
        assert not strided.color.is_contiguous()
        assert torch.equal(self.image(blur, strided), self.image(blur, frame))
        fine = self.image(blur, frame.to(dtype=torch.float64))
        assert fine.dtype == torch.float64
        coarse = self.image(blur, frame.to(dtype=torch.bfloat16))
        assert coarse.dtype == torch.bfloat16
        assert bool(torch.isfinite(coarse).all())

    def test_inputs_are_not_changed(self) -> None:
        frame = self.given(moving_square())
        before = {name: layer.clone() for name, layer in frame.layers().items()}
        self.image(self.filter_class(), frame)
        for name, layer in frame.layers().items():
            assert torch.equal(layer, before[name])

    def test_invalid_pixels_lend_no_color(self) -> None:
        frame = self.given(moving_square())
        poisoned = frame.color.clone()
        poisoned[..., 8:12, 8:12] = torch.nan
        with pytest.warns(UserWarning, match="48 values"):
            masked = dataclasses.replace(frame, color=poisoned, on_invalid="mask")
        grey = masked.map(lambda t: torch.ones_like(t) if t.shape[1] == 3 else t)
        color = torch.where(masked.require("valid"), grey.color, torch.zeros(()))
        blurred = self.image(self.filter_class(), dataclasses.replace(masked, color=color))
        valid = masked.require("valid").expand_as(blurred)
        assert torch.allclose(blurred[valid], torch.ones(()), atol=1e-5)
