"""What all stages of the twin of Oberberger 2022 use: samples, sums, lookups, weights.

Pixels are (x, y) with whole numbers at their centers. A sample frame is a grid, `grid[y][x]`, of
`Sample`s; n samples per pixel are n grids. Borders replicate: an index outside is moved to the
nearest one inside, and what is found there lies there. Plain loops in float64, no torchblur.
"""

import math
from dataclasses import dataclass
from types import SimpleNamespace

from twins.reconstruction import FAR_DEPTH, dot, length, scaled

LEAST = 1e-4  # a weight that is no more may be rounding of 0, and is 0

DEFAULTS = {
    "shutter": 0.5,
    "shutter_position": "centered",  # not read: a sample's time says all
    "moving_threshold": 0.5,
    "variance_window": 15,
    "variance_stride": 2,
    "depth_extent": 0.1,
    "angle_mode": "relative",
    "angle_normalization": (math.pi / 2) ** 2,
    "length_normalization": "px",
    "blend_gain": 1.0,
    "blend_source": "variance",
    "prefilter": True,
    "prefilter_samples": 2,
    "prefilter_jitter": 1.5,
    "prefilter_distance": 2.5,
    "prefilter_min_length": 3.0,
    "first_stage": True,
    "kernel": "b3",
    "length_gain": 10.0,
    "angle_gain": 1.0,
    "segment_softness": 0.0,
    "static_filter": "kernel",
    "temporal": True,
    "reprojection_iterations": 2,
    "accept_threshold": 1.0,
    "cancel_threshold": 16.0,
    "history_limit": 8.0,
    "second_stage_iterations": 3,
    "kernel_scaling": "motion",
    "kernel_rotation": True,
    "step_divisor": 5.0,
    "min_step": 1.0,
    "lookup": "nearest",
    "demodulate": False,
    "albedo_floor": 0.01,
    "seed": 0,  # not read: random numbers come as planes
}


def settings_of(changes):
    """The parameters by name; an unknown one is refused."""
    unknown = set(changes) - set(DEFAULTS)
    if unknown:
        raise TypeError(f"the twin knows no {sorted(unknown)}")
    return SimpleNamespace(**(DEFAULTS | changes))


# -- what is kept of a pixel -------------------------------------------------------------------


@dataclass(frozen=True)
class Sample:
    """What the ray of a pixel saw."""

    value: tuple  # color; with demodulation color / albedo, then albedo
    z: float
    u: tuple  # px / frame
    v: tuple  # px over the shutter
    t: float
    speed: float  # |v|
    moving: bool
    still: bool  # neither, if it cannot be trusted


@dataclass(frozen=True)
class Motion:
    """The variance estimate around a pixel, section 4.1."""

    length: float = 0.0  # l
    angle: float = 0.0
    length_variance: float = 0.0
    angle_variance: float = 0.0  # normalized: s_a
    moving_part: float = 0.0  # f
    c: float = 1.0  # c_a c_l

    @property
    def active(self):
        return self.length > 0


@dataclass
class Sum:
    """A weighted sum of values and the sum of the weights."""

    total: tuple = ()
    weight: float = 0.0

    def add(self, a, value):
        if a > 0:
            old = self.total or (0.0,) * len(value)
            self.total = tuple(s + a * v for s, v in zip(old, value, strict=True))
            self.weight += a

    def mean(self):
        return tuple(s / self.weight for s in self.total)


@dataclass(frozen=True)
class Moving:
    """A pixel of the moving channel; where the weight is 0 there is nothing."""

    value: tuple = ()
    u: tuple = (0.0, 0.0)
    t: float = 0.0
    weight: float = 0.0

    @staticmethod
    def of(total):
        if total.weight == 0:
            return Moving()
        *value, ux, uy, t = total.mean()
        return Moving(tuple(value), (ux, uy), t, total.weight)

    def data(self):
        return (*self.value, *self.u, self.t)


@dataclass(frozen=True)
class Still:
    """A pixel of the non-moving channel."""

    value: tuple = ()
    weight: float = 0.0


def demodulated(color, albedo, settings):
    """Light, then albedo: what is filtered in place of the color."""
    albedo = tuple(max(a, settings.albedo_floor) for a in albedo)
    return tuple(c / a for c, a in zip(color, albedo, strict=True)) + albedo


def remodulated(value):
    """The color: with demodulation, light times albedo."""
    if len(value) == 3:
        return value
    return tuple(a * b for a, b in zip(value[:3], value[3:], strict=True))


