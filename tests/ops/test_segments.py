import math

import pytest
import torch

from torchblur.ops.segments import path_distance, path_weight, project, width_of_weights


def numbers(*values):
    return tuple(torch.tensor(float(v), dtype=torch.float64) for v in values)


def weight(dx, dy, vx=10.0, vy=0.0, time=0.5, width=2.0, softness=0.0):
    dx, dy, vx, vy, time, width, softness = numbers(dx, dy, vx, vy, time, width, softness)
    return float(path_weight((dx, dy), (vx, vy), time, width, softness))


def test_share_and_distance_against_the_formula_of_the_paper():
    generator = torch.Generator().manual_seed(0)
    p, q, v = (20 * torch.rand(2, 50, generator=generator, dtype=torch.float64) for _ in range(3))
    time = torch.rand(50, generator=generator, dtype=torch.float64)
    q0, q1 = q - v * time, q + v * (1 - time)
    share = ((p - q0) * (q1 - q0)).sum(0) / (q1 - q0).square().sum(0)
    distance = (p - (q0 + share * (q1 - q0))).norm(dim=0)
    result = project(*(p - q), *v, time)
    assert torch.allclose(result.share, share)
    assert torch.allclose(result.distance, distance)
    ends = q0 + share.clamp(0, 1) * (q1 - q0)
    assert torch.allclose(path_distance(*(p - q), *v, time), (p - ends).norm(dim=0))


def test_the_weight_falls_with_the_distance_to_the_path():
    assert weight(0, 0) == 1
    assert weight(3, 0) == 1
    assert weight(3, 1) == pytest.approx(0.5)
    assert weight(3, 2) == 0
    assert weight(3, 5) == 0
    assert weight(3, 1, width=4.0) == pytest.approx(0.75)


def test_no_weight_beyond_the_ends_of_the_path():
    # Seen at time 0.2 of a path of 10 px: 2 px of it lie behind, 8 px ahead.
    assert weight(7.9, 0, time=0.2) == 1
    assert weight(8.1, 0, time=0.2) == 0
    assert weight(-1.9, 0, time=0.2) == 1
    assert weight(-2.1, 0, time=0.2) == 0


def test_soft_ends():
    for dx in (9.0, -3.0):  # 1 px beyond either end, over 2 px
        assert weight(dx, 0, time=0.2, softness=0.2) == pytest.approx(0.5)
    assert weight(8.0, 0, time=0.2, softness=0.2) == pytest.approx(1)
    assert weight(10.5, 0, time=0.2, softness=0.2) == 0


def test_what_does_not_move_is_a_point():
    share, distance = project(*numbers(3, 4, 0, 0, 0.9))
    assert float(share) == 0.5
    assert float(distance) == pytest.approx(5)
    assert weight(0.5, 0, vx=0.0) == pytest.approx(0.75)


def test_gradients_are_finite_everywhere():
    generator = torch.Generator().manual_seed(0)
    dx, dy = (torch.randint(-2, 3, (200,), generator=generator).double() for _ in range(2))
    v = torch.randint(-2, 3, (2, 200), generator=generator).double().requires_grad_()
    width = torch.full((200,), 1.7, dtype=torch.float64, requires_grad=True)
    time = torch.rand(200, generator=generator, dtype=torch.float64)
    softness = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    total = path_weight((dx, dy), (v[0], v[1]), time, width, softness).sum()
    for grad in torch.autograd.grad(total, [v, width, softness]):
        assert bool(torch.isfinite(grad).all())
        assert bool(grad.any())


def test_width_of_weights():
    (length, angle, beta_l, beta_a) = numbers(0.03, 0.25, 10, 1)
    assert float(width_of_weights(length, angle, beta_l, beta_a)) == pytest.approx(1.25 * 1.3)
    assert float(width_of_weights(length * 50, angle * 50, beta_l, beta_a)) == 4
    assert math.isclose(float(width_of_weights(length * 0, angle * 0, beta_l, beta_a)), 1)
