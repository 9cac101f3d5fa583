"""Slow twin of Oberberger, Chajdas and Westermann 2022, "Spatiotemporal Variance-Guided Filtering
for Motion Blur": one function per stage, each about one pixel.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from twins.oberberger2022_pixels import (
    Motion,
    Moving,
    Still,
    Sum,
    at,
    corners,
    depth_weight,
    is_inside,
    kernel_taps,
    motion_weight,
    moving_at,
    remodulated,
    sample_grid,
    sat,
    segment_distance,
    settings_of,
)
from twins.reconstruction import length, scaled


def oberberger2022(frames, history=None, *, times=None, jitter=None, **changes):
    """Filter one frame.

    frames: the sample frames, each a dict of "color" (3, H, W), "depth" (1, H, W), "velocity"
    (2, H, W) in px/frame, "time" (1, H, W), "albedo" (3, H, W) if demodulated. times (n, K, H, W)
    in [0, 1) and jitter (n, 2K, H, W) in px: the pre-filter's random numbers. Then parameters by
    name. Returns the planes by name, and the history for the next frame.
    """
    settings = settings_of(changes)
    grids = [sample_grid(frame, settings) for frame in frames]
    colors = np.mean([frame["color"] for frame in frames], axis=0)
    motions = motion_grid(grids, settings)
    values = [
        prefilter(
            grid,
            times[i] if settings.prefilter else None,
            jitter[i] if settings.prefilter else None,
            settings,
        )
        for i, grid in enumerate(grids)
    ]
    rows, columns = len(grids[0]), len(grids[0][0])
    everywhere = [(x, y) for y in range(rows) for x in range(columns)]
    old = history if settings.temporal else None
    collected = {
        (x, y): collect(grids, values, (x, y), motions[y][x], old, settings) for x, y in everywhere
    }
    moving = [[collected[x, y][0] for x in range(columns)] for y in range(rows)]
    static = [[collected[x, y][1] for x in range(columns)] for y in range(rows)]
    history = remember(moving, static, settings)
    filtered = all_passes(moving, motions, settings)
    shares = filtered_shares(grids, motions, settings)

    planes = {}
    for x, y in everywhere:
        motion, color = motions[y][x], tuple(colors[:, y, x])
        channels = moving[y][x], static[y][x], filtered[y][x]
        opacities = collected[x, y][3], shares[y][x]
        seen = look_at(motion, channels, opacities, color, settings)
        seen["reprojection"] = collected[x, y][2]
        seen["prefiltered"] = remodulated(values[0][y][x])
        for name, value in seen.items():
            shape = (np.size(value), rows, columns)
            planes.setdefault(name, np.zeros(shape))[:, y, x] = value
    return planes, history


def look_at(motion, channels, opacities, color, settings):
    """What is shown of one pixel; 0 where nothing moves nearby.

    opacities: weights of the first stage, and the filtered share.
    """
    moving, static, filtered = channels
    if not motion.active:
        moving, static, opacities = Moving(), Still(), ((0.0, 0.0), 0.0)
    alpha = blend_factor(motion, (moving.weight, static.weight), *opacities, settings)
    black = (0.0, 0.0, 0.0)
    return {
        "color": compose(filtered, static, alpha, color) if motion.active else color,
        "mean_length": motion.length,
        "mean_angle": motion.angle,
        "length_variance": motion.length_variance,
        "angle_variance": motion.angle_variance,
        "blend": alpha,
        "moving": remodulated(moving.value or black),
        "moving_weight": moving.weight,
        "static": remodulated(static.value or black),
        "static_weight": static.weight,
        "second_stage": remodulated(filtered.value or black),
    }


def collect(grids, values, p, motion, history, settings):
    """First stage and history at p: moving, static, outcome of the reprojection, first weights."""
    x, y = p
    own = grids[0][y][x]
    if not motion.active:
        value = np.mean([grid[y][x].value for grid in grids], axis=0)
        return Moving(), Still(tuple(value), 1.0 if own.still else 0.0), 0, (0.0, 0.0)
    moving, static = first_stage(grids, values, x, y, motion.c, settings)
    outcome, first_weights = 0, (moving.weight, static.weight)
    if history is not None:
        current = Moving.of(moving)
        if current.weight > 0:
            place, outcome = reproject(p, current.u, history.moving, settings)
        if outcome > 0:
            add_moving_history(moving, history.moving, place, motion.c, settings)
        keeps_own = settings.static_filter == "own" and own.still
        add_static_history(static, history.static, p, keeps_own, settings)
    still = Still(static.mean(), static.weight) if static.weight > 0 else Still()
    return Moving.of(moving), still, outcome, first_weights


def remember(moving, static, settings):
    """What the next frame gets to see: both channels, their weights limited."""

    def limited(channel):
        limit = settings.history_limit
        return [[replace(p, weight=min(p.weight, limit)) for p in row] for row in channel]

    return SimpleNamespace(moving=limited(moving), static=limited(static))


def all_passes(channel, motions, settings):
    """The second stage: every iteration over all active pixels."""
    for i in range(1, settings.second_stage_iterations + 1):
        channel = [
            [
                second_stage(channel, x, y, motion, i, settings) if motion.active else Moving()
                for x, motion in enumerate(row)
            ]
            for y, row in enumerate(motions)
        ]
    return channel


# -- 4.1 variance estimate ---------------------------------------------------------------------


def wrapped(angle):
    """The angle in (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2 * math.pi)


