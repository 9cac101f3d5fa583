"""Slow twin of "Notes On Motion Blur Rendering" (9 December 2025), written from its snippets.

Per pixel, in float64. Half resolution is the same main pass on a smaller frame, and an upsampling.
"""

import math
from types import SimpleNamespace

import numpy as np
from twins import reconstruction as common
from twins.reconstruction import direction_of, dot, length, sat, scaled

DEFAULTS = {
    "shutter": 0.5,
    "shutter_position": "centered",
    "num_samples": 6,
    "tile_size": 32,
    "noise": "checkerboard",
    "jitter": 1.0,
    "tile_jitter": 0.0,
    "early_out": 0.125,
    "mirror_filter": "ports",
    "spread_compare": "static_zero",
    "spread_offset": 1.0,
    "spread_slope": 1.0,
    "depth_range": 1.0,
    "relative_depth_range": 0.1,
    "depth_compare": "absolute",
    "velocity_encoding": "float",
    "softness": 0.0,
    "seed": 0,  # not read: the noise comes as planes
    "separate_sums": True,
    "center_weight": 0.0,
    "background_fade": 0.0,
    "directions": "two",
    "direction_reduction": "exact",
    "secondary_exponent": 2.0,
    "neighbor_culling": False,
    "min_angle": 5.0,
    "depth_level": 1.0,
    "direction_weights": True,
    "direction_exponent": 3.0,
    "tile_classes": False,
    "fast_ratio": 0.9,
    "alpha_combination": "max",
    "accurate_alpha": True,
    "area_slope": 2.0,
    "alpha_gain": 1.0,
    "post_filter": True,
    "post_samples": 6,
    "post_radius": 0.5,
    "post_alpha": "foreground",
    "post_acceptance": "hard",
    "post_threshold": 1.0,
    "post_tau": 1.0,
    "post_zero_alpha": 1e-4,
    "post_edges": True,
    "post_center_weight": 1.0,
    "color_lookup": "opportunistic",
    "bilinear_min": 1.0,
    "double_samples": True,
    "resolution": "full",
    "downsample_depth_range": 1.0,
    "upsample_depth_range": 1.0,
    "upsample_depth_weights": True,
    "alpha_weighted_color": True,
    "corner_fallback": True,
    "alpha_fade": True,
    "fade_start": 1.0,
    "fade_end": 2.0,
    "fade_min_alpha": 0.5,
}


def notes2025(color, depth, velocity, *, tap_noise=None, tile_noise=None, **changes):
    """Blur one frame.

    color (3, H, W), depth (1, H, W), velocity (2, H, W) in px/frame; tap_noise and tile_noise
    (H, W) in [0, 1), ½ if left out; then parameters by name. Returns "color" (3, H, W),
    "alpha", "output_alpha" (1, ·, ·) and "secondary", per pixel.
    """
    settings = common.settings_of(DEFAULTS, changes)
    settings.pairs = (settings.num_samples + 1) // 2
    depth = np.minimum(depth[0], common.FAR_DEPTH)
    settings.tap_noise = np.full(depth.shape, 0.5) if tap_noise is None else tap_noise
    settings.tile_noise = np.full(depth.shape, 0.5) if tile_noise is None else tile_noise
    if settings.resolution == "full":
        return blur(color, depth, velocity, settings)
    small = downsampled(color, depth, velocity, settings)
    half_settings = SimpleNamespace(**vars(settings))
    half_settings.tile_size = (settings.tile_size + 1) // 2
    half_settings.early_out = settings.early_out / 2
    layers = blur(*small, half_settings)
    half = (layers["color"], layers["output_alpha"][0], small[1])
    result, alpha = np.zeros_like(color), np.zeros((1, *depth.shape))
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            result[:, y, x], alpha[0, y, x] = upsampled(color, depth, half, x, y, settings)
    return layers | {"color": result, "output_alpha": alpha}


