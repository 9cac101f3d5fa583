import pytest
import torch

from torchblur.ops.raymask import edge_strength, ray_mask, reaches, uncovered


def plane(value, height=20, width=48):
    return torch.full((1, 1, height, width), float(value))


def motion(x, y=0.0, height=20, width=48):
    return torch.tensor([x, y]).view(1, 2, 1, 1).expand(1, 2, height, width)


def step(columns=(16, 36), front=2.0, back=6.0):
    """An object, number 7, over some columns before a background, number 3."""
    depth, number = plane(back), plane(3).int()
    depth[..., columns[0] : columns[1]] = front
    number[..., columns[0] : columns[1]] = 7
    return depth, number


def test_sobel_of_a_ramp():
    # A slope of one gives 16 · 8: (1 4 6 4 1) adds up to 16, (−1 −2 0 2 1) · x to 8.
    y, x = torch.meshgrid(torch.arange(9.0), torch.arange(11.0), indexing="ij")
    depth = (5 + 0.3 * x + 0.4 * y)[None, None]
    inner = (..., slice(2, -2), slice(2, -2))
    expected = 128 * 0.5 / depth
    assert torch.allclose(edge_strength(depth)[inner], (1 - 1 / (1 + expected))[inner])
    assert torch.allclose(
        edge_strength(depth, depth_gain=0.01)[inner], (1 - 1 / (1 + 0.01 * expected))[inner]
    )
    normal = torch.cat((0.1 * x[None, None], 0.2 * y[None, None], plane(1, 9, 11)), 1)
    got = edge_strength(plane(4, 9, 11), normal, normal_gain=0.5)
    slope = 0.5 * 128 * (0.1**2 + 0.2**2) ** 0.5
    assert torch.allclose(got[inner], torch.tensor(1 - 1 / (1 + slope)), atol=1e-6)


def test_sobel_of_a_step():
    depth, _ = step()
    strength = edge_strength(depth)
    x = 1 / (1 - strength[0, 0, 10]) - 1
    # 48 · (6 − 2) beside the step and 16 · (6 − 2) one further, over the depth of the pixel
    assert x[14:18].tolist() == pytest.approx([64 / 6, 192 / 6, 192 / 2, 64 / 2], rel=1e-3)
    assert x[[13, 18]].tolist() == pytest.approx([0, 0], abs=1e-5)
    assert torch.allclose(edge_strength(1000 * depth), strength, atol=1e-5)  # of any unit


def test_depth_of_the_sky_gives_finite_edges_with_gradients():
    depth, _ = step(back=1e10)
    depth.requires_grad_()
    strength = edge_strength(depth)
    assert strength.min() >= 0
    assert strength.max() <= 1
    assert float(strength[0, 0, 5, 17]) == 1
    strength.sum().backward()
    assert torch.isfinite(depth.grad).all()


def test_uncovered_by_hand():
    depth, number = step()
    # To the left by 5 px: the first five columns of the object leave it.
    got = uncovered(motion(-5.0), depth, number, 0.1)
    assert got[0, 0, 3].nonzero().flatten().tolist() == [16, 17, 18, 19, 20]
    assert uncovered(motion(5.0), depth, number, 0.1)[0, 0, 3].nonzero().flatten().tolist() == [
        31,
        32,
        33,
        34,
        35,
    ]
    # the other must be deeper by the extent, be another object, and lie in the image
    assert uncovered(motion(-5.0), depth, number, 4.5).sum() == 0
    assert uncovered(motion(-5.0), depth, torch.full_like(number, 7), 0.1).sum() == 0
    assert uncovered(motion(-40.0), depth, number, 0.1).sum() == 0
    assert uncovered(motion(0.0), depth, number, 0.1).sum() == 0
    # without numbers the depths decide
    assert torch.equal(uncovered(motion(-5.0), depth, None, 0.1), got)
    assert torch.equal(
        uncovered(motion(-5.0), -depth + 10, None, 0.1)[..., 21:36] > 0, got[..., 21:36] > 0
    )


