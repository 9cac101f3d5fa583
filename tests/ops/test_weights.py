import pytest
import torch

from torchblur.ops.weights import cone, cylinder, depth_weights, power, saturate, threshold


def t(*values):
    return torch.tensor(values)


def test_cone_by_hand():
    assert cone(t(0.0, 2.0, 4.0, 6.0), t(4.0)).tolist() == [1.0, 0.5, 0.0, 0.0]
    assert cone(t(1.0), t(4.0), slope=2.0).tolist() == [0.5]


def test_cylinder_by_hand():
    assert cylinder(t(3.8, 4.0, 4.2, 5.0), t(4.0)).tolist() == pytest.approx(
        [1, 0.5, 0, 0], abs=1e-5
    )
    assert cylinder(t(6.0), t(4.0), inner=1.0, outer=2.0).tolist() == pytest.approx([0.5])


def test_a_nearer_sample_is_foreground_and_a_farther_one_background():
    nearer = depth_weights(t(20.0), t(10.0), 1.0, relative=True)
    assert (float(nearer.foreground), float(nearer.background)) == (1.0, 0.0)
    farther = depth_weights(t(10.0), t(20.0), 1.0, relative=True)
    assert (float(farther.foreground), float(farther.background)) == (0.0, 1.0)


def test_level_depths_are_both():
    for relative in (True, False):
        level = depth_weights(t(7.0), t(7.0), 0.1, relative=relative)
        assert (float(level.foreground), float(level.background)) == (1.0, 1.0)


def test_level_of_one_half_makes_the_weights_add_up_to_one():
    for sample in (6.9, 6.96, 7.0, 7.03, 7.2):
        weights = depth_weights(t(7.0), t(sample), 0.1, relative=False, level=0.5)
        assert float(weights.foreground + weights.background) == pytest.approx(1.0, abs=1e-5)


def test_relative_comparison_does_not_depend_on_the_scale_of_the_scene():
    near = depth_weights(t(1.0), t(1.3), 0.5, relative=True)
    far = depth_weights(t(100.0), t(130.0), 0.5, relative=True)
    assert torch.allclose(near.foreground, far.foreground, atol=1e-6)
    assert float(near.foreground) == pytest.approx(0.4, abs=1e-6)
    absolute = depth_weights(t(1.0), t(1.3), 0.5, relative=False)
    assert float(absolute.foreground) == pytest.approx(0.4, abs=1e-6)


def test_softness_opens_the_dead_gradient():
    for softness, dead in ((0.0, True), (0.2, False)):
        x = t(-0.05, 1.05).requires_grad_()
        saturate(x, softness).sum().backward()
        assert bool((x.grad == 0).all()) is dead
    values = saturate(torch.linspace(-2, 3, 101), 0.1)
    assert float(values.min()) >= 0
    assert float(values.max()) <= 1 + 1e-6
    assert float((values - torch.linspace(-2, 3, 101).clamp(0, 1)).abs().max()) < 0.03


def test_power_has_finite_gradients_at_zero():
    base = t(0.0, 0.3, 1.0).requires_grad_()
    exponent = torch.tensor(0.5, requires_grad=True)
    power(base, exponent).sum().backward()
    assert bool(torch.isfinite(base.grad).all())
    assert bool(torch.isfinite(exponent.grad))
    assert power(t(0.0, 0.25), 0.5).tolist() == [0.0, 0.5]


def test_threshold_hard_and_soft():
    values = t(-1.0, 0.0, 1e-6, 2.0)
    assert threshold(values).tolist() == [0, 0, 1, 1]
    soft = threshold(t(-1.0, -0.1, 0.0, 0.1, 1.0), softness=0.2)
    assert soft.tolist() == pytest.approx([0, 0.1192, 0.5, 0.8808, 1], abs=1e-4)
