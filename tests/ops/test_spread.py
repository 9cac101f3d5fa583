import pytest
import torch

from torchblur.ops.spread import TapPair, depth_shares, mirror, spread_weight


def numbers(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_depth_shares_add_up_to_one():
    sample = torch.linspace(0.1, 9, 50, dtype=torch.float64)
    for softness in (0.0, 0.3):
        for relative in (False, True):
            shares = depth_shares(numbers(4.0), sample, 0.7, relative=relative, softness=softness)
            assert torch.allclose(shares.foreground + shares.background, torch.ones_like(sample))


def test_depth_shares_by_hand():
    # bg = sat(½ + κ (Z_S − Z_p))
    shares = depth_shares(numbers(5.0), numbers(5.0, 5.2, 4.8, 9.0, 1.0), 2.0)
    assert shares.background.tolist() == pytest.approx([0.5, 0.9, 0.1, 1, 0])
    level = depth_shares(numbers(5.0), numbers(5.0, 4.8), 2.0, level=1.0)
    assert level.foreground.tolist() == pytest.approx([0, 0.4])
    relative = depth_shares(numbers(5.0), numbers(4.0, 6.0), 1.0, relative=True)
    assert relative.background.tolist() == pytest.approx([0.25, 0.7])


def test_spread_weight_by_hand():
    distance, reach = numbers(0.5, 0.5, 2.5, 3.5, 4.5), numbers(0.0, 3.0, 3.0, 3.0, 3.0)
    slides = spread_weight(distance, reach)
    assert slides.tolist() == pytest.approx([0.5, 1, 1, 0.5, 0])
    zero = spread_weight(distance, reach, form="static_zero")
    assert zero.tolist() == pytest.approx([0, 1, 1, 0.5, 0])
    other = spread_weight(distance, reach, offset=2.0, slope=0.4)
    assert other.tolist() == pytest.approx([0.6, 1, 1, 0.6, 0.2])


@pytest.mark.parametrize("form", ["slides", "static_zero"])
def test_gradients_of_the_weights(form):
    args = [numbers(2.6, 3.4, 3.7), numbers(3.0), numbers(1.1), numbers(0.7)]
    args = [a.requires_grad_() for a in args]
    assert torch.autograd.gradcheck(
        lambda d, r, o, s: spread_weight(d, r, offset=o, slope=s, form=form), args
    )
    depths = [numbers(5.0), numbers(4.9, 5.1), numbers(2.0), numbers(0.4)]
    depths = [d.requires_grad_() for d in depths]
    assert torch.autograd.gradcheck(
        lambda p, s, k, level: tuple(depth_shares(p, s, k, level=level)), depths
    )


# depths (later, earlier), lengths (later, earlier) and the weights 1 and 2 become:
CASES = [
    ((2, 1), (3, 4), (2, 2), (2, 2)),  # the earlier tap is nearer and faster
    ((1, 2), (4, 3), (1, 1), (1, 1)),  # the later one
    ((1, 2), (3, 4), (1, 2), (1, 2)),  # nearer and slower
    ((2, 1), (4, 3), (1, 2), (1, 2)),
    ((1, 1), (4, 3), (1, 1), (1, 2)),  # level and faster: a tie
    ((1, 1), (3, 4), (1, 2), (1, 2)),
    ((1, 1), (3, 3), (1, 1), (1, 2)),
]


@pytest.mark.parametrize(("depths", "lengths", "ports", "strict"), CASES)
def test_mirror(depths, lengths, ports, strict):
    pairs = [TapPair(*(numbers(v) for v in p)) for p in (depths, lengths)]
    weights = tuple((numbers(v), numbers(10 * v)) for v in (1, 2))
    for rule, expected in (("ports", ports), ("strict", strict), ("none", (1, 2))):
        both = mirror(weights, *pairs, rule)
        assert [tuple(w.item() for w in planes) for planes in both] == [
            (v, 10 * v) for v in expected
        ]
