"""Slow twin of torchblur's own filter; written from its formulas, per pixel, in float64."""

import math
from types import SimpleNamespace

import numpy as np
from twins import reconstruction as common
from twins.notes2025 import tile_of, tiles_of
from twins.reach import directions_of, taps_of
from twins.reconstruction import length, sat, scaled

SHARED = ("shutter", "shutter_position", "background_gain", "softness", "noise", "seed")
DEFAULTS = {name: common.DEFAULTS[name] for name in SHARED} | {
    "num_samples": 16,
    "reach": "frame",
    "max_reach": 512.0,
    "tile_size": 8,
    "early_out": 0.25,
    "tap_spacing": 3.0,
    "max_samples": 512,
    "first_direction": True,
    "own_direction": True,
    "second_direction": True,
    "reversed_direction": True,
    "refinements": 2,
    "arrivals": "winner",
    "hidden_times": "fill",
    "match_tolerance": 1.0,
    "match_slope": 0.0,
    "edge_motion": "nearest",
    "edge_depth": 0.0,
    "jitter": 1.0,
    "tile_jitter": 0.0,
    "color_lookup": "cubic",
    "neighbor_culling": False,
    "direction_reduction": "exact",
    "secondary_exponent": 2.0,
    "depth_classes": "shares",
    "depth_level": 0.5,
    "depth_compare": "relative",
    "relative_depth_extent": 0.05,
    "soft_depth_extent": 0.1,
    "missing_background": "foreground",
    "background_fade": 0.05,
    "center_taps": 0.0,
    "alpha_gain": 1.0,
}


def torchblur(color, depth, velocity, *, tap_noise=None, tile_noise=None, **changes):
    """Blur one frame.

    color (3, H, W), depth (1, H, W), velocity (2, H, W) in px/frame; tap_noise and tile_noise
    (H, W) in [0, 1), ½ if left out; then parameters by name. Returns "color" (3, H, W) and
    "alpha" (1, H, W).
    """
    settings = common.settings_of(DEFAULTS, changes)
    depth = np.minimum(depth[0], common.FAR_DEPTH)
    half = np.full(depth.shape, 0.5)
    settings.tap_noise = half if tap_noise is None else tap_noise
    settings.tile_noise = half if tile_noise is None else tile_noise
    depth, velocity = clean_edges(depth, velocity, settings)
    field = common.half_velocity(velocity, settings)
    if settings.reach == "frame":
        first, second = directions_of(field, settings)
    else:
        first, second, _ = tiles_of(field, settings)
    image, alphas = np.zeros_like(color), np.zeros((1, *depth.shape))
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            tx, ty = tile_of(x, y, (len(first), len(first[0])), settings)
            pixel = SimpleNamespace(x=x, y=y, color=color, depth=depth, field=field)
            starts = {"first": first[ty][tx], "own": field[y][x], "second": second[ty][tx]}
            starts["reversed"] = scaled(first[ty][tx], -1)
            if length(first[ty][tx]) <= settings.early_out:
                image[:, y, x] = color[:, y, x]
            else:
                image[:, y, x], alphas[0, y, x] = at_pixel(pixel, starts, settings)
    return {"color": image, "alpha": alphas}


# -- edges -------------------------------------------------------------------------------------


def clean_edges(depth, velocity, settings):
    """Beside something nearer, a pixel has its motion, and as "surface" its depth."""
    rows, columns = depth.shape
    new_depth, new_velocity = depth.copy(), np.array(velocity, dtype=float)
    if settings.edge_motion == "own":
        return new_depth, new_velocity
    for y in range(rows):
        for x in range(columns):
            around = [
                (common.clamp(y + j, 0, rows - 1), common.clamp(x + i, 0, columns - 1))
                for j in (-1, 0, 1)
                for i in (-1, 0, 1)
            ]
            nearest = min(depth[place] for place in around)
            if depth[y, x] * (1 - settings.edge_depth) > nearest:
                level = [place for place in around if depth[place] <= nearest * (1 + 1e-6)]
                new_velocity[:, y, x] = np.mean([velocity[:, j, i] for j, i in level], axis=0)
                if settings.edge_motion == "surface":
                    new_depth[y, x] = nearest
    return new_depth, new_velocity


# -- a pixel -----------------------------------------------------------------------------------


def at_pixel(pixel, starts, settings):
    """Return the color of a pixel, and the share of the time at which something arrives."""
    names = [n for n in starts if getattr(settings, f"{n}_direction")] or ["own"]
    front, back = np.zeros(4), np.zeros(4)
    moving = [pixel.field[pixel.y][pixel.x], *(starts[name] for name in names)]
    count = taps_of([length(v) for v in moving], settings)
    seen, hidden = np.zeros(4), 0.0
    shift = settings.jitter * (settings.tap_noise[pixel.y, pixel.x] - 0.5)
    share = 0.0
    for i in range(count):
        time = common.clamp(2 * (i + 0.5 + shift) / count - 1, -1, 1) + settings.c
        arrived = [follow(pixel, starts[name], time, settings) for name in names]
        covered, shares = visible(arrived, settings)
        color = sum(w * c for w, (_, _, c) in zip(shares, arrived, strict=True))
        front += covered * np.array([*color, 1.0])
        share += covered
        near = covered * (1 - abs(time) / (1 + abs(settings.c))) ** 2
        for weight, (_, z, sample) in zip(shares, arrived, strict=True):
            if classes(pixel.depth[pixel.y, pixel.x], z, settings)[1] > 0:
                seen += near * weight * np.array([*sample, 1.0])
        _, z, color = look(pixel, pixel.field[pixel.y][pixel.x], time, settings)
        _, behind = classes(pixel.depth[pixel.y, pixel.x], z, settings)
        weight = settings.background_gain * (1 - covered) * behind
        back += weight * np.array([*color, 1.0])
        hidden += (1 - covered) * (1 - behind)
    if settings.hidden_times == "fill" and seen[3] > 1e-6:
        back += settings.background_gain * hidden * np.array([*(seen[:3] / seen[3]), 1.0])
    alpha = sat(settings.alpha_gain * share / count)
    return resolved(pixel, front / count, back / count, alpha, settings)


