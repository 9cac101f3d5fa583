"""Slow twin of Tan, Cui and Bhojan 2022, "Hybrid MBlur": ray mask, gather, composite.

Depth is positive; the exposure follows the frame ("leading"), ends at it, or lies around it, and
so the taps lie behind the motion, before it, or on both sides.
"""

import math
from types import SimpleNamespace

import numpy as np
from twins import reconstruction as common
from twins.reconstruction import length, sat, scaled

DEFAULTS = common.DEFAULTS | {
    "shutter_position": "leading",
    "tile_size": 40,
    "soft_depth_extent": 0.03,
    "center_gain": 1.0,
    "jitter": 1.0,
    "foreground_magnifier": 30.0,
    "mask_magnifier": 3.0,
    "background_depth": 1.0,
    "edge_threshold": 0.9,
    "depth_edge_gain": 1.0,
    "normal_edge_gain": 1.0,
    "mask_samples": 40,
    "threshold_softness": 0.0,
    "noise": "halton",  # not read: the noise comes as a plane
}


def tan2022(frame, *, tap_noise=None, **changes):
    """Blur one frame, a dict of planes.

    "color" (3, H, W), "depth" (1, H, W), "velocity" (2, H, W) in px/frame, and as they are there
    "object_id" (1, H, W), "normal" (3, H, W), "valid" (1, H, W) and "revealed", a dict of the
    same; tap_noise (H, W) in [0, 1), ½ if left out; then parameters by name. Returns the
    planes by name.
    """
    settings = common.settings_of(DEFAULTS, changes)
    noise = np.full(frame["depth"].shape[1:], 0.5) if tap_noise is None else tap_noise
    planes = ray_mask(frame, settings)
    layer = frame.get("revealed")
    planes["hybrid"] = planes["ray_mask"].copy()
    for y, x in np.ndindex(*noise.shape):
        planes["hybrid"][0, y, x] *= behind_slope(frame, layer, x, y, settings) > 0
    if layer:
        planes["background"] = blurred(layer, noise, settings)["color"]
    gathered = blurred(frame, noise, settings, layer)
    planes |= {
        name: gathered[name] for name in ("foreground_weight", "background_weight", "moving")
    }
    planes["color"] = gathered["color"].copy()
    for y, x in zip(*np.nonzero(planes["hybrid"][0]), strict=True):
        if gathered["moving"][0, y, x]:
            front, front_weight = gathered["front"][:, y, x], gathered["front_weight"][0, y, x]
            back_weight = gathered["background_weight"][0, y, x] * settings.mask_magnifier
            total = front_weight / settings.mask_magnifier + back_weight
            if total > 0:
                color = front / settings.mask_magnifier
                color = color + back_weight * planes["background"][:, y, x]
                planes["color"][:, y, x] = color / total
    return planes


# -- ray mask, section 3.2.1 -------------------------------------------------------------------


def ray_mask(frame, settings):
    """The mask and what it is made of, (1, H, W) each; of both sides if the shutter is centered."""
    field = common.half_velocity(frame["velocity"], settings)
    depth = np.minimum(frame["depth"][0], common.FAR_DEPTH)
    ways = {"leading": [-2], "trailing": [2], "centered": [-1, 1]}[settings.shutter_position]
    strength = edge_strength(depth, frame.get("normal"), settings)
    planes = {name: np.zeros(frame["depth"].shape) for name in ("candidates", "edge_mask")}
    planes["ray_mask"] = np.zeros(frame["depth"].shape)
    for way in ways:
        looks = [[scaled(v, way) for v in row] for row in field]
        found = np.zeros((3, *depth.shape))
        for y, x in np.ndindex(*depth.shape):
            found[0, y, x] = is_candidate(
                x, y, looks[y][x], depth, frame.get("object_id"), settings
            )
        found[1] = found[0] * (strength > settings.edge_threshold)
        for y, x in np.ndindex(*depth.shape):
            found[2, y, x] = meets_edge(x, y, looks[y][x], found[1], settings)
        for name, plane in zip(("candidates", "edge_mask", "ray_mask"), found, strict=True):
            planes[name][0] = np.maximum(planes[name][0], plane)
    return planes


def inside(x, y, plane):
    """Row and column of the pixel nearest to (x, y), or None outside the image."""
    column, row = round(x), round(y)
    rows, columns = plane.shape
    return (row, column) if 0 <= row < rows and 0 <= column < columns else None


def moves(v):
    return length(v) >= 1e-3


def is_candidate(x, y, way, depth, object_id, settings):
    """Eq. 1 and 2: does the pixel come to lie on another object that is deeper?"""
    at = inside(x + way[0], y + way[1], depth)
    if at is None or not moves(way):
        return False
    if object_id is not None and object_id[0][at] == object_id[0, y, x]:
        return False
    return depth[at] - depth[y, x] > settings.soft_depth_extent


def sobel(plane, x, y):
    """(d/dx, d/dy) of a plane (H, W) by the 5x5 operator, borders replicated."""
    smooth, slope = (1, 4, 6, 4, 1), (-1, -2, 0, 2, 1)
    rows, columns = plane.shape
    gx = gy = 0.0
    for j in range(5):
        for i in range(5):
            row = common.clamp(y + j - 2, 0, rows - 1)
            column = common.clamp(x + i - 2, 0, columns - 1)
            gx += slope[i] * smooth[j] * plane[row, column]
            gy += smooth[i] * slope[j] * plane[row, column]
    return gx, gy


