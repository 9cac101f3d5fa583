"""PSNR per image, by hand."""

import math

import pytest
import torch

from torchblur.errors import FrameError
from torchblur.metrics import display_encode, psnr


def offset_images(*offsets):
    reference = torch.rand(len(offsets), 3, 8, 6, dtype=torch.float64)
    return reference + torch.tensor(offsets, dtype=torch.float64).view(-1, 1, 1, 1), reference


def test_by_hand():
    image, reference = offset_images(0.1, 0.01)
    torch.testing.assert_close(psnr(image, reference), torch.tensor([20.0, 40.0]).double())


def test_is_per_image_not_pooled():
    image, reference = offset_images(0.1, 0.01)
    pooled = -10 * math.log10((0.01 + 0.0001) / 2)
    assert abs(float(psnr(image, reference)[1]) - pooled) > 15


def test_peak():
    image, reference = offset_images(0.1)
    assert float(psnr(image, reference, peak=10.0)) == pytest.approx(40.0)


def test_mask_restricts():
    reference = torch.zeros(1, 3, 4, 4)
    image = reference.clone()
    image[..., 0, 0] = 1.0
    image[..., 1:, :] = 0.1
    mask = torch.zeros(1, 1, 4, 4, dtype=torch.bool)
    mask[..., 1:, :] = True
    assert float(psnr(image, reference, mask=mask)) == pytest.approx(20.0, abs=1e-4)
    assert float(psnr(image, reference)) == pytest.approx(
        -10 * math.log10((1 + 12 * 0.01) / 16), abs=1e-4
    )


def test_equality_is_infinite_with_zero_gradient():
    image = torch.rand(2, 3, 4, 4, requires_grad=True)
    reference = image.detach().clone()
    reference[1] += 0.5
    value = psnr(image, reference)
    assert value[0] == math.inf
    assert math.isfinite(value[1].item())
    value[1].backward(retain_graph=True)
    value[0].backward()
    assert torch.isfinite(image.grad).all()
    assert torch.equal(image.grad[0], torch.zeros(3, 4, 4))
    assert float(image.grad[1].abs().max()) > 0


def test_empty_mask_is_nan_with_zero_gradient():
    image = torch.rand(1, 3, 4, 4, requires_grad=True)
    value = psnr(image, torch.zeros(1, 3, 4, 4), mask=torch.zeros(1, 1, 4, 4, dtype=torch.bool))
    assert math.isnan(value.item())
    value.sum().backward()
    assert torch.equal(image.grad, torch.zeros_like(image))


def test_of_display_values():
    image, reference = torch.full((1, 3, 4, 4), 5.0), torch.full((1, 3, 4, 4), 0.0)
    assert float(psnr(display_encode(image), display_encode(reference))) == pytest.approx(
        0.0, abs=1e-5
    )
    gray = display_encode(torch.full((1, 3, 4, 4), 0.2140411))  # encodes to one half
    assert float(psnr(gray, display_encode(reference))) == pytest.approx(6.0206, abs=1e-3)


def test_gradcheck():
    image, reference = (torch.rand(2, 3, 4, 4, dtype=torch.float64) for _ in range(2))
    assert torch.autograd.gradcheck(psnr, (image.requires_grad_(), reference))


def test_refusals():
    image = torch.zeros(1, 3, 4, 4)
    with pytest.raises(FrameError, match=r"`peak` must be above 0, got 0"):
        psnr(image, image, peak=0.0)
    with pytest.raises(FrameError, match=r"`mask` must have shape \(1, 1, 4, 4\).*got \(1, 3, 4"):
        psnr(image, image, mask=torch.ones(1, 3, 4, 4))
    with pytest.raises(FrameError, match=r"`image` must be floating point, got torch.uint8"):
        psnr(image.to(torch.uint8), image)
