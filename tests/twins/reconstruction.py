"""What the twins of McGuire 2012 and Guertin 2014 share: velocities, tiles, lookups, weights.

Plain loops in float64; nothing here imports torchblur. A "field" is a list of rows of (x, y)
tuples, in px. Speed does not matter, being plain does.
"""

import math
from types import SimpleNamespace

FAR_DEPTH = 1e10
SHUTTER_CENTER = {"centered": 0, "leading": 1, "trailing": -1}

DEFAULTS = {
    "shutter": 0.5,
    "shutter_position": "centered",
    "num_samples": 15,
    "tile_size": 20,
    "cone_slope": 1.0,
    "cone_exponent": 1.0,
    "depth_level": 1.0,
    "cylinder_inner": 0.95,
    "cylinder_outer": 1.05,
    "foreground_gain": 1.0,
    "background_gain": 1.0,
    "third_gain": 2.0,
    "min_length": 0.5,
    "early_out": 0.505,
    "softness": 0.0,
    "color_lookup": "nearest",
    "noise": "none",  # not read: the noise comes as planes
    "seed": 0,  # not read either
}


def within_tiles(changes):
    """The parameters without those of the reach: the papers' is a tile, with N taps for all."""
    if changes.get("reach", "tile") != "tile" or changes.get("tap_spacing", 0.0):
        raise ValueError("this twin blurs as far as its tiles, with as many taps everywhere")
    ours = ("reach", "max_reach", "tap_spacing", "max_samples")
    return {name: value for name, value in changes.items() if name not in ours}


def settings_of(defaults, changes):
    """The parameters by name; an unknown name or a softness is refused."""
    if "reach" not in defaults:
        changes = within_tiles(changes)
    unknown = set(changes) - set(defaults)
    if unknown:
        raise TypeError(f"the twin knows no {sorted(unknown)}")
    settings = SimpleNamespace(**(defaults | changes))
    if settings.softness:
        raise ValueError(f"the twins clamp hard: softness = {settings.softness}")
    settings.c = SHUTTER_CENTER[settings.shutter_position]
    return settings


# -- vectors -----------------------------------------------------------------------------------


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1]


def length(v):
    return math.sqrt(v[0] * v[0] + v[1] * v[1])


def scaled(v, s):
    return (v[0] * s, v[1] * s)


def norm(v):
    """v / |v|, of a v that is not zero."""
    return scaled(v, 1 / length(v))


def direction_of(v):
    """û: the direction of a pixel's velocity, or (0, 0) where it hardly moves."""
    return norm(v) if length(v) >= 1e-3 else (0.0, 0.0)


def floored_length(v, settings):
    """ℓ = max(|V|, ½ px): "length clamped to 0.5 minimum"."""
    return max(length(v), settings.min_length)


# -- velocities and tiles ----------------------------------------------------------------------


def half_velocity(velocity, settings):
    """V = ½ · shutter · velocity, no longer than a tile (half a tile if not centered)."""
    limit = settings.tile_size / (1 + abs(settings.c))
    if getattr(settings, "reach", "tile") == "frame":
        limit = settings.max_reach
    _, rows, columns = velocity.shape
    field = []
    for y in range(rows):
        row = []
        for x in range(columns):
            v = (float(velocity[0, y, x]), float(velocity[1, y, x]))
            v = scaled(v, settings.shutter / 2)
            row.append(scaled(v, limit / length(v)) if length(v) > limit else v)
        field.append(row)
    return field


def longest(vectors):
    """The longest vector, the first of those of equal length."""
    best = vectors[0]
    for v in vectors[1:]:
        if dot(v, v) > dot(best, best):
            best = v
    return best


def tile_max(field, r):
    """TileMax: the longest V in each r x r tile; tiles over the border hold what there is."""
    rows, columns = len(field), len(field[0])
    tiles = []
    for top in range(0, rows, r):
        row = []
        for left in range(0, columns, r):
            ys = range(top, min(top + r, rows))
            xs = range(left, min(left + r, columns))
            row.append(longest([field[y][x] for y in ys for x in xs]))
        tiles.append(row)
    return tiles