def relative_angle(v, reference):
    """Angle of the line along v against the reference, in [-pi/2, pi/2]."""
    delta = wrapped(math.atan2(v[1], v[0]) - reference)
    if delta > math.pi / 2:
        return delta - math.pi
    return delta + math.pi if delta < -math.pi / 2 else delta


def estimate(grids, x, y, settings):
    """The `Motion` in the window around (x, y)."""
    center = grids[0][y][x]
    before, after = (settings.variance_window - 1) // 2, settings.variance_window // 2
    weighted, total = [], 0.0
    for grid in grids:
        for row in range(y - before, y + after + 1):
            for column in range(x - before, x + after + 1):
                q, _ = at(grid, column, row)
                d = depth_weight(center.z, q.z, settings)
                total += d if q.moving or q.still else 0.0
                if q.moving and d > 0:
                    weighted.append((d, q))
    n = sum(a for a, _ in weighted)
    if n == 0:
        return Motion()
    mean = sum(a * q.speed for a, q in weighted) / n
    length_variance = max(sum(a * q.speed**2 for a, q in weighted) / n - mean**2, 0.0)
    if settings.length_normalization == "mean":
        length_variance /= max(mean**2, 1e-12)
    angle, angle_variance = angles(center, weighted, n, settings)
    s_a = sat(angle_variance / settings.angle_normalization)
    c_a = 1 + min(1.0, settings.angle_gain * s_a)
    c_l = 1 + min(1.0, settings.length_gain * length_variance)
    return Motion(mean, angle, length_variance, s_a, n / total, c_a * c_l)


def angles(center, weighted, n, settings):
    """(mean angle, its variance) of the moving samples."""
    if settings.angle_mode == "double_angle":
        theta = [math.atan2(q.v[1], q.v[0]) for _, q in weighted]
        sine = sum(a * math.sin(2 * o) for (a, _), o in zip(weighted, theta, strict=True))
        cosine = sum(a * math.cos(2 * o) for (a, _), o in zip(weighted, theta, strict=True))
        angle = math.atan2(sine, cosine) / 2
        return angle, sum(a * relative_angle(q.v, angle) ** 2 for a, q in weighted) / n
    first = center if center.moving else max((q for _, q in weighted), key=lambda q: q.speed)
    reference = math.atan2(first.v[1], first.v[0])
    deltas = [(a, relative_angle(q.v, reference)) for a, q in weighted]
    mean = sum(a * delta for a, delta in deltas) / n
    variance = sum(a * delta**2 for a, delta in deltas) / n - mean**2
    return reference + mean, max(variance, 0.0)


def motion_grid(grids, settings):
    """The estimate of each pixel: that of its tile's top left pixel."""
    stride = settings.variance_stride
    rows, columns = len(grids[0]), len(grids[0][0])
    tiles = {
        (x, y): estimate(grids, x, y, settings)
        for y in range(0, rows, stride)
        for x in range(0, columns, stride)
    }
    return [[tiles[x - x % stride, y - y % stride] for x in range(columns)] for y in range(rows)]


# -- 4.2 pre-filter ----------------------------------------------------------------------------