def test_reach_by_hand():
    mask = plane(0)
    mask[..., 10] = 1
    got = reaches(mask, motion(-6.0), 6)
    assert got[0, 0, 0].nonzero().flatten().tolist() == [10, 11, 12, 13, 14, 15]
    # three samples at 0, 2 and 4 px leave gaps
    assert reaches(mask, motion(-6.0), 3)[0, 0, 0].nonzero().flatten().tolist() == [10, 12, 14]
    assert reaches(mask, motion(0.0), 6).sum() == 0  # nothing moves
    edge = plane(0)
    edge[..., 0] = 1
    assert reaches(edge, motion(-6.0), 6)[0, 0, 0].nonzero().flatten().tolist() == [
        0,
        1,
        2,
        3,
        4,
        5,
    ]
    # of two samples the second may lie outside, where nothing is found
    assert reaches(edge, motion(-6.0), 2)[0, 0, 0].nonzero().flatten().tolist() == [0, 3]
    assert float(reaches(0.25 * mask, motion(-6.0), 6).max()) == 0.25


@pytest.mark.parametrize("way", [(-12.0, 0.0), (12.0, 0.0), (-7.3, 4.0), (3.0, 0.0)])
def test_mask_holds_all_that_is_uncovered(way):
    depth, number = step()
    displacement = motion(*way)
    candidates = uncovered(displacement, depth, number, 0.1)
    found = ray_mask(displacement, edge_strength(depth), candidates, 0.9, 40)
    # The truth: pixels of the object that leave it on their way.
    rows, columns = torch.meshgrid(torch.arange(20), torch.arange(48), indexing="ij")
    truth = torch.zeros(20, 48, dtype=torch.bool)
    for i in range(201):
        x = (columns + way[0] * i / 200).round().long()
        y = (rows + way[1] * i / 200).round().long()
        inside = (x >= 0) & (x < 48) & (y >= 0) & (y < 20)
        truth |= inside & (number[0, 0, y.clamp(0, 19), x.clamp(0, 47)] == 3)
    truth &= number[0, 0] == 7
    away = rows + 2 * way[1] <= 19  # the edge that it meets ends in the image
    mask = found.mask[0, 0] > 0
    assert bool(mask[truth & away].all())
    # Edges are two pixels deep, so that the mask may hold two columns more, and none of the rest.
    extra = mask & ~truth
    assert int(extra.sum(1).max()) <= 2
    assert not bool((mask & (number[0, 0] == 3)).any())


def test_threshold_drops_what_is_no_edge():
    depth, number = step(front=5.5)  # a step of 9 %: x = 48 · 0.5 / 5.5, x_n = 0.81
    displacement = motion(-5.0)
    candidates = uncovered(displacement, depth, number, 0.1)
    strength = edge_strength(depth)
    assert ray_mask(displacement, strength, candidates, 0.9, 10).mask.sum() == 0
    assert ray_mask(displacement, strength, candidates, 0.8, 10).mask.sum() > 0


def test_soft_thresholds_pass_gradcheck():
    depth, number = step()
    depth = (depth + 0.3 * torch.rand_like(depth)).double()[..., 4:10, 12:24]
    number = number[..., 4:10, 12:24]
    way = motion(-3.0, 0.0, 6, 12).double()

    def run(depth, extent, level):
        candidates = uncovered(way, depth, number, extent, softness=0.7)
        return ray_mask(way, edge_strength(depth), candidates, level, 4, softness=0.3).mask

    inputs = [depth, torch.tensor(2.5).double(), torch.tensor(0.9).double()]
    inputs = [t.clone().requires_grad_() for t in inputs]
    assert torch.autograd.gradcheck(run, inputs, eps=1e-7, atol=1e-5, rtol=1e-3)
    for grad in torch.autograd.grad(run(*inputs).sum(), inputs):
        assert float(grad.abs().sum()) > 1e-3
