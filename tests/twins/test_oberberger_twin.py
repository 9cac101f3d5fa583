"""The variance estimate and the pre-filter of the twin of Oberberger 2022, worked out by hand."""

import math

import numpy as np
import pytest
from twins import oberberger2022 as ob
from twins.frames import moved_stream, still_stream
from twins.oberberger2022_pixels import (
    depth_weight,
    edge,
    motion_weight,
    sample_grid,
    segment_distance,
    settings_of,
)

FULL = settings_of({"shutter": 1.0})


def estimate_at(frame, x, y, **changes):
    settings = settings_of({"shutter": 1.0} | changes)
    return ob.estimate([sample_grid(frame, settings)], x, y, settings)


# -- weights -----------------------------------------------------------------------------------


def test_depth_weight():
    assert depth_weight(10, 3, FULL) == depth_weight(10, 10, FULL) == 1
    assert depth_weight(10, 10.5, FULL) == pytest.approx(0.5)
    assert depth_weight(10, 11, FULL) == depth_weight(10, 1e10, FULL) == 0
    assert depth_weight(1e10, 1e10, FULL) == 1


def test_distance_to_the_path():
    """q = (5, 0) at t = 1/4 moves by (8, 0): from (3, 0) to (11, 0)."""
    assert segment_distance((7, 3), (5, 0), (8, 0), 0.25) == (3, 0.5)
    assert segment_distance((1, 3), (5, 0), (8, 0), 0.25) == (3, -0.25)
    on_segment = segment_distance((0, 4), (5, 0), (8, 0), 0.25, clamped=True)
    assert on_segment == (5, -0.375)
    assert segment_distance((3, 4), (0, 0), (0, 0), 0.3)[0] == 5
    weights = [motion_weight((x, 1), (5, 0), (8, 0), 0.25, 4, FULL) for x in (2, 3, 11, 12)]
    assert weights == [0, 0.75, 0.75, 0]
    assert motion_weight((4, 4), (5, 0), (8, 0), 0.25, 4, FULL) == 0


def test_soft_ends_of_the_path():
    ends = [edge(along, 0.2) for along in (-0.25, -0.05, 0, 0.5, 1, 1.1, 1.2)]
    assert ends == pytest.approx([0, 0.75, 1, 1, 1, 0.5, 0])


# -- variance estimate -------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["relative", "double_angle"])
def test_estimate_of_uniform_motion(mode, rng):
    motion = estimate_at(moved_stream(rng, (3, 4)), 5, 5, angle_mode=mode)
    assert motion.length == pytest.approx(5)
    assert motion.angle == pytest.approx(math.atan2(4, 3))
    assert (motion.length_variance, motion.angle_variance) == pytest.approx((0, 0))
    assert (motion.moving_part, motion.c) == pytest.approx((1, 1))


def test_estimate_without_motion(rng):
    assert not estimate_at(still_stream(rng), 5, 5).active
    slow = moved_stream(rng, (0.3, 0.3))
    assert not estimate_at(slow, 5, 5).active
    assert estimate_at(slow, 5, 5, moving_threshold=0.4).active


def test_estimate_leaves_out_what_stands_still_or_lies_behind(rng):
    """3x3 window around the still (5, 5): one sample level, one behind, one half behind."""
    frame = still_stream(rng)
    frame["velocity"][0, 4, 4], frame["velocity"][0, 4, 5], frame["velocity"][0, 4, 6] = 2, 8, 5
    frame["depth"][0, 4, 5], frame["depth"][0, 4, 6] = 3, 2.1
    motion = estimate_at(frame, 5, 5, variance_window=3)
    assert motion.length == pytest.approx((2 + 5 / 2) / 1.5)
    assert motion.length_variance == pytest.approx((4 + 25 / 2) / 1.5 - 9)
    assert motion.moving_part == pytest.approx(1.5 / 7.5)
    relative = estimate_at(frame, 5, 5, variance_window=3, length_normalization="mean")
    assert relative.length_variance == pytest.approx(2 / 9)
    assert motion.c == 2
    assert relative.c == 2
    slack = {"length_gain": 0.1, "variance_window": 3}
    assert estimate_at(frame, 5, 5, **slack).c == pytest.approx(1.2)


def test_even_window_has_one_more_at_right_and_below(rng):
    frame = still_stream(rng)
    frame["velocity"][0, 4, 5] = frame["velocity"][0, 5, 7] = 3
    assert estimate_at(frame, 5, 5, variance_window=2).moving_part == 0
    assert estimate_at(frame, 5, 5, variance_window=4).moving_part == pytest.approx(2 / 16)
    assert estimate_at(frame, 6, 4, variance_window=2).moving_part == pytest.approx(1 / 4)


def two_directions(rng, first, second):
    """Columns to the left of 5 and column 5 move by `first`, the others by `second`."""
    frame = moved_stream(rng, first)
    frame["velocity"][:, :, 6:] = np.reshape(second, (2, 1, 1))
    return frame


def polar(length, degrees):
    return length * math.cos(math.radians(degrees)), length * math.sin(math.radians(degrees))


def test_angles_over_the_discontinuity(rng):
    """A third of the window at -170 degrees, the rest at 160: 30 degrees between them."""
    frame = two_directions(rng, polar(6, 160), polar(6, -170))
    motion = estimate_at(frame, 5, 5, variance_window=3)
    assert math.degrees(motion.angle) == pytest.approx(170)
    third = math.radians(30) ** 2 * (1 / 3 - 1 / 9)
    assert motion.angle_variance == pytest.approx(third / (math.pi / 2) ** 2)
    assert motion.c == pytest.approx(1 + motion.angle_variance)
    gained = estimate_at(frame, 5, 5, variance_window=3, angle_gain=100.0)
    assert gained.c == 2


