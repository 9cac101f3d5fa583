import math

import pytest
import torch

from torchblur.ops.atrous import (
    Centers,
    Footprint,
    Samples,
    Widths,
    footprint,
    kernel_taps,
    path_sums,
    plain_sums,
    split_sums,
)
from torchblur.ops.points import points_where, take

SIZE = (11, 14)
EVERY = points_where(torch.ones(1, 1, *SIZE, dtype=torch.bool), torch.float64)
GENERATOR = torch.Generator().manual_seed(0)
COLOR = torch.rand(1, 3, *SIZE, generator=GENERATOR, dtype=torch.float64)


def plane(value=1.0, channels=1):
    return torch.full((1, channels, *SIZE), float(value), dtype=torch.float64)


def columns(value):
    return torch.full((1, EVERY.number), float(value), dtype=torch.float64)


def samples(vx=20.0, moving=None, depth=None):
    velocity = torch.cat((plane(vx), plane(0)), 1)
    moving = plane() if moving is None else moving
    values = torch.cat((COLOR, velocity, plane(0.5)), 1)
    return Samples(values, velocity, plane() if depth is None else depth, moving, 1 - moving)


def split(given, width=1.0, keep=0.0, kernel="b3", **taps):
    own = Centers(take(given.moving, EVERY), columns(keep), take(given.depth, EVERY), columns(0.1))
    widths = Widths(columns(width), torch.tensor(0.0, dtype=torch.float64))
    sums = split_sums(given, EVERY, kernel_taps(kernel, COLOR, **taps), widths, own)
    return [part.reshape(-1, *SIZE) for part in sums]


@pytest.mark.parametrize("kernel", ["b3", "box"])
def test_taps_sum_to_one_and_are_symmetric(kernel):
    taps = kernel_taps(kernel, COLOR)
    assert taps.shape == (25, 3)
    assert float(taps[:, 2].sum()) == pytest.approx(1)
    assert torch.allclose(taps[:, 2], taps[:, 2].flip(0))
    assert taps[0].tolist()[:2] == [-2, -2]
    assert taps[1].tolist()[:2] == [-1, -2]
    assert float(kernel_taps("b3", COLOR)[12, 2]) == pytest.approx((6 / 16) ** 2)


def test_uniform_motion_counts_along_its_line_only():
    moving, weight, static, static_weight = split(samples())
    row = torch.tensor([1, 4, 6, 4, 1], dtype=torch.float64) / 16
    y, x = 5, 6
    expected = (COLOR[0, :, y, x - 2 : x + 3] * row).sum(1) * 6 / 16
    assert torch.allclose(moving[:3, y, x], expected)
    assert float(weight[0, y, x]) == pytest.approx(6 / 16)
    assert torch.allclose(moving[3:5, y, x] / weight[:, y, x], torch.tensor([20.0, 0.0]).double())
    assert not bool(static.any() | static_weight.any())
    wide = split(samples(), width=2.0)[1]
    assert float(wide[0, y, x]) == pytest.approx(6 / 16 + 0.5 * 8 / 16)


def test_still_samples_are_filtered_without_weights():
    moving, weight, static, static_weight = split(samples(moving=plane(0)))
    assert not bool(moving.any() | weight.any())
    row = torch.tensor([1, 4, 6, 4, 1], dtype=torch.float64) / 16
    expected = torch.einsum("chw,h,w->c", COLOR[0, :, 3:8, 4:9], row, row)
    assert torch.allclose(static[:, 5, 6], expected)
    assert torch.allclose(static_weight, torch.ones(()).double())
    kept = split(samples(moving=plane(0)), keep=1.0)
    assert torch.allclose(kept[2], COLOR[0])
    assert torch.allclose(kept[3], torch.ones(()).double())


def test_what_passes_behind_a_still_pixel_does_not_count():
    moving = plane(0)
    moving[..., 7:] = 1
    near, far = plane(1.0), plane(1.0)
    far[..., 7:] = 1.05  # half way through the ramp of 0.1
    level, behind, hidden = (
        split(samples(moving=moving, depth=z))[1][0, 5, 6] for z in (near, far, far + far - 1)
    )
    assert float(behind) == pytest.approx(0.5 * float(level))
    assert float(hidden) == pytest.approx(0, abs=1e-9)
    assert float(level) == pytest.approx(5 / 16 * 6 / 16)
    # Where the pixel itself moves there is no test.
    assert float(split(samples(moving=moving, depth=far))[1][0, 5, 7]) == pytest.approx(
        11 / 16 * 6 / 16
    )


def test_center_only_splits_without_a_filter():
    moving, weight, _, _ = split(samples(), center_only=True)
    assert torch.allclose(moving[:3], COLOR[0])
    assert torch.allclose(weight, torch.ones(()).double())


def shape_of(angle, step_x, step_y):
    return Footprint(
        columns(math.cos(angle)), columns(math.sin(angle)), columns(step_x), columns(step_y)
    )


def texture(vx=30.0, vy=0.0, weight=None):
    velocity = torch.cat((plane(vx), plane(vy)), 1)
    weight = plane() if weight is None else weight
    return torch.cat((COLOR, velocity, plane(0.5), velocity, weight), 1)


def passed(given, shape=None, lookup="nearest", width=1.0, points=EVERY):
    widths = Widths(columns(width), torch.tensor(0.0, dtype=torch.float64))
    values, weight = path_sums(given, points, kernel_taps("b3", COLOR), widths, shape, lookup)
    return values.reshape(-1, *SIZE), weight.reshape(*SIZE)


