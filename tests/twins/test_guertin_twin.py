"""The twin of Guertin 2014 against values worked out by hand."""

import math

import numpy as np
import pytest
from twins import guertin2014 as gu
from twins import reconstruction as rc
from twins.frames import moving_pixel, random_frame, uniform
from twins.guertin2014 import guertin2014

ONE_DIRECTION = {"directions": "one"}

# -- one pixel -------------------------------------------------------------------


def test_guertin_uniform_motion(rng):
    """As McGuire's, the middle tap kept, own weight N / (κ ℓ) = 3 / (40 · 4)."""
    frame = uniform(rng, (0, 8))
    color = np.swapaxes(frame[0], 1, 2)
    frame = (color, np.swapaxes(frame[1], 1, 2), np.swapaxes(frame[2], 1, 2))
    settings = {"num_samples": 3, "tile_size": 8, "shutter": 1.0}
    blurred = guertin2014(*frame, **settings)["color"]
    own = 3 / 160 + 4
    expected = own * color[:, 10] + 3 * (color[:, 8] + color[:, 12])
    np.testing.assert_allclose(blurred[:, 10], expected / (own + 6))
    none = guertin2014(*frame, **settings, center_weight=False)["color"]
    expected = 4 * color[:, 10] + 3 * (color[:, 8] + color[:, 12])
    np.testing.assert_allclose(none[:, 10], expected / 10)


HAND = {"num_samples": 3, "tile_size": 9, "shutter": 1.0}


def test_guertin_moving_pixel(rng):
    """N = 3, taps at 0 and ±1 px.

    Beside the pixel, which stands still: w_c is perpendicular, wA = 0 along w_n. Own weight
    3 / (40 · ½); middle tap (along w_c: wA = 1, wB = 0) 1 + 2; the pixel: f = 1, cone(1, 2) = ½.
    On the pixel: own weight 3 / (40 · 2), middle tap 1 + 1 + 2, the background behind ½ twice.
    """
    color, depth, velocity = moving_pixel(rng)
    blurred = guertin2014(color, depth, velocity, **HAND)["color"]
    q, left, right = color[:, 4, 4], color[:, 4, 3], color[:, 4, 5]
    np.testing.assert_allclose(blurred[:, 4, 5], (3.15 * right + 0.5 * q) / 3.65)
    np.testing.assert_allclose(blurred[:, 4, 4], (4.0375 * q + 0.5 * (left + right)) / 5.0375)
    np.testing.assert_allclose(blurred[:, 2, 4], color[:, 2, 4])


def test_guertin_moving_pixel_one_direction_without_direction_weights(rng):
    """wA = wB = 1: the middle tap weighs 4 everywhere, the pixel beside ½ as before."""
    color, depth, velocity = moving_pixel(rng)
    settings = HAND | ONE_DIRECTION | {"direction_weights": False}
    blurred = guertin2014(color, depth, velocity, **settings)["color"]
    q, left, right = color[:, 4, 4], color[:, 4, 3], color[:, 4, 5]
    np.testing.assert_allclose(blurred[:, 4, 5], (4.15 * right + 0.5 * q) / 4.65)
    np.testing.assert_allclose(blurred[:, 4, 4], (4.0375 * q + 0.5 * (left + right)) / 5.0375)


def test_guertin_leading_shutter(rng):
    """Taps 1, 2, 3 px behind p; at p = q + 2 the pixel is in the middle of its blur: weight 1.

    At p = q + 1 and q + 3 it is 1 px from the middle: ½. Nothing blurs backward.
    """
    color, depth, velocity = moving_pixel(rng)
    settings = HAND | ONE_DIRECTION | {"shutter_position": "leading"}
    blurred = guertin2014(color, depth, velocity, **settings)["color"]
    q = color[:, 4, 4]
    for x, weight in [(5, 0.5), (6, 1.0), (7, 0.5)]:
        expected = (0.15 * color[:, 4, x] + weight * q) / (0.15 + weight)
        np.testing.assert_allclose(blurred[:, 4, x], expected)
    np.testing.assert_allclose(blurred[:, 4, :4], color[:, 4, :4])


