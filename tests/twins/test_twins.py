"""The twins against values worked out by hand, on frames small enough to do so."""

import math

import numpy as np
import pytest
from twins import reconstruction as rc
from twins.frames import moving_pixel, random_frame, uniform
from twins.guertin2014 import guertin2014
from twins.line import line
from twins.mcguire2012 import mcguire2012

# -- properties that hold for all three --------------------------------------------------------

NOISY = [
    pytest.param(guertin2014, {"tile_size": 4, "num_samples": 7}, id="guertin2014"),
    pytest.param(
        guertin2014,
        {"tile_size": 4, "sample_assignment": "variance", "color_lookup": "bilinear"},
        id="guertin2014-variance",
    ),
    pytest.param(mcguire2012, {"tile_size": 4, "num_samples": 6}, id="mcguire2012"),
]


def noise_of(blur, rng, shape):
    planes = {"tap_noise": rng.uniform(-1, 1, shape)}
    if blur is guertin2014:
        planes["tile_noise"] = rng.uniform(0, 1, shape)
    return planes


@pytest.mark.parametrize("position", ["centered", "leading", "trailing"])
@pytest.mark.parametrize(("blur", "settings"), NOISY)
def test_zero_velocity_is_identity(blur, settings, position, rng):
    color, depth, velocity = random_frame(rng)
    noise = noise_of(blur, rng, depth[0].shape)
    settings = settings | {"shutter_position": position, "early_out": 0.0}
    np.testing.assert_array_equal(
        blur(color, depth, 0 * velocity, **noise, **settings)["color"], color
    )
    moved = blur(color, depth, velocity, **noise, **settings)["color"]
    assert np.abs(moved - color).max() > 0.1


@pytest.mark.parametrize(("blur", "settings"), NOISY)
def test_constant_image_stays_constant(blur, settings, rng):
    color, depth, velocity = random_frame(rng)
    noise = noise_of(blur, rng, depth[0].shape)
    color[:] = [[[0.25]], [[0.5]], [[3.0]]]
    np.testing.assert_allclose(blur(color, depth, velocity, **noise, **settings)["color"], color)


@pytest.mark.parametrize(("blur", "settings"), NOISY)
def test_mirror_in_x(blur, settings, rng):
    """Width a multiple of the tile, so that the mirrored frame has the mirrored tiles.

    No vector is longer than a tile: clamped ones are equally long but for rounding, and then the
    order in the tile decides.
    """
    color, depth, velocity = random_frame(rng, 9, 12)
    velocity /= 2
    assert np.linalg.norm(velocity, axis=0).max() / 4 < settings["tile_size"]
    blurred = blur(color, depth, velocity, **settings)["color"]
    flipped = [np.flip(plane, 2).copy() for plane in (color, depth, velocity)]
    flipped[2][0] *= -1
    np.testing.assert_allclose(np.flip(blur(*flipped, **settings)["color"], 2), blurred)


@pytest.mark.parametrize("blur", [guertin2014, mcguire2012])
def test_unknown_or_missing_parameters_are_refused(blur, rng):
    with pytest.raises(TypeError, match="kapa"):
        blur(*random_frame(rng), kapa=40)
    with pytest.raises(ValueError, match=r"softness = 0\.1"):
        blur(*random_frame(rng), softness=0.1)


# -- line --------------------------------------------------------------------------------------


def test_line_zero_velocity_is_identity(rng):
    color, _, velocity = random_frame(rng)
    np.testing.assert_allclose(line(color, 0 * velocity)["color"], color)


@pytest.mark.parametrize(
    ("position", "shift"), [("centered", 0.0), ("leading", -1.5), ("trailing", 1.5)]
)
def test_line_moves_a_ramp_by_the_mean_time(position, shift):
    """Color x, velocity 3, open for 1 frame: the mean of x - 3 s is x - 3 · (mean of s)."""
    color = np.broadcast_to(np.arange(16.0), (3, 2, 16)).copy()
    velocity = np.zeros((2, 2, 16))
    velocity[0] = 3
    blurred = line(color, velocity, shutter=1.0, shutter_position=position, num_samples=5)
    np.testing.assert_allclose(blurred["color"][:, :, 4:12], color[:, :, 4:12] + shift)


