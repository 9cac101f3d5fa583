import pytest
import torch

from torchblur.filters.jimenez2014 import Jimenez2014Blur, jimenez2014
from torchblur.frame import Frame
from torchblur.testing.contract import FilterContract
from torchblur.testing.frames import constant_motion, moving_square


class TestJimenez2014(FilterContract):
    filter_class = Jimenez2014Blur
    function = staticmethod(jimenez2014)
    # "strict" because the ports' rule breaks ties by the order of the taps, that is by the sign.
    plain = {"noise": "none", "mirror_filter": "strict"}
    one_structure = {"tile_classes": False}  # the fast class has a kernel of its own
    acts_with = {
        "background_depth": {"background": "revealed"},
        "early_out": {"tile_size": 2},
        "tile_jitter": {"tile_size": 8},
        "neighbor_culling": {"tile_size": 8},
        "fast_ratio": {"tile_size": 2, "shutter": 0.8},
        "tile_classes": {"tile_size": 2, "shutter": 0.8},
        "seed": {"noise": "gradient"},
    }


def textured(velocity, height=40, width=60, depth=5.0):
    """A frame of noise at one depth; velocity (B, 2, H, W) or a pair, px/frame."""
    frame = constant_motion((0.0, 0.0), height, width)
    motion = torch.as_tensor(velocity, dtype=torch.float32)
    motion = motion.view(1, 2, 1, 1) if motion.ndim == 1 else motion
    plane = torch.as_tensor(depth).expand(1, 1, height, width)
    return Frame(
        color=frame.color, velocity=motion.expand(1, 2, height, width).clone(), depth=plane
    )


@pytest.mark.parametrize("position", ["centered", "leading", "trailing"])
@pytest.mark.parametrize("noise", ["checkerboard", "gradient", "none"])
def test_the_fast_class_is_the_full_one_where_all_moves_alike(position, noise):
    # An optimization: weights are 1 where min == max, whatever the depths.
    waves = 5 + torch.linspace(0, 20, 60).sin().view(1, 1, 1, 60)
    for depth in (5.0, waves):
        frame = textured((13.0, -6.0), depth=depth)
        params = {"shutter_position": position, "noise": noise}
        fast = Jimenez2014Blur(**params).layers(frame)
        full = Jimenez2014Blur(**params, tile_classes=False).layers(frame)
        assert set(fast["tile_class"].unique().tolist()) == {1.0}
        assert set(full["tile_class"].unique().tolist()) == {2.0}
        assert torch.allclose(fast["color"], full["color"], atol=1e-6)
        assert torch.allclose(fast["alpha"], torch.ones(()))


def test_the_fast_class_is_the_plain_average_where_speeds_differ():
    # Half spreads of 10 and 5 px by turns; ten taps on ±10 px.
    speed = torch.tensor([40.0, 20.0]).repeat(30).expand(40, 60)
    frame = textured(torch.stack((speed, torch.zeros_like(speed)))[None])
    settings = {"num_samples": 10, "noise": "none", "tile_size": 10, "fast_ratio": 0.5}
    fast = Jimenez2014Blur(**settings)(frame).detach()
    full = Jimenez2014Blur(**settings, tile_classes=False)(frame).detach()
    taps = [frame.color[0, :, 20, 30 + o] for o in (-9, -7, -5, -3, -1, 1, 3, 5, 7, 9)]
    assert torch.allclose(fast[0, :, 20, 30], torch.stack(taps).mean(0), atol=1e-6)
    assert float((fast - full).abs().mean()) > 1e-3  # here the premise fails


def test_three_classes():
    velocity = torch.zeros(1, 2, 10, 90)
    velocity[:, 0, :, 30:] = 8.0  # the tile before, and the one after, see both
    layers = Jimenez2014Blur(tile_size=10, tile_jitter=0.0).layers(textured(velocity, 10, 90))
    classes = layers["tile_class"][0, 0, 5, 5::10].tolist()
    assert classes == [0, 0, 2, 2, 1, 1, 1, 1, 1]
    assert layers["tile_min"][0, 0, 0].tolist() == pytest.approx([0] * 4 + [2] * 5, abs=1e-5)
    assert layers["tile_max"].shape == layers["neighbor_max"].shape == (1, 2, 1, 9)
    assert torch.equal(layers["color"][..., :20], textured(velocity, 10, 90).color[..., :20])


