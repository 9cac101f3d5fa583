import pytest
import torch

from torchblur.ops.points import (
    flat,
    nearest_index,
    per_point,
    points_where,
    put,
    take,
    total,
    unflat,
)


def some_points():
    mask = torch.zeros(2, 1, 3, 4, dtype=torch.bool)
    mask[0, 0, 1, 2] = mask[1, 0, 0, 0] = mask[1, 0, 2, 3] = True
    return mask, points_where(mask)


def test_positions_of_the_listed_pixels():
    _, points = some_points()
    assert points.number == 3
    assert points.place.tolist() == [6, 12, 23]
    assert (points.x.tolist(), points.y.tolist()) == ([[2.0, 0.0, 3.0]], [[1.0, 0.0, 2.0]])
    assert points.first.tolist() == [[0, 12, 12]]
    assert points.shape == (2, 3, 4)
    few = points.among(torch.tensor([[True, False, True]]))
    assert (few.place.tolist(), few.y.tolist()) == ([6, 23], [[1.0, 2.0]])


def test_flat_and_back():
    planes = torch.rand(2, 5, 3, 4)
    assert flat(planes).shape == (5, 24)
    assert torch.equal(unflat(flat(planes), (2, 3, 4)), planes)


def test_take_and_put():
    mask, points = some_points()
    planes = torch.rand(2, 5, 3, 4)
    taken = take(planes, points)
    assert torch.equal(taken[:, 1], planes[1, :, 0, 0])
    assert torch.equal(put(taken, points), planes * mask)
    rest = torch.rand(2, 5, 3, 4)
    assert torch.equal(put(taken, points, rest), torch.where(mask, planes, rest))


def test_a_parameter_for_each_pixel():
    _, points = some_points()
    like = torch.zeros(())
    assert float(per_point(2.5, points, like)) == 2.5
    batch = torch.tensor([1.0, 2.0]).view(2, 1, 1, 1)
    assert per_point(batch, points, like).tolist() == [[1.0, 2.0, 2.0]]
    plane = torch.arange(12.0).view(1, 1, 3, 4)
    assert per_point(plane, points, like).tolist() == [[6.0, 0.0, 11.0]]


@pytest.mark.parametrize(
    ("x", "y", "column", "row"),
    [(0.4, 1.6, 0, 2), (-7.0, 1.0, 0, 1), (9.0, 9.0, 3, 2), (0.5, 1.5, 0, 2), (1.5, 2.5, 2, 2)],
)
def test_nearest_pixel_stays_inside_its_own_image(x, y, column, row):
    _, points = some_points()
    given = torch.full((1, 3), x), torch.full((1, 3), y)
    index, near_x, near_y = nearest_index(*given, points.inputs())
    assert index.tolist() == [row * 4 + column, 12 + row * 4 + column, 12 + row * 4 + column]
    assert near_x.unique().tolist() == [column]
    assert near_y.unique().tolist() == [row]


def test_totals_of_several_gathers():
    parts = [(torch.ones(1, 2), torch.full((3, 2), 2.0)), (torch.ones(1, 2), torch.ones(3, 2))]
    first, second = total(parts)
    assert float(first.sum()) == 4
    assert float(second.sum()) == 18
    assert total(parts[:1])[1] is parts[0][1]
