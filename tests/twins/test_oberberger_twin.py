"""The twin of Oberberger 2022 against values worked out by hand."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from twins import oberberger2022 as ob
from twins.oberberger2022 import oberberger2022
from twins.oberberger2022_pixels import (
    Motion,
    Moving,
    depth_weight,
    edge,
    motion_weight,
    sample_grid,
    segment_distance,
    settings_of,
)

FULL = settings_of({"shutter": 1.0})
WHOLE = {"shutter": 1.0, "prefilter": False}


def still_frame(rng, rows=9, columns=12):
    """Random colors at depth 2; nothing moves."""
    return {
        "color": rng.uniform(0, 1, (3, rows, columns)),
        "depth": np.full((1, rows, columns), 2.0),
        "velocity": np.zeros((2, rows, columns)),
        "time": np.full((1, rows, columns), 0.5),
    }


def moved_frame(rng, velocity, rows=9, columns=12):
    frame = still_frame(rng, rows, columns)
    frame["velocity"][:] = np.reshape(velocity, (2, 1, 1))
    return frame


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
    motion = estimate_at(moved_frame(rng, (3, 4)), 5, 5, angle_mode=mode)
    assert motion.length == pytest.approx(5)
    assert motion.angle == pytest.approx(math.atan2(4, 3))
    assert (motion.length_variance, motion.angle_variance) == pytest.approx((0, 0))
    assert (motion.moving_part, motion.c) == pytest.approx((1, 1))


def test_estimate_without_motion(rng):
    assert not estimate_at(still_frame(rng), 5, 5).active
    slow = moved_frame(rng, (0.3, 0.3))
    assert not estimate_at(slow, 5, 5).active
    assert estimate_at(slow, 5, 5, moving_threshold=0.4).active


def test_estimate_leaves_out_what_stands_still_or_lies_behind(rng):
    """3x3 window around the still (5, 5): one sample level, one behind, one half behind."""
    frame = still_frame(rng)
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
    frame = still_frame(rng)
    frame["velocity"][0, 4, 5] = frame["velocity"][0, 5, 7] = 3
    assert estimate_at(frame, 5, 5, variance_window=2).moving_part == 0
    assert estimate_at(frame, 5, 5, variance_window=4).moving_part == pytest.approx(2 / 16)
    assert estimate_at(frame, 6, 4, variance_window=2).moving_part == pytest.approx(1 / 4)


def two_directions(rng, first, second):
    """Columns to the left of 5 and column 5 move by `first`, the others by `second`."""
    frame = moved_frame(rng, first)
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
    frame = still_frame(rng)
    frame["velocity"][:, 4, 4], frame["velocity"][:, 6, 6] = polar(4, -60), polar(5, 60)
    motion = estimate_at(frame, 5, 5, variance_window=3)
    assert math.degrees(motion.angle) == pytest.approx(90)
    frame["velocity"][:, 4, 4] = polar(6, -60)
    motion = estimate_at(frame, 5, 5, variance_window=3)
    assert math.degrees(motion.angle) == pytest.approx(-90)


def test_tiles_of_the_estimate(rng):
    """Stride 3: pixels 3 to 5 have the estimate made at 3; a window of 1 sees only (3, 3)."""
    frame = still_frame(rng)
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
    frame = moved_frame(rng, (4, 0))
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
    frame = still_frame(rng)
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
    frame = still_frame(rng)
    frame["velocity"][0, 0, 5] = 4
    times, jitter = np.full((1, 9, 12), 0.5), np.zeros((2, 9, 12))
    frame["velocity"][0, 0, 6] = 1
    jitter[0] = 1
    color = frame["color"]
    value = prefiltered(frame, times, jitter)[0][5]
    np.testing.assert_allclose(value, (color[:, 0, 5] + 2 * color[:, 0, 6]) / 3)


# -- first stage -------------------------------------------------------------------------------


def collected(frame, x, y, c=1.0, **changes):
    settings = settings_of(WHOLE | changes)
    grid = sample_grid(frame, settings)
    values = [[sample.value for sample in row] for row in grid]
    return ob.first_stage([grid], [values], x, y, c, settings)


def test_first_stage_of_uniform_motion(rng):
    """Only the row of p is within 1 px of it: h = 1, 4, 6, 4, 1 over 16, times 6 / 16."""
    frame = moved_frame(rng, (8, 0))
    row = frame["color"][:, 4, 3:8]
    moving, static = collected(frame, 5, 4)
    assert moving.weight == pytest.approx(6 / 16)
    assert static.weight == 0
    expected = row @ np.array([1, 4, 6, 4, 1]) / 16
    np.testing.assert_allclose(moving.mean(), (*expected, 8, 0, 0.5))
    moving, _ = collected(frame, 5, 4, kernel="box")
    np.testing.assert_allclose(moving.mean()[:3], row.mean(1))
    moving, _ = collected(frame, 5, 4, c=2.0)
    assert moving.weight == pytest.approx((6 + 2 * 4 / 2) / 16)
    moving, _ = collected(frame, 5, 4, first_stage=False)
    assert moving.weight == 1
    np.testing.assert_allclose(moving.mean()[:3], frame["color"][:, 4, 5])


def test_first_stage_knows_when_a_sample_is_where(rng):
    """v = (2, 0), t = 0: paths begin at q, so that only p itself and those to the left count."""
    frame = moved_frame(rng, (2, 0))
    frame["time"][:] = 0
    moving, _ = collected(frame, 5, 4)
    assert moving.weight == pytest.approx((6 + 4 + 1) / 16 * 6 / 16)
    moving, _ = collected(frame, 5, 4, segment_softness=1.0)
    assert moving.weight == pytest.approx((6 + 4 + 1 + 4 / 2) / 16 * 6 / 16)


def test_first_stage_separates(rng):
    """Beside an edge: 3 of 5 columns stand still; what moves lies half behind."""
    frame = still_frame(rng)
    frame["velocity"][0, :, 6:] = 6
    frame["depth"][0, :, 6:] = 2.1
    moving, static = collected(frame, 5, 4)
    assert static.weight == pytest.approx((1 + 4 + 6) / 16)
    assert moving.weight == pytest.approx((4 + 1) / 16 * 6 / 16 / 2)
    _, own = collected(frame, 5, 4, static_filter="own")
    assert own.weight == 1
    np.testing.assert_allclose(own.mean(), frame["color"][:, 4, 5])
    moving, static = collected(frame, 6, 4, static_filter="own")
    assert static.weight == pytest.approx((1 + 4) / 16)  # to fill what lies behind
    assert moving.weight == pytest.approx((6 + 4 + 1) / 16 * 6 / 16)  # a moving p: no depth test


# -- temporal filter ---------------------------------------------------------------------------


def history_of(ux, weight=1.0, columns=20):
    row = [Moving((1.0, 1.0, 1.0), (ux, 0.0), 0.5, weight) for _ in range(columns)]
    return [list(row) for _ in range(3)]


@pytest.mark.parametrize(
    ("ux", "changes", "found"),
    [
        (4.0, {}, (6, 1)),
        (4.0, {"reprojection_iterations": 1}, (6, 1)),
        (1.0, {}, (8, 1)),  # 1.5 px off, then 0, at x = 7.5: even is 8
        (1.0, {"reprojection_iterations": 1}, None),
        (1.0, {"accept_threshold": 1.6}, (6, 1)),
        (1.0, {"cancel_threshold": 1.0}, (8, 1)),  # |u_p| = 4 is what counts
        (16.0, {"cancel_threshold": 5.0}, None),  # 6 px off
        (16.0, {}, (0, 1)),
    ],
)
def test_reprojection(ux, changes, found):
    """p = (10, 1), u_p = (4, 0), history ux: first guess 6; off by 2 - ux / 2."""
    assert ob.reproject((10, 1), (4.0, 0.0), history_of(ux), settings_of(changes)) == found


def test_reprojection_fails_outside_and_where_nothing_moved():
    settings = settings_of({})
    assert ob.reproject((3, 1), (4.0, 0.0), history_of(4.0), settings) is None
    assert ob.reproject((10, 1), (4.0, 0.0), history_of(4.0, weight=0.0), settings) is None


def test_history_adds_up_to_its_limit(rng):
    """Uniform motion of one color along x: W = 6/16, then W + 6/16 W, and so on."""
    frame = moved_frame(rng, (4, 0), columns=24)
    planes, history = oberberger2022([frame], **WHOLE)
    row = 6 / 16
    assert planes["moving_weight"][0, 4, 12] == pytest.approx(row)
    planes, history = oberberger2022([frame], history, **WHOLE)
    assert planes["moving_weight"][0, 4, 12] == pytest.approx(row + row**2)
    assert planes["reprojected"][0, 4, 12] == 1
    limited = WHOLE | {"history_limit": 0.1}
    _, history = oberberger2022([frame], **limited)
    planes, _ = oberberger2022([frame], history, **limited)
    assert planes["moving_weight"][0, 4, 12] == pytest.approx(row + row * 0.1)
    planes, _ = oberberger2022([frame], history, **WHOLE, temporal=False)
    assert planes["moving_weight"][0, 4, 12] == pytest.approx(row)


# -- second stage ------------------------------------------------------------------------------


def test_steps_of_the_kernel():
    motion = Motion(40.0, 0.0, 0.0, 0.25)
    steps = [ob.kernel_steps(motion, i, FULL) for i in (1, 2, 3)]
    assert steps == [(2, 1.25), (4, 1.75), (8, 2.75)]
    assert ob.kernel_steps(Motion(3.0), 1, FULL) == (1, 1)
    literal = settings_of({"min_step": 0.0})
    assert ob.kernel_steps(Motion(3.0), 1, literal) == pytest.approx((0.15, 1))
    fixed = settings_of({"kernel_scaling": "fixed"})
    assert [ob.kernel_steps(motion, i, fixed) for i in (1, 2, 3)] == [(1, 1), (2, 2), (4, 4)]


def test_rotation_of_the_kernel():
    motion = Motion(40.0, math.radians(30))
    assert ob.displacement(2, 0, motion, 3, FULL) == (14, 8)
    assert ob.displacement(0, 2, motion, 3, FULL) == (-1, 2)
    exact = settings_of({"lookup": "bilinear"})
    assert ob.displacement(2, 0, motion, 3, exact) == pytest.approx((16 * math.sqrt(0.75), 8))
    straight = settings_of({"kernel_rotation": False})
    assert ob.displacement(2, 1, motion, 3, straight) == (16, 1)


def test_second_stage_along_the_motion(rng):
    """l = 10 along x, last pass: taps 0, 2, 4 px to both sides; the path reaches 5 px."""
    values = rng.uniform(0, 1, (1, 20))
    row = [Moving((v, v, v), (10.0, 0.0), 0.5, 0.3) for v in values[0]]
    pixel = ob.second_stage([row], 8, 0, Motion(10.0), 3, FULL)
    taps = values[0, [4, 6, 8, 10, 12]]
    # One row, replicated: all five rows of the kernel fall on it.
    assert pixel.value[0] == pytest.approx(taps @ np.array([1, 4, 6, 4, 1]) / 16)
    assert pixel.weight == pytest.approx(1)
    row[4] = row[12] = Moving()
    pixel = ob.second_stage([row], 8, 0, Motion(10.0), 3, FULL)
    assert pixel.value[0] == pytest.approx(taps[1:4] @ np.array([4, 6, 4]) / 14)
    still = [Moving()] * 20
    assert ob.second_stage([still], 8, 0, Motion(10.0), 3, FULL).weight == 0


def test_bilinear_leaves_out_what_is_not_valid():
    row = [Moving((1.0,), (4.0, 0.0), 0.5, 1.0), Moving(), Moving((3.0,), (4.0, 0.0), 0.5, 1.0)]
    part, data, place = ob.bilinear([row, row], 0.25, 0.5)
    assert (part, data[0], place) == (0.75, 1.0, (0.25, 0.5))
    part, data, place = ob.bilinear([row, row], 7.0, -3.0)
    assert (part, data[0], place) == (1.0, 3.0, (2, 0))


# -- the whole filter --------------------------------------------------------------------------


def test_composition():
    moving, static = SimpleNamespace(weight=2, value=(1, 1, 1)), SimpleNamespace(weight=0)
    assert ob.compose(moving, static, 0.25, (9, 9, 9)) == (1, 1, 1)
    static = SimpleNamespace(weight=1, value=(2, 4, 6))
    assert ob.compose(moving, static, 0.25, (9, 9, 9)) == (1.75, 3.25, 4.75)
    moving.weight = 0
    assert ob.compose(moving, static, 0.25, (9, 9, 9)) == (2, 4, 6)
    static.weight = 0
    assert ob.compose(moving, static, 0.25, (9, 9, 9)) == (9, 9, 9)
    motion = Motion(1.0, moving_part=0.3)
    assert ob.blend_factor(motion, 1, 3, settings_of({"blend_gain": 2.0})) == pytest.approx(0.6)
    assert ob.blend_factor(motion, 1, 3, settings_of({"blend_source": "weights"})) == 0.25


def test_nothing_moves(rng):
    frame = still_frame(rng)
    planes, history = oberberger2022([frame], **WHOLE)
    np.testing.assert_array_equal(planes["color"], frame["color"])
    planes, _ = oberberger2022([frame], history, **WHOLE)
    np.testing.assert_array_equal(planes["color"], frame["color"])


@pytest.mark.parametrize("lookup", ["nearest", "bilinear"])
def test_one_color_stays(lookup, rng):
    frame = moved_frame(rng, (6, 2))
    frame["velocity"][:, :, 6:] = 0
    frame["color"][:] = [[[0.25]], [[0.5]], [[3.0]]]
    frame["time"] = rng.uniform(0, 1, (1, 9, 12))
    randoms = {"times": rng.uniform(0, 1, (1, 2, 9, 12)), "jitter": np.zeros((1, 4, 9, 12))}
    history = None
    for _ in range(2):
        planes, history = oberberger2022([frame], history, **randoms, shutter=1.0, lookup=lookup)
        np.testing.assert_allclose(planes["color"], frame["color"])
        assert 0 < planes["alpha"][0, 4, 6] < 1
