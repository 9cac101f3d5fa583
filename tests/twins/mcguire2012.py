"""Slow twin of McGuire et al. 2012, "A Reconstruction Filter for Plausible Motion Blur".

Depth is positive here (the paper's z is negative), and distances are those of the taps before
they are rounded to a pixel.
"""

import numpy as np
from twins import reconstruction as common

DEFAULTS = common.DEFAULTS | {
    "soft_depth_extent": 0.1,
    "center_gain": 1.0,
    "jitter": 1.0,
    "skip_middle_tap": True,
}


def mcguire2012(color, depth, velocity, *, tap_noise=None, **changes):
    """Blur one frame.

    color (3, H, W), depth (1, H, W), velocity (2, H, W) in px/frame; tap_noise (H, W) in [-1, 1],
    zero if left out; then parameters by name. Returns "color" (3, H, W) and "vmax" (2, H, W).
    """
    settings = common.settings_of(DEFAULTS, changes)
    depth = np.minimum(depth[0], common.FAR_DEPTH)
    noise = np.zeros(depth.shape) if tap_noise is None else tap_noise
    field = common.half_velocity(velocity, settings)
    r = settings.tile_size
    dominant = common.neighbor_max(common.tile_max(field, r), culling=False)

    layers = {"color": color.copy(), "vmax": np.zeros((2, *depth.shape))}
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            vmax = dominant[y // r][x // r]  # NeighborMax[X / k]
            layers["vmax"][:, y, x] = vmax
            if common.length(vmax) > settings.early_out:
                pixel = (color, depth, field, x, y)
                layers["color"][:, y, x] = gather(pixel, vmax, noise[y, x], settings)
    return layers


def gather(pixel, vmax, noise, settings):
    """The weighted mean along vmax at one pixel X."""
    color, depth, field, x, y = pixel
    v_p = field[y][x]
    spread_p = common.floored_length(v_p, settings)
    # weight = 1 / |V[X]|; sum = C[X] · weight
    total = settings.center_gain / spread_p
    result = color[:, y, x] * total

    direction = common.norm(vmax)
    shift = settings.jitter * noise / 2  # j in [-½, ½] at jitter 1
    skips_middle = settings.skip_middle_tap and settings.c == 0  # it lies on X only if centered
    for i in range(settings.num_samples):
        if skips_middle and 2 * i == settings.num_samples - 1:
            continue  # i ≠ (N - 1) / 2
        t = common.tap_time(i, shift, settings.num_samples)
        position = (t + settings.c) * common.length(vmax)
        sx, sy = x - position * direction[0], y - position * direction[1]
        column, row = common.nearest(sx, sy, *depth.shape)
        depths = (depth[y, x], depth[row, column])
        weight = tap_weight(position, direction, depths, (v_p, field[row][column]), settings)
        total += weight
        result = result + weight * common.color_at(color, sx, sy, settings.color_lookup)
    return result / total if total > 0 else color[:, y, x]


def tap_weight(position, direction, depths, velocities, settings):
    """α = f·cone(d, |V_S|) + b·cone(d, |V_p|) + 2·cylinder(d, |V_S|)·cylinder(d, |V_p|)."""
    v_p, v_s = velocities
    spread_p = common.floored_length(v_p, settings)
    spread_s = common.floored_length(v_s, settings)
    distance_p = common.distance_along(position, v_p, direction, settings)
    distance_s = common.distance_along(position, v_s, direction, settings)
    f, b = common.depth_absolute(*depths, settings.soft_depth_extent, settings.depth_level)

    # Case 1: a blurry S in front of X.
    weight = settings.foreground_gain * f * common.cone(distance_s, spread_s, settings)
    # Case 2: any S behind a blurry X.
    weight += settings.background_gain * b * common.cone(distance_p, spread_p, settings)
    # Case 3: both blurry over each other.
    both = common.cylinder(distance_s, spread_s, settings)
    both *= common.cylinder(distance_p, spread_p, settings)
    return weight + settings.third_gain * both
