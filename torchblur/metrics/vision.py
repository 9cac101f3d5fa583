"""The eye that FLIP models: contrast sensitivity, edges and points, and color differences.

Sections are those of Andersson et al. 2020.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.metrics.vision_steps import cube_root_curve, length, mix, power

__all__ = ["Kernels", "View", "make_kernels", "perceive", "visible_error"]

_Matrix = list[list[float]]

# Contrast sensitivity (section 4.1): weights a and widths b (degrees²) of Gaussians
# a sqrt(pi/b) exp(-pi² x²/b) for the channels Y, Cx, and for Cz the sum of two.
_WIDTH_Y = 0.0047
_WIDTH_CX = 0.0053
_WEIGHTS_CZ = (34.1, 13.5)
_WIDTHS_CZ = (0.04, 0.025)

_FEATURE_WIDTH = 0.082  # w, degrees: width of the edge and point detectors (section 4.2)
_RADIUS_IN_SIGMAS = 3.0  # all kernels end there
_COLOR_EXPONENT = 0.7  # q_c (section 4.1.3)
_FEATURE_EXPONENT = 0.5  # q_f (section 4.2)
_KNEE_INPUT = 0.4  # p_c: fraction of the greatest color distance that maps to
_KNEE_OUTPUT = 0.95  # p_t: this error

# Linear sRGB to XYZ at D65, exact for the primaries; its row sums are the white point.
_RGB_TO_XYZ = (
    (10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794),
    (2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897),
    (1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382),
)
_LAB_DELTA = 6 / 29
_HUNT = 0.01  # chroma is scaled by this times the lightness (section 4.1.2)

# Where the exact formulas have an infinite slope (equal images) they are continued by a line.
# Each moves the result by less than 3e-5.
_COLOR_LINE = 1e-4  # units of Lab
_FEATURE_LINE = 1e-7
_ERROR_LINE = 1e-8
_NORM_FLOOR = 1e-24  # squared length below which a vector is taken as zero


@dataclass(frozen=True, eq=False)
class Kernels:
    """Taps of the separable kernels, one row per plane that `perceive` filters.

    Args:
        across: Horizontal taps, (7, 1, 1, K): Y smoothed; Y with g, g', g''; Cx; Cz twice.
        down: Vertical taps, (8, 1, K, 1): Y; Cx; Cz twice; edges g'g, gg'; points g''g, gg''.
    """

    across: Tensor
    down: Tensor


@dataclass(frozen=True, eq=False)
class View:
    """What the eye makes of an image.

    Args:
        lab: CIELab after contrast sensitivity and Hunt adjustment, (B, 3, H, W).
        edge: Strength of edges in luminance, (B, 1, H, W).
        point: Strength of points and thin lines in luminance, (B, 1, H, W).
    """

    lab: Tensor
    edge: Tensor
    point: Tensor

    def map(self, function: Callable[[Tensor], Tensor]) -> View:
        """Return the view with a function applied to each of its tensors."""
        return View(function(self.lab), function(self.edge), function(self.point))


def make_kernels(pixels_per_degree: float, like: Tensor) -> Kernels:
    """Return the kernels of a viewing condition.

    Args:
        pixels_per_degree: Resolution at the eye, px per degree of visual angle, above 0.
        like: A tensor of the type and on the device that the kernels should have.

    Returns:
        The taps; they end at three standard deviations of the widest kernel.

    Differentiable: no.
    Reference: Andersson et al. 2020, sections 4.1.1 and 4.2; the separation is that of the
        authors' code. We differ: nothing.
    """
    sigma = 0.5 * _FEATURE_WIDTH * pixels_per_degree
    widest = math.sqrt(max(_WIDTHS_CZ) / (2 * math.pi**2)) * pixels_per_degree
    radius = math.ceil(_RADIUS_IN_SIGMAS * widest)
    x = torch.arange(-radius, radius + 1, dtype=torch.float64) / pixels_per_degree
    smooth_y, smooth_cx = _gaussian(x, _WIDTH_Y), _gaussian(x, _WIDTH_CX)
    cz1, cz2 = _blue_yellow(x)
    g, edge, point = _feature_kernels(sigma, radius)
    across = torch.stack([smooth_y, g, edge, point, smooth_cx, cz1, cz2])
    down = torch.stack([smooth_y, smooth_cx, cz1, cz2, g, edge, g, point])
    return Kernels(across[:, None, None, :].to(like), down[:, None, :, None].to(like))


def _gaussian(x: Tensor, width: float) -> Tensor:
    kernel = torch.exp(-(math.pi**2) * x * x / width)
    return kernel / kernel.sum()


def _blue_yellow(x: Tensor) -> tuple[Tensor, Tensor]:
    """Return the two kernels whose outer squares add up to the kernel of Cz, with sum 1."""
    parts = [
        math.sqrt(weight * math.sqrt(math.pi / width)) * torch.exp(-(math.pi**2) * x * x / width)
        for weight, width in zip(_WEIGHTS_CZ, _WIDTHS_CZ, strict=True)
    ]
    total = math.hypot(float(parts[0].sum()), float(parts[1].sum()))
    return parts[0] / total, parts[1] / total


def _feature_kernels(sigma: float, radius: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return a Gaussian with its first and second derivative, padded to a radius.

    The positive and the negative taps of a derivative add up to 1 and -1.
    """
    own = math.ceil(_RADIUS_IN_SIGMAS * sigma)
    x = torch.arange(-own, own + 1, dtype=torch.float64)
    g = torch.exp(-x * x / (2 * sigma**2))
    kernels = [g / g.sum()]
    for derivative in (-x * g, (x * x / sigma**2 - 1) * g):
        up, down = derivative.clamp_min(0), derivative.clamp_max(0)
        kernels.append(up / up.sum() - down / down.sum())
    smooth, edge, point = (F.pad(k, (radius - own, radius - own)) for k in kernels)
    return smooth, edge, point


