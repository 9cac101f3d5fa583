import pytest
import torch

from torchblur.errors import FrameError
from torchblur.ops.velocity import (
    clamp_length,
    direction,
    half_velocity,
    length,
    quantize_gamma2,
    quantize_linear,
    quantize_uint8,
    velocity_from_depth,
)


def vector(x, y):
    return torch.tensor([x, y]).view(1, 2, 1, 1)


def test_length_has_a_gradient_at_zero():
    still = torch.zeros(1, 2, 1, 1, requires_grad=True)
    length(still).sum().backward()
    assert bool(torch.isfinite(still.grad).all())
    assert float(length(vector(3.0, 4.0))) == pytest.approx(5.0)


def test_direction_of_a_still_pixel_is_zero():
    assert direction(vector(0.0, 0.0)).flatten().tolist() == [0, 0]
    assert direction(vector(5e-4, 0.0)).flatten().tolist() == [0, 0]
    assert direction(vector(0.0, -2.0)).flatten().tolist() == pytest.approx([0, -1])


def test_clamp_keeps_the_direction():
    assert clamp_length(vector(30.0, 40.0), 5).flatten().tolist() == pytest.approx([3, 4])
    assert clamp_length(vector(0.3, 0.4), 5).flatten().tolist() == pytest.approx([0.3, 0.4])
    assert half_velocity(vector(40.0, 0.0), 0.5, 8).flatten().tolist() == pytest.approx([8, 0])


def test_uint8_has_255_levels_and_passes_the_gradient():
    values = torch.linspace(-10, 10, 4001).view(1, 1, 1, -1).expand(1, 2, 1, -1).clone()
    values.requires_grad_()
    stored = quantize_uint8(values, 10.0)
    assert len(stored.unique()) == 255
    assert float((stored - values).detach().abs().max()) <= 10 / 127 / 2 + 1e-5
    stored.sum().backward()
    assert bool((values.grad == 1).all())
    assert float(quantize_uint8(vector(0.0, 0.0), 10.0).abs().max()) == 0


def perspective(yaw=0.0, x=0.0):
    """View-projection of a camera at (x, 0, 0) that looks along -z, turned by yaw."""
    c, s = torch.cos(torch.tensor(yaw)), torch.sin(torch.tensor(yaw))
    view = torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])
    view = view @ torch.tensor([[1.0, 0, 0, -x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    near, far = 0.1, 100.0
    a, b = (far + near) / (near - far), 2 * far * near / (near - far)
    return torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, a, b], [0, 0, -1, 0]]) @ view


def test_velocity_of_a_still_world_under_a_moving_camera():
    # A camera that moves right by 0.1 sees a wall at z = 4 move left by 0.1 / 4 of half a width.
    near, far = 0.1, 100.0
    device = ((far + near) / (near - far) * -4 + 2 * far * near / (near - far)) / 4
    depth = torch.full((1, 1, 20, 40), device, dtype=torch.float32)
    velocity = velocity_from_depth(depth, perspective(x=0.1), perspective(x=0.0))
    assert torch.allclose(velocity[:, 0], torch.full((1, 20, 40), -0.1 / 4 * 20), atol=1e-3)
    assert float(velocity[:, 1].abs().max()) < 1e-3


def test_still_camera_gives_no_velocity_and_rotation_moves_all_depths_alike():
    depth = torch.rand(2, 1, 6, 8) * 0.5 + 0.3
    assert float(velocity_from_depth(depth, perspective(), perspective()).abs().max()) < 1e-3
    turned = velocity_from_depth(depth, perspective(yaw=0.05), perspective())
    other = velocity_from_depth(depth * 0.5, perspective(yaw=0.05), perspective())
    assert torch.allclose(turned, other, atol=1e-3)
    assert float(turned[:, 0].abs().min()) > 0.1


def test_bad_matrix():
    with pytest.raises(FrameError, match=r"must be \(4, 4\) or \(B, 4, 4\), got \(3, 3\)"):
        velocity_from_depth(torch.ones(1, 1, 2, 2), torch.eye(3), torch.eye(4))


def test_eight_bits_with_gamma_two_by_hand():
    # code = round(√(|v| / 127²) · 127): the squares are stored exactly.
    largest = float(127**2)
    exact = torch.tensor([0.0, 1.0, -4.0, 100.0, -largest]).view(1, 1, 1, 5)
    assert torch.allclose(quantize_gamma2(exact, largest), exact)
    between = torch.tensor([2.2, -2.3, 6.3, 2 * largest]).view(1, 1, 1, 4)
    expected = torch.tensor([1.0, -4.0, 9.0, largest]).view(1, 1, 1, 4)
    assert torch.allclose(quantize_gamma2(between, largest), expected)


def test_eight_bits_linear_by_hand():
    values = torch.tensor([0.0, 0.4, 0.6, 100.2, 255.0, 1e10])
    assert quantize_linear(values, 255.0).tolist() == [0, 0, 1, 100, 255, 255]


@pytest.mark.parametrize("quantize", [quantize_gamma2, quantize_linear])
def test_quantization_passes_the_gradient(quantize):
    values = torch.tensor([0.0, 0.3, 2.7]).requires_grad_()
    quantize(values, 4.0).sum().backward()
    assert values.grad.tolist() == [1, 1, 1]