def test_the_kernel_reaches_along_the_motion():
    row = torch.tensor([1, 4, 6, 4, 1], dtype=torch.float64) / 16
    values, _ = passed(texture(), shape_of(0.0, 3.0, 1.0))
    assert torch.allclose(values[:3, 5, 6], (COLOR[0, :, 5, 0:13:3] * row).sum(1) * 6 / 16)
    values, _ = passed(texture(0.0, 30.0), shape_of(math.pi / 2, 2.0, 1.0))
    assert torch.allclose(values[:3, 5, 6], (COLOR[0, :, 1:10:2, 6] * row).sum(1) * 6 / 16)
    # Rounded to whole pixels: steps of 0.4 fall on 0 and 1.
    values, _ = passed(texture(), shape_of(0.0, 0.4, 1.0))
    near = COLOR[0, :, 5, 5:8] * torch.tensor([1, 14, 1]).double() / 16
    assert torch.allclose(values[:3, 5, 6], near.sum(1) * 6 / 16)


def test_bilinear_lookups_equal_nearest_ones_on_pixels_and_interpolate_between():
    on_pixels = shape_of(0.0, 2.0, 1.0)
    for a, b in zip(
        passed(texture(), on_pixels), passed(texture(), on_pixels, "bilinear"), strict=True
    ):
        assert torch.allclose(a, b)
    values, weight = passed(texture(), shape_of(0.0, 0.5, 1.0), "bilinear")
    line = COLOR[0, :, 5]
    half = (line[:, 5] + line[:, 6]) / 2 * 4 + (line[:, 6] + line[:, 7]) / 2 * 4
    expected = (line[:, 5] + half + 6 * line[:, 6] + line[:, 7]) / 16 * 6 / 16
    assert torch.allclose(values[:3, 5, 6], expected)
    assert float(weight[5, 6]) == pytest.approx(6 / 16)


@pytest.mark.parametrize("lookup", ["nearest", "bilinear"])
def test_empty_pixels_lend_nothing(lookup):
    weight = plane()
    weight[..., ::2] = 0
    given = texture(weight=weight)
    poisoned = torch.where(weight.expand_as(given) > 0, given, 7.0)
    poisoned[:, -1:] = weight
    shape = shape_of(0.0, 1.3, 1.0)
    for a, b in zip(passed(given, shape, lookup), passed(poisoned, shape, lookup), strict=True):
        assert torch.allclose(a, b)
    assert float(passed(given)[1][5, 6]) == pytest.approx(8 / 16 * 6 / 16)


def test_footprint_of_the_passes():
    length, variance = columns(20.0), columns(0.5)
    divisors = [torch.tensor(5.0 * 2 ** (3 - i)).double() for i in (1, 2, 3)]
    least = torch.tensor(1.5).double()
    shapes = [footprint(None, length, variance, divisor, least) for divisor in divisors]
    assert [float(s.step_x[0, 0]) for s in shapes] == [1.5, 2.0, 4.0]
    assert [float(s.step_y[0, 0]) for s in shapes] == [1.25, 1.5, 2.5]
    assert [float(s.sin.abs().max()) for s in shapes] == [0, 0, 0]
    turned = footprint(columns(0.7), length, variance, divisors[0], least)
    assert float(turned.sin[0, 0]) == pytest.approx(math.sin(0.7))


def test_plain_sums():
    weight = plane()
    weight[..., 7:] = 0.5
    _, total = plain_sums(
        torch.cat((COLOR, weight), 1), EVERY, kernel_taps("b3", COLOR), columns(0)
    )
    total = total.reshape(SIZE)
    assert float(total[5, 3]) == pytest.approx(1)
    assert float(total[5, 6]) == pytest.approx(11 / 16 + 0.5 * 5 / 16)
    kept, own = plain_sums(
        torch.cat((COLOR, weight), 1), EVERY, kernel_taps("b3", COLOR), columns(1)
    )
    assert torch.allclose(own.reshape(SIZE), weight[0, 0])
    assert torch.allclose(kept.reshape(3, *SIZE), COLOR[0] * weight[0])


def test_gradcheck_of_the_bilinear_pass():
    generator = torch.Generator().manual_seed(1)
    points = EVERY.among((EVERY.x > 5) & (EVERY.x < 9))
    number = points.number

    def some(low, high):
        drawn = torch.rand(1, number, generator=generator, dtype=torch.float64)
        return (low + (high - low) * drawn).requires_grad_()

    leaves = [
        texture().requires_grad_(),
        some(0.2, 0.4),
        some(1.1, 1.7),
        some(0.6, 0.9),
        some(2, 3),
    ]

    def run(planes, angle, step_x, step_y, width):
        shape = Footprint(angle.cos(), angle.sin(), step_x, step_y)
        widths = Widths(width, torch.tensor(0.1, dtype=torch.float64))
        return path_sums(planes, points, kernel_taps("b3", COLOR), widths, shape, "bilinear")

    assert torch.autograd.gradcheck(run, leaves, eps=1e-7, atol=1e-5, fast_mode=True)
    grads = torch.autograd.grad(run(*leaves)[0].square().sum(), leaves)
    assert all(float(grad.abs().max()) > 1e-3 for grad in grads)