def blur(color, depth, velocity, settings):
    """The main pass and, if asked for, the post-filter, at one resolution."""
    field = common.half_velocity(velocity, settings)
    first, second, least = tiles_of(field, settings)
    rows, columns = depth.shape
    image = np.zeros((5, rows, columns))  # color, foreground alpha, output alpha
    lines_of = {}
    for y in range(rows):
        for x in range(columns):
            tx, ty = tile_of(x, y, (len(first), len(first[0])), settings)
            linear = least[ty][tx] >= settings.bilinear_min
            lines = lines_of[y, x] = lines_at(first[ty][tx], second[ty][tx], linear, settings)
            alike = least[ty][tx] >= settings.fast_ratio * length(first[ty][tx])
            pixel = SimpleNamespace(x=x, y=y, color=color, depth=depth, field=field, linear=linear)
            pixel.fast = settings.tile_classes and len(lines) == 1 and alike
            image[:, y, x] = main_pass(pixel, lines, settings)
    layers = {"alpha": image[3:4].copy()}
    if settings.post_filter:
        image = filtered_again(image, lines_of, settings)
    return layers | {"color": image[:3], "output_alpha": image[4:5]}


# -- tiles -------------------------------------------------------------------------------------


def tiles_of(field, settings):
    """Primary and secondary motion of the 3x3 tiles around each tile, and their minimum."""
    r, cull = settings.tile_size, settings.neighbor_culling
    own = common.tile_max(field, r)
    first = common.neighbor_max(own, cull)
    shape = range(len(own)), range(len(own[0]))
    pixels = [[pixels_of(field, tx, ty, r) for tx in shape[1]] for ty in shape[0]]
    candidates = pixels
    if settings.direction_reduction == "hierarchical":
        candidates = reduced_in_steps(field, r, settings)
    second = [[(0.0, 0.0) for _ in shape[1]] for _ in shape[0]]
    least = [[0.0 for _ in shape[1]] for _ in shape[0]]
    for ty in shape[0]:
        for tx in shape[1]:
            around = common.neighborhood(candidates, ty, tx)
            taking_part = [v for o, vs in around for v in vs if not cull or reaches(o, v)]
            second[ty][tx] = best(taking_part, first[ty][tx], settings)
            lengths = [length(v) for _, vs in common.neighborhood(pixels, ty, tx) for v in vs]
            least[ty][tx] = min(lengths)
    return first, second, least


def reaches(offset, v):
    return 0 in offset or common.reaches_middle(offset, v)


def pixels_of(field, tx, ty, r):
    return [v for row in field[ty * r : (ty + 1) * r] for v in row[tx * r : (tx + 1) * r]]


def best(vectors, primary, settings):
    """computeSecondaryMotionWeight times the length: long, and across the primary motion."""

    def score(v):
        cosine = abs(dot(direction_of(primary), direction_of(v)))
        return length(v) * max(1 - cosine, 0) ** settings.secondary_exponent

    return max(vectors, key=score)


