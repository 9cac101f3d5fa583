import torch

from torchblur.ops.points import points_where, take
from torchblur.ops.reproject import FAILED, Search, reproject

SIZE = (20, 30)


def planes(vx, vy):
    return torch.tensor([vx, vy], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, *SIZE).clone()


def run(velocity, past, weight=None, **search):
    points = points_where(torch.ones(1, 1, *SIZE, dtype=torch.bool), torch.float64)
    weight = torch.ones(1, 1, *SIZE, dtype=torch.float64) if weight is None else weight
    found = reproject(points, take(velocity, points), past, weight, Search(**search))
    shape = (20, 30)
    return (
        found.points.x.reshape(shape),
        found.points.y.reshape(shape),
        found.outcome.reshape(shape),
    )


def test_uniform_motion_is_found_at_once():
    x, y, outcome = run(planes(4.0, -2.0), planes(4.0, -2.0))
    assert float(outcome[5, 9]) == 1
    assert (float(x[5, 9]), float(y[5, 9])) == (5.0, 7.0)
    assert bool((outcome[:, :4] == FAILED).all())  # they were outside the image
    assert bool((outcome[18:] == FAILED).all())


def test_a_miss_below_the_threshold_is_taken_as_it_is():
    # |δ| is half the difference of the velocities: 0.9 px.
    x, _, outcome = run(planes(6.0, 0.0), planes(4.2, 0.0))
    assert float(outcome[5, 20]) == 1
    assert float(x[5, 20]) == 14
    _, _, strict = run(planes(6.0, 0.0), planes(4.2, 0.0), accept=0.8, iterations=1)
    assert float(strict[5, 20]) == FAILED


def test_the_second_evaluation_moves_by_the_miss():
    # u_p = 6 and u_q = 2: δ = (p − 3) − (p − 6 + 1) = 2, after which q = p − 4 misses nothing.
    velocity, past = planes(6.0, 0.0), planes(2.0, 0.0)
    x, _, outcome = run(velocity, past)
    assert float(outcome[5, 20]) == 2
    assert float(x[5, 20]) == 16
    assert float(run(velocity, past, iterations=1)[2][5, 20]) == FAILED


def test_a_great_miss_ends_the_search():
    # δ = (9 + 9) / 2 = 9 px: more than both thresholds only if the motion is shorter.
    velocity, past = planes(9.0, 0.0), planes(-9.0, 0.0)
    assert float(run(velocity, past, cancel=1.0, iterations=8)[2][5, 25]) > 0  # |u_p| = 9 allows it
    short = planes(5.0, 0.0)  # δ = 7
    assert float(run(short, past, cancel=6.0, iterations=8)[2][5, 25]) == FAILED
    assert float(run(short, past, cancel=8.0, iterations=8)[2][5, 22]) > 1


def test_nothing_is_found_where_nothing_moved():
    weight = torch.ones(1, 1, *SIZE, dtype=torch.float64)
    weight[..., 10] = 0
    _, _, outcome = run(planes(4.0, 0.0), planes(4.0, 0.0), weight)
    assert bool((outcome[:, 14] == FAILED).all())
    assert bool((outcome[:, 15] == 1).all())


def test_a_threshold_per_pixel():
    points = points_where(torch.ones(1, 1, *SIZE, dtype=torch.bool), torch.float64)
    accept = torch.where(points.x < 15, 0.5, 1.0)
    weight = torch.ones(1, 1, *SIZE, dtype=torch.float64)
    velocity = take(planes(6.0, 0.0), points)
    found = reproject(points, velocity, planes(4.2, 0.0), weight, Search(1, accept))
    outcome = found.outcome.reshape(20, 30)
    assert bool((outcome[:, 6:15] == FAILED).all())
    assert bool((outcome[:, 15:] == 1).all())
