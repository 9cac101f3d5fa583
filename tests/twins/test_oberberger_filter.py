"""The filter of Oberberger 2022 against its slow twin, over three frames."""

import numpy as np
import pytest
import torch
from twins.oberberger2022 import oberberger2022
from twins.oberberger2022_pixels import DEFAULTS

from torchblur.filters.oberberger2022 import Oberberger2022Blur
from torchblur.frame import Frame
from torchblur.ops.prefilter import random_candidates

ROWS, COLUMNS = 14, 18
SMALL = {"variance_window": 5, "shutter": 0.75}
CASES = [
    {},
    {"shutter": 1.0, "variance_window": 7, "angle_mode": "double_angle", "angle_gain": 4.0},
    SMALL | {"variance_stride": 1, "depth_extent": 0.4, "lookup": "bilinear", "angle_gain": 9.0},
    SMALL | {"variance_stride": 3, "kernel": "box", "static_filter": "own", "length_gain": 0.02},
    SMALL | {"length_normalization": "mean", "length_gain": 0.7, "blend_gain": 3.0},
    SMALL | {"prefilter_samples": 3, "prefilter_jitter": 0.6, "prefilter_distance": 4.0},
    SMALL | {"prefilter_min_length": 6.0, "blend_source": "weights", "history_limit": 0.2},
    SMALL | {"prefilter": False, "segment_softness": 0.4, "second_stage_iterations": 0},
    SMALL | {"first_stage": False, "reprojection_iterations": 4, "accept_threshold": 0.7},
    SMALL | {"first_stage": False, "static_filter": "own", "moving_threshold": 3.0},
    SMALL | {"cancel_threshold": 3.0, "accept_threshold": 2.5, "kernel_scaling": "fixed"},
    SMALL | {"temporal": False, "min_step": 0.0, "step_divisor": 2.0, "seed": 5},
    SMALL
    | {
        "blend_source": "first_stage",
        "kernel_rotation": False,
        "second_stage_iterations": 2,
        "lookup": "bilinear",
    },
    SMALL | {"blend_source": "filtered", "variance_stride": 3},
    SMALL | {"blend_source": "filtered", "lookup": "bilinear", "kernel": "box", "min_step": 0.3},
    SMALL | {"demodulate": True, "albedo_floor": 0.1, "angle_normalization": 0.5},
]


def stream(rng, index, *, samples=1):
    """n sample frames: sky, ground that creeps, and a block that moves past.

    Every vector differs a little, some point elsewhere; a few pixels of the ground show the
    block. In the lower left corner nothing but the block moves.
    """
    y, x = np.indices((ROWS, COLUMNS))
    calm = (y > 8) & (x < 9)
    left = 2 + 3 * index
    frames = []
    for _ in range(samples):
        block = (y > 2) & (y < 9) & (x >= left) & (x < left + 8)
        block ^= (rng.uniform(0, 1, block.shape) < 0.15) & ~calm
        velocity = 0.2 * rng.normal(size=(2, ROWS, COLUMNS))
        velocity += np.where(block, np.array([4.0, 1.0])[:, None, None], 0)
        wild = (rng.uniform(0, 1, block.shape) < 0.06) & ~calm
        velocity += np.where(wild, rng.normal(0, 9, velocity.shape), 0)
        velocity[:, :5, :2] = rng.normal(0, 3, (2, 5, 2))
        depth = np.where(block, rng.uniform(1.9, 2.1, block.shape), 2.3)
        depth = np.where(wild, rng.uniform(1, 3, block.shape), depth)
        depth[:3, 9:] = np.inf
        frames.append(
            {
                "color": rng.uniform(0, 2, (3, ROWS, COLUMNS)),
                "depth": depth[None],
                "velocity": velocity,
                "time": rng.uniform(0.001, 0.999, (1, ROWS, COLUMNS)),
                "albedo": rng.uniform(0, 1, (3, ROWS, COLUMNS)),
            }
        )
    return frames


