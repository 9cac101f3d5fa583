import pytest
import torch

from torchblur.ops.prefilter import Candidates, Stream, add_candidates, random_candidates


def stream(vx=8.0, size=(9, 24), seed=0, dtype=torch.float64):
    """Noise that moves to the right, seen at time 0.5."""
    generator = torch.Generator().manual_seed(seed)
    color = torch.rand(1, 3, *size, generator=generator, dtype=dtype)
    displacement = torch.zeros(1, 2, *size, dtype=dtype)
    displacement[:, 0] = vx
    time = torch.full((1, 1, *size), 0.5, dtype=dtype)
    return Stream(color, displacement, time, torch.ones_like(time))


def chosen(like, time, jitter=(0.0, 0.0), count=1):
    """Candidates that are all alike."""
    plane = torch.ones(1, 1, *like.shape[-2:], dtype=like.dtype)
    pair = torch.cat((plane * jitter[0], plane * jitter[1]), 1)
    return Candidates((plane * time).repeat(1, count, 1, 1), pair.repeat(1, count, 1, 1))


def test_candidates_come_from_along_the_motion_of_the_3x3_pixels():
    given = stream()
    result = add_candidates(given, chosen(given.color, 0.75), jitter=0.0, distance=2.5)
    # Each of the nine neighbors draws the pixel 8 * 0.25 = 2 to its right.
    y, x = 4, 10
    around = given.color[0, :, y - 1 : y + 2, x + 1 : x + 4].sum((1, 2))
    assert torch.allclose(result[0, :, y, x], (given.color[0, :, y, x] + around) / 10)


def test_a_candidate_counts_only_if_its_path_comes_near():
    given = stream()
    # At time 0.5 the path reaches 4 px to both sides: what is drawn 4 px away (5, 3 for the
    # neighbors) ends 1 px short of the pixel, at it, or beyond.
    y, x = 4, 10
    near = add_candidates(given, chosen(given.color, 1.0), jitter=0.0, distance=0.5)
    row = given.color[0, :, y, x + 3 : x + 5].sum(1)  # own row only: others are 1 px off
    assert torch.allclose(near[0, :, y, x], (given.color[0, :, y, x] + row) / 3)
    wide = add_candidates(given, chosen(given.color, 1.0), jitter=0.0, distance=1.2)
    rows = given.color[0, :, y - 1 : y + 2, x + 3 : x + 5].sum((1, 2)) + given.color[0, :, y, x + 5]
    assert torch.allclose(wide[0, :, y, x], (given.color[0, :, y, x] + rows) / 8)


def test_jitter_shifts_candidates():
    given = stream()
    y, x = 4, 10
    random = chosen(given.color, 0.5, (0.5, -1.0))
    result = add_candidates(given, random, jitter=2.0, distance=10.0)
    around = given.color[0, :, y - 3 : y, x : x + 3].sum((1, 2))  # 1 right, 2 up
    assert torch.allclose(result[0, :, y, x], (given.color[0, :, y, x] + around) / 10)


def test_slow_and_still_pixels_stay_and_give_nothing():
    slow = stream(vx=2.9)
    assert add_candidates(slow, chosen(slow.color, 0.9)) is slow.color
    given = stream()
    still = given.moving.clone()
    still[..., 12:] = 0
    mixed = given._replace(moving=still)
    result = add_candidates(mixed, chosen(given.color, 0.75), jitter=0.0)
    assert torch.equal(result[..., 12:], given.color[..., 12:])
    y, x = 4, 10  # of x + 1 .. x + 3 only x + 1 moves; the neighbor at x + 1 draws x + 3
    taken = given.color[0, :, y - 1 : y + 2, 11].sum(1)
    assert torch.allclose(result[0, :, y, x], (given.color[0, :, y, x] + taken) / 4)


def test_random_numbers_follow_seed_and_stream():
    like = torch.zeros(2, 3, 30, 40)
    one = random_candidates(like, 2, seed=5, stream=1024)
    assert one.times.shape == (1, 2, 30, 40)
    assert one.jitter.shape == (1, 4, 30, 40)
    assert torch.equal(one.times, random_candidates(like, 2, seed=5, stream=1024).times)
    for other in ((6, 1024), (5, 1025), (5, 0)):
        assert not torch.equal(one.times, random_candidates(like, 2, *other).times)
    assert 0 <= float(one.times.min()) < 0.01
    assert 0.99 < float(one.times.max()) < 1
    assert -1 <= float(one.jitter.min()) < -0.99
    assert 0.99 < float(one.jitter.max()) < 1


def test_it_lowers_the_variance_and_keeps_the_mean():
    given = stream(vx=12.0, size=(40, 80))
    result = add_candidates(given, random_candidates(given.color, 2, 0))
    assert float(result.var()) < 0.4 * float(given.color.var())
    assert float(result.mean()) == pytest.approx(float(given.color.mean()), abs=0.01)


def test_gradcheck_and_batches():
    given = stream(size=(5, 9))
    random = random_candidates(given.color, 2, 0)
    assert torch.autograd.gradcheck(
        lambda c: add_candidates(given._replace(color=c), random),
        given.color.clone().requires_grad_(),
        fast_mode=True,
    )
    other = stream(vx=-5.0, size=(5, 9), seed=1)
    both = Stream(*(torch.cat(pair) for pair in zip(given, other, strict=True)))
    single = torch.cat([add_candidates(s, random) for s in (given, other)])
    assert torch.allclose(add_candidates(both, random), single)