@pytest.mark.parametrize("mode", ["relative", "double_angle"])
def test_opposite_motion_is_one_direction(mode, rng):
    frame = two_directions(rng, polar(6, 30), polar(6, -150))
    motion = estimate_at(frame, 5, 5, variance_window=3, angle_mode=mode)
    assert math.degrees(motion.angle) == pytest.approx(30)
    assert motion.angle_variance == pytest.approx(0)


def test_double_angle_mean(rng):
    """Twice 0 and once 60 degrees, doubled: 2 (1, 0) + (cos 120, sin 120) = (1.5, sqrt(3) / 2)."""
    frame = two_directions(rng, polar(6, 0), polar(6, 60))
    motion = estimate_at(frame, 5, 5, variance_window=3, angle_mode="double_angle")
    assert math.degrees(motion.angle) == pytest.approx(15)
    expected = (2 * 15**2 + 45**2) / 3 / 90**2
    assert motion.angle_variance == pytest.approx(expected)


def test_still_center_takes_the_longest_as_reference(rng):
    """60 degrees and -60: against the first -60 is 60 behind (flipped), so the mean is 90."""
    frame = still_stream(rng)
    frame["velocity"][:, 4, 4], frame["velocity"][:, 6, 6] = polar(4, -60), polar(5, 60)
    motion = estimate_at(frame, 5, 5, variance_window=3)
    assert math.degrees(motion.angle) == pytest.approx(90)
    frame["velocity"][:, 4, 4] = polar(6, -60)
    motion = estimate_at(frame, 5, 5, variance_window=3)
    assert math.degrees(motion.angle) == pytest.approx(-90)


def test_tiles_of_the_estimate(rng):
    """Stride 3: pixels 3 to 5 have the estimate made at 3; a window of 1 sees only (3, 3)."""
    frame = still_stream(rng)
    frame["velocity"][0, 3, 3] = 7
    settings = settings_of({"shutter": 1.0, "variance_window": 1, "variance_stride": 3})
    motions = ob.motion_grid([sample_grid(frame, settings)], settings)
    lengths = np.array([[motion.length for motion in row] for row in motions])
    expected = np.zeros((9, 12))
    expected[3:6, 3:6] = 7
    np.testing.assert_array_equal(lengths, expected)


# -- pre-filter --------------------------------------------------------------------------------


def prefiltered(frame, times, jitter, **changes):
    settings = settings_of({"shutter": 1.0, "prefilter_samples": 1} | changes)
    return ob.prefilter(sample_grid(frame, settings), times, jitter, settings)


def test_prefilter_of_uniform_motion(rng):
    """v = (4, 0), t = 1/2, t' = 1: every pixel tries the one 2 px to the right.

    Pixel (5, 4) gets those of x = 6, 7, 8 and y = 3, 4, 5, most of them 1 px away: (8, 4) comes
    from (6, 4).
    """
    frame = moved_stream(rng, (4, 0))
    times, jitter = np.ones((1, 9, 12)), np.zeros((2, 9, 12))
    color = frame["color"]
    value = prefiltered(frame, times, jitter)[4][5]
    expected = (color[:, 4, 5] + color[:, 3:6, 6:9].sum((1, 2))) / 10
    np.testing.assert_allclose(value, expected)
    value = prefiltered(frame, times, jitter, prefilter_distance=1.0)[4][5]
    np.testing.assert_allclose(value, color[:, 4, 5:8].mean(1))
    value = prefiltered(frame, times, jitter, prefilter_min_length=4.1)[4][5]
    np.testing.assert_allclose(value, color[:, 4, 5])


def test_prefilter_measures_to_the_path_not_to_its_line(rng):
    """One fast pixel, v = (4, 0), finds a slow one 4 px to the right, which moves away from it."""
    frame = still_stream(rng)
    frame["velocity"][0, 4, 5], frame["velocity"][0, 4, 9] = 4, 1.0
    times, jitter = np.full((1, 9, 12), 1.0), np.zeros((2, 9, 12))
    jitter[0] = 2
    color = frame["color"]
    near = prefiltered(frame, times, jitter, prefilter_distance=3.6)[4][5]
    np.testing.assert_allclose(near, (color[:, 4, 5] + color[:, 4, 9]) / 2)
    far = prefiltered(frame, times, jitter, prefilter_distance=3.4)[4][5]
    np.testing.assert_allclose(far, color[:, 4, 5])
    frame["velocity"][0, 4, 9] = 0  # what stands still is not taken
    still = prefiltered(frame, times, jitter, prefilter_distance=5.0)[4][5]
    np.testing.assert_allclose(still, color[:, 4, 5])


def test_prefilter_counts_a_candidate_of_the_border_twice(rng):
    frame = still_stream(rng)
    frame["velocity"][0, 0, 5] = 4
    times, jitter = np.full((1, 9, 12), 0.5), np.zeros((2, 9, 12))
    frame["velocity"][0, 0, 6] = 1
    jitter[0] = 1
    color = frame["color"]
    value = prefiltered(frame, times, jitter)[0][5]
    np.testing.assert_allclose(value, (color[:, 0, 5] + 2 * color[:, 0, 6]) / 3)