def look(pixel, v, time, settings):
    """Return motion, depth and color where something with the half spread v comes from."""
    x, y = pixel.x - time * v[0], pixel.y - time * v[1]
    column, row = common.nearest(x, y, *pixel.depth.shape)
    color = color_at(pixel.color, x, y, settings.color_lookup)
    return pixel.field[row][column], pixel.depth[row, column], color


def follow(pixel, v, time, settings):
    """Return match, depth and color of the sample that a start leads to."""
    for _ in range(settings.refinements):
        v = moving(look(pixel, v, time, settings)[0])
    found, z, color = look(pixel, v, time, settings)
    found = moving(found)
    miss = length((found[0] - v[0], found[1] - v[1])) * abs(time)
    allowed = settings.match_tolerance + settings.match_slope * length(v) * abs(time)
    return sat(1 - miss / allowed), z, color


def moving(v):
    """The vector, or 0 where it hardly moves."""
    return v if length(v) >= 1e-3 else (0.0, 0.0)


def visible(arrived, settings):
    """Return how much of this time is covered, and each one's share: the nearer hide the others."""
    weights = []
    for i, (match, z, _) in enumerate(arrived):
        weight = match
        for j, (other, z_other, _) in enumerate(arrived):
            if i != j:
                in_front, _ = classes(z, z_other, settings)
                weight *= 1 - other * in_front
        weights.append(weight)
    total = sum(weights)
    covered = 1 - math.prod(1 - match for match, _, _ in arrived) if total > 1e-6 else 0.0
    if settings.arrivals == "winner":
        best = 0
        for i, weight in enumerate(weights):
            if weight > weights[best] + 1e-4:  # a tie goes to the first
                best = i
        return covered, [float(i == best) for i in range(len(weights))]
    return covered, [weight / total if total > 1e-6 else 0.0 for weight in weights]


def classes(z, z_other, settings):
    """Return how far the other is in front, and how far behind."""
    extent = settings.soft_depth_extent
    if settings.depth_compare == "relative":
        extent = settings.relative_depth_extent * min(z, z_other)
    front, back = common.depth_absolute(z, z_other, extent, settings.depth_level)
    return (1 - back if settings.depth_classes == "shares" else front), back


def resolved(pixel, front, back, alpha, settings):
    """Return color and alpha of the sums."""
    center = pixel.color[:, pixel.y, pixel.x]
    known = 1e-6 if settings.missing_background == "foreground" else 0
    shown = float(back[3] > known)
    if settings.background_fade > 0:
        shown = sat(back[3] / settings.background_fade)
    if settings.missing_background == "foreground":
        alpha = 1 - (1 - alpha) * shown
        shown = float(back[3] > 0)
    if front[3] == 0:
        alpha = 0.0
    color = (1 - alpha) * (1 - shown) * center
    if front[3] > 0:
        color = color + alpha * front[:3] / front[3]
    if shown > 0:
        own = settings.center_taps / (2 * ((settings.num_samples + 1) // 2))
        back = back + own * np.array([*center, 1.0])
        color = color + (1 - alpha) * shown * back[:3] / back[3]
    return color, alpha


# -- lookups -----------------------------------------------------------------------------------


def color_at(color, x, y, mode):
    return cubic(color, x, y) if mode == "cubic" else common.color_at(color, x, y, mode)


def cubic(planes, x, y):
    """Catmull-Rom along x and along y, less the bilinear value between; within four pixels."""
    _, rows, columns = planes.shape
    x, y = common.clamp(x, 0, columns - 1), common.clamp(y, 0, rows - 1)
    left, top = math.floor(x), math.floor(y)
    u, v = x - left, y - top

    def at(i, j):
        column, row = common.clamp(left + i, 0, columns - 1), common.clamp(top + j, 0, rows - 1)
        return planes[:, row, column]

    def spline(p, t):
        return (
            p[1]
            + 0.5 * t * (p[2] - p[0])
            + t * t * (p[0] - 2.5 * p[1] + 2 * p[2] - 0.5 * p[3])
            + t**3 * (-0.5 * p[0] + 1.5 * p[1] - 1.5 * p[2] + 0.5 * p[3])
        )

    def mixed(pair, t):
        return (1 - t) * pair[0] + t * pair[1]

    columns_at = [mixed([at(i, j) for j in (0, 1)], v) for i in (0, 1)]
    rows_at = [mixed([at(i, j) for i in (0, 1)], u) for j in (0, 1)]
    along_x = mixed([spline([at(i, j) for i in (-1, 0, 1, 2)], u) for j in (0, 1)], v)
    along_y = mixed([spline([at(i, j) for j in (-1, 0, 1, 2)], v) for i in (0, 1)], u)
    along_x = np.clip(along_x, np.minimum(*columns_at), np.maximum(*columns_at))
    along_y = np.clip(along_y, np.minimum(*rows_at), np.maximum(*rows_at))
    four = np.stack([at(i, j) for i in (0, 1) for j in (0, 1)])
    return np.clip(along_x + along_y - mixed(columns_at, u), four.min(0), four.max(0))
