"""All metrics in one call."""

import math

import pytest
import torch

from torchblur.errors import FrameError
from torchblur.metrics import (
    evaluate,
    flip_hdr,
    flip_ldr,
    masked_mean,
    prepare_flip_hdr,
    psnr,
    ssim,
)


@pytest.fixture
def pair():
    reference = torch.rand(2, 3, 16, 18)
    return (reference + 0.1 * torch.randn_like(reference)).clamp_min(0), reference


@pytest.fixture
def mask():
    mask = torch.zeros(2, 1, 16, 18, dtype=torch.bool)
    mask[:, :, 4:9, 5:] = True
    return mask


def test_equals_the_single_metrics(pair, mask):
    results = evaluate(*pair, masks={"band": mask})
    assert set(results) == {"flip", "psnr", "ssim", "flip_band", "psnr_band", "ssim_band"}
    expected = {
        "flip": flip_ldr(*pair).mean(dim=(1, 2, 3)),
        "psnr": psnr(*pair),
        "ssim": ssim(*pair).mean(dim=(1, 2, 3)),
        "flip_band": masked_mean(flip_ldr(*pair), mask),
        "psnr_band": psnr(*pair, mask=mask),
        "ssim_band": masked_mean(ssim(*pair), mask),
    }
    for name, value in expected.items():
        torch.testing.assert_close(results[name], value)
        assert value.shape == (2,)
        if "_" in name:
            assert not torch.allclose(value, expected[name.split("_")[0]], rtol=1e-3)


def test_takes_a_prepared_reference(pair):
    image, reference = pair
    results = evaluate(image, reference, prepared=prepare_flip_hdr(reference))
    torch.testing.assert_close(results["flip"], flip_hdr(*pair).mean(dim=(1, 2, 3)))


def test_equal_images_and_an_empty_mask(pair, mask):
    image = pair[1].clone().requires_grad_()
    results = evaluate(image, pair[1], masks={"none": torch.zeros_like(mask)})
    assert results["flip"].tolist() == [0, 0]
    assert results["psnr"].tolist() == [math.inf, math.inf]
    assert all(results[f"{k}_none"].isnan().all() for k in ("flip", "psnr", "ssim"))
    sum(value.sum() for value in results.values()).backward()
    assert torch.isfinite(image.grad).all()


def test_refusals(pair):
    image, reference = pair
    with pytest.raises(FrameError, match=r"`mask` must have shape \(2, 1, 16, 18\).*\(2, 16, 18\)"):
        evaluate(image, reference, masks={"band": torch.ones(2, 16, 18)})
    with pytest.raises(FrameError, match=r"`reference` must be finite, got 1728 values.*inf in"):
        evaluate(image, torch.full_like(reference, math.inf))