def sample_grid(frame, settings):
    """A grid of samples from a frame's planes, (C, H, W) by name."""

    def plane(name, x, y):
        return tuple(float(c) for c in frame[name][:, y, x])

    def sample(x, y):
        u = plane("velocity", x, y)
        v = scaled(u, settings.shutter)
        color = plane("color", x, y)
        if settings.demodulate:
            color = demodulated(color, plane("albedo", x, y), settings)
        z = min(plane("depth", x, y)[0], FAR_DEPTH)
        moves = length(v) >= settings.moving_threshold
        trusted = "valid" not in frame or bool(frame["valid"][0, y, x])
        kinds = moves and trusted, not moves and trusted
        return Sample(color, z, u, v, plane("time", x, y)[0], length(v), *kinds)

    _, rows, columns = frame["depth"].shape
    return [[sample(x, y) for x in range(columns)] for y in range(rows)]


# -- lookups and weights -----------------------------------------------------------------------


def clamp(value, low, high):
    return max(low, min(value, high))


def sat(value):
    return clamp(value, 0.0, 1.0)


def at(grid, x, y):
    """Replicated border: what is at (x, y), and where that is."""
    row, column = clamp(y, 0, len(grid) - 1), clamp(x, 0, len(grid[0]) - 1)
    return grid[row][column], (column, row)


def is_inside(grid, x, y):
    return 0 <= y < len(grid) and 0 <= x < len(grid[0])


def corners(grid, x, y):
    """(part, pixel) of each of the four pixels around (x, y); a whole position is one pixel."""
    x, y = clamp(x, 0, len(grid[0]) - 1), clamp(y, 0, len(grid) - 1)
    found = []
    for row in (math.floor(y), math.floor(y) + 1):
        for column in (math.floor(x), math.floor(x) + 1):
            part = (1 - abs(x - column)) * (1 - abs(y - row))
            if part > 0:
                found.append((part, grid[row][column]))
    return found


def bilinear(channel, x, y):
    """(valid part, mean data of it, place) between the four pixels around (x, y)."""
    total = Sum()
    for part, pixel in corners(channel, x, y):
        if pixel.weight > 0:
            total.add(part, pixel.data())
    place = clamp(x, 0, len(channel[0]) - 1), clamp(y, 0, len(channel) - 1)
    if total.weight <= LEAST:
        return 0.0, None, place
    return total.weight, total.mean(), place


def moving_at(channel, x, y, settings):
    """(valid part, data, place) of the moving channel at (x, y)."""
    if settings.lookup == "bilinear":
        return bilinear(channel, x, y)
    pixel, place = at(channel, x, y)
    return float(pixel.weight > 0), pixel.data(), place


def kernel_taps(settings):
    """(o_x, o_y, h) of the 5x5 kernel."""
    row = {"b3": (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16), "box": (0.2,) * 5}[settings.kernel]
    return [(i - 2, j - 2, row[i] * row[j]) for j in range(5) for i in range(5)]


def depth_weight(z_p, z_q, settings):
    """1 if q is in front of p or level with it, 0 from `depth_extent` of p's depth behind."""
    return sat(1 + (z_p - z_q) / (settings.depth_extent * z_p))


def segment_distance(p, q, v, t, *, clamped=False):
    """(distance, l): from p to the line that q moves along, and where on it p comes to lie."""
    q0 = (q[0] - v[0] * t, q[1] - v[1] * t)
    to_p = (p[0] - q0[0], p[1] - q0[1])
    if length(v) < 1e-3:
        return length(to_p), 0.5
    along = dot(to_p, v) / dot(v, v)
    nearest = clamp(along, 0.0, 1.0) if clamped else along
    return length((to_p[0] - nearest * v[0], to_p[1] - nearest * v[1])), along


def edge(along, softness):
    """1 on the segment, 0 off it; softly down to 0 within `softness` beyond its ends."""
    beyond = max(-along, along - 1, 0.0)
    if softness == 0:
        return 1.0 if beyond == 0 else 0.0
    return sat(1 - beyond / softness)


def motion_weight(p, q, v, t, c, settings):
    """w(p, q): could what is at q at time t be at p at another time?"""
    distance, along = segment_distance(p, q, v, t)
    weight = sat(1 - distance / c)
    if weight <= LEAST:
        return 0.0
    return weight * edge(along, settings.segment_softness)
