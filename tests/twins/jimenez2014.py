"""Slow twin of Jimenez 2014, "Next Generation Post Processing in Call of Duty".

Written per pixel from the formulas on which the public ports agree: pairs of taps, DepthCmp,
SpreadCmp, mirror filter, center fill, classes of tiles.
"""

import numpy as np
from twins import reconstruction as common

DEFAULTS = {
    "shutter": 0.5,
    "shutter_position": "centered",
    "num_samples": 14,
    "tile_size": 20,
    "depth_scale": 1.0,
    "depth_level": 0.5,
    "depth_compare": "absolute",
    "spread_offset": 1.0,
    "spread_slope": 1.0,
    "spread_compare": "slides",
    "mirror_filter": "ports",
    "noise": "none",
    "jitter": 1.0,
    "tile_jitter": 0.5,
    "tile_classes": True,
    "early_out": 0.505,
    "fast_ratio": 0.9,
    "neighbor_culling": False,
    "tile_encoding": "float",
    "softness": 0.0,
    "color_lookup": "nearest",
    "seed": 0,  # not read: the noise comes as planes
}


def jimenez2014(color, depth, velocity, *, tap_noise=None, tile_noise=None, **changes):
    """Blur one frame.

    color (3, H, W), depth (1, H, W), velocity (2, H, W) in px/frame; tap_noise (H, W) in steps, 0
    if left out (with noise="checkerboard" the 2x2 dither is made here); tile_noise
    (H, W) in [0, 1), ½ if left out; then parameters by name. Returns "color" (3, H, W), "alpha"
    and "tile_class", both (1, H, W).
    """
    settings = common.settings_of(DEFAULTS, changes)
    depth = np.minimum(depth[0], common.FAR_DEPTH)
    shape = depth.shape
    tap_noise = np.zeros(shape) if tap_noise is None else tap_noise
    tile_noise = np.full(shape, 0.5) if tile_noise is None else tile_noise

    field = common.half_velocity(velocity, settings)
    r = settings.tile_size
    longest = common.neighbor_max(common.tile_max(field, r), settings.neighbor_culling)
    if settings.tile_encoding == "uint8":
        longest = [[encode_and_decode(v, r) for v in row] for row in longest]
    shortest = shortest_around(field, r)

    layers = {"color": color.copy(), "alpha": np.zeros((1, *shape))}
    layers["tile_class"] = np.zeros((1, *shape))
    for y in range(shape[0]):
        for x in range(shape[1]):
            tx, ty = tile_of(x, y, tile_noise[y, x], len(longest[0]), len(longest), settings)
            kind = class_of(common.length(longest[ty][tx]), shortest[ty][tx], settings)
            layers["tile_class"][:, y, x] = kind
            if kind == 0:
                continue
            shift = tap_noise[y, x]
            if settings.noise == "checkerboard":
                shift = settings.jitter * (-0.25 + 0.5 * (x & 1)) * (-1 + 2 * (y & 1))
            pixel = (color, depth, field, x, y)
            total, alpha = gather(pixel, longest[ty][tx], shift, kind == 1, settings)
            layers["color"][:, y, x] = total + (1 - alpha) * color[:, y, x]
            layers["alpha"][:, y, x] = alpha
    return layers


# -- tiles -------------------------------------------------------------------------------------


def encode_and_decode(v, r):
    """A signed byte per component, 127 for the edge of a tile."""
    return tuple(float(np.clip(np.rint(c / r * 127), -127, 127) * r / 127) for c in v)


def shortest_around(field, r):
    """The length of the slowest pixel of a tile and the eight around it."""
    rows, columns = len(field), len(field[0])
    result = []
    for top in range(0, rows, r):
        row = []
        for left in range(0, columns, r):
            ys = range(max(top - r, 0), min(top + 2 * r, rows))
            xs = range(max(left - r, 0), min(left + 2 * r, columns))
            row.append(min(common.length(field[y][x]) for y in ys for x in xs))
        result.append(row)
    return result