def test_guertin_leading_pixel_sees_what_it_uncovers(rng):
    """On q: V_p · d = 2, so the tap 2 px behind is the middle of its own blur: b · cone = 1.

    The taps at 1 and 3 px have ½; all along the even and odd taps alike, as w_c = w_n.
    """
    color, depth, velocity = moving_pixel(rng)
    settings = HAND | {"shutter_position": "leading"}
    blurred = guertin2014(color, depth, velocity, **settings)["color"]
    behind = 0.5 * color[:, 4, 3] + color[:, 4, 2] + 0.5 * color[:, 4, 1]
    expected = (3 / 80 * color[:, 4, 4] + behind) / (3 / 80 + 2)
    np.testing.assert_allclose(blurred[:, 4, 4], expected)


def test_guertin_nothing_seen_keeps_the_color(rng):
    """A still pixel, taps along w_n only, and no own weight: all weights are 0."""
    color, depth, velocity = moving_pixel(rng)
    settings = HAND | ONE_DIRECTION | {"center_weight": False}
    blurred = guertin2014(color, depth, velocity, **settings)["color"]
    np.testing.assert_array_equal(blurred[:, 4, 7], color[:, 4, 7])


def test_guertin_relative_depth():
    settings = rc.settings_of(gu.DEFAULTS, {})
    assert gu.depth_factors(20.0, 10.0, settings) == (1, 0)  # twice as near: all in front
    assert gu.depth_factors(10.0, 20.0, settings) == (0, 1)
    assert gu.depth_factors(10.0, 15.0, settings) == (0.5, 1)
    assert gu.depth_factors(rc.FAR_DEPTH, rc.FAR_DEPTH, settings) == (1, 1)
    settings.relative_depth_extent = 0.1
    assert gu.depth_factors(10.5, 10.0, settings) == pytest.approx((1, 0.5))
    settings.depth_compare = "absolute"
    assert gu.depth_factors(10.05, 10.0, settings) == pytest.approx((1, 0.5))


def test_guertin_center_direction():
    settings = rc.settings_of(gu.DEFAULTS, {})
    w_n = (1.0, 0.0)
    assert gu.center_direction((0, 0), w_n, settings) == (0, 1)
    assert gu.center_direction((0.4, -0.1), w_n, settings) == (0, -1)  # flipped, a = 0
    assert gu.center_direction((-3, 0), w_n, settings) == (-1, 0)  # a = 1
    half = gu.center_direction((1.25, 0), w_n, settings)  # a = ½
    assert half == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))


def test_guertin_direction_factors():
    settings = rc.settings_of(gu.DEFAULTS, {})
    w_c, w_n = (0.6, 0.8), (1.0, 0.0)
    assert gu.direction_factors(w_c, w_n, w_n, (0, -5), settings) == (0.6, 0)
    assert gu.direction_factors(w_c, w_n, w_c, (-4, 0), settings) == pytest.approx((1, 0.6))
    assert gu.direction_factors(w_c, w_n, w_c, (5e-4, 0), settings)[1] == 0
    settings.own_direction_against = "tile"
    settings.direction_exponent = 2.0
    assert gu.direction_factors(w_c, w_n, w_c, (-4, 0), settings) == pytest.approx((0.36, 0.36))


def test_guertin_third_weight_uses_the_shorter_blur():
    settings = rc.settings_of(gu.DEFAULTS, {"shutter_position": "leading"})
    settings.foreground_gain = settings.background_gain = 0.0
    settings.third_gain = 3.0
    d = (1.0, 0.0)
    slow, fast = (1.0, 0.0), (5.0, 0.0)
    for velocities in [(slow, fast), (fast, slow)]:
        near = gu.tap_weight(1.5, d, (1, 1), velocities, (0.25, 0.5), settings)
        far = gu.tap_weight(4.0, d, (1, 1), velocities, (0.25, 0.5), settings)
        assert (near, far) == (1.5, 0)  # |1.5 - 1| < 1; |4 - 1| > 1, though |4 - 5| < 5


