import pytest
import torch

from torchblur.ops.tiles import (
    neighbor_max,
    neighbor_min,
    tile_lookup,
    tile_max,
    tile_min,
    tile_offset,
    tile_variance,
)
from torchblur.ops.velocity import length


@pytest.mark.parametrize("tile_size", [1, 3, 4, 7, 40])
@pytest.mark.parametrize("size", [(12, 16), (13, 9), (1, 1)])
def test_tile_max_equals_a_loop(size, tile_size):
    height, width = size
    velocity = torch.randn(2, 2, height, width)
    tiles = tile_max(velocity, tile_size)
    assert tiles.shape == (2, 2, -(-height // tile_size), -(-width // tile_size))
    for b in range(2):
        for ty in range(tiles.shape[2]):
            for tx in range(tiles.shape[3]):
                block = velocity[
                    b,
                    :,
                    ty * tile_size : (ty + 1) * tile_size,
                    tx * tile_size : (tx + 1) * tile_size,
                ].flatten(1)
                expected = block[:, block.square().sum(0).argmax()]
                assert torch.equal(tiles[b, :, ty, tx], expected)


def test_tile_max_passes_the_gradient_to_the_longest():
    velocity = torch.randn(1, 2, 6, 6, requires_grad=True)
    tile_max(velocity, 3).sum().backward()
    assert int((velocity.grad != 0).any(1).sum()) == 4


def test_neighbor_max_equals_a_loop():
    tiles = torch.randn(1, 2, 5, 6)
    around = neighbor_max(tiles)
    for y in range(5):
        for x in range(6):
            block = tiles[0, :, max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].flatten(1)
            assert torch.equal(around[0, :, y, x], block[:, block.square().sum(0).argmax()])


@pytest.mark.parametrize(
    ("offset", "velocity", "reaches"),
    [
        ((1, 1), (5.0, 5.0), True),
        ((1, 1), (-5.0, -5.0), True),
        ((1, 1), (5.0, -5.0), False),
        ((1, 1), (5.0, 0.5), True),
        ((1, 1), (5.0, 0.0), False),
        ((1, 1), (0.0, 5.0), False),
        ((-1, 1), (5.0, -2.0), True),
        ((-1, 1), (5.0, 2.0), False),
        ((1, 0), (0.0, 5.0), True),
        ((0, -1), (5.0, 0.0), True),
    ],
)
def test_culling_of_diagonal_tiles(offset, velocity, reaches):
    tiles = torch.zeros(1, 2, 3, 3)
    tiles[0, :, 1, 1] = torch.tensor([0.0, 1.0])
    tiles[0, :, 1 + offset[1], 1 + offset[0]] = torch.tensor(velocity)
    middle = neighbor_max(tiles, cull=True)[0, :, 1, 1]
    assert torch.equal(middle, torch.tensor(velocity if reaches else (0.0, 1.0)))
    assert torch.equal(neighbor_max(tiles)[0, :, 1, 1], torch.tensor(velocity))


def test_variance_of_known_tiles():
    same = torch.tensor([3.0, 0.0]).view(1, 2, 1, 1).expand(1, 2, 3, 3)
    assert float(tile_variance(same).abs().max()) < 1e-6
    assert float(tile_variance(torch.cat((-same[..., :1], same[..., 1:]), 3)).abs().max()) < 1e-6
    cross = same.clone()
    cross[0, :, 1, 1] = torch.tensor([0.0, 9.0])
    # the middle agrees with itself only: 1 - 1/9
    assert float(tile_variance(cross)[0, 0, 1, 1]) == pytest.approx(8 / 9, abs=1e-6)
    # a corner sees four tiles, one of which is crossed
    assert float(tile_variance(cross)[0, 0, 0, 0]) == pytest.approx(1 / 4, abs=1e-6)
    still = cross.clone()
    still[0, :, 0] = 0
    assert float(tile_variance(still)[0, 0, 1, 1]) == pytest.approx(5 / 6, abs=1e-6)
    assert float(tile_variance(still)[0, 0, 0, 0]) == 0


def test_lookup_takes_each_pixel_to_its_tile():
    tiles = torch.arange(6.0).view(1, 1, 2, 3)
    like = torch.zeros(1, 3, 7, 11)
    expected = tiles.repeat_interleave(4, 2).repeat_interleave(4, 3)[..., :7, :11]
    assert torch.equal(tile_lookup(tiles, like, 4), expected)
    smooth = tile_lookup(tiles, like, 4, bilinear=True)
    assert float(smooth[0, 0, 0, 4]) == pytest.approx(0.625)  # px 4.5, tile centers at 2 and 6


def test_offsets_stray_at_edges_only_and_never_diagonally():
    like = torch.zeros(1, 1, 40, 40)
    for noise in (0.0, 0.999):
        offset = tile_offset(like, torch.full((1, 1, 1, 1), noise), 10, 1.0)
        assert float(offset.abs().amin(1).max()) == 0
        tiles = torch.arange(16.0).view(1, 1, 4, 4)
        strayed = tile_lookup(tiles, like, 10, offset) != tile_lookup(tiles, like, 10)
        position = torch.arange(40) % 10
        middle = (position >= 3) & (position <= 6)
        assert not strayed[0, 0][middle][:, middle].any()
        assert strayed.any()


def test_half_of_the_pixels_at_an_edge_see_the_other_tile():
    like = torch.zeros(1, 1, 4, 400)
    noise = torch.rand(1, 1, 4, 400)
    offset = tile_offset(like, noise, 200, 1.0)
    tiles = torch.tensor([0.0, 1.0]).view(1, 1, 1, 2)
    edge = tile_lookup(tiles, like, 200, offset)[0, 0, :, 190:200]
    along_x = (torch.arange(4)[:, None] + torch.arange(190, 200)) % 2 == 0
    assert 0.2 < float(edge[along_x].mean()) < 0.75
    assert float(length(offset).max()) <= 0.5 + 1e-5


@pytest.mark.parametrize("size", [(1, 1), (8, 12), (9, 13), (3, 40)])
def test_tile_min_is_the_least_of_what_lies_in_the_tile(size):
    lengths = torch.rand(2, 1, *size)
    tiles = tile_min(lengths, 4)
    expected = [
        [lengths[1, 0, y : y + 4, x : x + 4].min().item() for x in range(0, size[1], 4)]
        for y in range(0, size[0], 4)
    ]
    assert tiles[1, 0].tolist() == expected
    assert tile_min(lengths, 64).shape == (2, 1, 1, 1)


def test_neighbor_min_by_hand():
    tiles = torch.tensor([[5.0, 4, 3, 9, 9], [6, 7, 8, 9, 2]])
    around = neighbor_min(tiles[None, None])[0, 0].tolist()
    assert around == [[4, 3, 3, 2, 2], [4, 3, 3, 2, 2]]
