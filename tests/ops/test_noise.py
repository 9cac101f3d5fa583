import pytest
import torch

from torchblur.ops.noise import checkerboard, dither_2x2, halton, halton_plane, noise_plane


def test_halton_by_hand():
    assert halton(7, 2).tolist() == [1 / 2, 1 / 4, 3 / 4, 1 / 8, 5 / 8, 3 / 8, 7 / 8]
    assert halton(4, 3).tolist() == pytest.approx([1 / 3, 2 / 3, 1 / 9, 4 / 9])


@pytest.mark.parametrize("kind", ["halton", "gradient"])
def test_noise_is_uniform_seeded_and_streams_do_not_correlate(kind):
    like = torch.zeros(1, 3, 70, 90)
    first = noise_plane(kind, like, 0, 0)
    assert first.shape == (1, 1, 70, 90)
    assert float(first.min()) >= 0
    assert float(first.max()) < 1
    assert float(first.mean()) == pytest.approx(0.5, abs=0.02)
    assert float(first.var()) == pytest.approx(1 / 12, abs=0.01)
    assert torch.equal(first, noise_plane(kind, like, 0, 0))
    assert not torch.equal(first, noise_plane(kind, like, 0, 1))
    second = noise_plane(kind, like, 1, 0)
    pair = torch.stack((first.flatten(), second.flatten()))
    assert abs(float(torch.corrcoef(pair)[0, 1])) < 0.15


def test_halton_tile_repeats_every_32_px():
    plane = halton_plane(torch.zeros(1, 1, 64, 64))[0, 0]
    assert torch.equal(plane[:32, :32], plane[32:, 32:])
    assert len(plane[:32, :32].unique()) == 1024


def test_none_is_one_half_and_checkerboard_alternates():
    like = torch.zeros(1, 1, 3, 4)
    assert bool((noise_plane("none", like) == 0.5).all())
    assert checkerboard(like)[0, 0].tolist() == [[0, 1, 0, 1], [1, 0, 1, 0], [0, 1, 0, 1]]


def test_the_dither_of_two_by_two():
    dither = dither_2x2(torch.zeros(1, 3, 3, 4))[0, 0]
    assert dither[:2, :2].tolist() == [[0.25, -0.25], [-0.25, 0.25]]
    assert torch.equal(dither[:, 2:], dither[:, :2])