def tile_of(x, y, noise, tiles_x, tiles_y, settings):
    """The tile of a pixel, jittered along x or y by turns, the more the nearer to the edge."""
    u, v = (x + 0.5) / settings.tile_size, (y + 0.5) / settings.tile_size
    stray = settings.tile_jitter * (noise - 0.5)
    if (x + y) % 2 == 0:
        u += stray * 2 * abs(u % 1 - 0.5)
    else:
        v += stray * 2 * abs(v % 1 - 0.5)
    return common.clamp(int(u // 1), 0, tiles_x - 1), common.clamp(int(v // 1), 0, tiles_y - 1)


def class_of(longest, shortest, settings):
    """0 static, 1 fast, 2 full."""
    if longest <= settings.early_out:
        return 0
    return 1 if settings.tile_classes and shortest >= settings.fast_ratio * longest else 2


# -- one pixel ---------------------------------------------------------------------------------


def gather(pixel, vmax, shift, fast, settings):
    """A = (1/N) Σ w (C, 1), over pairs of taps."""
    color = pixel[0]
    pairs = -(-settings.num_samples // 2)
    total, alpha = np.zeros(3), 0.0
    for i in range(pairs):
        # Tap 1 lies o₁ = i + ½ + shift steps after the middle, tap 2 o₂ = i + ½ − shift before.
        times = [(i + 0.5 + shift) / pairs, -(i + 0.5 - shift) / pairs]
        taps = [tap_at(pixel, common.clamp(t, -1, 1), vmax, pairs, settings) for t in times]
        w1, w2 = (tap["weight"] for tap in taps)
        w1, w2 = mirrored(w1, w2, *taps, settings.mirror_filter)
        for tap, weight in zip(taps, [1, 1] if fast else [w1, w2], strict=True):
            x, y = tap["position"]
            total = total + weight * common.color_at(color, x, y, settings.color_lookup)
            alpha += weight
    return total / (2 * pairs), alpha / (2 * pairs)


def mirrored(w1, w2, tap1, tap2, rule):
    """m₁ = [Z₁ > Z₂], m₂ = [s₂ > s₁]; both: w₂ twice, neither: w₁ twice."""
    m1, m2 = tap1["depth"] > tap2["depth"], tap2["length"] > tap1["length"]
    if rule == "none":
        return w1, w2
    if m1 and m2:
        return w2, w2
    tie = tap1["depth"] == tap2["depth"] or tap1["length"] == tap2["length"]
    if not m1 and not m2 and not (rule == "strict" and tie):
        return w1, w1
    return w1, w2


def tap_at(pixel, t, vmax, pairs, settings):
    """Position, depth, length and weight of the tap at time t ∈ [-1, 1]."""
    _, depth, field, x, y = pixel
    reach, d = common.length(vmax), common.norm(vmax)
    along = (t + settings.c) * reach
    sx, sy = x - along * d[0], y - along * d[1]
    column, row = common.nearest(sx, sy, *depth.shape)
    v_p, v_s = field[y][x], field[row][column]
    z_p, z_s = depth[y, x], depth[row, column]

    a = pairs / reach  # steps per px
    o_p = a * common.distance_along(along, v_p, d, settings)
    o_s = a * common.distance_along(along, v_s, d, settings)
    bg, fg = depth_cmp(z_p, z_s, settings)
    weight = bg * spread_cmp(a * common.length(v_p), o_p, settings)
    weight += fg * spread_cmp(a * common.length(v_s), o_s, settings)
    return {"position": (sx, sy), "depth": z_s, "length": common.length(v_s), "weight": weight}


def depth_cmp(z_p, z_s, settings):
    """(bg, fg) = sat(½ + κ (Z_S − Z_p) (1, −1)); with another level than ½, fg = 1 − bg."""
    difference = z_s - z_p
    if settings.depth_compare == "relative":
        difference /= min(z_p, z_s)
    bg = common.sat(settings.depth_level + settings.depth_scale * difference)
    fg = common.sat(1 - settings.depth_level - settings.depth_scale * difference)
    return bg, fg


def spread_cmp(reach, o, settings):
    """sat(a s − o + 1), or sat(a s − max(o − 1, 0)); offset and slope for the ones."""
    beyond = o - settings.spread_offset
    if settings.spread_compare == "static_zero":
        beyond = max(beyond, 0)
    return common.sat(settings.spread_slope * (reach - beyond))
