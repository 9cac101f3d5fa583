import dataclasses

import pytest
import torch

from torchblur.errors import FrameError
from torchblur.filters.oberberger2022 import Oberberger2022Blur, oberberger2022
from torchblur.filters.parts.base import History
from torchblur.frame import Frame, FrameSequence
from torchblur.testing.contract import FilterContract
from torchblur.testing.frames import as_stream, moving_square, random_frame
from torchblur.testing.probes import mirrored, mirrored_frame
from torchblur.testing.streams import TexturedPlane


class TestOberberger2022(FilterContract):
    """The contract with a history: each image is that of the second of two frames."""

    filter_class = Oberberger2022Blur
    function = staticmethod(oberberger2022)
    # A block's estimate is made at its top left pixel, and candidates are drawn at random: neither
    # is symmetric.
    plain = {"prefilter": False, "variance_stride": 1}
    inert = ("shutter_position",)  # each sample brings its own time
    acts_with = {
        "albedo_floor": {"demodulate": True},
        "length_gain": {"length_normalization": "mean"},
        "blend_gain": {"moving_threshold": 4.0},
        "cancel_threshold": {"reprojection_iterations": 8},
        "history_limit": {"history_limit": 0.1},
        "kernel_rotation": {"step_divisor": 1.0},
        "lookup": {"step_divisor": 1.0},
    }

    # Fewer taps than the defaults, unless a test asks for others: the tests are many.
    fewer = {"variance_window": 5, "second_stage_iterations": 2}

    def outcome(self, blur, frame, **overrides):
        defaults = blur.config_class()
        fewer = {
            name: value
            for name, value in self.fewer.items()
            if getattr(blur.config, name) == getattr(defaults, name)
        }
        overrides = fewer | overrides
        _, history = blur.step(frame, **overrides)
        return blur.layers(frame, history, **overrides)

    def by_function(self, frame, config=None, **params):
        changed = (
            params
            if config is None
            else {
                name: value
                for name, value in config.model_dump().items()
                if value != getattr(type(config)(), name)
            }
        )
        params = self.fewer | changed
        _, history = oberberger2022(frame, config=config, **params)
        return oberberger2022(frame, history, config, **params)[0]

    def tiles_of_10(self):
        # Reaches 20 px; and going back in time is no symmetry of what has a past.
        return {"temporal": False, "shutter": 0.3}

    def few_taps(self):
        return {}

    def backwards(self, frame):
        return dataclasses.replace(frame, velocity=-frame.velocity, time=1 - frame.time)

    @pytest.mark.parametrize("position", ["centered", "leading", "trailing"])
    def test_uniform_motion_is_a_box_blur(self, position):
        # Not of any noise, as for filters of sharp frames: of what the stream shows over time.
        plane = TexturedPlane((12.0, 0.0), size=(40, 60), wave=24.0)
        blur = self.blur(shutter=1.0, shutter_position=position)
        with torch.no_grad():
            images = [
                blur.layers(plane.stream(seed=s), second_stage_iterations=0)["color"]
                for s in range(16)
            ]
            smooth = blur.layers(plane.stream())["color"][0]
        inner = (..., slice(8, -8), slice(12, -12))
        mean, expected = torch.cat(images).mean(0)[inner], plane.reference()[0][inner]
        sharp = plane.stream(still_time=0.5).color[0][inner]
        assert rms(mean - expected) < 0.3 * rms(sharp - expected)
        assert abs(float((mean - expected).mean())) < 0.004
        # The second stage trades noise for blur beyond the shutter's.
        assert rms(smooth[inner] - expected) < 0.75 * rms(images[0][0][inner] - expected)

    def test_leading_and_trailing_swap_with_the_sign_of_velocity(self):
        frame = self.given(moving_square())
        images = [
            self.blur(shutter_position=p)(frame)[0] for p in ("centered", "leading", "trailing")
        ]
        assert torch.equal(images[0], images[1])
        assert torch.equal(images[0], images[2])

    @pytest.mark.parametrize("kind", ["mirror_x", "mirror_y", "transpose"])
    def test_symmetry_with_a_past(self, kind):
        frame = self.given(random_frame(40, 40))
        blur = self.blur(variance_window=5)
        expected = mirrored(self.image(blur, frame), kind)
        assert torch.allclose(self.image(blur, mirrored_frame(frame, kind)), expected, atol=1e-5)