def frame_of(planes, *, demodulate):
    names = [name for name in planes if demodulate or name != "albedo"]
    return Frame(**{name: torch.from_numpy(planes[name])[None] for name in names})


def settings_as_the_filter_has_them(blur):
    """Its numbers are float32, so the twin's are made the same."""
    values = blur.config.model_dump()
    return {k: float(np.float32(v)) if isinstance(v, float) else v for k, v in values.items()}


def randoms(frame, settings, count):
    """What the filter draws for the n samples of frame number `count` of a shot."""
    number = settings["prefilter_samples"]
    drawn = [
        random_candidates(frame.color, number, settings["seed"], 1024 * count + i) for i in range(3)
    ]
    times = np.array([d.times[0].numpy() for d in drawn])
    return times, settings["prefilter_jitter"] * np.array([d.jitter[0].numpy() for d in drawn])


def planes_of(history):
    """The twin's history as the filter's planes."""

    def stacked(of, channels):
        empty = (0.0,) * channels
        rows = [[of(p) if p.value else empty for p in row] for row in channel]
        return np.moveaxis(np.array(rows), 2, 0)

    planes = {}
    for name, extra in (("moving", 3), ("static", 0)):
        channel = getattr(history, name)
        width = max(len(p.value) for row in channel for p in row) + extra
        planes[name] = stacked(lambda p: p.data() if hasattr(p, "data") else p.value, width)
        planes[f"{name}_weight"] = stacked(lambda p: (p.weight,), 1)
    return planes


def differences(got, expected, batch=0):
    """By name, the share of pixels that are not alike.

    Of an angle only the direction counts, not which way; of a channel only where it has weight.
    """
    shares = {}
    for name, plane in expected.items():
        away = got[name].detach().numpy()[batch] - plane
        if name == "mean_angle":
            away = np.sin(away)
        away *= expected.get(f"{name}_weight", 1) > 0
        shares[name] = float((np.abs(away) > 1e-7 * (1 + np.abs(plane))).any(0).mean())
    return {name: share for name, share in shares.items() if share > 0}


def run_both(params, samples=1, frames=3, invalid=0.0, **twin_params):
    """(layers, history) of the filter and of the twin for each of the frames.

    invalid: share of pixels that cannot be trusted; twin_params: what the twin does otherwise.
    """
    rng = np.random.default_rng(22)
    blur = Oberberger2022Blur(**params)
    settings = settings_as_the_filter_has_them(blur)
    history = twin_history = None
    for count in range(frames):
        stack = stream(rng, count, samples=samples)
        for planes in stack if invalid else ():
            planes["valid"] = rng.uniform(0, 1, (1, ROWS, COLUMNS)) >= invalid
        tensors = [frame_of(f, demodulate=blur.config.demodulate) for f in stack]
        layers, history = blur.step(tensors, history)
        times, jitter = randoms(tensors[0], settings, count)
        planes, twin_history = oberberger2022(
            stack, twin_history, times=times, jitter=jitter, **(settings | twin_params)
        )
        yield (layers, history.planes), (planes, planes_of(twin_history))


def assert_equal(results):
    for (layers, memory), (planes, twin_memory) in results:
        assert differences(layers, planes) == {}
        assert differences(memory, twin_memory) == {}


@pytest.mark.parametrize("params", CASES, ids=str)
def test_filter_equals_its_twin(params):
    assert_equal(run_both(params))


@pytest.mark.parametrize("params", [CASES[i] for i in (0, 2, 6, 9, 13)], ids=str)
def test_filter_equals_its_twin_with_two_samples_per_pixel(params):
    assert_equal(run_both(params, samples=2, frames=2))


@pytest.mark.parametrize("params", [CASES[i] for i in (5, 9, 13, 14)], ids=str)
def test_filter_equals_its_twin_where_pixels_cannot_be_trusted(params):
    assert_equal(run_both(params, invalid=0.2, frames=2))


