import math

import pytest
import torch

from torchblur.ops.motion_variance import Motions, estimate_motion


def motions(velocity, depth=None, moving=None):
    """Motion planes from (B, 2, H, W); what has no speed is still."""
    plane = velocity[:, :1]
    if moving is None:
        moving = (velocity.square().sum(1, keepdim=True) > 0).to(velocity.dtype)
    depth = torch.ones_like(plane) if depth is None else depth
    return Motions(velocity, depth, moving, torch.ones_like(plane))


def uniform(vx, vy, size=(12, 13), dtype=torch.float64):
    return torch.tensor([vx, vy], dtype=dtype).view(1, 2, 1, 1).expand(1, 2, *size).clone()


def estimate(velocity, extent=0.1, window=5, **options):
    return estimate_motion([motions(velocity)], extent, window, **options)


@pytest.mark.parametrize("mode", ["relative", "double_angle"])
@pytest.mark.parametrize("vector", [(7.0, 0.0), (-3.0, 4.0), (0.0, -9.0), (-5.0, 0.0)])
def test_uniform_motion(mode, vector):
    result = estimate(uniform(*vector), mode=mode)
    assert bool(result.active.all())
    assert torch.allclose(result.length, torch.tensor(math.hypot(*vector)).double())
    assert torch.allclose(result.share, torch.ones(()).double())
    assert float(result.length_variance.abs().max()) < 1e-12
    assert float(result.angle_variance.abs().max()) < 1e-12
    turn = torch.remainder(result.angle - math.atan2(vector[1], vector[0]), math.pi)
    assert float(torch.minimum(turn, math.pi - turn).max()) < 1e-9


@pytest.mark.parametrize("mode", ["relative", "double_angle"])
def test_opposite_motion_is_one_direction(mode):
    velocity = uniform(6.0, 2.0)
    velocity[..., ::2] *= -1
    result = estimate(velocity, mode=mode)
    assert float(result.angle_variance.max()) < 1e-12
    assert float(result.length_variance.max()) < 1e-12


def test_no_step_where_angles_wrap():
    angle = torch.full((1, 1, 9, 9), math.pi - 0.1, dtype=torch.float64)
    angle[..., ::2, :] = -math.pi + 0.1  # 0.2 apart, over the seam
    velocity = 5 * torch.cat((angle.cos(), angle.sin()), 1)
    result = estimate(velocity, window=9, stride=9)
    share = 5 / 9  # of the rows that have the second angle
    assert float(result.angle_variance[0, 0, 0, 0]) < 0.04 * 0.25 + 1e-9
    middle = estimate_motion([motions(velocity)], 0.1, 9, 1).angle_variance[0, 0, 4, 4]
    assert float(middle) == pytest.approx(0.04 * share * (1 - share))


@pytest.mark.parametrize("mode", ["relative", "double_angle"])
def test_variance_of_two_directions(mode):
    half = math.radians(40)
    velocity = uniform(5 * math.cos(half), 5 * math.sin(half))
    velocity[:, 1, :, ::2] *= -1
    result = estimate(velocity, window=4, mode=mode, stride=1)
    # Equally many of both: the mean lies between, 40 degrees from each.
    assert float(result.angle_variance[0, 0, 5, 5]) == pytest.approx(half**2, rel=1e-6)
    assert float(result.angle[0, 0, 5, 5]) == pytest.approx(0, abs=1e-9)


def test_mean_and_variance_of_the_length():
    velocity = uniform(4.0, 0.0)
    velocity[:, 0, :, ::2] = 8.0
    result = estimate(velocity, window=4, stride=1)
    assert float(result.length[0, 0, 5, 5]) == pytest.approx(6)
    assert float(result.length_variance[0, 0, 5, 5]) == pytest.approx(4)


def test_still_samples_count_in_the_share_only():
    velocity = uniform(4.0, 0.0)
    velocity[..., ::4] = 0
    result = estimate(velocity, window=4, stride=1)
    assert float(result.share[0, 0, 5, 5]) == pytest.approx(0.75)
    assert float(result.length[0, 0, 5, 5]) == pytest.approx(4)
    assert float(result.length_variance[0, 0, 5, 5]) == pytest.approx(0, abs=1e-9)


