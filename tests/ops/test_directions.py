import math

import pytest
import torch

from torchblur.ops.directions import secondary_score, tile_directions
from torchblur.ops.tiles import neighbor_max, tile_max


def field(vectors, size=8):
    """One vector per tile of `size` px."""
    tiles = torch.tensor(vectors, dtype=torch.float32).permute(2, 0, 1)[None]
    return tiles.repeat_interleave(size, 2).repeat_interleave(size, 3)


def test_score_by_hand():
    primary = torch.tensor([3.0, 0.0]).view(1, 2, 1, 1)
    for angle, expected in [(0, 0.0), (60, 0.25 * 4), (90, 4.0), (180, 0.0), (120, 0.25 * 4)]:
        turned = math.radians(angle)
        sample = torch.tensor([4 * math.cos(turned), 4 * math.sin(turned)]).view(1, 2, 1, 1)
        assert float(secondary_score(primary, sample)) == pytest.approx(expected, abs=1e-5)
    assert float(secondary_score(torch.zeros(1, 2, 1, 1), primary)) == pytest.approx(3.0)


@pytest.mark.parametrize("reduction", ["exact", "hierarchical"])
@pytest.mark.parametrize("size", [5, 8, 16])
def test_finds_both_directions(reduction, size):
    velocity = field([[(9, 0), (0, 0), (0, 0)], [(0, 0), (0, 0), (1, 5)]], size)
    tiles = tile_directions(velocity, size, reduction=reduction)
    assert tiles.primary.shape == tiles.secondary.shape == (1, 2, 2, 3)
    assert tiles.primary[0, :, 0, 1].tolist() == [9, 0]
    assert tiles.secondary[0, :, 0, 1].tolist() == [1, 5]
    assert tiles.primary[0, :, 1, 2].tolist() == [1, 5]


def test_primary_is_the_neighbor_max_in_both_reductions():
    velocity = torch.randn(2, 2, 37, 50)
    for cull in (False, True):
        expected = neighbor_max(tile_max(velocity, 16), cull=cull)
        for reduction in ("exact", "hierarchical"):
            primary = tile_directions(velocity, 16, reduction=reduction, cull=cull).primary
            assert torch.equal(primary, expected)


def test_exact_scores_at_least_as_high_as_hierarchical():
    velocity = torch.randn(1, 2, 96, 96) * torch.rand(1, 1, 96, 96) ** 4
    exact = tile_directions(velocity, 16)
    steps = tile_directions(velocity, 16, reduction="hierarchical")
    higher = secondary_score(exact.primary, exact.secondary)
    lower = secondary_score(steps.primary, steps.secondary)
    assert bool((higher >= lower - 1e-5).all())
    assert float((higher > lower + 1e-3).float().mean()) > 0.1


def test_culling_leaves_out_diagonal_tiles_that_point_elsewhere():
    velocity = field([[(3, -3), (0, 0)], [(0, 0), (1, 0)]])
    # The upper left tile moves along the other diagonal: it cannot reach the lower right one.
    assert tile_directions(velocity, 8).primary[0, :, 1, 1].tolist() == [3, -3]
    for reduction in ("exact", "hierarchical"):
        tiles = tile_directions(velocity, 8, cull=True, reduction=reduction)
        assert tiles.primary[0, :, 1, 1].tolist() == [1, 0]
        assert tiles.secondary[0, :, 1, 1].norm() < 2


def test_gradient_goes_to_the_selected_vectors():
    velocity = field([[(9, 0), (0, 5)]]).requires_grad_()
    tiles = tile_directions(velocity, 8)
    tiles.secondary[..., 0].sum().backward()
    assert float(velocity.grad[..., 8:].abs().sum()) == 2
    assert float(velocity.grad[..., :8].abs().sum()) == 0
