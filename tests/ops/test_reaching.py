import math

import pytest
import torch

from torchblur.ops import reaching
from torchblur.ops.directions import secondary_score
from torchblur.ops.pixels import all_pixels
from torchblur.ops.reaching import least_along, longest_reaching, reaching_directions
from torchblur.ops.tiles import neighbor_max, tile_max
from torchblur.ops.velocity import clamp_length, length


def met(vector, offset, tile_size, interval):
    """Whether a tile that moves over the interval overlaps the one at an offset, in small steps."""
    begin, end = interval
    times = torch.linspace(begin, end, 4001, dtype=torch.float64)
    away = torch.tensor(offset)[:, None] * tile_size - vector[:, None].double() * times
    return bool((away.abs().amax(0) < tile_size - 1e-6).any())


def loop(tiles, tile_size, longest, interval, score):
    """The best source of each tile by a loop over all pairs, from the definition."""
    best = torch.full(tiles.shape[-2:], -1.0)
    found = torch.zeros_like(tiles)
    swept = clamp_length(tiles, longest)
    height, width = tiles.shape[-2:]
    places = [(y, x) for y in range(height) for x in range(width)]
    for ty, tx in places:
        for sy, sx in places:
            offset = (tx - sx, ty - sy)
            near = max(map(abs, offset)) <= 1
            if not near and not met(swept[0, :, sy, sx], offset, tile_size, interval):
                continue
            value = score((sy, sx), (ty, tx))
            if value >= best[ty, tx]:
                best[ty, tx], found[0, :, ty, tx] = value, tiles[0, :, sy, sx]
    return found


@pytest.mark.parametrize("interval", [(-1.0, 1.0), (0.0, 2.0), (-2.0, 0.0)])
@pytest.mark.parametrize("longest", [9.0, 1000.0])
def test_longest_reaching_equals_a_loop(interval, longest):
    torch.manual_seed(0)
    tiles = torch.randn(1, 2, 7, 8) * torch.tensor([1.0, 4, 12, 30, 1, 2, 5, 0]) * 2
    size = length(tiles)[0, 0]
    expected = loop(tiles, 6, longest, interval, lambda source, _: float(size[source]))
    assert torch.equal(longest_reaching(tiles, 6, longest, interval), expected)


def test_short_motion_is_that_of_the_3x3_tiles():
    tiles = torch.randn(2, 2, 6, 5).clamp(-3, 3)
    assert torch.equal(longest_reaching(tiles, 8, 100.0), neighbor_max(tiles))


def test_parts_of_the_pairs_make_no_difference(monkeypatch):
    tiles = torch.randn(2, 2, 12, 15) * 20
    whole = longest_reaching(tiles, 4, 1000.0)
    monkeypatch.setattr(reaching, "_PAIRS", 1 << 9)
    assert torch.equal(longest_reaching(tiles, 4, 1000.0), whole)
    with all_pixels():
        assert torch.equal(longest_reaching(tiles, 4, 200.0), whole)


def test_batch_equals_single_runs():
    velocity = torch.randn(3, 2, 40, 52) * torch.tensor([1.0, 20.0, 0.0]).view(3, 1, 1, 1)
    together = reaching_directions(velocity, 8, 500.0)
    for index in range(3):
        alone = reaching_directions(velocity[index : index + 1], 8, 500.0)
        assert torch.equal(together.primary[index : index + 1], alone.primary)
        assert torch.equal(together.secondary[index : index + 1], alone.secondary)


def test_second_direction_is_the_best_that_reaches():
    torch.manual_seed(1)
    velocity = torch.randn(1, 2, 24, 28) * 9
    found = reaching_directions(velocity, 4, 1000.0)
    tiles = tile_max(velocity, 4)
    assert torch.equal(found.primary, longest_reaching(tiles, 4, 1000.0))
    # Each is one of the two candidates of some tile, and no tile that reaches has a better one.
    score = secondary_score(found.primary, found.secondary)[0, 0]
    for ty in range(6):
        for tx in range(7):
            primary = found.primary[:, :, ty, tx, None, None]
            for sy in range(6):
                for sx in range(7):
                    vector = tiles[:, :, sy, sx, None, None]
                    if met(vector[0, :, 0, 0], (tx - sx, ty - sy), 4, (-1, 1)):
                        least = float(secondary_score(primary, vector))
                        assert float(score[ty, tx]) >= least - 1e-4


def test_second_direction_comes_from_far_away():
    velocity = torch.zeros(1, 2, 80, 80)
    velocity[..., 40:48, :8] = torch.tensor([60.0, 0.0]).view(1, 2, 1, 1)  # passes the middle
    velocity[..., :8, 40:48] = torch.tensor([0.0, 50.0]).view(1, 2, 1, 1)  # passes it, too
    found = reaching_directions(velocity, 8, 1000.0)
    assert found.primary[0, :, 5, 5].tolist() == [60.0, 0.0]
    assert found.secondary[0, :, 5, 5].tolist() == [0.0, 50.0]
    assert found.secondary[0, :, 5, 2].tolist() == [0.0, 0.0]
    assert found.primary[0, :, 5, 9].tolist() == [0.0, 0.0]  # 72 px away


def test_gradient_goes_to_the_selected_vectors():
    velocity = (torch.randn(1, 2, 16, 16) * 5).requires_grad_()
    found = reaching_directions(velocity, 4, 100.0)
    (found.primary.sum() + found.secondary.sum()).backward()
    assert 0 < int((velocity.grad != 0).any(1).sum()) <= 32


def test_least_along_looks_where_taps_lie():
    values = torch.full((1, 1, 5, 12), 7.0)
    values[..., 2, 9] = 1.0
    tiles = torch.zeros(1, 2, 5, 12)
    tiles[:, 0] = 24.0  # taps of 24 px to both sides, tiles of 8 px
    least = least_along(values, tiles, 8, 100.0)[0, 0]
    seen = [x for x in range(12) if float(least[2, x]) == 1.0]
    assert seen == [6, 7, 8, 9, 10, 11]
    assert float(least[0, 9]) == 7.0
    ahead = least_along(values, tiles, 8, 100.0, (0.0, 2.0))[0, 0]  # leading: taps lie behind
    assert [x for x in range(12) if float(ahead[2, x]) == 1.0] == [8, 9, 10, 11]
    assert math.isfinite(float(ahead.sum()))