def test_line_two_taps_by_hand(rng):
    """Velocity (0, 4), shutter ½, 2 taps: times ∓⅛, rows ±½; with leading rows -½ and -1½."""
    color = rng.uniform(0, 1, (3, 6, 1))
    velocity = np.zeros((2, 6, 1))
    velocity[1] = 4
    near, mid, far = color[:, 1, 0], color[:, 2, 0], color[:, 3, 0]
    blurred = line(color, velocity, num_samples=2)["color"]
    np.testing.assert_allclose(blurred[:, 2, 0], (near + 2 * mid + far) / 4)
    blurred = line(color, velocity, num_samples=2, shutter_position="leading")["color"]
    np.testing.assert_allclose(blurred[:, 3, 0], (far + 2 * mid + near) / 4)
    blurred = line(color, 1.5 * velocity, num_samples=2, lookup="nearest")["color"]
    np.testing.assert_allclose(blurred[:, 2, 0], (near + far) / 2)


def test_line_replicates_the_border():
    color = np.zeros((3, 1, 4))
    color[:, 0, 0] = 1
    velocity = np.full((2, 1, 4), 8.0)
    blurred = line(color, velocity, num_samples=2, shutter_position="leading")["color"]
    np.testing.assert_allclose(blurred[0, 0], [1, 1, 0.5, 0.5])  # x - 1 and x - 3


# -- shared pieces -----------------------------------------------------------------------------


def test_half_velocity_is_half_and_clamped():
    velocity = np.array([[[4.0, 60.0, 0.0]], [[-2.0, -80.0, 0.0]]])
    settings = rc.settings_of(rc.DEFAULTS, {"tile_size": 10, "shutter": 1.0})
    assert rc.half_velocity(velocity, settings)[0] == [(2, -1), pytest.approx((6, -8)), (0, 0)]
    settings.c = -1
    assert rc.half_velocity(velocity, settings)[0][1] == pytest.approx((3, -4))


def test_tile_max_keeps_the_longest_and_partial_tiles():
    field = [[(1, 0), (0, -3), (2, 0)], [(2, 2), (0, 0), (0, 1)], [(0, 0), (-1, 0), (0, 5)]]
    assert rc.tile_max(field, 2) == [[(0, -3), (2, 0)], [(-1, 0), (0, 5)]]


@pytest.mark.parametrize(
    ("v", "counts"),
    [((3, 3), True), ((-3, -1), True), ((3, 0), False), ((0, -3), False), ((3, -2), False)],
)
def test_diagonal_tile_counts_if_it_points_at_the_middle(v, counts):
    tiles = [[(0, 0)] * 3 for _ in range(3)]
    tiles[0][0] = v
    assert rc.neighbor_max(tiles, culling=True)[1][1] == (v if counts else (0, 0))
    assert rc.neighbor_max(tiles, culling=True)[0][1] == v  # beside it: always
    assert rc.neighbor_max(tiles, culling=False)[1][1] == v
    assert rc.neighbor_max(tiles, culling=False)[2][2] == (0, 0)
    cosine = abs(v[0] + v[1]) / math.hypot(*v) / math.sqrt(2)
    assert (cosine > math.cos(math.pi / 4) + 1e-9) == counts


def test_lookups_by_hand():
    assert rc.nearest(0.5, 1.5, 5, 5) == (0, 2)  # half to even
    assert rc.nearest(-3, 9, 5, 4) == (0, 4)
    planes = np.array([[[0.0, 1.0], [10.0, 11.0]]])
    assert rc.bilinear(planes, 0.25, 0.5) == pytest.approx([5.25])
    assert rc.bilinear(planes, -1, 7) == pytest.approx([10])


def test_weights_by_hand():
    settings = rc.settings_of(rc.DEFAULTS, {})
    assert rc.cone(1.5, 2.0, settings) == 0.25
    assert rc.cone(3.0, 2.0, settings) == 0
    distances = [1.9, 1.95, 2.0, 2.05, 2.1]
    cylinder = [rc.cylinder(d, 2.0, settings) for d in distances]
    assert cylinder == pytest.approx([1, 0.84375, 0.5, 0.15625, 0])
    assert rc.depth_absolute(5.0, 4.95, 0.1) == pytest.approx((1, 0.5))  # S a little in front
    assert rc.depth_absolute(5.0, 5.0, 0.1) == (1, 1)


