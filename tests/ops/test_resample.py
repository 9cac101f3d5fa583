import pytest
import torch

from torchblur.ops.resample import HalfImage, UpsampleRules, box_halve, depth_halve, upsample_over


def planes(*rows):
    return torch.tensor(rows, dtype=torch.float64)[None, None]


def test_box_halve_by_hand():
    assert box_halve(planes([1, 3, 8], [5, 7, 8])).tolist() == [[[[4, 8]]]]
    assert box_halve(torch.rand(2, 3, 5, 7)).shape == (2, 3, 3, 4)


@pytest.mark.parametrize(
    ("extent", "relative", "expected"),
    [(1.0, False, 10.0), (4.0, False, 15.0), (2.0, True, 15.0), (0.5, True, 10.0)],
)
def test_depth_halve_takes_what_is_near(extent, relative, expected):
    """Depths 2 and, twice, 4: weights 1, 1 and 1 - 2/extent twice; values 10 and 25."""
    depth = planes([2, 4], [2, 4])
    value = planes([10, 25], [10, 25])
    assert float(depth_halve(value, depth, extent, relative=relative)) == pytest.approx(expected)


def constant(color, alpha, depth, size=(3, 3)):
    full = torch.ones(1, 1, *size, dtype=torch.float64)
    return HalfImage(color * full.expand(1, 3, *size), alpha * full, depth * full)


def test_upsampling_a_constant_is_a_lerp():
    color, depth = torch.rand(1, 3, 5, 6).double(), torch.full((1, 1, 5, 6), 2.0).double()
    image, alpha = upsample_over(color, depth, constant(0.8, 0.25, 2.0), UpsampleRules(1.0))
    assert torch.allclose(image, 0.75 * color + 0.25 * 0.8)
    assert torch.allclose(alpha, alpha.new_tensor(0.25))


def test_bilinear_position():
    half = HalfImage(
        planes([0, 4]).expand(1, 3, 1, 2), planes([1, 1]), torch.ones(1, 1, 1, 2).double()
    )
    color, depth = torch.zeros(1, 3, 2, 4).double(), torch.ones(1, 1, 2, 4).double()
    image, _ = upsample_over(color, depth, half, UpsampleRules(1.0))
    assert image[0, 0, 0].tolist() == [0, 1, 3, 4]


def edge():
    """Sharp foreground (left, depth 1, alpha 0) before a blurred background (right, alpha 1)."""
    color = torch.cat((torch.ones(1, 3, 2, 4), torch.zeros(1, 3, 2, 4)), 3).double()
    depth = torch.cat((torch.full((1, 1, 2, 4), 1.0), torch.full((1, 1, 2, 4), 9.0)), 3).double()
    left = torch.tensor([True, True, False, False]).view(1, 1, 1, 4)
    half = HalfImage(
        torch.where(left, 1.0, 0.25).expand(1, 3, 1, 4).double(),
        torch.where(left, 0.0, 1.0).double(),
        torch.where(left, 1.0, 9.0).double(),
    )
    return color, depth, half


def test_nothing_leaks_over_an_edge_in_depth():
    image, _ = upsample_over(*edge(), UpsampleRules(1.0))
    assert torch.equal(image[0, 0, 0, :4], torch.ones(4).double())
    # Behind the edge alphas mix with the sharp background, but no foreground color comes along.
    assert float(image[0, 0, 0, 4:].max()) <= 0.25
    assert float(image[0, 0, 0, 5]) == 0.25


def test_each_measure_is_needed():
    image, _ = upsample_over(*edge(), UpsampleRules(1.0, depth_weights=False))
    assert float(image[0, 0, 0, 3]) < 0.9  # background over the foreground
    color, depth, half = edge()
    some = half._replace(alpha=half.alpha.clamp_min(0.5))
    leak, _ = upsample_over(color, depth, some, UpsampleRules(1.0, alpha_weighted=False))
    less, _ = upsample_over(color, depth, some, UpsampleRules(1.0))
    assert float(leak[0, 0, 0, 4]) > float(less[0, 0, 0, 4])


def test_fallback_where_everything_lies_behind():
    color, depth = torch.zeros(1, 3, 2, 2).double(), torch.ones(1, 1, 2, 2).double()
    half = constant(1.0, 1.0, 5.0, (1, 1))
    image, alpha = upsample_over(color, depth, half, UpsampleRules(1.0))
    assert float(alpha.min()) == float(image.min()) == 1
    image, alpha = upsample_over(color, depth, half, UpsampleRules(1.0, fallback=False))
    assert float(alpha.max()) == float(image.max()) == 0


def test_gradcheck():
    color, depth, half = edge()
    half = half._replace(alpha=half.alpha.clamp(0.3, 0.8), depth=half.depth * 0.9 + 0.4)
    extent = torch.tensor(4.0).double()
    leaves = [t.clone().requires_grad_() for t in (color, *half, extent)]

    def run(full, half_color, half_alpha, half_depth, extent):
        return upsample_over(
            full, depth, HalfImage(half_color, half_alpha, half_depth), UpsampleRules(extent)
        )

    assert torch.autograd.gradcheck(run, leaves, fast_mode=True)
    depth = depth + 0.3 * torch.rand_like(depth)
    assert torch.autograd.gradcheck(
        lambda d, e: depth_halve(color, d, e), (depth.requires_grad_(), extent.requires_grad_())
    )