def test_a_still_pixel_refers_to_the_longest_motion_around_it():
    velocity = torch.zeros(1, 2, 9, 9, dtype=torch.float64)
    velocity[0, :, 4, 3] = torch.tensor([0.0, 2.0])
    velocity[0, :, 4, 5] = torch.tensor([9.0, 0.1])
    result = estimate_motion([motions(velocity)], 0.1, 3, 1)
    # Against the longest, 0 and nearly +90 degrees: its mean is +45, not −45.
    assert float(result.angle[0, 0, 4, 4]) == pytest.approx(
        (math.atan2(0.1, 9) + math.pi / 2) / 2, abs=1e-9
    )
    assert float(result.share[0, 0, 4, 4]) == pytest.approx(2 / 9)


def test_what_lies_behind_does_not_count():
    velocity = torch.zeros(1, 2, 9, 9, dtype=torch.float64)
    velocity[0, 0, :, :4] = 6.0

    def share(depth_of_moving):
        depth = torch.full((1, 1, 9, 9), 2.0, dtype=torch.float64)
        depth[..., :4] = depth_of_moving
        result = estimate_motion([motions(velocity, depth)], 0.1, 5, 1)
        return float(result.share[0, 0, 4, 5]), bool(result.active[0, 0, 4, 5])

    assert share(1.0) == (pytest.approx(0.2), True)
    assert share(2.0) == (pytest.approx(0.2), True)
    assert share(2.1) == (pytest.approx(0.5 * 5 / (0.5 * 5 + 20)), True)
    assert share(2.3) == (0.0, False)


def test_one_estimate_for_each_block_and_windows_of_even_size():
    velocity = torch.zeros(1, 2, 8, 8, dtype=torch.float64)
    velocity[0, 0, 5, 5] = 3.0
    active = estimate_motion([motions(velocity)], 0.1, 3, 2).active[0, 0]
    expected = torch.zeros(8, 8, dtype=torch.bool)
    expected[4:8, 4:8] = True  # seen from (4, 4), (4, 6), (6, 4) and (6, 6)
    assert torch.equal(active, expected)
    even = estimate_motion([motions(velocity)], 0.1, 2, 1).active[0, 0]
    assert even.nonzero().tolist() == [[4, 4], [4, 5], [5, 4], [5, 5]]


def test_nothing_moves():
    result = estimate(uniform(0.0, 0.0))
    assert not bool(result.active.any())
    assert all(float(plane.abs().max()) == 0 for plane in result[:5])


def test_samples_are_put_together():
    one, two = uniform(4.0, 0.0), uniform(8.0, 0.0)
    both = estimate_motion([motions(one), motions(two)], 0.1, 5, 2)
    assert float(both.length.mean()) == pytest.approx(6)
    assert float(both.length_variance.mean()) == pytest.approx(4)


@pytest.mark.parametrize("mode", ["relative", "double_angle"])
def test_gradcheck(mode):
    generator = torch.Generator().manual_seed(3)
    velocity = 4 * torch.randn(1, 2, 6, 7, generator=generator, dtype=torch.float64)
    depth = 1 + 0.1 * torch.rand(1, 1, 6, 7, generator=generator, dtype=torch.float64)
    moving = (torch.rand(1, 1, 6, 7, generator=generator) < 0.7).double()
    extent = torch.tensor(0.2, dtype=torch.float64)

    def run(v, z, e):
        return estimate_motion([motions(v, z, moving)], e, 3, 2, mode)[:5]

    leaves = [t.clone().requires_grad_() for t in (velocity, depth, extent)]
    assert torch.autograd.gradcheck(run, leaves, eps=1e-7, atol=1e-5, fast_mode=True)
    assert not torch.equal(run(*leaves)[2], run(-velocity[:, [1, 0]], depth, extent)[2])
