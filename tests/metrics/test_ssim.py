"""SSIM against scikit-image."""

import pytest
import torch
from skimage.metrics import structural_similarity

from torchblur.errors import FrameError
from torchblur.metrics import display_encode, ssim

MARGIN = 5  # half of the window: there the two pad differently


def noisy_pair(size=(40, 47)):
    reference = torch.rand(2, 3, *size) ** 2 * 1.5
    return reference + 0.2 * torch.randn_like(reference), reference


def test_agrees_with_scikit_image_on_display_values():
    image, reference = noisy_pair()
    ours = ssim(image, reference)[..., MARGIN:-MARGIN, MARGIN:-MARGIN]
    for b in range(2):
        shown, wanted = (
            display_encode(x[b]).permute(1, 2, 0).double().numpy() for x in (image, reference)
        )
        _, full = structural_similarity(
            wanted, shown, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5,
            use_sample_covariance=False, full=True,
        )  # fmt: skip
        expected = torch.from_numpy(full).mean(dim=2)[MARGIN:-MARGIN, MARGIN:-MARGIN]
        torch.testing.assert_close(ours[b, 0].double(), expected, rtol=0, atol=1e-4)


def test_by_hand_for_constant_images():
    # No variance: (2 m1 m2 + c1) / (m1² + m2² + c1) of the encoded values.
    low, high = display_encode(torch.tensor([0.1, 0.4])).tolist()
    expected = (2 * low * high + 1e-4) / (low**2 + high**2 + 1e-4)
    similarity = ssim(torch.full((1, 3, 12, 12), 0.1), torch.full((1, 3, 12, 12), 0.4))
    torch.testing.assert_close(similarity, torch.full((1, 1, 12, 12), expected), rtol=0, atol=1e-4)


def test_is_one_at_equality_with_zero_gradient():
    reference = noisy_pair()[1]
    image = reference.clone().requires_grad_()
    similarity = ssim(image, reference)
    torch.testing.assert_close(similarity, torch.ones(2, 1, 40, 47), rtol=0, atol=1e-5)
    similarity.mean().backward()
    assert float(image.grad.abs().max()) < 1e-5
    black = torch.zeros(1, 3, 8, 8)
    assert torch.equal(ssim(black, black), torch.ones(1, 1, 8, 8))


def test_one_reference_for_many():
    image, reference = noisy_pair()
    both = torch.cat([ssim(x[None], reference[:1]) for x in image])
    torch.testing.assert_close(ssim(image, reference[:1]), both, rtol=0, atol=1e-5)


def test_gradcheck():
    image, reference = (0.2 + 0.6 * torch.rand(1, 3, 6, 7).double() for _ in range(2))
    assert torch.autograd.gradcheck(ssim, (image.requires_grad_(), reference))


def test_refuses_small_images():
    with pytest.raises(FrameError, match=r"at least 6x6 px.*got 9x5"):
        ssim(torch.zeros(1, 3, 5, 9), torch.zeros(1, 3, 5, 9))
