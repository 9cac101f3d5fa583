"""Slow twin of Guertin et al. 2014, "A Fast and Stable Feature-Aware Motion Blur Filter".

Written line by line from the pseudocode of the paper's appendix A, with its gaps closed: unit
directions, positive depths, absolute distances and dot products, center direction w_c sampled.
"""

import math

import numpy as np
from twins import reconstruction as common

GOLDEN_RATIO = 0.6180339887498949

DEFAULTS = common.DEFAULTS | {
    "num_samples": 35,
    "tile_size": 40,
    "tau": 1.0,
    "kappa": 40.0,
    "eta": 0.95,
    "gamma": 1.5,
    "phi": 27.0,
    "direction_exponent": 1.0,
    "relative_depth_extent": 1.0,
    "soft_depth_extent": 0.1,
    "directions": "two",
    "sample_assignment": "even",
    "direction_weights": True,
    "own_direction_against": "tap",
    "tap_length": "tile",
    "stochastic_tiles": True,
    "neighbor_culling": True,
    "center_weight": True,
    "depth_compare": "relative",
    "velocity_encoding": "float",
    "luma": "checkerboard",
}


def guertin2014(color, depth, velocity, *, tap_noise=None, tile_noise=None, **changes):
    """Blur one frame.

    color (3, H, W), depth (1, H, W), velocity (2, H, W) in px/frame; tap_noise j (H, W) in
    [-1, 1], 0 if left out; tile_noise ξ (H, W) in [0, 1), ½ (no offset) if left out; then
    parameters by name. Returns "color" (3, H, W), "luma" (1, H, W), "vmax" (2, H, W), the vector
    that each pixel looked up, and "variance" (1, H, W), υ.
    """
    settings = common.settings_of(DEFAULTS, changes)
    depth = np.minimum(depth[0], common.FAR_DEPTH)
    shape = depth.shape
    tap_noise = np.zeros(shape) if tap_noise is None else tap_noise
    tile_noise = np.full(shape, 0.5) if tile_noise is None else tile_noise

    field = common.half_velocity(velocity, settings)
    if settings.velocity_encoding == "uint8":
        field = [[encode_and_decode(v, settings.tile_size) for v in row] for row in field]
    tiles = common.tile_max(field, settings.tile_size)
    dominant = common.neighbor_max(tiles, settings.neighbor_culling)
    variances = np.array([tile_variances(tiles, settings)])

    layers = {"color": color.copy(), "luma": np.zeros((1, *shape))}
    layers |= {"vmax": np.zeros((2, *shape)), "variance": np.zeros((1, *shape))}
    for y in range(shape[0]):
        for x in range(shape[1]):
            tx, ty = tile_of(x, y, tile_noise[y, x], variances.shape[1:], settings)
            vmax = dominant[ty][tx]
            variance = variance_at(variances, x, y, settings)
            if common.length(vmax) > settings.early_out:
                pixel = (color, depth, field, x, y)
                layers["color"][:, y, x] = gather(pixel, vmax, variance, tap_noise[y, x], settings)
            layers["vmax"][:, y, x] = vmax
            layers["variance"][:, y, x] = variance
            layers["luma"][:, y, x] = luma_output(layers["color"][:, y, x], vmax, x, y, settings)
    return layers


# -- tiles -------------------------------------------------------------------------------------


def encode_and_decode(v, r):
    """Store a vector in 8 bits per component: V / 2r + ½ (section 5).

    We differ: 255 levels, not 256, so that zero is one of them (code 127) and stays zero.
    """
    codes = [np.rint(component / (2 * r) * 254) + 127 for component in v]
    return tuple(float((code - 127) / 254 * (2 * r)) for code in codes)


def tile_of(x, y, noise, tile_shape, settings):
    """soffset: jitter the tile lookup on one axis, more so towards the tile's border (4.2)."""
    u, v = (x + 0.5) / settings.tile_size, (y + 0.5) / settings.tile_size
    if settings.stochastic_tiles:
        if (x + y) & 1 == 0:  # one axis only: "never into a diagonal tile"
            u += settings.tau * border_closeness(u) * (noise - 0.5)
        else:
            v += settings.tau * border_closeness(v) * (noise - 0.5)
    tiles_y, tiles_x = tile_shape
    tx = common.clamp(math.floor(u), 0, tiles_x - 1)
    ty = common.clamp(math.floor(v), 0, tiles_y - 1)
    return tx, ty


def border_closeness(u):
    """Linear fall-off: 1 at the border of a tile, 0 in its middle."""
    return 2 * abs(u - math.floor(u) - 0.5)


def tile_variances(tiles, settings):
    """Eq. 2 per tile: υ = 1 - mean |v̂max(t) · v̂max(t̄)|, over tiles that move."""
    result = []
    for ty in range(len(tiles)):
        row = []
        for tx in range(len(tiles[0])):
            own = tiles[ty][tx]
            around = [v for _, v in common.neighborhood(tiles, ty, tx)]
            moving = [v for v in around if common.length(v) >= settings.min_length]
            if common.length(own) < settings.min_length:
                row.append(0.0)
            else:
                dots = [abs(common.dot(common.norm(own), common.norm(v))) for v in moving]
                row.append(1 - sum(dots) / len(dots))
        result.append(row)
    return result


def variance_at(variances, x, y, settings):
    """TileVariance "required a bilinear interpolant": between the centers of the tiles."""
    u, v = (x + 0.5) / settings.tile_size - 0.5, (y + 0.5) / settings.tile_size - 0.5
    return common.bilinear(variances, u, v)[0]


