"""The contract of a filter, as tests: subclass `FilterContract` and say what is special.

::

    class TestMyBlur(FilterContract):
        filter_class = MyBlur
        function = staticmethod(my_blur)
"""

from __future__ import annotations

import copy
import dataclasses
import pickle
from collections.abc import Callable
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from torchblur.errors import ConfigError, FrameError
from torchblur.filters import BlurFilter, get_filter
from torchblur.frame import Frame
from torchblur.params import declared
from torchblur.testing.frames import as_stream, constant_motion, moving_square, random_frame
from torchblur.testing.kernels import traced_kernels
from torchblur.testing.probes import (
    box_blur,
    inside,
    mirrored,
    mirrored_frame,
    numbers,
    other_values,
)

__all__ = ["FilterContract"]

_STEP = 0.1  # finite difference of a weak parameter, as a share of its range


class FilterContract:
    """Tests that every filter passes: identity, symmetry, gradients, one source, errors."""

    filter_class: ClassVar[type[BlurFilter]]
    function: ClassVar[Callable[..., Tensor]]
    plain: ClassVar[dict[str, Any]] = {}
    """Parameters that take the noise out, under which the symmetries hold exactly."""
    acts_with: ClassVar[dict[str, dict[str, Any]]] = {}
    """Per parameter: what else must be set for it to act at all."""
    inert: ClassVar[tuple[str, ...]] = ()
    """Parameters of all filters that change nothing in this one."""
    one_structure: ClassVar[dict[str, Any]] = {}
    """For compiled taps: switches that make one kernel, whatever the frame, or a small one."""
    box_tolerance: ClassVar[float] = 0.02
    """Largest mean difference to a box blur under uniform motion, color in [0, 1]."""

    def blur(self, **params: Any) -> BlurFilter:
        """Return the filter with its `plain` parameters and some others."""
        return self.filter_class(**(self.plain | params))

    # -- hooks for filters that need more than color, velocity and depth -----------------------

    def given(self, frame: Frame) -> Frame:
        """Return a frame with the layers that the filter needs."""
        return as_stream(frame) if "time" in self.filter_class.needs else frame

    def outcome(self, blur: BlurFilter, frame: Frame, **overrides: Any) -> dict[str, Tensor]:
        """Return the layers that are looked at; a filter with a memory may run twice."""
        return blur.layers(frame, **overrides)

    def image(self, blur: BlurFilter, frame: Frame, **overrides: Any) -> Tensor:
        """Return the color of `outcome`."""
        return self.outcome(blur, frame, **overrides)["color"]

    def by_function(self, frame: Frame, config: Any = None, **params: Any) -> Tensor:
        """Return the color that the filter's function gives."""
        return self.function(frame, config=config, **params)

    def backwards(self, frame: Frame) -> Frame:
        """Return what moves the other way, and is to blur into the same image."""
        return dataclasses.replace(frame, velocity=-frame.velocity)

    # -- identity ------------------------------------------------------------------------------

    def test_zero_velocity_is_the_identity(self) -> None:
        frame = self.given(random_frame(speed=0.0))
        still = dataclasses.replace(frame, velocity=torch.zeros_like(frame.velocity))
        image = self.image(self.filter_class(), still)
        assert torch.allclose(image, frame.color, atol=1e-6)

    def test_zero_shutter_is_the_identity(self) -> None:
        frame = self.given(random_frame())
        image = self.image(self.filter_class(shutter=0.0), frame)
        assert torch.allclose(image, frame.color, atol=1e-6)

    @pytest.mark.parametrize("position", ["centered", "leading", "trailing"])
    def test_constant_image_stays_constant(self, position: str) -> None:
        frame = self.given(random_frame())
        color = torch.tensor([0.2, 3.0, 40.0]).view(1, 3, 1, 1).expand_as(frame.color)
        frame = dataclasses.replace(frame, color=color)
        blurred = self.image(self.filter_class(shutter_position=position), frame)
        assert torch.allclose(blurred, color, rtol=1e-5)

    def test_result_lies_within_the_colors_of_the_frame(self) -> None:
        frame = self.given(random_frame(speed=30.0))
        blurred = self.image(self.filter_class(), frame).detach()
        assert float(blurred.min()) >= float(frame.color.min()) - 1e-6
        assert float(blurred.max()) <= float(frame.color.max()) + 1e-6

    # -- uniform motion is a box blur ------------------------------------------------------------

    @pytest.mark.parametrize("position", ["centered", "leading", "trailing"])
    def test_uniform_motion_is_a_box_blur(self, position: str) -> None:
        shift = {"centered": 0.0, "leading": 0.5, "trailing": -0.5}[position]
        frame = self.given(constant_motion((24.0, 0.0), 8, 96))
        blur = self.blur(
            shutter=0.5, shutter_position=position, num_samples=121, **self.long_reach()
        )
        blurred = self.image(blur, frame).detach()
        expected = box_blur(frame.color, 12.0, shift * 12.0)
        inner = slice(28, -28)
        difference = (blurred - expected)[..., inner].abs().mean()
        assert float(difference) < self.box_tolerance
        unblurred = (frame.color - expected)[..., inner].abs().mean()
        assert float(difference) < 0.2 * float(unblurred)

    def long_reach(self) -> dict[str, Any]:
        """Return the parameters under which a blur of 12 px is not cut short."""
        return {"tile_size": 40} if "tile_size" in declared(self.filter_class.config_class) else {}

    # -- symmetries ----------------------------------------------------------------------------

    @pytest.mark.parametrize("kind", ["mirror_x", "mirror_y", "transpose"])
    def test_symmetry(self, kind: str) -> None:
        # Sizes that tiles divide: the padded edge of a tile grid is not symmetric.
        frame = self.given(random_frame(40, 40))
        blur = self.blur(**self.tiles_of_10())
        expected = mirrored(self.image(blur, frame), kind)
        assert torch.allclose(self.image(blur, mirrored_frame(frame, kind)), expected, atol=1e-5)

    def test_sign_of_velocity_does_not_matter_for_a_centered_shutter(self) -> None:
        frame = self.given(random_frame(40, 40))
        blur = self.blur(**self.tiles_of_10())
        flipped = self.image(blur, self.backwards(frame))
        assert torch.allclose(flipped, self.image(blur, frame), atol=1e-5)

    def test_leading_and_trailing_swap_with_the_sign_of_velocity(self) -> None:
        frame = self.given(random_frame(40, 40))
        flipped = self.backwards(frame)
        ahead, behind = (self.blur(shutter_position=p) for p in ("leading", "trailing"))
        leading = self.image(ahead, frame)
        assert torch.allclose(leading, self.image(behind, flipped), atol=1e-5)
        assert not torch.allclose(leading, self.image(behind, frame), atol=0.1)

    def test_shift_by_a_tile_shifts_the_result(self) -> None:
        frame = self.given(random_frame(60, 80))
        blur = self.blur(**self.tiles_of_10())
        shifted = frame.crop(10, 20, 50, 60)
        inner = (..., slice(20, -20), slice(20, -20))
        whole = self.image(blur, frame)[..., 10:60, 20:80]
        assert torch.allclose(self.image(blur, shifted)[inner], whole[inner], atol=1e-5)

    def tiles_of_10(self) -> dict[str, Any]:
        """Return a tile size of 10, if the filter has tiles."""
        return {"tile_size": 10} if "tile_size" in declared(self.filter_class.config_class) else {}

    def test_scale_of_radiance(self) -> None:
        frame = self.given(random_frame())
        bright = dataclasses.replace(frame, color=frame.color * 1000)
        blur = self.filter_class()
        expected = self.image(blur, frame) * 1000
        assert torch.allclose(self.image(blur, bright), expected, rtol=1e-4, atol=1e-3)

    # -- batches -------------------------------------------------------------------------------

    def test_batch_equals_single_runs(self) -> None:
        frames = [self.given(random_frame(seed=seed)) for seed in range(3)]
        blur = self.filter_class()
        single = torch.cat([self.image(blur, frame) for frame in frames])
        assert torch.allclose(self.image(blur, Frame.stack(frames)), single, atol=1e-6)

    def test_batch_of_parameter_sets_equals_single_runs(self) -> None:
        frame = self.given(moving_square())
        for name, spec in numbers(self.filter_class):
            values = spec.from_unit(torch.tensor([0.2, 0.5, 0.7]))
            given = self.acts_with.get(name, {})
            blur = self.filter_class(**given)
            together = self.image(blur, frame, **{name: values.view(3, 1, 1, 1)})
            blurs = [self.filter_class(**(given | {name: float(v)})) for v in values]
            single = torch.cat([self.image(blur, frame) for blur in blurs])
            assert torch.allclose(together, single, atol=1e-4), name

    def test_a_value_per_pixel(self) -> None:
        frame = self.given(moving_square())
        for name, spec in numbers(self.filter_class):
            plane = torch.full((1, 1, *frame.size), float(spec.from_unit(torch.tensor(0.4))))
            blur = self.filter_class(**self.acts_with.get(name, {}))
            one = self.image(blur, frame, **{name: float(plane[0, 0, 0, 0])})
            many = self.image(blur, frame, **{name: plane})
            assert torch.allclose(one, many, atol=1e-5), name

    # -- one source ----------------------------------------------------------------------------

    def test_module_equals_function_for_every_parameter(self) -> None:
        frame = self.given(moving_square())
        config = self.filter_class.config_class
        for name, value in other_values(config):
            given = self.acts_with.get(name, {}) | {name: value}
            module = self.image(self.filter_class(**given), frame)
            assert torch.equal(self.by_function(frame, **given), module), name
            assert torch.equal(self.by_function(frame, config(**given)), module), name
            assert torch.equal(self.image(self.filter_class(), frame, **given), module), name

    def test_every_parameter_changes_something(self) -> None:
        frame = self.given(moving_square())
        for name, value in other_values(self.filter_class.config_class):
            given = self.acts_with.get(name, {})
            before = self.outcome(self.filter_class(**given), frame)
            after = self.outcome(self.filter_class(**(given | {name: value})), frame)
            changed = any(
                before[key].shape != after[key].shape or not torch.equal(before[key], after[key])
                for key in before
            )
            assert changed == (name not in self.inert), f"{name} = {value!r}: changes {changed}"

    def test_config_round_trip(self) -> None:
        config = self.filter_class.config_class
        for name, value in other_values(config):
            one = config(**{name: value})
            assert config.model_validate_json(one.model_dump_json()) == one
            shown = repr(self.filter_class(one))
            again = eval(shown, {self.filter_class.__name__: self.filter_class})
            assert again.config == one, shown

    def test_range_of_every_parameter(self) -> None:
        for name, spec in numbers(self.filter_class, discrete=True):
            low, high = spec.bounds
            kind = self.filter_class.config_class.model_fields[name].annotation
            for end in (low, high):
                blur = self.blur(**{name: kind(end) if kind else end})
                # float32 must not put the end of a range outside of it
                assert getattr(blur.current_config(), name) == end
            outside = (low - 1, high + 1) if kind is int else (low - 1e-3, high * 1.01, torch.nan)
            for value in outside:
                with pytest.raises(ConfigError, match=f"`{name}`.*got"):
                    self.blur(**{name: kind(value) if kind else value})

    def test_copies_and_state(self) -> None:
        blur = self.filter_class(shutter=0.7)
        frame = self.given(moving_square())
        for twin in (copy.deepcopy(blur), pickle.loads(pickle.dumps(blur))):
            assert torch.equal(self.image(twin, frame), self.image(blur, frame))
        other = self.filter_class()
        other.load_state_dict(blur.state_dict())
        assert torch.equal(self.image(other, frame), self.image(blur, frame))
        assert get_filter(self.filter_class.name) is self.filter_class

    # -- gradients -----------------------------------------------------------------------------

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

    def as_function_of(
        self, blur: BlurFilter, frame: Frame, name: str
    ) -> Callable[[Tensor], Tensor]:
        """Return the image as a function of one parameter."""
        return lambda value: self.image(blur, frame, **{name: value})

    def few_taps(self) -> dict[str, Any]:
        """Return a number of taps that keeps gradcheck quick."""
        return {"num_samples": 7} | self.tiles_of_10()

    # -- machine -------------------------------------------------------------------------------

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

    # -- errors --------------------------------------------------------------------------------

    def test_unknown_parameter_names_the_nearest(self) -> None:
        with pytest.raises(ConfigError, match=r"unknown key `shuter` \(did you mean `shutter`"):
            self.filter_class(shuter=0.5)
        with pytest.raises(ConfigError, match=r"`shuter` \(did you mean `shutter`"):
            self.filter_class()(self.given(moving_square()), shuter=0.5)

    def test_values_of_the_wrong_kind_or_shape(self) -> None:
        with pytest.raises(ConfigError, match=r"`shutter`.*'long'"):
            self.filter_class(shutter="long")
        with pytest.raises(ConfigError, match=r"`shutter` must broadcast.*\(5,\)"):
            self.filter_class()(self.given(moving_square()), shutter=torch.full((5,), 0.5))
        two = torch.tensor([0.5, 9]).view(2, 1, 1, 1)
        with pytest.raises(ConfigError, match=r"`shutter` must lie in \[0, 8\] frame, got 9"):
            self.filter_class()(self.given(moving_square()), shutter=two)

    def test_not_a_number_in_the_velocity(self) -> None:
        frame = self.given(random_frame())
        velocity = frame.velocity.clone()
        velocity[0, 1, 3, 5] = torch.nan
        with pytest.raises(FrameError, match=r"`velocity` must be finite, got 1 .*x=5, y=3"):
            dataclasses.replace(frame, velocity=velocity)