def reduced_in_steps(field, r, settings):
    """Cells of at most 8 px leave a primary and a secondary each, and so do the tiles."""
    cell = max(n for n in range(1, 9) if r % n == 0)
    primaries = common.tile_max(field, cell)
    shape = range(len(primaries)), range(len(primaries[0]))
    left = [
        [
            [primaries[cy][cx], best(pixels_of(field, cx, cy, cell), primaries[cy][cx], settings)]
            for cx in shape[1]
        ]
        for cy in shape[0]
    ]
    tiles = common.tile_max(primaries, r // cell)
    return [
        [
            [
                tiles[ty][tx],
                best(
                    [v for vs in pixels_of(left, tx, ty, r // cell) for v in vs],
                    tiles[ty][tx],
                    settings,
                ),
            ]
            for tx in range(len(tiles[0]))
        ]
        for ty in range(len(tiles))
    ]


def tile_of(x, y, shape, settings):
    """The tile of a pixel; near a tile's border perhaps the next, on one axis."""
    u, v = (x + 0.5) / settings.tile_size, (y + 0.5) / settings.tile_size
    shift = settings.tile_jitter * (settings.tile_noise[y, x] - 0.5)
    if (x + y) % 2 == 0:
        u += shift * 2 * abs(u - math.floor(u) - 0.5)
    else:
        v += shift * 2 * abs(v - math.floor(v) - 0.5)
    tx = common.clamp(math.floor(u), 0, shape[1] - 1)
    return tx, common.clamp(math.floor(v), 0, shape[0] - 1)


def lines_at(first, second, linear, settings):
    """The directions that are sampled: vector and pairs of taps."""
    if length(first) <= settings.early_out:
        return []
    doubled = settings.double_samples and not linear
    lines = [(first, settings.pairs * (2 if doubled else 1))]
    cosine = abs(dot(direction_of(first), direction_of(second)))
    apart = cosine < math.cos(math.radians(settings.min_angle))
    if settings.directions == "two" and apart and length(second) > settings.early_out:
        lines.append((second, settings.pairs))
    return lines


# -- main pass ---------------------------------------------------------------------------------


def main_pass(pixel, lines, settings):
    """Return color, foreground alpha and output alpha of a pixel."""
    center = pixel.color[:, pixel.y, pixel.x]
    if not lines:
        return [*center, 0, 0]
    background, foreground = np.zeros(4), np.zeros(4)
    alphas, weights, longest = [], [], 0.0
    for vector, pairs in lines:
        sums = along_line(pixel, vector, pairs, settings)
        background += sums.background
        foreground += sums.foreground
        alphas.append(sums.alpha)
        weights.append(sums.background[3] + sums.foreground[3])
        longest = max(longest, sums.longest)
    if not settings.separate_sums:
        color, alpha, output = one_sum(center, background + foreground, weights, lines, settings)
    else:
        alpha = together(alphas, settings)
        color, alpha, output = two_sums(center, background, foreground, alpha, settings)
    if settings.resolution == "half" and settings.alpha_fade:
        output *= fade(2 * longest, settings)
    return [*color, alpha, output]


def together(alphas, settings):
    """max(alpha[0], alpha[1]); a direction that is not sampled has none."""
    if settings.alpha_combination == "max":
        return max(alphas)
    return sum(alphas) / (2 if settings.directions == "two" else 1)


def along_line(pixel, vector, pairs, settings):
    """The sampling loop along one direction; background and foreground as (rgb, weight)."""
    d, reach = direction_of(vector), length(vector)
    background, foreground, alpha, longest = np.zeros(4), np.zeros(4), 0.0, 0.0
    jitter = settings.jitter * tap_shift(pixel, settings)
    for i in range(pairs):
        sides = []
        for side in (1, -1):
            t = common.clamp((side * (i + 0.5) + jitter) / pairs, -1, 1)
            sides.append(tap(pixel, t, d, reach, pairs, settings))
        one, two = (side.weights for side in sides)
        if settings.mirror_filter != "none":
            one, two = mirrored(*sides, settings.mirror_filter == "strict")
        for side, (bg, fg, area) in zip(sides, (one, two), strict=True):
            background += bg * np.append(side.color, 1)
            foreground += fg * np.append(side.color, 1)
            alpha += sat(fg / area)
            if bg + fg > 0:
                longest = max(longest, side.spread)
    count = 2 * pairs
    alpha /= count
    if settings.accurate_alpha:
        alpha *= 1 + settings.area_slope * reach
    return SimpleNamespace(
        background=background / count,
        foreground=foreground / count,
        alpha=sat(settings.alpha_gain * alpha),
        longest=longest,
    )


def tap_shift(pixel, settings):
    if settings.noise == "checkerboard":
        return -0.25 if (pixel.x + pixel.y) % 2 else 0.25
    return settings.tap_noise[pixel.y, pixel.x] - 0.5


def mirrored(one, two, strict):
    """Jimenez: bool2(depth1 > depth2, spread2 > spread1); all: w1 = w2; none: w2 = w1."""
    w1, w2 = one.weights, two.weights
    nearer, faster = one.depth > two.depth, two.spread > one.spread
    if nearer and faster:
        return w2, w2
    if strict:
        other = two.depth > one.depth and one.spread > two.spread
    else:
        other = not nearer and not faster
    return (w1, w1) if other else (w1, w2)


def tap(pixel, t, d, reach, pairs, settings):
    """One sample: its color, depth, |V|, and (background, foreground, area)."""
    position = (t + settings.c) * reach
    x, y = pixel.x - position * d[0], pixel.y - position * d[1]
    column, row = common.nearest(x, y, *pixel.depth.shape)
    v_p, v_s = pixel.field[pixel.y][pixel.x], pixel.field[row][column]
    if pixel.fast:  # all count as at one depth and as moving along the tile's motion
        v_s, bg, fg = (d[0] * reach, d[1] * reach), settings.depth_level, 1 - settings.depth_level
    else:
        bg, fg = depth_weights(pixel.depth[pixel.y, pixel.x], pixel.depth[row, column], settings)
        bg *= spread(position, v_p, d, pairs / reach, settings)
        fg *= spread(position, v_s, d, pairs / reach, settings)
        if settings.direction_weights:
            bg *= abs(dot(d, direction_of(v_p))) ** settings.direction_exponent
            fg *= abs(dot(d, direction_of(v_s))) ** settings.direction_exponent
    bilinear = settings.color_lookup == "bilinear"
    bilinear = bilinear or (settings.color_lookup == "opportunistic" and pixel.linear)
    return SimpleNamespace(
        color=common.color_at(pixel.color, x, y, "bilinear" if bilinear else "nearest"),
        depth=pixel.depth[row, column],
        spread=length(v_s),
        weights=(bg, fg, 1 + settings.area_slope * length(v_s) if settings.accurate_alpha else 1),
    )


def depth_weights(z_p, z_s, settings):
    """computeDepthWeights: ½ ± for one direction; at depth_level 1 level depths are background."""
    extent = settings.depth_range
    if settings.depth_compare == "relative":
        extent = settings.relative_depth_range * min(z_p, z_s)
    background = sat(settings.depth_level - (z_p - z_s) / extent)
    return background, 1 - background


def spread(position, v, d, per_px, settings):
    """SpreadCmp in samples: sat(a s - max(o - 1, 0)), or sat(a s - o + 1) as in the slides."""
    offset = common.distance_along(position, v, d, settings) * per_px
    beyond = offset - settings.spread_offset
    if settings.spread_compare == "static_zero":
        beyond = max(beyond, 0)
    return sat(settings.spread_slope * (length(v) * per_px - beyond))


def two_sums(center, background, foreground, alpha, settings):
    """lerp(background, foreground, alpha); without a background the output alpha is alpha."""
    own = settings.center_weight / (2 * settings.pairs)
    valid = float(background[3] > 0)
    if settings.background_fade:
        valid = sat(background[3] / settings.background_fade)
    behind = center
    if background[3] + own > 0:
        behind = (background[:3] + own * center) / (background[3] + own)
    if foreground[3] == 0:
        front, alpha = np.zeros(3), 0.0
    else:
        front = foreground[:3] / foreground[3]
    output = alpha + valid - alpha * valid
    if settings.resolution == "full":
        behind = valid * behind + (1 - valid) * center
        return (1 - alpha) * behind + alpha * front, alpha, output
    if output == 0:
        return center, alpha, output
    return (alpha * front + (1 - alpha) * valid * behind) / output, alpha, output


def one_sum(center, total, weights, lines, settings):
    """centerColor · (1 - colorSum.a) + colorSum.rgb, with the larger alpha of the two lines."""
    if total[3] == 0:
        return center, 0.0, 0.0
    alpha = together(weights, settings)
    return center * (1 - alpha) + alpha * total[:3] / total[3], alpha, alpha


def fade(pixels, settings):
    """remap(maxInfluenceVelocityPixels, 1, 2, minAlpha, 1), clamped."""
    t = sat((pixels - settings.fade_start) / (settings.fade_end - settings.fade_start))
    return settings.fade_min_alpha + (1 - settings.fade_min_alpha) * t


# -- post-filter -------------------------------------------------------------------------------


def filtered_again(image, lines_of, settings):
    result = image.copy()
    for (y, x), lines in lines_of.items():
        if lines:
            rgba = post_pixel(image, x, y, lines, settings)
            result[:3, y, x], result[4, y, x] = rgba[:3], rgba[3]
    return result


def post_pixel(image, x, y, lines, settings):
    """The bilateral blur of one pixel; returns rgb and output alpha."""
    compared = image[3 if settings.post_alpha == "foreground" else 4]
    rgba = image[[0, 1, 2, 4]]
    center = compared[y, x]
    peak = center
    inner = settings.post_center_weight * np.append(rgba[:, y, x], 1)
    outer = inner.copy()
    most = max(settings.post_samples // 2, 1)
    for vector, _ in lines:
        gap = length(vector) / settings.pairs  # coveredPixels
        count = common.clamp(math.ceil(gap), 1, most)
        d = direction_of(vector)
        for t in [side * (i + 0.5) / count for i in range(count) for side in (1, -1)]:
            offset = scaled(d, t * settings.post_radius * gap)
            column, row = common.nearest(x + offset[0], y + offset[1], *compared.shape)
            sample = compared[row, column]
            peak = max(peak, sample)
            accepted, alive = acceptance(sample, center, settings)
            planes = np.append(rgba[:, row, column], 1)
            outer += accepted * planes
            inner += accepted * alive * planes
    edge = edge_of(peak, settings) if settings.post_edges else 0.0
    return (1 - edge) * inner[:4] / inner[4] + edge * outer[:4] / outer[4]


def acceptance(sample, center, settings):
    zero, step = settings.post_zero_alpha, 1 / settings.pairs
    if settings.post_acceptance == "soft":
        bell = math.exp(-(((sample - center) / (settings.post_tau * step)) ** 2))
        return bell, sat(max(sample, center) / zero)
    accepted = abs(sample - center) <= settings.post_threshold * step + 1e-6
    return accepted, not (center <= zero and sample <= zero)


def edge_of(peak, settings):
    zero, step = settings.post_zero_alpha, 1 / settings.pairs
    if settings.post_acceptance == "soft":
        return sat(peak / zero) * math.exp(-((peak / (settings.post_tau * step)) ** 2))
    return float(zero < peak <= settings.post_threshold * step + 1e-6)


# -- half resolution ---------------------------------------------------------------------------


def downsampled(color, depth, velocity, settings):
    rows, columns = ((n + 1) // 2 for n in depth.shape)
    small = np.zeros((3, rows, columns)), np.zeros((rows, columns)), np.zeros((2, rows, columns))
    for y in range(rows):
        for x in range(columns):
            block = [
                (min(2 * y + j, depth.shape[0] - 1), min(2 * x + i, depth.shape[1] - 1))
                for j in (0, 1)
                for i in (0, 1)
            ]
            nearest = min(depth[p] for p in block)
            extent = settings.downsample_depth_range
            extent *= nearest if settings.depth_compare == "relative" else 1
            weights = [1 - sat(abs(nearest - depth[p]) / extent) for p in block]
            for p, w in zip(block, weights, strict=True):
                small[0][:, y, x] += color[:, p[0], p[1]] / 4
                small[1][y, x] += depth[p] * w / sum(weights)
                small[2][:, y, x] += velocity[:, p[0], p[1]] / 2 * w / sum(weights)
    return small


def upsampled(color, depth, half, x, y, settings):
    """One pixel of full resolution: four half-resolution samples over it."""
    half_color, half_alpha, half_depth = half
    hx, hy = (x + 0.5) / 2 - 0.5, (y + 0.5) / 2 - 0.5
    left, top = math.floor(hx), math.floor(hy)
    samples, alphas, bilinear, by_depth = [], [], [], []
    for j in (0, 1):
        for i in (0, 1):
            column = common.clamp(left + i, 0, half_depth.shape[1] - 1)
            row = common.clamp(top + j, 0, half_depth.shape[0] - 1)
            samples.append(half_color[:, row, column])
            alphas.append(half_alpha[row, column])
            bilinear.append((1 - abs(hx - left - i)) * (1 - abs(hy - top - j)))
            by_depth.append(
                bilinear[-1] * upsample_depth(depth[y, x], half_depth[row, column], settings)
            )
    total = sum(by_depth)
    if total > 0:
        by_depth = [w / total for w in by_depth]
    elif settings.corner_fallback:
        by_depth = bilinear
    alpha = sum(w * a for w, a in zip(by_depth, alphas, strict=True))
    shares = bilinear
    if settings.alpha_weighted_color:
        shares = [w * a for w, a in zip(bilinear, alphas, strict=True)]
    mixed = sum(w * c for w, c in zip(shares, samples, strict=True))
    if sum(shares) > 0:
        mixed = mixed / sum(shares)
    return (1 - alpha) * color[:, y, x] + alpha * mixed, alpha


def upsample_depth(pixel, sample, settings):
    if not settings.upsample_depth_weights:
        return 1.0
    extent = settings.upsample_depth_range
    extent *= min(pixel, sample) if settings.depth_compare == "relative" else 1
    return 1 - sat((sample - pixel) / extent)