# -- one pixel ---------------------------------------------------------------------------------


def gather(pixel, vmax, variance, noise, settings):
    """function filter(p), from "let w_n = norm(vmax)" to "return result / totalWeight"."""
    color, depth, field, x, y = pixel
    v_p = field[y][x]
    w_n = common.norm(vmax)
    w_c = center_direction(v_p, w_n, settings)

    # totalWeight = N / (κ × ‖v_c‖); result = color[p] × totalWeight
    total = center_weight(v_p, settings)
    result = color[:, y, x] * total

    count = settings.num_samples
    shift = noise * settings.eta * settings.phi / count  # j' = j η φ / N
    for i in range(count):
        t = common.tap_time(i, shift, count)
        along_center = uses_center_direction(i, variance, settings)
        d = w_c if along_center else w_n
        reach = tap_reach(along_center, v_p, vmax, settings)
        position = (t + settings.c) * reach  # T
        sx, sy = x - position * d[0], y - position * d[1]  # S
        column, row = common.nearest(sx, sy, *depth.shape)
        depths = (depth[y, x], depth[row, column])
        factors = direction_factors(w_c, w_n, d, field[row][column], settings)
        velocities = (v_p, field[row][column])
        weight = tap_weight(position, d, depths, velocities, factors, settings)
        total += weight  # totalWeight += weight
        result = result + weight * common.color_at(color, sx, sy, settings.color_lookup)
    return result / total if total > 0 else color[:, y, x]


def center_direction(v_p, w_n, settings):
    """w_c = rnmix(w_p, norm(v_c), (‖v_c‖ - 0.5) / γ), w_p perpendicular to w_n."""
    w_p = (-w_n[1], w_n[0])
    if common.dot(w_p, v_p) < 0:
        w_p = common.scaled(w_p, -1)
    spread = common.floored_length(v_p, settings)
    a = common.sat((spread - settings.min_length) / settings.gamma)
    own = common.direction_of(v_p)
    mixed = ((1 - a) * w_p[0] + a * own[0], (1 - a) * w_p[1] + a * own[1])
    return common.norm(mixed) if common.length(mixed) >= 1e-6 else w_p


def center_weight(v_p, settings):
    if not settings.center_weight:
        return 0.0
    return settings.num_samples / (settings.kappa * common.floored_length(v_p, settings))


def uses_center_direction(i, variance, settings):
    """d = v_c if i odd, or vmax if i even; or a share υ of the taps along v_c (4.1)."""
    if settings.directions == "one":
        return False
    if settings.sample_assignment == "variance":
        return ((i + 0.5) * GOLDEN_RATIO) % 1.0 < variance
    return i % 2 == 1


def tap_reach(along_center, v_p, vmax, settings):
    """‖vmax‖, or for taps along the center direction ‖V_p‖ if tap_length is "own"."""
    own = along_center and settings.tap_length == "own"
    return common.length(v_p) if own else common.length(vmax)


def direction_factors(w_c, w_n, d, v_s, settings):
    """wA = |w_c · d|, wB = |norm(v_s) · d|, to a power; 1 and 1 without direction weights."""
    if not settings.direction_weights:
        return 1.0, 1.0
    against = w_n if settings.own_direction_against == "tile" else d
    q = settings.direction_exponent
    w_a = abs(common.dot(w_c, against)) ** q
    w_b = abs(common.dot(common.direction_of(v_s), d)) ** q
    return w_a, w_b


def tap_weight(position, d, depths, velocities, factors, settings):
    """The three phenomenological cases of one tap."""
    v_p, v_s = velocities
    w_a, w_b = factors
    spread_p = common.floored_length(v_p, settings)
    spread_s = common.floored_length(v_s, settings)
    distance_p = common.distance_along(position, v_p, d, settings)
    distance_s = common.distance_along(position, v_s, d, settings)
    f, b = depth_factors(*depths, settings)

    # weight += f · cone(T, 1/‖v_s‖) × wB
    weight = settings.foreground_gain * f * common.cone(distance_s, spread_s, settings) * w_b
    # weight += b · cone(T, 1/‖v_c‖) × wA
    weight += settings.background_gain * b * common.cone(distance_p, spread_p, settings) * w_a
    # weight += cylinder(T, min(‖v_s‖, ‖v_c‖)) × max(wA, wB) × 2
    if spread_s <= spread_p:
        both = common.cylinder(distance_s, spread_s, settings)
    else:
        both = common.cylinder(distance_p, spread_p, settings)
    return weight + settings.third_gain * both * max(w_a, w_b)


def depth_factors(z_p, z_s, settings):
    """f = zCompare(Z[p], Z[S]), b = zCompare(Z[S], Z[p]), for positive depths."""
    if settings.depth_compare == "absolute":
        return common.depth_absolute(z_p, z_s, settings.soft_depth_extent, settings.depth_level)
    extent = settings.relative_depth_extent * min(z_p, z_s)
    return common.depth_absolute(z_p, z_s, extent, settings.depth_level)


# -- output for anti-aliasing ------------------------------------------------------------------


def luma_output(color, vmax, x, y, settings):
    """(p_x + p_y) & 1 where there is blur, luma(color) elsewhere (or everywhere)."""
    if settings.luma == "checkerboard" and common.length(vmax) > settings.early_out:
        return float((x + y) & 1)
    red, green, blue = np.clip(color, 0, 1)
    return math.sqrt(0.2126 * red + 0.7152 * green + 0.0722 * blue)