def edge_strength(depth, normal, settings):
    """Eq. 3 and 4: x_n = 1 - 1 / (x + 1), x = delta_d + delta_n."""
    strength = np.zeros(depth.shape)
    for y, x in np.ndindex(*depth.shape):
        total = settings.depth_edge_gain * length(sobel(depth, x, y)) / depth[y, x]
        if normal is not None:
            squares = [g * g for plane in normal for g in sobel(plane, x, y)]
            total += settings.normal_edge_gain * math.sqrt(sum(squares))
        strength[y, x] = 1 - 1 / (total + 1)
    return strength


def meets_edge(x, y, way, edges, settings):
    """The range check: is there an edge on the way?"""
    if not moves(way):
        return False
    for i in range(settings.mask_samples):
        share = i / settings.mask_samples
        at = inside(x + share * way[0], y + share * way[1], edges)
        if at is not None and edges[at]:
            return True
    return False


# -- gather, section 3.1 and appendix ----------------------------------------------------------


def dominant_velocities(velocity, settings):
    """NeighborMax, chosen before the vectors are shortened to what the tiles reach."""
    unclamped = SimpleNamespace(c=0, shutter=settings.shutter, tile_size=math.inf)
    tiles = common.tile_max(common.half_velocity(velocity, unclamped), settings.tile_size)
    limit = settings.tile_size / (1 + abs(settings.c))
    return [
        [scaled(v, min(1.0, limit / length(v))) if length(v) > 0 else v for v in row]
        for row in common.neighbor_max(tiles, culling=False)
    ]


def blurred(frame, noise, settings, layer=None):
    """The gather over one layer: color, and the sums in front of and behind the pixels."""
    depth = np.minimum(frame["depth"][0], common.FAR_DEPTH)
    dominant = dominant_velocities(frame["velocity"], settings)
    field = common.half_velocity(frame["velocity"], settings)
    shape, r = depth.shape, settings.tile_size
    valid = frame.get("valid", np.ones((1, *shape))).astype(float)
    shown = np.concatenate((frame["color"] * valid, valid))  # pixels not trusted lend nothing
    planes = {"color": frame["color"].copy(), "front": np.zeros((3, *shape))}
    for name in ("front_weight", "foreground_weight", "background_weight", "moving"):
        planes[name] = np.zeros((1, *shape))
    for y, x in np.ndindex(*shape):
        vmax = dominant[y // r][x // r]
        if length(vmax) <= settings.early_out:
            continue
        slope = behind_slope(frame, layer, x, y, settings)
        pixel = SimpleNamespace(x=x, y=y, slope=slope, noise=noise[y, x])
        sums = gather(pixel, vmax, shown, depth, field, settings)
        center = settings.center_gain / shown_length(field[y][x], settings) * valid[0, y, x]
        total = center + sums.front + sums.back
        front = center * frame["color"][:, y, x] + sums.front_color
        if total > 0:
            planes["color"][:, y, x] = (front + sums.back_color) / total
        planes["front"][:, y, x] = front
        planes["front_weight"][0, y, x] = center + sums.front
        planes["foreground_weight"][0, y, x] = sums.front
        planes["background_weight"][0, y, x] = sums.back
        planes["moving"][0, y, x] = 1
    return planes


def shown_length(v, settings):
    """Length of the range of a pixel: one side of it has all of the displacement, or half."""
    return max(length(v) * (1 + abs(settings.c)), settings.min_length)


def behind_slope(frame, layer, x, y, settings):
    """How fast taps get to show the revealed layer as they lie deeper; 0 if they never do."""
    if layer is None or ("valid" in layer and not layer["valid"][0, y, x]):
        return 0.0
    z_p, z_r = frame["depth"][0, y, x], min(layer["depth"][0, y, x], common.FAR_DEPTH)
    gap = 1 - min(z_p, common.FAR_DEPTH) / z_r
    return 1 / (settings.background_depth * gap) if gap > 1e-4 else 0.0


def gather(pixel, vmax, shown, depth, field, settings):
    """Sums over the taps: what they show is the background's share, the rest in front."""
    sums = SimpleNamespace(front=0.0, back=0.0, front_color=0.0, back_color=0.0)
    direction = common.norm(vmax)
    for i in range(settings.num_samples):
        t = sat((i + 0.5 + settings.jitter * (pixel.noise - 0.5)) / settings.num_samples)
        if settings.c == 0:
            position = (2 * t - 1) * length(vmax)
        else:
            position = settings.c * t * 2 * length(vmax)
        sx, sy = pixel.x - position * direction[0], pixel.y - position * direction[1]
        column, row = common.nearest(sx, sy, *depth.shape)
        depths = depth[pixel.y, pixel.x], depth[row, column]
        vectors = field[pixel.y][pixel.x], field[row][column]
        weight = tap_weight(abs(position), depths, vectors, settings)
        share = sat(pixel.slope * (1 - depths[0] / depths[1]))
        *color, trusted = common.color_at(shown, sx, sy, settings.color_lookup)
        front, back = weight * (1 - share), weight * share
        sums.front += front * trusted
        sums.back += back * trusted
        sums.front_color = sums.front_color + front * np.array(color)
        sums.back_color = sums.back_color + back * np.array(color)
    return sums


def tap_weight(distance, depths, vectors, settings):
    """Eq. 5 to 10: w_f + w_b + w_s; w_f magnified where the tap is clearly in front."""
    z_p, z_s = depths
    length_p, length_s = (shown_length(v, settings) for v in vectors)
    f, b = common.depth_absolute(z_p, z_s, settings.soft_depth_extent, settings.depth_level)
    w_f = settings.foreground_gain * f * common.cone(distance, length_s, settings)
    if z_p - z_s >= settings.soft_depth_extent:
        w_f *= settings.foreground_magnifier
    w_b = settings.background_gain * b * common.cone(distance, length_p, settings)
    both = common.cylinder(distance, length_s, settings)
    both *= common.cylinder(distance, length_p, settings)
    return w_f + w_b + settings.third_gain * both