@pytest.mark.parametrize(("position", "distance"), [(2.0, 3.2), (-2.0, 0.8)])
def test_distance_is_from_the_middle_of_the_blur(position, distance):
    """V · d = (-2, 9) · (0.6, 0) = -1.2 px."""
    settings = rc.settings_of(rc.DEFAULTS, {"shutter_position": "leading"})
    assert rc.distance_along(position, (-2, 9), (0.6, 0), settings) == pytest.approx(distance)
    settings.c = 0
    assert rc.distance_along(position, (-2, 9), (0.6, 0), settings) == 2


def test_tap_times():
    assert [rc.tap_time(i, 0, 3) for i in range(3)] == [-0.5, 0, 0.5]
    assert rc.tap_time(1, 0.5, 3) == 0.25
    assert rc.tap_time(0, -3, 3) == -1
    assert rc.tap_time(2, 1.5, 3) == 1


# -- McGuire 2012 ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("skip", "center", "middle"), [(True, 0.25, 0.0), (False, 0.25, 4.0), (False, 0.75, 4.0)]
)
def test_mcguire_uniform_motion(skip, center, middle, rng):
    """V = 4, taps at 0 and ±2 px: cone ½ twice and 2 · cylinder 1 make 3, the middle tap 4."""
    frame = uniform(rng, (16, 0))
    settings = {"num_samples": 3, "tile_size": 8, "skip_middle_tap": skip}
    blurred = mcguire2012(*frame, **settings, center_gain=4 * center)["color"]
    color = frame[0]
    here, left, right = color[:, :, 8:16], color[:, :, 6:14], color[:, :, 10:18]
    expected = (center + middle) * here + 3 * (left + right)
    np.testing.assert_allclose(blurred[:, :, 8:16], expected / (center + middle + 6))


def test_mcguire_even_number_of_taps_skips_none(rng):
    """N = 2: taps at ∓⅓ of V = 6; cone ⅔ twice + 2 = 10/3 each, center ⅙."""
    color, depth, velocity = uniform(rng, (24, 0))
    blurred = mcguire2012(color, depth, velocity, num_samples=2, tile_size=8)["color"]
    expected = color[:, :, 10] / 6 + 10 / 3 * (color[:, :, 8] + color[:, :, 12])
    np.testing.assert_allclose(blurred[:, :, 10], expected / (1 / 6 + 20 / 3))


def test_mcguire_moving_pixel(rng):
    """Taps at ±1 px. Beside the pixel: own weight 1/½, the pixel in front with cone(1, 2) = ½.

    On the pixel: own weight ½, the background behind with cone(1, 2) = ½ twice.
    """
    color, depth, velocity = moving_pixel(rng)
    settings = {"num_samples": 3, "tile_size": 9, "shutter": 1.0}
    blurred = mcguire2012(color, depth, velocity, **settings)["color"]
    q, left, right = color[:, 4, 4], color[:, 4, 3], color[:, 4, 5]
    np.testing.assert_allclose(blurred[:, 4, 5], (2 * right + 0.5 * q) / 2.5)
    np.testing.assert_allclose(blurred[:, 4, 4], (0.5 * q + 0.5 * (left + right)) / 1.5)
    np.testing.assert_allclose(blurred[:, 4, 7], color[:, 4, 7])
    np.testing.assert_allclose(blurred[:, 3, 4], color[:, 3, 4])


def test_mcguire_gains_and_depth(rng):
    """The pixel 0.05 behind: f = ½ beside it; on it the background has b = ½, f and cone 0."""
    color, depth, velocity = moving_pixel(rng)
    depth[0, 4, 4] = 2.05
    settings = {"num_samples": 3, "tile_size": 9, "shutter": 1.0}
    gains = {"foreground_gain": 3.0, "background_gain": 5.0, "cone_slope": 1.5}  # cone ¼
    blurred = mcguire2012(color, depth, velocity, **settings, **gains)["color"]
    q, left, right = color[:, 4, 4], color[:, 4, 3], color[:, 4, 5]
    beside = 3 * 0.5 * 0.25
    np.testing.assert_allclose(blurred[:, 4, 5], (2 * right + beside * q) / (2 + beside))
    on = 5 * 0.5 * 0.25
    np.testing.assert_allclose(blurred[:, 4, 4], (0.5 * q + on * (left + right)) / (0.5 + 2 * on))