def rms(error):
    return float(error.square().mean().sqrt())


PLANE = TexturedPlane((8.0, 3.0), size=(32, 44), wave=24.0)
SQUARE = TexturedPlane((9.0, 2.0), size=(36, 52), wave=16.0, square=16.0)
SMALL = TexturedPlane((3.5, 1.0), size=(9, 10), wave=9.0, square=5.0, dtype=torch.float64)


@torch.no_grad()
def filtered(plane, count, **params):
    """Layers of `count` frames in a row."""
    blur, history, result = Oberberger2022Blur(shutter=1.0, **params), None, []
    for index in range(count):
        layers, history = blur.step(plane.stream(index), history)
        result.append(layers)
    return result


def test_the_defaults_are_those_of_the_paper():
    config = Oberberger2022Blur().config
    assert (config.variance_window, config.variance_stride) == (15, 2)
    assert (config.length_gain, config.angle_gain) == (10.0, 1.0)
    assert (config.prefilter_samples, config.prefilter_jitter) == (2, 1.5)
    assert (config.prefilter_distance, config.prefilter_min_length) == (2.5, 3.0)
    assert (config.reprojection_iterations, config.second_stage_iterations) == (2, 3)
    assert config.step_divisor == 5.0


# -- what is read and refused ----------------------------------------------------------------------


@pytest.mark.parametrize("layer", ["time", "depth"])
def test_a_missing_layer_is_named(layer):
    frame = dataclasses.replace(PLANE.stream(), **{layer: None})
    with pytest.raises(FrameError, match=f"`{layer}` is needed and is missing"):
        Oberberger2022Blur()(frame)


def test_demodulation_needs_the_albedo():
    frame = dataclasses.replace(PLANE.stream(), albedo=None)
    assert Oberberger2022Blur()(frame)[0].shape == frame.color.shape
    with pytest.raises(FrameError, match="`albedo` is needed"):
        Oberberger2022Blur(demodulate=True)(frame)


def test_filtering_light_and_albedo_apart_keeps_what_both_are_alone():
    frame = SQUARE.stream()
    lit = dataclasses.replace(frame, albedo=torch.full_like(frame.color, 0.5))
    blur = Oberberger2022Blur(shutter=1.0)
    assert torch.allclose(blur(lit, demodulate=True)[0], blur(lit)[0], atol=1e-6)
    flat = dataclasses.replace(frame, albedo=frame.color)  # a light of 1 everywhere
    assert torch.allclose(blur(flat, demodulate=True)[0], blur(flat)[0], atol=1e-5)
    assert not torch.allclose(blur(frame, demodulate=True)[0], blur(frame)[0], atol=1e-4)


# -- where nothing moves ---------------------------------------------------------------------------


def test_pixels_that_no_motion_reaches_are_the_input_bit_for_bit():
    frame = TexturedPlane((4.0, 0.0), size=(60, 70), square=10.0).stream()
    blur = Oberberger2022Blur(shutter=1.0)
    _, history = blur.step(frame)
    layers = blur.layers(frame, history)
    quiet = (layers["mean_length"] == 0).expand_as(frame.color)
    assert 0.2 < float(quiet.float().mean()) < 0.9
    assert torch.equal(layers["color"][quiet], frame.color[quiet])
    assert not torch.equal(layers["color"][~quiet], frame.color[~quiet])
    names = ("blend", "moving", "moving_weight", "static", "static_weight", "second_stage")
    for name in names:
        assert not bool(layers[name][quiet[:, : layers[name].shape[1]]].any()), name


def test_a_frame_at_rest_between_moving_ones():
    still = dataclasses.replace(PLANE.stream(1), velocity=torch.zeros(1, 2, *PLANE.size))
    blur = Oberberger2022Blur(shutter=1.0)
    moving, history = blur.step(PLANE.stream(0))
    layers, history = blur.step(still, history)
    assert torch.equal(layers["color"], still.color)
    assert layers.keys() == moving.keys()
    assert {n: p.shape for n, p in layers.items()} == {n: p.shape for n, p in moving.items()}
    after, _ = blur.step(PLANE.stream(2), history)
    assert not bool((after["reprojection"] > 0).any())  # nothing moved before: nothing is found