def candidates(grid, x, y, times, jitter, settings):
    """The places (with what is there) that pixel (x, y) tries out.

    times (K, H, W) in [0, 1), jitter (2K, H, W) in px: x and y of the first candidate, then of
    the next.
    """
    r = grid[y][x]
    if not r.moving or r.speed < settings.prefilter_min_length:
        return []
    found = []
    for k in range(settings.prefilter_samples):
        step = float(times[k, y, x]) - r.t
        column = round(x + r.v[0] * step + float(jitter[2 * k, y, x]))
        row = round(y + r.v[1] * step + float(jitter[2 * k + 1, y, x]))
        found.append(at(grid, column, row))
    return found


def prefilter(grid, times, jitter, settings):
    """The grid's values, those of fast pixels averaged with what other pixels found."""
    rows, columns = len(grid), len(grid[0])
    if not settings.prefilter:
        return [[sample.value for sample in row] for row in grid]
    found = [
        [candidates(grid, x, y, times, jitter, settings) for x in range(columns)]
        for y in range(rows)
    ]

    def value(x, y):
        p = grid[y][x]
        if not p.moving or p.speed < settings.prefilter_min_length:
            return p.value
        total = Sum()
        total.add(1.0, p.value)
        for row in (y - 1, y, y + 1):
            for column in (x - 1, x, x + 1):
                for s, place in at(found, column, row)[0]:
                    distance, _ = segment_distance((x, y), place, s.v, s.t, clamped=True)
                    if s.moving and distance < settings.prefilter_distance:
                        total.add(1.0, s.value)
        return total.mean()

    return [[value(x, y) for x in range(columns)] for y in range(rows)]


# -- 4.3 first stage ---------------------------------------------------------------------------


def first_stage(grids, values, x, y, c, settings):
    """(moving, static) sums at (x, y) over the 5x5 pixels around it, of all sample frames."""
    p = grids[0][y][x]
    taps = kernel_taps(settings) if settings.first_stage else [(0, 0, 1.0)]
    keeps_own = settings.static_filter == "own" and p.still
    moving, static = Sum(), Sum()
    for grid, value_of in zip(grids, values, strict=True):
        for o_x, o_y, h in taps:
            q, place = at(grid, x + o_x, y + o_y)
            value, _ = at(value_of, x + o_x, y + o_y)
            if q.moving:
                a = h * motion_weight((x, y), place, q.v, q.t, c, settings)
                a *= 1.0 if p.moving else depth_weight(p.z, q.z, settings)
                moving.add(a, (*value, *q.u, q.t))
            elif q.still and not keeps_own:
                static.add(h, value)
            elif q.still and (o_x, o_y) == (0, 0):
                static.add(1.0, value)
    return moving, static


# -- 4.4 temporal filter -----------------------------------------------------------------------


def reproject(p, u_p, history, settings):
    """The pixel of the history that moved to p and the evaluation that found it, or None, -1."""
    q = (p[0] - u_p[0], p[1] - u_p[1])
    for evaluation in range(1, settings.reprojection_iterations + 1):
        column, row = round(q[0]), round(q[1])
        if not is_inside(history, column, row) or history[row][column].weight == 0:
            return None, -1
        u_q = history[row][column].u
        delta = (
            (p[0] - u_p[0] / 2) - (q[0] + u_q[0] / 2),
            (p[1] - u_p[1] / 2) - (q[1] + u_q[1] / 2),
        )
        if length(delta) < settings.accept_threshold:
            return (column, row), evaluation
        if length(delta) > max(settings.cancel_threshold, length(u_p)):
            return None, -1
        q = (q[0] + delta[0], q[1] + delta[1])
    return None, -1


def add_moving_history(moving, history, k, c, settings):
    """The first stage again, about pixel k of the frame before."""
    for o_x, o_y, h in kernel_taps(settings):
        s, place = at(history, k[0] + o_x, k[1] + o_y)
        if s.weight > 0:
            v = scaled(s.u, settings.shutter)
            w = motion_weight(k, place, v, s.t, c, settings)
            moving.add(h * w * s.weight, s.data())