def test_mcguire_third_weight_is_a_product(rng):
    """V = 2 on the left half and 20 on the right, taps at ±10 px: only the fast cylinder is 1."""
    color, depth, velocity = uniform(rng, (40, 0))
    velocity = velocity.copy()
    velocity[0, :, :12] = 4
    settings = {"num_samples": 3, "tile_size": 20, "shutter": 1.0}
    blurred = mcguire2012(color, depth, velocity, **settings)["color"]
    fast, slow = color[:, :, 14], color[:, :, 4]
    other = color[:, :, 23]  # 24 is over the border
    expected = (fast / 20 + 0.5 * slow + 3 * other) / (1 / 20 + 3.5)
    np.testing.assert_allclose(blurred[:, :, 14], expected)


def test_mcguire_jitter_shifts_all_taps(rng):
    """N = 3, j = 1: t = ((i + 1 + ½) / 2) - 1 = -¼, [¼ skipped], ¾; V = 4: -1 and 3 px."""
    color, depth, velocity = uniform(rng, (16, 0))
    settings = {"num_samples": 3, "tile_size": 8}
    noise = np.ones(depth[0].shape)
    blurred = mcguire2012(color, depth, velocity, tap_noise=noise, **settings)["color"]
    weights = (0.25, 2 * 0.75 + 2, 2 * 0.25 + 2)
    taps = color[:, :, 10], color[:, :, 11], color[:, :, 7]
    expected = sum(w * tap for w, tap in zip(weights, taps, strict=True)) / sum(weights)
    np.testing.assert_allclose(blurred[:, :, 10], expected)
    none = mcguire2012(color, depth, velocity, tap_noise=noise, jitter=0.0, **settings)["color"]
    np.testing.assert_array_equal(none, mcguire2012(color, depth, velocity, **settings)["color"])


def test_mcguire_leading_shutter_blurs_forward(rng):
    """V = 2 forward covers 0 to 4 px; taps at 1, [2 skipped], 3 px behind p; cone(1, 2) = ½."""
    color, depth, velocity = moving_pixel(rng)
    settings = {"num_samples": 3, "tile_size": 9, "shutter": 1.0, "shutter_position": "leading"}
    blurred = mcguire2012(color, depth, velocity, **settings)["color"]
    q = color[:, 4, 4]
    for x in (5, 7):
        np.testing.assert_allclose(blurred[:, 4, x], (2 * color[:, 4, x] + 0.5 * q) / 2.5)
    settings["shutter_position"] = "trailing"
    mirrored = mcguire2012(color, depth, velocity, **settings)["color"]
    for x in (1, 3):
        np.testing.assert_allclose(mirrored[:, 4, x], (2 * color[:, 4, x] + 0.5 * q) / 2.5)
        np.testing.assert_allclose(blurred[:, 4, x], color[:, 4, x])


def test_mcguire_takes_all_nine_tiles(rng):
    color, depth, velocity = random_frame(rng)
    velocity[:] = 0
    velocity[0, 0, 0] = 12  # along x
    vmax = mcguire2012(color, depth, velocity, tile_size=4)["vmax"]
    assert (vmax[0, :8, :8] == 3).all()
    assert not vmax[0, 8:].any()
    assert not vmax[0, :, 8:].any()


@pytest.mark.parametrize("blur", [guertin2014, mcguire2012])
def test_bilinear_color(blur, rng):
    """N = 2: t = ∓⅓, so that V = 4.5 looks 1.5 px to both sides; cone ⅔ twice + 2."""
    frame = uniform(rng, (18, 0))
    color = frame[0]
    blurred = blur(*frame, color_lookup="bilinear", num_samples=2, tile_size=8)["color"]
    own = 2 / (40 * 4.5) if blur is guertin2014 else 1 / 4.5
    taps = (color[:, :, 8] + color[:, :, 9] + color[:, :, 11] + color[:, :, 12]) / 2
    expected = (own * color[:, :, 10] + 10 / 3 * taps) / (own + 20 / 3)
    np.testing.assert_allclose(blurred[:, :, 10], expected)


@pytest.mark.parametrize("blur", [guertin2014, mcguire2012])
def test_early_out_keeps_the_color(blur, rng):
    color, depth, velocity = moving_pixel(rng)
    settings = {"tile_size": 9, "shutter": 1.0}
    kept = blur(color, depth, velocity, early_out=2.0, **settings)["color"]
    np.testing.assert_array_equal(kept, color)
    blurred = blur(color, depth, velocity, early_out=1.99, **settings)["color"]
    assert np.abs(blurred - color).max() > 0.01