# -- through time ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("prefilter", "most"), [(True, 0.96), (False, 0.85)])
def test_the_history_lowers_the_error(prefilter, most):
    plane = TexturedPlane((12.0, 0.0), size=(40, 60), wave=20.0)
    inner = (..., slice(8, -8), slice(14, -14))

    def error(**more):
        layers = filtered(plane, 6, prefilter=prefilter, **more)
        return sum(rms((layers[i]["color"] - plane.reference(i))[inner]) for i in range(3, 6))

    assert error() < most * error(temporal=False)


def test_a_cut_leaves_no_ghost():
    first, second = PLANE, TexturedPlane((-9.0, 1.0), size=PLANE.size, wave=9.0)
    frames = tuple(plane.stream(i) for plane in (first, second) for i in range(2))
    blur = Oberberger2022Blur(shutter=1.0)
    with torch.no_grad():
        cut = blur.sequence(FrameSequence(frames, cuts=(2,)))
        ghost = blur.sequence(FrameSequence(frames))
        fresh = blur.sequence(FrameSequence(frames[2:]))
    assert torch.equal(cut[2], fresh[0])
    assert torch.equal(cut[3], fresh[1])
    assert not torch.equal(ghost[2], fresh[0])
    assert torch.equal(ghost[1], cut[1])


def test_another_size_forgets_the_history():
    blur = Oberberger2022Blur(shutter=1.0)
    _, history = blur.step(PLANE.stream(0))
    other = TexturedPlane((8.0, 3.0), size=(30, 40)).stream(1)
    assert torch.equal(blur(other, history)[0], blur(other)[0])
    assert not torch.equal(blur(PLANE.stream(1), history)[0], blur(PLANE.stream(1))[0])


def test_light_apart_from_albedo_forgets_a_history_of_color():
    blur = Oberberger2022Blur(shutter=1.0, prefilter=False)
    _, history = blur.step(PLANE.stream(0))
    frame = PLANE.stream(1)
    again = blur.layers(frame, history, demodulate=True)
    assert not bool(again["reprojection"].any())
    assert torch.equal(again["color"], blur(frame, demodulate=True)[0])


def test_a_sequence_equals_the_loop():
    frames = tuple(SQUARE.stream(i) for i in range(3))
    blur = Oberberger2022Blur(shutter=1.0)
    history = None
    for frame, color in zip(frames, blur.sequence(FrameSequence(frames)), strict=True):
        expected, history = blur(frame, history)
        assert torch.equal(color, expected)


def test_random_samples_differ_from_frame_to_frame_and_follow_the_seed():
    frame = PLANE.stream()
    blur = Oberberger2022Blur(shutter=1.0)
    first, history = blur.step(frame)
    second, _ = blur.step(frame, history)
    again, _ = blur.step(frame)
    other, _ = blur.step(frame, seed=1)
    assert torch.equal(first["prefiltered"], again["prefiltered"])
    assert torch.equal(first["color"], again["color"])
    assert not torch.equal(first["prefiltered"], second["prefiltered"])
    assert not torch.equal(first["prefiltered"], other["prefiltered"])


def test_a_batch_with_a_history_equals_single_runs():
    planes = [PLANE, TexturedPlane((-5.0, 6.0), size=PLANE.size, square=12.0)]
    blur = Oberberger2022Blur(shutter=1.0)
    single = [
        torch.stack(blur.sequence(FrameSequence(tuple(p.stream(i) for i in range(3)))))
        for p in planes
    ]
    together = blur.sequence(
        FrameSequence(tuple(Frame.stack([p.stream(i) for p in planes]) for i in range(3)))
    )
    assert torch.allclose(torch.stack(together), torch.cat(single, 1), atol=1e-6)


def test_the_history_is_bounded_and_counts_frames():
    blur, history = Oberberger2022Blur(shutter=1.0, history_limit=0.25), None
    for index in range(3):
        _, history = blur.step(SQUARE.stream(index), history)
    assert isinstance(history, History)
    for name in ("moving_weight", "static_weight"):
        assert float(history.planes[name].max()) == pytest.approx(0.25)
    assert float(history.planes["frame"]) == 3


