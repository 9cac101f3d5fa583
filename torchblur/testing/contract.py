"""The contract of a filter, as tests: subclass `FilterContract` and say what is special.

::

    class TestMyBlur(FilterContract):
        filter_class = MyBlur
        function = staticmethod(my_blur)
"""

from __future__ import annotations

import copy
import dataclasses
import io
import pickle

import pytest
import torch

from torchblur.errors import ConfigError, FrameError
from torchblur.filters import get_filter
from torchblur.frame import Frame
from torchblur.testing.frames import constant_motion, moving_square, random_frame
from torchblur.testing.gradients import GradientContract
from torchblur.testing.machine import MachineContract
from torchblur.testing.probes import box_blur, mirrored, mirrored_frame, numbers, other_values

__all__ = ["FilterContract"]


class FilterContract(GradientContract, MachineContract):
    """Tests that every filter passes: identity, symmetry, gradients, one source, errors."""

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

    def test_a_state_brings_all_parameters(self) -> None:
        config = self.filter_class.config_class
        for name, value in other_values(config):
            if isinstance(value, float):
                value = float(f"{value:.4g}")  # a float32 knows no more than seven digits
            file = io.BytesIO()
            saved = self.filter_class(**{name: value})
            torch.save(saved.state_dict(), file)
            file.seek(0)
            blur = self.filter_class()
            blur.load_state_dict(torch.load(file, weights_only=True))
            assert blur.current_config() == config(**{name: value}), name
            assert repr(blur) == repr(saved)

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