def add_static_history(static, history, p, keeps_own, settings):
    """What stands still is where it was."""
    for o_x, o_y, h in [(0, 0, 1.0)] if keeps_own else kernel_taps(settings):
        s, _ = at(history, p[0] + o_x, p[1] + o_y)
        if s.weight > 0:
            static.add(h * s.weight, s.value)


# -- 4.3 second stage --------------------------------------------------------------------------


def kernel_steps(motion, i, settings, across=1.0):
    """(s_x, s_y) of iteration i = 1 .. n: steps along the motion and across it, in px.

    across: the step across a motion that has one angle.
    """
    if settings.kernel_scaling == "fixed":
        return 2.0 ** (i - 1), 2.0 ** (i - 1)
    n = settings.second_stage_iterations
    along = max(settings.min_step, motion.length / (settings.step_divisor * 2 ** (n - i)))
    return along, (1 - motion.angle_variance) * across + motion.angle_variance * along


def displacement(o_x, o_y, motion, i, settings, across=1.0):
    """Where tap (o_x, o_y) lies, in px from the center of the kernel."""
    s_x, s_y = kernel_steps(motion, i, settings, across)
    x, y = o_x * s_x, o_y * s_y
    if settings.kernel_rotation and settings.kernel_scaling == "motion":
        cosine, sine = math.cos(motion.angle), math.sin(motion.angle)
        x, y = cosine * x - sine * y, sine * x + cosine * y
    return (round(x), round(y)) if settings.lookup == "nearest" else (x, y)


def second_stage(channel, x, y, motion, i, settings):
    """The moving channel at (x, y) after iteration i."""
    total = Sum()
    for o_x, o_y, h in kernel_taps(settings):
        d_x, d_y = displacement(o_x, o_y, motion, i, settings)
        part, data, place = moving_at(channel, x + d_x, y + d_y, settings)
        if part > 0:
            *_, ux, uy, t = data
            v = scaled((ux, uy), settings.shutter)
            w = motion_weight((x, y), place, v, t, motion.c, settings)
            total.add(h * part * w, data)
    return Moving.of(total) if total.weight > 0 else channel[y][x]


def filtered_shares(grids, motions, settings):
    """Share of moving samples after the kernels of all passes; None where all are unknown.

    S_0(q) is the share among the pixel's own samples, and S_i(p) = sum h S_i-1(q) / sum h over
    the taps q of pass i where there is one. Where all motion has one angle, the taps lie on a
    line. Only active pixels are filtered.
    """

    def own(x, y):
        known = [grid[y][x].moving for grid in grids if grid[y][x].moving or grid[y][x].still]
        return sum(known) / len(known) if known else None

    shares = [[own(x, y) for x in range(len(row))] for y, row in enumerate(motions)]
    for i in range(1, settings.second_stage_iterations + 1):
        shares = [
            [
                filtered_share(shares, x, y, motion, i, settings) if motion.active else shares[y][x]
                for x, motion in enumerate(row)
            ]
            for y, row in enumerate(motions)
        ]
    return [[share or 0.0 for share in row] for row in shares]


def filtered_share(shares, x, y, motion, i, settings):
    """The share at (x, y) after pass i."""
    total = weights = 0.0
    for o_x, o_y, h in kernel_taps(settings):
        d_x, d_y = displacement(o_x, o_y, motion, i, settings, across=0.0)
        for part, share in corners(shares, x + d_x, y + d_y):
            if share is not None:
                total += h * part * share
                weights += h * part
    return total / weights if weights > 0 else shares[y][x]


# -- composition -------------------------------------------------------------------------------


def blend_factor(motion, weights, first_weights, filtered, settings):
    """Opacity of the moving channel; weights: (moving, static), with history and without."""
    if settings.blend_source == "variance":
        return sat(settings.blend_gain * motion.moving_part)
    if settings.blend_source == "filtered":
        return filtered
    moving, static = weights if settings.blend_source == "weights" else first_weights
    return moving / (moving + static) if moving + static > 0 else 0.0


def compose(moving, static, alpha, color):
    """The moving channel over the non-moving one."""
    if moving.weight > 0 and static.weight > 0:
        pairs = zip(remodulated(moving.value), remodulated(static.value), strict=True)
        return tuple(alpha * m + (1 - alpha) * s for m, s in pairs)
    if moving.weight > 0:
        return remodulated(moving.value)
    return remodulated(static.value) if static.weight > 0 else color
