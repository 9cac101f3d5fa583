"""Slow twin of Sousa 2013, "CryENGINE 3 Graphics Gems": McGuire's filter, simplified, in passes."""

import numpy as np
from twins import reconstruction as common

DEFAULTS = common.DEFAULTS | {
    "num_samples": 6,
    "passes": 2,
    "pass_spread": 1.0,
    "cylinder_outer": 1.95,
    "soft_depth_extent": 1.0,
    "center_gain": 1.0,
    "jitter": 1.0,
    "encoding": "float",
    "depth_range": 100.0,
}


def sousa2013(color, depth, velocity, *, tap_noise=None, **changes):
    """Blur one frame.

    color (3, H, W), depth (1, H, W), velocity (2, H, W) in px/frame; tap_noise (passes, H, W) in
    [-1, 1], zero if left out; then parameters by name. Returns "color" and "first_pass", both
    (3, H, W).
    """
    settings = common.settings_of(DEFAULTS, changes)
    depth = np.minimum(depth[0], common.FAR_DEPTH)
    noise = np.zeros((settings.passes, *depth.shape)) if tap_noise is None else tap_noise
    field = common.half_velocity(velocity, settings)
    limit = settings.tile_size / (1 + abs(settings.c))
    if settings.encoding == "packed":
        field = [[tuple(unpack(pack(u / limit)) * limit for u in v) for v in row] for row in field]
        depth = packed_depth(depth, settings.depth_range)
    dominant = common.neighbor_max(common.tile_max(field, settings.tile_size), culling=False)
    sizes = [[stored_length(v, limit, settings) for v in row] for row in field]

    scale = 1.0
    layers = {}
    for number in range(settings.passes):
        buffers = (color, depth, field, sizes)
        color = one_pass(buffers, dominant, scale, noise[number], settings)
        layers.setdefault("first_pass", color)
        scale *= settings.pass_spread / settings.num_samples
        settings.c = 0  # further passes lie around the pixel
    return layers | {"color": color}


# -- packing -----------------------------------------------------------------------------------


def pack(v):
    """sgn(v) √|v| as a signed byte."""
    return round(np.sign(v) * np.sqrt(min(abs(v), 1.0)) * 127)


def unpack(code):
    u = code / 127
    return u * abs(u)


def packed_depth(depth, depth_range):
    """256 levels from 0 to the range; the first stands for a quarter of a step."""
    codes = np.rint(np.minimum(depth / depth_range, 1) * 255)
    return np.maximum(codes, 0.25) / 255 * depth_range


def stored_length(v, limit, settings):
    size = common.length(v)
    if settings.encoding == "float":
        return size
    return round(min(size / limit, 1.0) * 255) / 255 * limit


# -- one pass ----------------------------------------------------------------------------------


def one_pass(buffers, dominant, scale, noise, settings):
    """The weighted mean along the dominant velocity, which is `scale` times that of the tiles."""
    result = buffers[0].copy()
    r = settings.tile_size
    for y in range(result.shape[1]):
        for x in range(result.shape[2]):
            vmax = common.scaled(dominant[y // r][x // r], scale)
            if common.length(vmax) > settings.early_out:
                result[:, y, x] = gather(buffers, x, y, vmax, scale, noise[y, x], settings)
    return result


def gather(buffers, x, y, vmax, scale, noise, settings):
    color, depth, field, sizes = buffers
    # The direction is that of the packed velocity, the length is stored beside it.
    v_p = common.scaled(common.direction_of(field[y][x]), sizes[y][x] * scale)
    spread_p = max(sizes[y][x] * scale, settings.min_length)
    total = settings.center_gain / spread_p
    result = color[:, y, x] * total
    direction = common.norm(vmax)
    for i in range(settings.num_samples):
        t = common.tap_time(i, settings.jitter * noise / 2, settings.num_samples)
        position = (t + settings.c) * common.length(vmax)
        sx, sy = x - position * direction[0], y - position * direction[1]
        column, row = common.nearest(sx, sy, *depth.shape)
        v_s = common.scaled(common.direction_of(field[row][column]), sizes[row][column] * scale)
        spread_s = max(sizes[row][column] * scale, settings.min_length)
        distances = [
            common.distance_along(position, v_s, direction, settings),
            common.distance_along(position, v_p, direction, settings),
        ]
        depths = (depth[y, x], depth[row, column])
        weight = tap_weight(depths, distances, (spread_s, spread_p), settings)
        total += weight
        result = result + weight * common.color_at(color, sx, sy, settings.color_lookup)
    return result / total if total > 0 else color[:, y, x]


def tap_weight(depths, distances, spreads, settings):
    """zc = (fg, bg); vc = four clamped lines; w = fg·vc₀ + bg·vc₁ + 2·vc₂·vc₃."""
    fg, bg = common.depth_absolute(*depths, settings.soft_depth_extent, settings.depth_level)
    vc = [common.cone(d, s, settings) for d, s in zip(distances, spreads, strict=True)]
    inner, outer = settings.cylinder_inner, settings.cylinder_outer
    vc += [
        common.sat((outer - d / s) / (outer - inner))
        for d, s in zip(distances, spreads, strict=True)
    ]
    weight = settings.foreground_gain * fg * vc[0] + settings.background_gain * bg * vc[1]
    return weight + settings.third_gain * vc[2] * vc[3]
