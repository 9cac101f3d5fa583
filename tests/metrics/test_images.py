"""The display encoding that metrics share."""

import torch

from torchblur.metrics import display_encode


def test_display_encode_clips_and_encodes():
    color = torch.tensor([-1.0, 0.0, 0.2140411, 1.0, 50.0])
    expected = torch.tensor([0.0, 0.0, 0.5, 1.0, 1.0])
    torch.testing.assert_close(display_encode(color), expected, rtol=0, atol=1e-5)


def test_display_encode_has_finite_gradients():
    color = torch.tensor([-1.0, 0.0, 1e-9, 0.5, 1.0, 50.0], requires_grad=True)
    display_encode(color).sum().backward()
    assert torch.isfinite(color.grad).all()
    assert color.grad[0] == color.grad[-1] == 0
