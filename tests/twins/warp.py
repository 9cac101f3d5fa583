"""Slow twin of the forward warp: every splat, corner and neighbor in plain loops.

Written from the formula in the filter's docstring, with none of its lists: all pixels are
splatted, moving or not.
"""

import math

import numpy as np
from twins.line import shutter_interval

STEPS = ((0, -1), (0, 1), (-1, 0), (1, 0))


def same(one, other, gap):
    """Whether two depths may belong to one surface."""
    near, far = min(one, other), max(one, other)
    return 1 / near < (1 + gap) / far


class Pixels:
    """The layers of a frame, and what a pixel sees of its neighbors."""

    def __init__(self, color, depth, velocity, acceleration, valid, gap):
        self.color, self.depth, self.gap = color, np.minimum(depth[0], 1e10), gap
        self.velocity = velocity
        self.acceleration = np.zeros_like(velocity) if acceleration is None else acceleration
        self.rows, self.columns = self.depth.shape
        self.valid = np.ones_like(self.depth, dtype=bool) if valid is None else valid[0]

    def inside(self, y, x):
        return 0 <= y < self.rows and 0 <= x < self.columns

    def clamped(self, y, x):
        return min(max(y, 0), self.rows - 1), min(max(x, 0), self.columns - 1)

    def linked(self, y, x):
        """The four neighbors (replicated at the border), None where of another surface."""
        found = []
        for dy, dx in STEPS:
            at = self.clamped(y + dy, x + dx)
            fits = self.valid[at] and same(self.depth[at], self.depth[y, x], self.gap)
            found.append(at if fits else None)
        return found

    def step(self, y, x):
        """Change of the surface's depth per px: less of both sides, more of both axes."""
        steps = [abs(self.depth[n] - self.depth[y, x]) if n else None for n in self.linked(y, x)]
        axes = [[s for s in steps[:2] if s is not None], [s for s in steps[2:] if s is not None]]
        return max(min(axis, default=0.0) for axis in axes)

    def gradient(self, y, x):
        """(dv/dx, dv/dy), each (2,)."""
        v = self.velocity
        left, right, up, down = self.linked(y, x)
        result = []
        for before, after in ((left, right), (up, down)):
            sides = []
            if after:
                sides.append(v[:, after[0], after[1]] - v[:, y, x])
            if before:
                sides.append(v[:, y, x] - v[:, before[0], before[1]])
            result.append(sum(sides) / len(sides) if sides else np.zeros(2))
        return result

    def bend(self, y, x):
        """Second differences of the color along x and y."""
        left, right, up, down = self.linked(y, x)
        result = []
        for before, after in ((left, right), (up, down)):
            if before and after:
                there = self.color[:, before[0], before[1]] + self.color[:, after[0], after[1]]
                result.append(there - 2 * self.color[:, y, x])
            else:
                result.append(np.zeros(3))
        return result

    def color_range(self, y, x):
        colors = [self.color[:, y, x]]
        for dy, dx in STEPS:
            at = self.clamped(y + dy, x + dx)
            if self.valid[at]:
                colors.append(self.color[:, at[0], at[1]])
        return np.min(colors, axis=0), np.max(colors, axis=0)

    def at_edge(self, y, x):
        """Whether one of the eight neighbors is of another surface."""
        around = [self.clamped(y + dy, x + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
        return not all(same(self.depth[n], self.depth[y, x], self.gap) for n in around)

    def clean(self, y, x, radius):
        """The pixel's color, at an edge that of its surface beside the edge."""
        if radius == 0 or not self.at_edge(y, x):
            return self.color[:, y, x]
        total, weight = np.zeros(3), 0.0
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                at = (y + dy, x + dx)
                if not self.inside(*at) or not self.valid[at] or self.at_edge(*at):
                    continue
                if same(self.depth[at], self.depth[y, x], self.gap):
                    share = 0.01 ** max(abs(dx), abs(dy))
                    total += share * self.color[:, at[0], at[1]]
                    weight += share
        return total / weight if weight else self.color[:, y, x]

    def row(self, y, x, color):
        """What is continued behind: color, velocity, acceleration, 1 / depth."""
        motion = (self.velocity[:, y, x], self.acceleration[:, y, x])
        return np.concatenate((color, *motion, [1 / self.depth[y, x]]))


def guess(pixels, radius, reach):
    """{(y, x): row} of what lies behind."""
    rows, columns = pixels.rows, pixels.columns
    given = {
        (y, x): pixels.row(y, x, pixels.clean(y, x, radius))
        for y in range(rows)
        for x in range(columns)
        if pixels.valid[y, x]
    }
    behind = {}
    for _ in range(reach):
        ring = {}
        for y in range(rows):
            for x in range(columns):
                if (y, x) in behind:
                    continue
                limit = 1 / pixels.depth[y, x] / (1 + pixels.gap)
                sources = [given.get((y + dy, x + dx)) for dy, dx in STEPS]
                sources = [s for s in sources if s is not None and s[-1] < limit]
                if sources:
                    ring[y, x] = np.mean(sources, axis=0)
        if not ring:
            break
        behind |= ring
        given = ring
    return behind


def own_splats(pixels, s):
    for y in range(pixels.rows):
        for x in range(pixels.columns):
            low, high = pixels.color_range(y, x)
            depth = pixels.depth[y, x]
            yield {
                "at": (x, y),
                "color": pixels.color[:, y, x],
                "v": pixels.velocity[:, y, x],
                "a": pixels.acceleration[:, y, x],
                "z": depth,
                "near": depth - s["depth_slope"] * pixels.step(y, x),
                "gradient": pixels.gradient(y, x),
                "bend": pixels.bend(y, x),
                "low": low,
                "high": high,
                "mass": float(pixels.valid[y, x]),
            }


def hidden_splats(behind):
    for (y, x), row in behind.items():
        yield {
            "at": (x, y),
            "color": row[:3],
            "v": row[3:5],
            "a": row[5:7],
            "z": 1 / row[7],
            "near": 1 / row[7],
            "gradient": [np.zeros(2), np.zeros(2)],
            "bend": [np.zeros(3), np.zeros(3)],
            "low": row[:3],
            "high": row[:3],
            "mass": 1.0,
        }


def marks_of(splat, time, s):
    """Yield (x, y, share) of the pixels that a splat touches, and set its color at the time."""
    move = splat["v"] * time + splat["a"] * time**2 / 2
    x, y = splat["at"] + move
    gx, gy = splat["gradient"]
    growth = 1 + s["stretch"] * (time * (gx[0] + gy[1]) + time**2 * (gx[0] * gy[1] - gx[1] * gy[0]))
    growth = min(max(growth, 0.25), 16.0)
    dx, dy = x - math.floor(x), y - math.floor(y)
    blur = (dx * (1 - dx) * splat["bend"][0] + dy * (1 - dy) * splat["bend"][1]) / 2
    splat["shown"] = np.clip(splat["color"] - s["sharpening"] * blur, splat["low"], splat["high"])
    parts = s["supersampling"]
    width = s["footprint"] / parts
    for i in range(parts):
        for j in range(parts):
            ox, oy = (j + 0.5) / parts - 0.5, (i + 0.5) / parts - 0.5
            px = x + ox + time * (ox * gx[0] + oy * gy[0])
            py = y + oy + time * (ox * gx[1] + oy * gy[1])
            left, top = math.floor(px), math.floor(py)
            to_right = min(max((px - left - 0.5) / width + 0.5, 0), 1)
            to_bottom = min(max((py - top - 0.5) / width + 0.5, 0), 1)
            for cy, wy in ((top, 1 - to_bottom), (top + 1, to_bottom)):
                for cx, wx in ((left, 1 - to_right), (left + 1, to_right)):
                    yield cx, cy, wx * wy * growth * splat["mass"] / parts**2


def layer(marks, weights, gain):
    """Mean color and coverage of a layer."""
    total = sum(weights)
    if total <= 0:
        return np.zeros(3), 0.0
    color = sum(w * m[2]["shown"] for w, m in zip(weights, marks, strict=True)) / max(total, 1e-8)
    return color, min(gain * total, 1.0)


def closeness(near, nearest, extent):
    return math.exp(-min(max((near - nearest) / (extent * nearest), 0), 80))


def two_layers(marks, s):
    """Color times coverage, and coverage, of a pixel at one moment."""
    solid = [m for m in marks if m[1] > 1e-3]
    if not solid:
        front = [1.0] * len(marks)
    else:
        nearest = min(m[2]["z"] for m in solid)
        front = [closeness(m[2]["near"], nearest, s["depth_extent"]) for m in marks]
    rest = [
        m[2]["z"] for m, f in zip(marks, front, strict=True) if m[1] > 1e-3 and f < math.exp(-1)
    ]
    second = min(rest, default=math.inf)
    back = [
        (1 - f) * (closeness(m[2]["near"], second, s["depth_extent"]) if rest else 1.0)
        for m, f in zip(marks, front, strict=True)
    ]
    gain = s["coverage_gain"]
    color, cover = layer(marks, [m[1] * f for m, f in zip(marks, front, strict=True)], gain)
    under, below = layer(marks, [m[1] * b for m, b in zip(marks, back, strict=True)], gain)
    return color * cover + (1 - cover) * below * under, cover + (1 - cover) * below


def what_is_behind(pixels, revealed, s):
    opening, closing = shutter_interval(s["shutter"], s["shutter_position"])
    time = max(abs(opening), abs(closing))
    longest = np.abs(pixels.velocity) * time + np.abs(pixels.acceleration) * time**2 / 2
    reach = min(s["background_reach"], 2 * math.ceil(longest.max()) + 2)
    if s["background"] == "none":
        return {}
    if s["background"] == "guessed":
        return guess(pixels, s["edge_radius"], reach)
    known = {}
    for y in range(pixels.rows):
        for x in range(pixels.columns):
            hides = 1 - pixels.depth[y, x] / revealed.depth[y, x] > 1e-4
            if hides and revealed.valid[y, x]:
                known[y, x] = revealed.row(y, x, revealed.color[:, y, x])
    rest = guess(pixels, s["edge_radius"], reach)
    return known | {at: row for at, row in rest.items() if not revealed.valid[at]}


def warp(color, depth, velocity, *, acceleration=None, valid=None, revealed=None, **s):
    """Return {"color": (3, H, W), "coverage": (1, H, W)}.

    `revealed` is (color, depth, velocity, valid or None); all parameters must be given.
    """
    bend = acceleration if s["curved"] else None
    pixels = Pixels(color, depth, velocity, bend, valid, s["depth_gap"])
    if revealed is not None:
        revealed = Pixels(*revealed[:3], None, revealed[3], s["depth_gap"])
    splats = [*own_splats(pixels, s), *hidden_splats(what_is_behind(pixels, revealed, s))]
    opening, closing = shutter_interval(s["shutter"], s["shutter_position"])
    total = np.zeros_like(color)
    coverage = np.zeros((1, pixels.rows, pixels.columns))
    for i in range(s["num_samples"]):
        time = opening + (i + 0.5) / s["num_samples"] * (closing - opening)
        touched = {}
        for splat in splats:
            for x, y, share in marks_of(splat, time, s):
                if pixels.inside(y, x):
                    touched.setdefault((y, x), []).append((None, share, dict(splat)))
        for (y, x), marks in touched.items():
            shown, covered = two_layers(marks, s)
            total[:, y, x] += shown / s["num_samples"]
            coverage[0, y, x] += covered / s["num_samples"]
    weight = s["own_weight"] * pixels.valid
    known = coverage + weight
    fill = (total + weight * color) / np.where(known > 0, known, 1)
    fill = np.where(known > 0, fill, color)
    return {"color": total + (1 - coverage) * fill, "coverage": coverage}
