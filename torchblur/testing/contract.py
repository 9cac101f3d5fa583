"""The contract of a filter, as tests: subclass `FilterContract` and say what is special.

::

    class TestMyBlur(FilterContract):
        filter_class = MyBlur
        function = staticmethod(my_blur)
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from torchblur.errors import ConfigError, FrameError
from torchblur.filters import BlurFilter, get_filter
from torchblur.frame import Frame
from torchblur.params import Param, choices, declared
from torchblur.testing.frames import constant_motion, moving_square, random_frame

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
    box_tolerance: ClassVar[float] = 0.02
    """Largest mean difference to a box blur under uniform motion, color in [0, 1]."""

    def blur(self, **params: Any) -> BlurFilter:
        """Return the filter with its `plain` parameters and some others."""
        return self.filter_class(**(self.plain | params))

    # -- identity ------------------------------------------------------------------------------

    def test_zero_velocity_is_the_identity(self) -> None:
        frame = random_frame(speed=0.0)
        still = Frame(
            color=frame.color, velocity=torch.zeros_like(frame.velocity), depth=frame.depth
        )
        assert torch.allclose(self.filter_class()(still), frame.color, atol=1e-6)

    def test_zero_shutter_is_the_identity(self) -> None:
        frame = random_frame()
        assert torch.allclose(self.filter_class(shutter=0.0)(frame), frame.color, atol=1e-6)

    @pytest.mark.parametrize("position", ["centered", "leading", "trailing"])
    def test_constant_image_stays_constant(self, position: str) -> None:
        frame = random_frame()
        color = torch.tensor([0.2, 3.0, 40.0]).view(1, 3, 1, 1).expand_as(frame.color)
        frame = Frame(color=color, velocity=frame.velocity, depth=frame.depth)
        blurred = self.filter_class(shutter_position=position)(frame)
        assert torch.allclose(blurred, color, rtol=1e-5)

    def test_result_lies_within_the_colors_of_the_frame(self) -> None:
        frame = random_frame(speed=30.0)
        blurred = self.filter_class()(frame).detach()
        assert float(blurred.min()) >= float(frame.color.min()) - 1e-6
        assert float(blurred.max()) <= float(frame.color.max()) + 1e-6

    # -- uniform motion is a box blur ------------------------------------------------------------

    @pytest.mark.parametrize("position", ["centered", "leading", "trailing"])
    def test_uniform_motion_is_a_box_blur(self, position: str) -> None:
        shift = {"centered": 0.0, "leading": 0.5, "trailing": -0.5}[position]
        frame = constant_motion((24.0, 0.0), 8, 96)
        blurred = self.blur(
            shutter=0.5, shutter_position=position, num_samples=121, **self.long_reach()
        )(frame).detach()
        expected = _box_blur(frame.color, 12.0, shift * 12.0)
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
        frame = random_frame(40, 40)
        blur = self.blur(**self.tiles_of_10())
        expected = _mirrored(frame, kind, blur(frame))
        moved = Frame(
            color=_mirrored(frame, kind, frame.color),
            velocity=_mirrored_velocity(frame, kind),
            depth=_mirrored(frame, kind, frame.require("depth")),
        )
        assert torch.allclose(blur(moved), expected, atol=1e-5)

    def test_sign_of_velocity_does_not_matter_for_a_centered_shutter(self) -> None:
        frame = random_frame(40, 40)
        flipped = Frame(color=frame.color, velocity=-frame.velocity, depth=frame.depth)
        blur = self.blur(**self.tiles_of_10())
        assert torch.allclose(blur(flipped), blur(frame), atol=1e-5)

    def test_leading_and_trailing_swap_with_the_sign_of_velocity(self) -> None:
        frame = random_frame(40, 40)
        flipped = Frame(color=frame.color, velocity=-frame.velocity, depth=frame.depth)
        leading = self.blur(shutter_position="leading")(frame)
        trailing = self.blur(shutter_position="trailing")(flipped)
        assert torch.allclose(leading, trailing, atol=1e-5)
        assert not torch.allclose(leading, self.blur(shutter_position="trailing")(frame), atol=0.1)

    def test_shift_by_a_tile_shifts_the_result(self) -> None:
        frame = random_frame(60, 80)
        blur = self.blur(**self.tiles_of_10())
        shifted = frame.crop(10, 20, 50, 60)
        inner = (..., slice(20, -20), slice(20, -20))
        whole = blur(frame)[..., 10:60, 20:80]
        assert torch.allclose(blur(shifted)[inner], whole[inner], atol=1e-5)

    def tiles_of_10(self) -> dict[str, Any]:
        """Return a tile size of 10, if the filter has tiles."""
        return {"tile_size": 10} if "tile_size" in declared(self.filter_class.config_class) else {}

    def test_scale_of_radiance(self) -> None:
        frame = random_frame()
        bright = Frame(color=frame.color * 1000, velocity=frame.velocity, depth=frame.depth)
        blur = self.filter_class()
        assert torch.allclose(blur(bright), blur(frame) * 1000, rtol=1e-4, atol=1e-3)

    # -- batches -------------------------------------------------------------------------------

    def test_batch_equals_single_runs(self) -> None:
        frames = [random_frame(seed=seed) for seed in range(3)]
        blur = self.filter_class()
        single = torch.cat([blur(frame) for frame in frames])
        assert torch.allclose(blur(Frame.stack(frames)), single, atol=1e-6)

    def test_batch_of_parameter_sets_equals_single_runs(self) -> None:
        frame = moving_square()
        for name, spec in _numbers(self.filter_class):
            values = spec.from_unit(torch.tensor([0.2, 0.5, 0.7]))
            given = self.acts_with.get(name, {})
            together = self.filter_class(**given)(frame, **{name: values.view(3, 1, 1, 1)})
            single = [self.filter_class(**(given | {name: float(v)}))(frame) for v in values]
            assert torch.allclose(together, torch.cat(single), atol=1e-4), name

    def test_a_value_per_pixel(self) -> None:
        frame = moving_square()
        for name, spec in _numbers(self.filter_class):
            plane = torch.full((1, 1, *frame.size), float(spec.from_unit(torch.tensor(0.4))))
            given = self.acts_with.get(name, {})
            one = self.filter_class(**given)(frame, **{name: float(plane[0, 0, 0, 0])})
            many = self.filter_class(**given)(frame, **{name: plane})
            assert torch.allclose(one, many, atol=1e-5), name

    # -- one source ----------------------------------------------------------------------------

    def test_module_equals_function_for_every_parameter(self) -> None:
        frame = moving_square()
        config = self.filter_class.config_class
        for name, value in _other_values(config):
            given = self.acts_with.get(name, {}) | {name: value}
            module = self.filter_class(**given)(frame)
            assert torch.equal(self.function(frame, **given), module), name
            assert torch.equal(self.function(frame, config(**given)), module), name
            assert torch.equal(self.filter_class()(frame, **given), module), name

    def test_every_parameter_changes_something(self) -> None:
        frame = moving_square()
        for name, value in _other_values(self.filter_class.config_class):
            given = self.acts_with.get(name, {})
            before = self.filter_class(**given).layers(frame)
            after = self.filter_class(**(given | {name: value})).layers(frame)
            assert any(
                before[key].shape != after[key].shape or not torch.equal(before[key], after[key])
                for key in before
            ), f"{name} = {value!r} changes nothing"

    def test_config_round_trip(self) -> None:
        config = self.filter_class.config_class
        for name, value in _other_values(config):
            one = config(**{name: value})
            assert config.model_validate_json(one.model_dump_json()) == one
            shown = repr(self.filter_class(one))
            again = eval(shown, {self.filter_class.__name__: self.filter_class})
            assert again.config == one, shown

    def test_range_of_every_parameter(self) -> None:
        for name, spec in _numbers(self.filter_class, discrete=True):
            low, high = spec.bounds
            kind = self.filter_class.config_class.model_fields[name].annotation
            for inside in (low, high):
                self.blur(**{name: kind(inside) if kind else inside})
            outside = (low - 1, high + 1) if kind is int else (low - 1e-3, high * 1.01, torch.nan)
            for value in outside:
                with pytest.raises(ConfigError, match=f"`{name}`.*got"):
                    self.blur(**{name: kind(value) if kind else value})

    def test_copies_and_state(self) -> None:
        blur = self.filter_class(shutter=0.7)
        frame = moving_square()
        for twin in (copy.deepcopy(blur), pickle.loads(pickle.dumps(blur))):
            assert torch.equal(twin(frame), blur(frame))
        other = self.filter_class()
        other.load_state_dict(blur.state_dict())
        assert torch.equal(other(frame), blur(frame))
        assert get_filter(self.filter_class.name) is self.filter_class

    # -- gradients -----------------------------------------------------------------------------

    def test_gradcheck_of_the_layers(self) -> None:
        frame = moving_square(7, 8, dtype=torch.float64)
        blur = self.blur(**self.few_taps())

        def run(color: Tensor, velocity: Tensor, depth: Tensor) -> Any:
            return blur(Frame(color=color, velocity=velocity, depth=depth))

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
        frame = moving_square(dtype=torch.float64)
        for name, spec in _numbers(self.filter_class):
            if spec.grad != "smooth":
                continue
            blur = self.blur(**(self.few_taps() | self.acts_with.get(name, {})))
            value = _inside(spec, getattr(blur.config, name)).requires_grad_()
            run = _as_function_of(blur, frame, name)
            assert torch.autograd.gradcheck(
                run, (value,), eps=1e-7, atol=1e-5, rtol=1e-3, fast_mode=True
            ), name
            (grad,) = torch.autograd.grad(run(value).square().mean(), value)
            assert float(grad.abs()) > 1e-7, f"{name} has no gradient"

    def test_weak_parameters_act_where_autograd_is_wrong(self) -> None:
        frame = moving_square(dtype=torch.float64)
        for name, spec in _numbers(self.filter_class):
            if spec.grad != "weak":
                continue
            blur = self.filter_class(**self.acts_with.get(name, {}))
            middle = spec.to_unit(_inside(spec, getattr(blur.config, name)))
            run = _as_function_of(blur, frame, name)
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
        frame = random_frame()
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
        result = blur(Frame(color=leaves[0], velocity=leaves[1], depth=leaves[2]))
        result.square().sum().backward()
        assert bool(torch.isfinite(result).all())
        for leaf in (*leaves, *blur.parameters()):
            assert leaf.grad is None or bool(torch.isfinite(leaf.grad).all())
        assert leaves[0].grad is not None
        assert float(leaves[0].grad.abs().sum()) > 0

    def few_taps(self) -> dict[str, Any]:
        """Return a number of taps that keeps gradcheck quick."""
        return {"num_samples": 7} | self.tiles_of_10()

    # -- machine -------------------------------------------------------------------------------

    @pytest.mark.slow
    def test_compiled_equals_eager_with_gradients(self) -> None:
        results = []
        for engine in ("eager", "compiled"):
            frame = moving_square()
            color = frame.color.clone().requires_grad_()
            frame = Frame(color=color, velocity=frame.velocity, depth=frame.depth)
            blur = self.filter_class(None, engine=engine, num_samples=9)
            image = blur(frame)
            image.square().mean().backward()
            used = [p.grad for p in blur.parameters() if p.grad is not None]
            results.append([image, color.grad, *used])
        for eager, compiled in zip(*results, strict=True):
            assert torch.allclose(eager, compiled, atol=1e-5, rtol=1e-4)

    @pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (13, 41)])
    def test_any_size(self, size: tuple[int, int]) -> None:
        frame = random_frame(*size)
        assert self.filter_class()(frame).shape == frame.color.shape

    def test_types_and_strides(self) -> None:
        frame = moving_square()
        blur = self.filter_class()
        strided = frame.map(lambda t: t.transpose(2, 3).contiguous().transpose(2, 3))
        assert not strided.color.is_contiguous()
        assert torch.equal(blur(strided), blur(frame))
        assert blur(frame.to(dtype=torch.float64)).dtype == torch.float64
        coarse = blur(frame.to(dtype=torch.bfloat16))
        assert coarse.dtype == torch.bfloat16
        assert bool(torch.isfinite(coarse).all())

    def test_inputs_are_not_changed(self) -> None:
        frame = moving_square()
        before = {name: layer.clone() for name, layer in frame.layers().items()}
        self.filter_class()(frame)
        for name, layer in frame.layers().items():
            assert torch.equal(layer, before[name])

    def test_invalid_pixels_lend_no_color(self) -> None:
        frame = moving_square()
        poisoned = frame.color.clone()
        poisoned[..., 8:12, 8:12] = torch.nan
        with pytest.warns(UserWarning, match="48 values"):
            masked = Frame(
                color=poisoned, velocity=frame.velocity, depth=frame.depth, on_invalid="mask"
            )
        grey = masked.map(lambda t: torch.ones_like(t) if t.shape[1] == 3 else t)
        blurred = self.filter_class()(
            Frame(
                color=torch.where(masked.require("valid"), grey.color, torch.zeros(())),
                velocity=masked.velocity,
                depth=masked.depth,
                valid=masked.valid,
            )
        )
        valid = masked.require("valid").expand_as(blurred)
        assert torch.allclose(blurred[valid], torch.ones(()), atol=1e-5)

    # -- errors --------------------------------------------------------------------------------

    def test_unknown_parameter_names_the_nearest(self) -> None:
        with pytest.raises(ConfigError, match=r"unknown key `shuter` \(did you mean `shutter`"):
            self.filter_class(shuter=0.5)
        with pytest.raises(ConfigError, match=r"`shuter` \(did you mean `shutter`"):
            self.filter_class()(moving_square(), shuter=0.5)

    def test_values_of_the_wrong_kind_or_shape(self) -> None:
        with pytest.raises(ConfigError, match=r"`shutter`.*'long'"):
            self.filter_class(shutter="long")
        with pytest.raises(ConfigError, match=r"`shutter` must broadcast.*\(5,\)"):
            self.filter_class()(moving_square(), shutter=torch.full((5,), 0.5))
        with pytest.raises(ConfigError, match=r"`shutter` must lie in \[0, 8\] frame, got 9"):
            self.filter_class()(moving_square(), shutter=torch.tensor([0.5, 9]).view(2, 1, 1, 1))

    def test_not_a_number_in_the_velocity(self) -> None:
        frame = random_frame()
        velocity = frame.velocity.clone()
        velocity[0, 1, 3, 5] = torch.nan
        with pytest.raises(FrameError, match=r"`velocity` must be finite, got 1 .*x=5, y=3"):
            Frame(color=frame.color, velocity=velocity, depth=frame.depth)


def _numbers(filter_class: type[BlurFilter], *, discrete: bool = False) -> list[tuple[str, Param]]:
    return [
        (name, spec)
        for name, spec in declared(filter_class.config_class).items()
        if spec.low is not None and (discrete or spec.grad != "discrete")
    ]


def _other_values(config: Any) -> list[tuple[str, Any]]:
    """Return, for each parameter, values that are not its default."""
    pairs: list[tuple[str, Any]] = []
    for name, spec in declared(config).items():
        default = config.model_fields[name].default
        if spec.low is None:
            pairs += [(name, c) for c in choices(config, name) if c != default]
        elif config.model_fields[name].annotation is int:
            pairs.append((name, max(default // 4, 1) if default else 4))
        else:
            pairs.append((name, round(float(_inside(spec, default, 0.2)), 6)))
    return pairs


def _inside(spec: Param, value: float, step: float = 0.05) -> Tensor:
    """Return a value some way from the given one, and from both ends of the range."""
    unit = spec.to_unit(torch.tensor(float(value), dtype=torch.float64))
    unit = unit + step if float(unit) < 0.5 else unit - step
    return spec.from_unit(unit.clamp(0.11, 0.89))


def _as_function_of(blur: BlurFilter, frame: Frame, name: str) -> Callable[[Tensor], Tensor]:
    return lambda value: blur(frame, **{name: value})


def _box_blur(color: Tensor, length: float, shift: float) -> Tensor:
    """Average over a horizontal line of a length in px, moved by a shift: many linear lookups."""
    width = color.shape[-1]
    total = torch.zeros_like(color)
    steps = 120
    for i in range(steps):
        offset = shift + ((i + 0.5) / steps - 0.5) * length
        position = (torch.arange(width) - offset).clamp(0, width - 1)
        low = position.floor().long()
        high = (low + 1).clamp(max=width - 1)
        share = position - low
        total += color[..., low] * (1 - share) + color[..., high] * share
    return total / steps


def _mirrored(frame: Frame, kind: str, plane: Tensor) -> Tensor:
    if kind == "transpose":
        return plane.transpose(2, 3)
    return plane.flip(3 if kind == "mirror_x" else 2)


def _mirrored_velocity(frame: Frame, kind: str) -> Tensor:
    velocity = _mirrored(frame, kind, frame.velocity)
    if kind == "transpose":
        return velocity.flip(1)
    sign = torch.tensor([-1.0, 1.0] if kind == "mirror_x" else [1.0, -1.0])
    return velocity * sign.view(1, 2, 1, 1)