@pytest.mark.parametrize(("length", "row"), [("tile", 2), ("own", 3)])
def test_guertin_tap_length(length, row, rng):
    """p moves down with V = 2, another pixel right with V = 4: the odd tap goes up 2 px, or 1.

    N = 2: t = -⅓, ⅓; lengths 6 and 3 in place of 4 and 2 make the odd tap 2 px or 1 px long.
    """
    color, depth, velocity = moving_pixel(rng, (0, 1.5))
    depth[:] = 2
    velocity[0, 0, 8] = 12
    settings = {"num_samples": 2, "tile_size": 9, "shutter": 1.0, "tap_length": length}
    blurred = guertin2014(color, depth, velocity, **settings)["color"]
    own, q, tap = 2 / (40 * 3), color[:, 4, 4], color[:, row, 4]
    weight = 1 - (4 - row) / 3  # b · cone, wA = 1; S stands still
    np.testing.assert_allclose(blurred[:, 4, 4], (own * q + weight * tap) / (own + weight))


def test_guertin_own_length_is_for_the_center_direction():
    settings = rc.settings_of(gu.DEFAULTS, {"tap_length": "own"})
    assert gu.tap_reach(True, (3, 4), (0, 9), settings) == 5
    assert gu.tap_reach(False, (3, 4), (0, 9), settings) == 9


def test_guertin_jitter_is_scaled_by_phi_over_n(rng):
    """N = 3, j η φ / N = 1 · ½ · 3 / 3 = ½: t = -¼, ¼, ¾; V = 4: -1, 1, 3 px."""
    color, depth, velocity = uniform(rng, (16, 0))
    settings = {"num_samples": 3, "tile_size": 8, "eta": 0.5, "phi": 3.0, "center_weight": False}
    noise = np.ones(depth[0].shape)
    blurred = guertin2014(color, depth, velocity, tap_noise=noise, **settings)["color"]
    expected = 3.5 * (color[:, :, 11] + color[:, :, 9]) + 2.5 * color[:, :, 7]
    np.testing.assert_allclose(blurred[:, :, 10], expected / 9.5)


# -- tiles -----------------------------------------------------------------------


def test_guertin_variance_of_tiles():
    settings = rc.settings_of(gu.DEFAULTS, {})
    tiles = [[(2.0, 0.0), (0.0, 3.0), (0.3, 0.3)]]
    assert gu.tile_variances(tiles, settings) == [[0.5, 0.5, 0.0]]
    tiles = [[(2.0, 0.0), (-5.0, 0.0)], [(0.0, 0.0), (3.0, 4.0)]]
    expected = 1 - (1 + 1 + 0.6) / 3
    assert gu.tile_variances(tiles, settings)[0] == pytest.approx([expected, expected])
    assert gu.tile_variances(tiles, settings)[1][1] == pytest.approx(1 - 2.2 / 3)


def test_guertin_variance_is_read_between_tile_centers():
    settings = rc.settings_of(gu.DEFAULTS, {"tile_size": 4})
    variances = np.array([[[0.0, 1.0]]])
    read = [gu.variance_at(variances, x, 2, settings) for x in range(8)]
    assert read == pytest.approx([0, 0, 0.125, 0.375, 0.625, 0.875, 1, 1])


def test_guertin_split_of_taps():
    """frac((i + ½) · 0.618) = .309 .927 .545 .163 .781 .399 .017 .635"""
    settings = rc.settings_of(gu.DEFAULTS, {})
    assert [gu.uses_center_direction(i, 0.9, settings) for i in range(4)] == [0, 1, 0, 1]
    settings.sample_assignment = "variance"
    assert not any(gu.uses_center_direction(i, 0.0, settings) for i in range(8))
    assert all(gu.uses_center_direction(i, 1.0, settings) for i in range(8))
    chosen = [i for i in range(8) if gu.uses_center_direction(i, 0.4, settings)]
    assert chosen == [0, 3, 5, 6]
    settings.directions = "one"
    assert not gu.uses_center_direction(0, 1.0, settings)