def perceive(color: Tensor, kernels: Kernels) -> View:
    """Return what the eye makes of an image.

    Args:
        color: Linear sRGB in [0, 1], (B, 3, H, W).
        kernels: From `make_kernels`, of the same type and device.

    Returns:
        The view; its planes have the size of the image.

    Differentiable: yes, finite everywhere.
    Border: replicate.
    Reference: Andersson et al. 2020, sections 4.1.1, 4.1.2 and 4.2.
    """
    _, to_opponent, to_rgb = _matrices()
    y, cx, cz = mix(color, to_opponent).chunk(3, dim=1)
    passed = _filter(torch.cat([y, y, y, y, cx, cz, cz], dim=1), kernels.across)
    y, g, edge, point, cx, cz1, cz2 = passed.chunk(7, dim=1)
    passed = _filter(torch.cat([y, cx, cz1, cz2, edge, g, point, g], dim=1), kernels.down)
    y, cx, cz1, cz2, edges, points = passed.split([1, 1, 1, 1, 2, 2], dim=1)
    rgb = mix(torch.cat([y, cx, cz1 + cz2], dim=1), to_rgb).clamp(0, 1)
    return View(_hunt_lab(rgb), length(edges, _NORM_FLOOR), length(points, _NORM_FLOOR))


def _filter(planes: Tensor, taps: Tensor) -> Tensor:
    """Correlate each plane with its own taps, (C, 1, 1, K) or (C, 1, K, 1)."""
    rows, columns = taps.shape[2] // 2, taps.shape[3] // 2
    padded = F.pad(planes, (columns, columns, rows, rows), mode="replicate")
    return F.conv2d(padded, taps, groups=taps.shape[0])


@functools.cache
def _matrices() -> tuple[_Matrix, _Matrix, _Matrix]:
    """Return the matrices from linear sRGB to XYZ relative to white, to opponents, and back.

    The opponents are YCxCz less its scales and offset, which the filters do not see.
    """
    xyz = torch.tensor(_RGB_TO_XYZ, dtype=torch.float64)
    xyz = xyz / xyz.sum(dim=1, keepdim=True)
    opponent = torch.tensor([[0, 1, 0], [1, -1, 0], [0, 1, -1]], dtype=torch.float64) @ xyz
    return xyz.tolist(), opponent.tolist(), opponent.inverse().tolist()


def _hunt_lab(rgb: Tensor) -> Tensor:
    """Return CIELab with chroma scaled by lightness (the Hunt effect)."""
    xyz = mix(rgb, _matrices()[0])
    f = cube_root_curve(xyz, _LAB_DELTA**3, 1 / (3 * _LAB_DELTA**2), 4 / 29)
    fx, fy, fz = f.chunk(3, dim=1)
    lightness = 116 * fy - 16
    scale = _HUNT * lightness
    return torch.cat([lightness, scale * 500 * (fx - fy), scale * 200 * (fy - fz)], dim=1)


def visible_error(view: View, reference: View) -> Tensor:
    """Return the error from two views: the color difference, amplified where features differ.

    Args:
        view: View of the image, (B, …).
        reference: View of the reference, of the same batch or of 1.

    Returns:
        Error in [0, 1], (B, 1, H, W).

    Differentiable: yes, finite everywhere, zero where the views are equal.
    Reference: Andersson et al. 2020, sections 4.1.3, 4.2 and 4.3. We differ: powers are straight
        lines next to zero.
    """
    color = _color_difference(view.lab, reference.lab)
    edge, point = (view.edge - reference.edge).abs(), (view.point - reference.point).abs()
    strength = torch.maximum(edge, point) / math.sqrt(2)
    feature = power(strength, _FEATURE_EXPONENT, _FEATURE_LINE)
    return color * color.clamp_min(_ERROR_LINE) ** -feature


def _color_difference(lab: Tensor, reference: Tensor) -> Tensor:
    distance = power(_hyab(lab - reference), _COLOR_EXPONENT, _COLOR_LINE)
    greatest = _greatest_distance()
    knee = _KNEE_INPUT * greatest
    # The curve bends down at the knee, so it is the lower one of its two lines.
    upper = _KNEE_OUTPUT + (distance - knee) * ((1 - _KNEE_OUTPUT) / (greatest - knee))
    return torch.minimum(distance * (_KNEE_OUTPUT / knee), upper)


def _hyab(difference: Tensor) -> Tensor:
    return difference[:, :1].abs() + length(difference[:, 1:], _NORM_FLOOR)


@functools.cache
def _greatest_distance() -> float:
    """Return the distance of green and blue, the greatest within sRGB, to the power 0.7."""
    green, blue = torch.eye(3, dtype=torch.float64)[1:, :, None, None].split(1)
    distance = float(_hyab(_hunt_lab(green) - _hunt_lab(blue)))
    return math.pow(distance, _COLOR_EXPONENT)