def test_two_evaluations_find_more_than_one_under_rotation():
    plane = TexturedPlane((0.0, 0.0), spin=0.4, size=(56, 56), wave=20.0)

    def accepted(iterations):
        layers = filtered(plane, 2, reprojection_iterations=iterations)[1]
        return float((layers["reprojection"] > 0).float().mean())

    assert accepted(1) < accepted(2) - 0.02
    assert accepted(2) <= accepted(4)
    seen = filtered(plane, 2)[1]["reprojection"].unique().tolist()
    assert set(seen) >= {-1.0, 1.0, 2.0}


# -- stages ----------------------------------------------------------------------------------------


def test_a_fixed_kernel_does_not_reach_as_far_as_one_scaled_by_the_motion():
    plane = TexturedPlane((40.0, 0.0), size=(24, 120), wave=60.0)
    inner = (..., slice(4, -4), slice(30, -30))

    def error(kind):
        layers = filtered(plane, 1, kernel_scaling=kind, prefilter=False)[0]
        return rms((layers["color"] - plane.reference())[inner])

    scaled, fixed = error("motion"), error("fixed")
    assert scaled < 0.9 * fixed


def test_more_samples_per_pixel_lower_the_error():
    # Without the passes that blur beyond the shutter: it is the noise that falls.
    blur = Oberberger2022Blur(shutter=1.0, prefilter=False, second_stage_iterations=0)
    inner = (..., slice(6, -6), slice(10, -10))

    def error(number):
        image = blur([PLANE.stream(0, seed) for seed in range(number)])[0]
        return rms((image - PLANE.reference())[inner])

    with torch.no_grad():
        errors = [error(number) for number in (1, 4, 16)]
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.7 * errors[1]


def test_the_same_sample_twice_is_the_same_image():
    frame = SQUARE.stream()
    blur = Oberberger2022Blur(shutter=1.0, prefilter=False)
    assert torch.allclose(blur([frame, frame])[0], blur(frame)[0], atol=1e-6)


def test_keeping_static_pixels_leaves_their_detail():
    plane = TexturedPlane((6.0, 0.0), size=(40, 60), wave=6.0, square=12.0)
    inner = (..., slice(4, 10), slice(28, 42))  # above the square's way: active and still

    def error(**params):
        layers = filtered(plane, 2, variance_window=31, **params)[1]
        return rms((layers["static"] - plane.stream(1, still_time=0.5).color)[inner])

    assert error(static_filter="own") < 1e-6
    assert error() > 0.02


@pytest.mark.parametrize("source", ["variance", "weights", "first_stage"])
def test_opacity_follows_its_source(source):
    layers = filtered(SQUARE, 2, blend_source=source)[1]
    first = filtered(SQUARE, 2, temporal=False)[1]
    weights = {"weights": layers, "first_stage": first}.get(source)
    if weights is None:
        assert torch.equal(layers["blend"], filtered(SQUARE, 2)[1]["blend"])
        return
    total = weights["moving_weight"] + weights["static_weight"]
    expected = torch.where(total > 0, weights["moving_weight"] / total.clamp(min=1e-9), 0.0)
    assert torch.allclose(layers["blend"], expected, atol=1e-6)


def test_the_filtered_opacity_is_nearer_to_the_true_one_than_the_paper_s():
    plane = TexturedPlane((11.0, 0.0), size=(48, 72), wave=16.0, square=24.0)
    moments = [plane.stream(0, still_time=(i + 0.5) / 64).velocity[:, :1] > 0 for i in range(64)]
    true = torch.stack(moments).float().mean(0)

    def off(source):
        return rms(filtered(plane, 1, blend_source=source)[0]["blend"] - true)

    assert off("filtered") < 0.6 * off("first_stage") < 0.6 * off("variance")


# -- gradients -------------------------------------------------------------------------------------

SMOOTH = ["depth_extent", "blend_gain", "length_gain", "angle_gain", "history_limit"]


def through_two_frames(blur, color, **overrides):
    """The second image, from the colors of both frames."""
    frames = [dataclasses.replace(SMALL.stream(i), color=color[i : i + 1]) for i in range(2)]
    _, history = blur(frames[0], **overrides)
    return blur(frames[1], history, **overrides)[0]