def test_guertin_stochastic_tile_lookup():
    """Tile 4: at x = 3 b = ¾, so ξ = 0.99 moves by 0.3675 tiles over the border at 4.

    At y = 4 b = ¾ likewise; ξ = 0 moves up 0.375 tiles. The axis goes by the checkerboard.
    """
    settings = rc.settings_of(gu.DEFAULTS, {"tile_size": 4})
    shape = (3, 3)
    assert gu.tile_of(3, 5, 0.99, shape, settings) == (1, 1)  # 3 + 5 even: x
    assert gu.tile_of(3, 4, 0.99, shape, settings) == (0, 1)  # odd: y, not far enough
    assert gu.tile_of(3, 4, 0.0, shape, settings) == (0, 0)
    assert gu.tile_of(3, 5, 0.5, shape, settings) == (0, 1)
    assert gu.tile_of(0, 0, 0.0, shape, settings) == (0, 0)  # kept in the image
    assert gu.tile_of(11, 11, 0.99, shape, settings) == (2, 2)
    assert gu.tile_of(0, 11, 0.99, shape, settings) == (0, 2)
    assert gu.tile_of(5, 5, 0.99, shape, settings) == (1, 1)  # in the middle: never
    settings.tau = 0.3
    assert gu.tile_of(3, 5, 0.99, shape, settings) == (0, 1)
    settings.tau, settings.stochastic_tiles = 1.0, False
    assert gu.tile_of(3, 5, 0.99, shape, settings) == (0, 1)


def test_guertin_uses_tile_noise_and_culling(rng):
    color, depth, velocity = random_frame(rng)
    noise = rng.uniform(0, 1, depth[0].shape)
    blur = {"tile_size": 4, "num_samples": 3}
    plain = guertin2014(color, depth, velocity, **blur)["vmax"]
    offset = guertin2014(color, depth, velocity, tile_noise=noise, **blur)["vmax"]
    assert not np.array_equal(plain, offset)
    still = guertin2014(color, depth, velocity, tile_noise=noise, tau=0.0, **blur)["vmax"]
    np.testing.assert_array_equal(plain, still)
    velocity[:] = 0
    velocity[0, 0, 0] = 12  # along x: not towards the tile below and to the right
    culled = guertin2014(color, depth, velocity, **blur)["vmax"]
    kept = guertin2014(color, depth, velocity, neighbor_culling=False, **blur)["vmax"]
    assert not culled[0, 4:8, 4:8].any()
    assert (kept[0, 4:8, 4:8] == 3).all()


def test_guertin_8_bit_velocity():
    """With r = 127 a step is 1 px."""
    assert gu.encode_and_decode((2.6, -0.4), 127) == (3, 0)
    assert gu.encode_and_decode((127.0, -127.0), 127) == (127, -127)
    assert gu.encode_and_decode((0.0, 0.0), 40) == (0, 0)
    v = gu.encode_and_decode((12.3, -7.7), 40)
    assert v == pytest.approx((12.3, -7.7), abs=40 / 254)
    assert v != (12.3, -7.7)


def test_guertin_8_bit_changes_the_tiles(rng):
    color, depth, velocity = random_frame(rng)
    settings = {"tile_size": 4, "num_samples": 3}
    exact = guertin2014(color, depth, velocity, **settings)["vmax"]
    coded = guertin2014(color, depth, velocity, velocity_encoding="uint8", **settings)["vmax"]
    steps = coded / (2 * 4) * 254
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
    assert 0 < np.abs(coded - exact).max()


def test_guertin_luma(rng):
    """Checkerboard where there is blur: the left tiles and their neighbors."""
    color = rng.uniform(-0.2, 1.5, (3, 4, 12))
    depth = np.ones((1, 4, 12))
    velocity = np.zeros((2, 4, 12))
    velocity[0, 0, 0] = 12
    layers = guertin2014(color, depth, velocity, tile_size=4)
    board = np.indices((4, 12)).sum(0) % 2
    np.testing.assert_array_equal(layers["luma"][0, :, :8], board[:, :8])
    r, g, b = np.clip(color, 0, 1)
    true = np.sqrt(0.2126 * r + 0.7152 * g + 0.0722 * b)
    np.testing.assert_allclose(layers["luma"][0, :, 8:], true[:, 8:])
    layers = guertin2014(color, depth, velocity, tile_size=4, luma="true")
    r, g, b = np.clip(layers["color"], 0, 1)
    np.testing.assert_allclose(layers["luma"][0], np.sqrt(0.2126 * r + 0.7152 * g + 0.0722 * b))