def test_a_batch_of_images_and_values_equals_the_twin_one_by_one():
    rng = np.random.default_rng(3)
    sets = [
        {"length_gain": 0.05, "depth_extent": 0.3, "step_divisor": 2.0, "blend_gain": 2.0},
        {"length_gain": 2.0, "depth_extent": 0.6, "step_divisor": 7.0, "blend_gain": 0.5},
    ]
    sets[0] |= {"shutter": 0.5, "history_limit": 0.1, "min_step": 2.0, "prefilter_distance": 1.5}
    sets[1] |= {"shutter": 1.5, "history_limit": 2.0, "min_step": 0.5, "prefilter_distance": 4.0}
    sets[0] |= {"moving_threshold": 1.0, "prefilter_jitter": 0.5, "accept_threshold": 0.7}
    sets[1] |= {"moving_threshold": 2.0, "prefilter_jitter": 3.0, "accept_threshold": 2.0}
    together = {
        name: torch.tensor([s[name] for s in sets], dtype=torch.float64).view(2, 1, 1, 1)
        for name in sets[0]
    }
    blur = Oberberger2022Blur(variance_window=5)
    history, twin_histories = None, [None, None]
    for count in range(2):
        stacks = [stream(rng, count)[0], stream(rng, count + 3)[0]]
        frame = Frame.stack([frame_of(planes, demodulate=False) for planes in stacks])
        layers, history = blur.step(frame, history, **together)
        for i in range(2):
            settings = settings_as_the_filter_has_them(blur) | sets[i]
            times, jitter = randoms(frame, settings, count)
            planes, twin_histories[i] = oberberger2022(
                [stacks[i]], twin_histories[i], times=times, jitter=jitter, **settings
            )
            assert differences(layers, planes, batch=i) == {}
            assert differences(history.planes, planes_of(twin_histories[i]), batch=i) == {}


@pytest.mark.parametrize("lookup", ["nearest", "bilinear"])
@pytest.mark.parametrize("velocity", [(12.0, 5.0), (3.0, 2.0)])
def test_rounding_does_not_decide_what_is_seen(lookup, velocity):
    """One motion everywhere: taps across it are exactly c = 1 px away, and weigh 0, not 1e-8."""
    rng = np.random.default_rng(4)
    y, x = np.indices((32, 40))
    time = rng.uniform(0, 1, (1, 32, 40))
    block = (abs(x - 12 - velocity[0] * time) < 7) & (abs(y - 12 - velocity[1] * time) < 5)
    planes = {
        "color": np.where(block, 1.0, 0.2 * rng.uniform(0, 1, (3, 32, 40))),
        "depth": np.where(block, 1.0, 3.0),
        "velocity": np.where(block, np.reshape(velocity, (2, 1, 1)), 0.0),
        "time": time,
    }
    blur = Oberberger2022Blur(shutter=1.0, second_stage_iterations=1, lookup=lookup)
    frame = frame_of(planes, demodulate=False)
    exact, single = blur(frame)[0], blur(frame.map(lambda t: t.float()))[0]
    assert float((exact - single).abs().max()) < 1e-5
    assert float((exact - frame.color).abs().max()) > 0.1


def test_the_twin_has_the_defaults_of_the_filter():
    assert Oberberger2022Blur().config.model_dump() == DEFAULTS


@pytest.mark.parametrize(
    ("case", "changed"),
    [
        (0, {"accept_threshold": 1.2}),
        (2, {"segment_softness": 0.01}),
        (3, {"static_filter": "kernel"}),
        (6, {"history_limit": 0.21}),
    ],
)
def test_the_comparison_can_fail(case, changed):
    found = {}
    for (layers, memory), (planes, twin_memory) in run_both(CASES[case], frames=2, **changed):
        found |= differences(layers, planes) | differences(memory, twin_memory)
    assert found