def test_thresholds_of_the_classes():
    speed = torch.full((40, 60), 10.0)
    speed[:, ::2] = 6.0
    frame = textured(torch.stack((speed, torch.zeros_like(speed)))[None])
    for ratio, expected in ((0.5, 1), (0.7, 2)):
        classes = Jimenez2014Blur(fast_ratio=ratio).layers(frame)["tile_class"]
        assert set(classes.unique().tolist()) == {expected}
    still = Jimenez2014Blur(early_out=2.6).layers(frame)  # the longest half spread is 2.5 px
    assert torch.equal(still["color"], frame.color)
    assert float(still["tile_class"].max()) == float(still["alpha"].detach().max()) == 0


def test_alpha_is_what_is_not_filled_with_the_center():
    # One white pixel: it keeps at least what alpha leaves to the center.
    frame = moving_square()
    layers = Jimenez2014Blur(tile_size=8).layers(frame)
    alpha = layers["alpha"].detach()
    assert 0 <= float(alpha.min()) < 0.9 < float(alpha.max()) <= 1 + 1e-6
    black = Frame(color=torch.zeros_like(frame.color), velocity=frame.velocity, depth=frame.depth)
    row, column = 10, 3
    black.color[..., row, column] = 1.0
    lit = Jimenez2014Blur(tile_size=8)(black).detach()[0, 0, row, column]
    assert float(lit) >= 1 - float(alpha[0, 0, row, column]) - 1e-6


def pole(**params):
    """Return alpha of a static background beside an object that moves 40 px/frame before it."""
    velocity = torch.zeros(1, 2, 20, 80)
    velocity[:, 0, :, 40:] = 40.0
    depth = torch.full((20, 80), 10.0)
    depth[:, 40:] = 2.0
    frame = textured(velocity, 20, 80, depth)
    params = {"noise": "none", "tile_jitter": 0.0, "num_samples": 10, **params}
    return Jimenez2014Blur(**params).layers(frame)["alpha"].detach()[0, 0, 10]


def test_the_object_fades_over_its_reach():
    # Half spread 10 px, 5 steps of 2 px a side: taps at ±1, ±3, … ±9 px. The pixel d px before
    # the edge has those farther than d on the object; all lie within its reach.
    alpha = pole(mirror_filter="none", spread_compare="static_zero")
    for distance in (2, 4, 6, 8, 10, 12):
        taps = len([o for o in (1, 3, 5, 7, 9) if o >= distance])
        assert float(alpha[40 - distance]) == pytest.approx(taps / 10, abs=1e-6)


def test_a_static_pixel_counts_for_its_first_taps_in_the_slides_only():
    # o = ½: sat(0 − ½ + 1) = ½ for the taps at ±½ step, both of the background.
    slides = pole(mirror_filter="none")[28]
    zero = pole(mirror_filter="none", spread_compare="static_zero")[28]
    assert float(slides) == pytest.approx(0.1, abs=1e-5)
    assert float(zero) == pytest.approx(0.0, abs=1e-5)


def test_the_mirror_filter_doubles_the_object():
    # Before the edge, each pair has one tap on the object, nearer and faster: it counts twice.
    alpha = pole(spread_compare="static_zero")
    assert float(alpha[34]) == pytest.approx(2 * 2 / 10)
    assert float(pole(mirror_filter="none", spread_compare="static_zero")[34]) == pytest.approx(0.2)


def test_tiles_in_eight_bits_change_little_and_pass_the_gradient():
    frame = moving_square()
    velocity = frame.velocity.clone().requires_grad_()
    frame = Frame(color=frame.color, velocity=velocity, depth=frame.depth)
    exact = Jimenez2014Blur(noise="none").layers(frame)
    coarse = Jimenez2014Blur(noise="none", tile_encoding="uint8").layers(frame)
    steps = (coarse["neighbor_max"] / 20 * 127).detach()
    assert torch.allclose(steps, steps.round(), atol=1e-4)
    assert 0 < float((exact["neighbor_max"] - coarse["neighbor_max"]).detach().abs().max()) < 0.08
    assert float((exact["color"] - coarse["color"]).detach().abs().mean()) < 0.05
    coarse["neighbor_max"].square().sum().backward()
    assert float(velocity.grad.abs().sum()) > 0


def test_an_odd_number_of_taps_gets_one_more():
    frame = moving_square()
    blurs = [Jimenez2014Blur(num_samples=n)(frame) for n in (7, 8, 9)]
    assert torch.equal(blurs[0], blurs[1])
    assert not torch.allclose(blurs[1], blurs[2], atol=1e-3)
