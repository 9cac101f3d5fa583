import pytest
import torch

from torchblur.filters.mcguire2012 import McGuire2012Blur
from torchblur.filters.sousa2013 import Sousa2013Blur, sousa2013
from torchblur.frame import Frame
from torchblur.testing.contract import FilterContract
from torchblur.testing.frames import constant_motion, moving_square


class TestSousa2013(FilterContract):
    filter_class = Sousa2013Blur
    function = staticmethod(sousa2013)
    acts_with = {
        "early_out": {"tile_size": 2},
        "jitter": {"noise": "halton"},
        "seed": {"noise": "halton"},
        "depth_range": {"encoding": "packed"},
    }


def test_one_pass_is_the_filter_of_mcguire_but_for_the_cylinder():
    # Where no third weight counts, the two agree: same taps, same other weights.
    frame = moving_square()
    same = {"third_gain": 0.0, "soft_depth_extent": 0.5, "num_samples": 8, "noise": "none"}
    sousa = Sousa2013Blur(passes=1, **same)(frame)
    mcguire = McGuire2012Blur(skip_middle_tap=False, **same)(frame)
    assert torch.allclose(sousa, mcguire, atol=1e-6)
    assert not torch.allclose(
        Sousa2013Blur(passes=1, **(same | {"third_gain": 2.0}))(frame), sousa, atol=1e-2
    )


def test_the_cylinder_reaches_beyond_the_blur():
    # V = 10 px for all pixels but one with 20, so that seven taps lie 0, ±5, ±10, ±15 px away.
    # cone = 1, ½, 0, 0 and cylinder = sat(1.95 − d / 10) = 1, 1, 0.95, 0.45; f = b = 1.
    color = torch.zeros(1, 3, 9, 61)
    velocity = torch.zeros(1, 2, 9, 61)
    velocity[:, 0] = 40.0
    velocity[:, 0, 0, 0] = 80.0
    color[..., 4, 15] = 1.0
    frame = Frame(color=color, velocity=velocity, depth=torch.full_like(color[:, :1], 3.0))
    params = {"num_samples": 7, "passes": 1, "tile_size": 30, "center_gain": 0.01}
    row = Sousa2013Blur(**params)(frame).detach()[0, 0, 4]
    weights = {5: 2 * 0.5 + 2, 10: 2 * 0.95**2, 15: 2 * 0.45**2}
    center = 4 + 0.01 / 10
    total = center + 2 * sum(weights.values())
    assert float(row[15]) == pytest.approx(center / total, rel=1e-4)
    for offset, weight in weights.items():
        assert float(row[15 + offset]) == pytest.approx(weight / total, rel=1e-4)
    mcguire = McGuire2012Blur(num_samples=7, tile_size=30, noise="none")(frame).detach()
    assert float(mcguire[0, 0, 4, 30]) == 0  # whose cylinder ends at 1.05


def test_the_second_pass_closes_the_gaps():
    # Noise under a uniform motion of ±14 px, 6 taps: the spacing of the taps is 4 px.
    frame = constant_motion((56.0, 0.0), 8, 120)
    many = Sousa2013Blur(num_samples=127, passes=1)(frame).detach()[..., 30:-30]

    def error(**params):
        result = Sousa2013Blur(color_lookup="bilinear", **params)(frame).detach()[..., 30:-30]
        return float((result - many).abs().mean())

    once, twice, wide = error(passes=1), error(passes=2), error(passes=1, num_samples=12)
    assert twice < 0.75 * once
    assert twice < 1.1 * wide  # 6 + 6 taps against 12


def test_packing_changes_little_and_passes_the_gradient():
    frame = moving_square()
    velocity = frame.velocity.clone().requires_grad_()
    depth = frame.depth.clone().requires_grad_()
    frame = Frame(color=frame.color, velocity=velocity, depth=depth)
    exact = Sousa2013Blur()(frame)
    coarse = Sousa2013Blur(encoding="packed", depth_range=4.0)(frame)
    assert 0 < float((exact - coarse).detach().abs().mean()) < 0.03
    coarse.square().sum().backward()
    assert float(velocity.grad.abs().sum()) > 0
    assert float(depth.grad.abs().sum()) > 0


def test_layers_for_debug_views():
    frame = moving_square()
    layers = Sousa2013Blur(tile_size=8, num_samples=3).layers(frame)
    assert layers["tile_max"].shape == layers["neighbor_max"].shape == (1, 2, 3, 4)
    assert layers["weight"].shape == (1, 1, 21, 27)
    one = Sousa2013Blur(tile_size=8, num_samples=3, passes=1).layers(frame)
    assert torch.equal(layers["first_pass"], one["color"])
    assert not torch.allclose(layers["color"], one["color"], atol=1e-3)