def neighborhood(tiles, ty, tx):
    """Offset and vector of the 3x3 tiles around (and including) a tile, inside the image."""
    found = []
    for oy in (-1, 0, 1):
        for ox in (-1, 0, 1):
            if 0 <= ty + oy < len(tiles) and 0 <= tx + ox < len(tiles[0]):
                found.append(((ox, oy), tiles[ty + oy][tx + ox]))
    return found


def reaches_middle(offset, v):
    """Guertin 4.4: does the blur of the diagonal tile at `offset` point at the middle tile?

    |v̂ · ô| > cos 45°, squared and times 2|v|²: (v·o)² > |v|². With o = (±1, ±1) the left side is
    |v|² + 2 o.x o.y v.x v.y, which leaves an exact test of the signs.
    """
    return offset[0] * offset[1] * v[0] * v[1] > 0


def neighbor_max(tiles, culling):
    """NeighborMax: the longest of the 3x3 tile maxima; with `culling` not all diagonal ones."""
    result = []
    for ty in range(len(tiles)):
        row = []
        for tx in range(len(tiles[0])):
            taking_part = []
            for offset, v in neighborhood(tiles, ty, tx):
                diagonal = offset[0] != 0 and offset[1] != 0
                if not (culling and diagonal) or reaches_middle(offset, v):
                    taking_part.append(v)
            row.append(longest(taking_part))
        result.append(row)
    return result


# -- lookups -----------------------------------------------------------------------------------


def clamp(value, low, high):
    return min(max(value, low), high)


def nearest(x, y, rows, columns):
    """Column and row of the pixel nearest to a position in pixel indices (half to even)."""
    return clamp(round(x), 0, columns - 1), clamp(round(y), 0, rows - 1)


def bilinear(planes, x, y):
    """Planes (C, H, W) at a position in pixel indices, borders replicated."""
    _, rows, columns = planes.shape
    x, y = clamp(x, 0, columns - 1), clamp(y, 0, rows - 1)
    left, top = math.floor(x), math.floor(y)
    right, bottom = min(left + 1, columns - 1), min(top + 1, rows - 1)
    u, v = x - left, y - top
    upper = (1 - u) * planes[:, top, left] + u * planes[:, top, right]
    lower = (1 - u) * planes[:, bottom, left] + u * planes[:, bottom, right]
    return (1 - v) * upper + v * lower


def color_at(color, x, y, mode):
    if mode == "bilinear":
        return bilinear(color, x, y)
    column, row = nearest(x, y, *color.shape[1:])
    return color[:, row, column]


# -- taps and weights --------------------------------------------------------------------------


def tap_time(i, shift, count):
    """t = mix(-1, 1, (i + j' + 1) / (N + 1)), kept in [-1, 1]."""
    return clamp(-1 + 2 * (i + 1 + shift) / (count + 1), -1.0, 1.0)


def sat(x):
    return clamp(x, 0.0, 1.0)


def smoothstep(low, high, x):
    t = sat((x - low) / (high - low))
    return t * t * (3 - 2 * t)


def cone(distance, spread, settings):
    return sat(1 - settings.cone_slope * distance / spread) ** settings.cone_exponent


def cylinder(distance, spread, settings):
    low, high = settings.cylinder_inner * spread, settings.cylinder_outer * spread
    return 1 - smoothstep(low, high, distance)


def depth_absolute(z_p, z_s, extent, level=1):
    """softDepthCompare in positive depth: (f: S is in front of p, b: S is behind p)."""
    return sat(level + (z_p - z_s) / extent), sat(level + (z_s - z_p) / extent)


def distance_along(position, v, direction, settings):
    """Distance from the tap's position to the middle of v's blur, along the direction.

    With a centered shutter the blur lies around the pixel, and this is |position|.
    """
    return abs(position - settings.c * dot(v, direction))