def test_gradcheck_to_the_colors_of_two_frames():
    blur = Oberberger2022Blur(shutter=1.0, variance_window=5)
    color = torch.cat([SMALL.stream(i).color for i in range(2)]).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda c: through_two_frames(blur, c), (color,), eps=1e-6, atol=1e-6, fast_mode=True
    )
    (grad,) = torch.autograd.grad(through_two_frames(blur, color).sum(), color)
    assert float(grad[0].abs().sum()) > 0.1  # the first frame counts, through the history


def test_the_gradient_of_the_history_limit_comes_through_time():
    blur = Oberberger2022Blur(shutter=1.0, history_limit=0.2, prefilter=False)
    frames = tuple(SQUARE.stream(i) for i in range(3))

    def grad(count, **options):
        blur.zero_grad()
        colors = blur.sequence(FrameSequence(frames[:count]), **options)
        colors[-1].square().mean().backward()
        return float(blur.history_limit.grad or 0.0)

    assert grad(1) == 0.0
    assert abs(grad(2)) > 1e-7
    assert grad(2, detach_every=1) == 0.0


def test_detaching_truncates_the_gradient():
    blur = Oberberger2022Blur(shutter=1.0, prefilter=False)
    frames = [PLANE.stream(i) for i in range(4)]

    def reach(detach_every):
        leaves = [f.color.clone().requires_grad_() for f in frames]
        shot = tuple(dataclasses.replace(f, color=c) for f, c in zip(frames, leaves, strict=True))
        last = blur.sequence(FrameSequence(shot), detach_every=detach_every)[-1]
        grads = torch.autograd.grad(last.sum(), leaves, allow_unused=True)
        return [g is not None and bool(g.any()) for g in grads]

    assert reach(None) == [True, True, True, True]
    assert reach(2) == [False, False, True, True]
    assert reach(1) == [False, False, False, True]


def test_soft_ends_of_paths_have_a_gradient_and_hard_ones_none():
    frame = as_stream(moving_square(dtype=torch.float64))
    blur = Oberberger2022Blur(variance_window=5)
    grads = []
    for value in (0.0, 0.2):
        softness = torch.tensor(value, dtype=torch.float64, requires_grad=True)
        image = blur(frame, segment_softness=softness)[0]
        grads.append(float(torch.autograd.grad(image.square().mean(), softness)[0]))
    assert grads[0] == 0.0
    assert abs(grads[1]) > 1e-7


@pytest.mark.parametrize("name", ["step_divisor", "min_step"])
def test_bilinear_lookups_pass_a_gradient_to_the_steps(name):
    frame = as_stream(moving_square(dtype=torch.float64))
    blur = Oberberger2022Blur(variance_window=5, lookup="bilinear", min_step=1.3, prefilter=False)
    value = torch.tensor(2.3, dtype=torch.float64, requires_grad=True)
    (grad,) = torch.autograd.grad(blur(frame, **{name: value})[0].square().mean(), value)
    assert float(grad.abs()) > 1e-7
    nearest = blur(frame, lookup="nearest", **{name: value})[0].square().mean()
    hard = torch.autograd.grad(nearest, value, allow_unused=True)[0] if nearest.requires_grad else 0
    assert hard is None or float(hard) == 0.0


# -- the list of pixels ----------------------------------------------------------------------------


def test_filtering_all_pixels_gives_the_same_as_filtering_the_active_ones(monkeypatch):
    import torchblur.filters.oberberger2022.filter as module

    blur = Oberberger2022Blur(shutter=1.0)
    _, history = blur.step(SQUARE.stream(0))
    listed = blur.layers(SQUARE.stream(1), history)
    active = listed["mean_length"] > 0
    where = module.points_where
    monkeypatch.setattr(module, "points_where", lambda m, d: where(torch.ones_like(m), d))
    dense = blur.layers(SQUARE.stream(1), history)
    assert 0.2 < float(active.float().mean()) < 0.9
    for name in ("color", "moving", "static", "static_weight", "second_stage", "reprojection"):
        mask = active.expand_as(listed[name])
        assert torch.equal(listed[name][mask], dense[name][mask]), name
    assert bool(dense["static_weight"][~active].all())
