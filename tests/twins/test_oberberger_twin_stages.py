"""The filtering stages of the twin of Oberberger 2022, worked out by hand."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from twins import oberberger2022 as ob
from twins.frames import moved_stream, still_stream
from twins.oberberger2022 import oberberger2022
from twins.oberberger2022_pixels import Motion, Moving, bilinear, sample_grid, settings_of

FULL = settings_of({"shutter": 1.0})
WHOLE = {"shutter": 1.0, "prefilter": False}

# -- first stage -------------------------------------------------------------------------------


def collected(frame, x, y, c=1.0, **changes):
    settings = settings_of(WHOLE | changes)
    grid = sample_grid(frame, settings)
    values = [[sample.value for sample in row] for row in grid]
    return ob.first_stage([grid], [values], x, y, c, settings)


def test_first_stage_of_uniform_motion(rng):
    """Only the row of p is within 1 px of it: h = 1, 4, 6, 4, 1 over 16, times 6 / 16."""
    frame = moved_stream(rng, (8, 0))
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
    frame = moved_stream(rng, (2, 0))
    frame["time"][:] = 0
    moving, _ = collected(frame, 5, 4)
    assert moving.weight == pytest.approx((6 + 4 + 1) / 16 * 6 / 16)
    moving, _ = collected(frame, 5, 4, segment_softness=1.0)
    assert moving.weight == pytest.approx((6 + 4 + 1 + 4 / 2) / 16 * 6 / 16)


def test_first_stage_separates(rng):
    """Beside an edge: 3 of 5 columns stand still; what moves lies half behind."""
    frame = still_stream(rng)
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
        (4.0, {}, ((6, 1), 1)),
        (4.0, {"reprojection_iterations": 1}, ((6, 1), 1)),
        (1.0, {}, ((8, 1), 2)),  # 1.5 px off, then 0, at x = 7.5: even is 8
        (1.0, {"reprojection_iterations": 1}, (None, -1)),
        (1.0, {"accept_threshold": 1.6}, ((6, 1), 1)),
        (1.0, {"cancel_threshold": 1.0}, ((8, 1), 2)),  # |u_p| = 4 is what counts
        (16.0, {"cancel_threshold": 5.0}, (None, -1)),  # 6 px off
        (16.0, {}, ((0, 1), 2)),
    ],
)
def test_reprojection(ux, changes, found):
    """p = (10, 1), u_p = (4, 0), history ux: first guess 6; off by 2 - ux / 2."""
    assert ob.reproject((10, 1), (4.0, 0.0), history_of(ux), settings_of(changes)) == found


def test_reprojection_fails_outside_and_where_nothing_moved():
    settings = settings_of({})
    assert ob.reproject((3, 1), (4.0, 0.0), history_of(4.0), settings) == (None, -1)
    assert ob.reproject((10, 1), (4.0, 0.0), history_of(4.0, weight=0.0), settings) == (None, -1)


def test_history_adds_up_to_its_limit(rng):
    """Uniform motion of one color along x: W = 6/16, then W + 6/16 W, and so on."""
    frame = moved_stream(rng, (4, 0), columns=24)
    planes, history = oberberger2022([frame], **WHOLE)
    row = 6 / 16
    assert planes["moving_weight"][0, 4, 12] == pytest.approx(row)
    planes, history = oberberger2022([frame], history, **WHOLE)
    assert planes["moving_weight"][0, 4, 12] == pytest.approx(row + row**2)
    assert planes["reprojection"][0, 4, 12] == 1
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
    part, data, place = bilinear([row, row], 0.25, 0.5)
    assert (part, data[0], place) == (0.75, 1.0, (0.25, 0.5))
    part, data, place = bilinear([row, row], 7.0, -3.0)
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


def test_opacity():
    motion = Motion(1.0, moving_part=0.3)
    opacities = [
        ob.blend_factor(motion, (1, 3), (2, 3), 0.7, settings_of(changes))
        for changes in (
            {"blend_gain": 2.0},
            {"blend_gain": 4.0},
            {"blend_source": "weights"},
            {"blend_source": "first_stage"},
            {"blend_source": "filtered"},
        )
    ]
    assert opacities == pytest.approx([0.6, 1, 0.25, 0.4, 0.7])


def test_filtered_share_of_a_moving_stretch():
    """Two passes of an unturned kernel over a row, steps 1 and 2 px, by hand."""
    settings = settings_of(
        {"second_stage_iterations": 2, "kernel_scaling": "fixed", "lookup": "nearest"}
    )
    moves = np.array([0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0], float)
    kinds = [SimpleNamespace(moving=m > 0, still=m == 0) for m in moves]
    motions = [[Motion(length=6.0)] * len(moves)]
    taps = np.array([1, 4, 6, 4, 1]) / 16
    once = np.convolve(moves, taps, "same")
    twice = np.convolve(once, np.array([1, 0, 4, 0, 6, 0, 4, 0, 1]) / 16, "same")
    (shares,) = ob.filtered_shares([[kinds]], motions, settings)
    np.testing.assert_allclose(shares, twice)
    # A second sample per pixel that never moves halves it; unknown ones do not count.
    still = [SimpleNamespace(moving=False, still=True) for _ in moves]
    unknown = [SimpleNamespace(moving=False, still=False) for _ in moves]
    (half,) = ob.filtered_shares([[kinds], [still], [unknown]], motions, settings)
    np.testing.assert_allclose(half, twice / 2)
    # Scaled by the motion, nothing beside its way counts, unless it has many angles.
    scaled = settings_of({"second_stage_iterations": 1})
    beside = [kinds, still, kinds]
    rows = [[motion] * len(moves) for motion in (Motion(length=10.0),) * 3]
    (_, shares, _) = ob.filtered_shares([beside], rows, scaled)
    np.testing.assert_allclose(shares, 0)
    rows = [[motion] * len(moves) for motion in (Motion(length=10.0, angle_variance=1.0),) * 3]
    (_, shares, _) = ob.filtered_shares([beside], rows, scaled)
    assert 0.3 < shares[8] < 0.7
    # Pixels that are not filtered keep their own share.
    calm = [[Motion(length=6.0 if x < 8 else 0.0) for x in range(len(moves))]]
    (shares,) = ob.filtered_shares([[kinds]], calm, settings)
    np.testing.assert_allclose(shares[8:], moves[8:])


def test_nothing_moves(rng):
    frame = still_stream(rng)
    planes, history = oberberger2022([frame], **WHOLE)
    np.testing.assert_array_equal(planes["color"], frame["color"])
    planes, _ = oberberger2022([frame], history, **WHOLE)
    np.testing.assert_array_equal(planes["color"], frame["color"])


@pytest.mark.parametrize("lookup", ["nearest", "bilinear"])
def test_one_color_stays(lookup, rng):
    frame = moved_stream(rng, (6, 2))
    frame["velocity"][:, :, 6:] = 0
    frame["color"][:] = [[[0.25]], [[0.5]], [[3.0]]]
    frame["time"] = rng.uniform(0, 1, (1, 9, 12))
    randoms = {"times": rng.uniform(0, 1, (1, 2, 9, 12)), "jitter": np.zeros((1, 4, 9, 12))}
    history = None
    for _ in range(2):
        planes, history = oberberger2022([frame], history, **randoms, shutter=1.0, lookup=lookup)
        np.testing.assert_allclose(planes["color"], frame["color"])
        assert 0 < planes["blend"][0, 4, 6] < 1
