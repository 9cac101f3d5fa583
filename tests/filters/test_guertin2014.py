import pytest
import torch

from torchblur.filters.guertin2014 import Guertin2014Blur, guertin2014
from torchblur.frame import Frame
from torchblur.testing.contract import FilterContract
from torchblur.testing.frames import moving_square


class TestGuertin2014(FilterContract):
    filter_class = Guertin2014Blur
    function = staticmethod(guertin2014)
    plain = {"noise": "none"}
    acts_with = {
        "background_depth": {"background": "revealed"},
        "soft_depth_extent": {"depth_compare": "absolute"},
        "early_out": {"tile_size": 2},
        "tau": {"tile_size": 8},
        "stochastic_tiles": {"tile_size": 8},
        "neighbor_culling": {"tile_size": 8},
    }


def test_the_defaults_are_those_of_the_paper():
    config = Guertin2014Blur().config
    settings = [getattr(config, n) for n in ("num_samples", "tile_size", "tau", "kappa", "eta")]
    assert settings == [35, 40, 1.0, 40.0, 0.95]
    assert (config.gamma, config.phi) == (1.5, 27.0)


def test_layers_for_debug_views():
    frame = moving_square()
    layers = Guertin2014Blur(tile_size=8, sample_assignment="variance").layers(frame)
    assert layers["tile_max"].shape == (1, 2, 3, 4)
    assert layers["neighbor_max"].shape == (1, 2, 3, 4)
    assert layers["tile_variance"].shape == (1, 1, 3, 4)
    assert layers["weight"].shape == layers["luma"].shape == (1, 1, 21, 27)
    assert 0 <= float(layers["tile_variance"].min()) <= float(layers["tile_variance"].max()) <= 1


def test_checkerboard_luma_only_where_there_is_blur():
    frame = moving_square(40, 60)
    velocity = frame.velocity.clone()
    velocity[..., 30:] = 0
    frame = Frame(color=frame.color, velocity=velocity, depth=frame.depth)
    checkered = Guertin2014Blur(tile_size=10).layers(frame)["luma"].detach()
    true = Guertin2014Blur(tile_size=10, luma="true").layers(frame)["luma"].detach()
    assert set(checkered[..., :20].unique().tolist()) == {0.0, 1.0}
    # a tile away from the last moving one nothing can blur
    assert torch.equal(checkered[..., 50:], true[..., 50:])
    expected = (frame.color * torch.tensor([0.2126, 0.7152, 0.0722]).view(1, 3, 1, 1)).sum(1)
    assert torch.allclose(true[0, :, :, 50:], expected[..., 50:].sqrt(), atol=1e-4)


def test_eight_bits_change_little_and_pass_the_gradient():
    frame = moving_square()
    velocity = frame.velocity.clone().requires_grad_()
    frame = Frame(color=frame.color, velocity=velocity, depth=frame.depth)
    exact = Guertin2014Blur(noise="none")(frame)
    coarse = Guertin2014Blur(noise="none", velocity_encoding="uint8")(frame)
    assert 0 < float((exact - coarse).detach().abs().mean()) < 0.05
    coarse.square().sum().backward()
    assert float(velocity.grad.abs().sum()) > 0


def test_thin_feature_keeps_its_color_for_any_number_of_taps():
    # Guertin 2014, section 4.3: the center weight scales with N, so that a thin still pole before
    # a moving background does not fade as N grows.
    color = torch.zeros(1, 3, 40, 80)
    color[..., 40:42] = 1
    velocity = torch.zeros_like(color[:, :2])
    velocity[:, 0] = 40
    velocity[..., 40:42] = 0
    depth = torch.full_like(color[:, :1], 10.0)
    depth[..., 40:42] = 2
    frame = Frame(color=color, velocity=velocity, depth=depth)
    pole = [
        float(Guertin2014Blur(num_samples=n, noise="none")(frame)[0, 0, 20, 40].detach())
        for n in (9, 35, 101)
    ]
    assert max(pole) - min(pole) < 0.1
    assert min(pole) > 0.5


@pytest.mark.slow
def test_number_of_taps_and_size_compile_nothing_anew():
    from torch._dynamo.utils import counters

    def run(frame, **params):
        with torch.no_grad():
            Guertin2014Blur(None, engine="compiled", **params)(frame)

    run(moving_square(30, 40), num_samples=5)
    run(moving_square(34, 50), num_samples=7)
    compiled = counters["stats"]["unique_graphs"]
    run(moving_square(23, 61), num_samples=9, kappa=11.0, third_gain=3.0)
    run(moving_square(52, 33), num_samples=17, tile_size=13, shutter=0.9)
    assert counters["stats"]["unique_graphs"] == compiled > 0
