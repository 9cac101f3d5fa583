"""FLIP against NVIDIA's own evaluator, by hand, and its gradients."""

import math

import flip_evaluator
import numpy as np
import pytest
import torch

from torchblur.errors import FrameError
from torchblur.metrics import (
    DEFAULT_PPD,
    exposure_range,
    flip_hdr,
    flip_ldr,
    prepare_flip_hdr,
    prepare_flip_ldr,
)
from torchblur.ops.color import linear_to_srgb

TOLERANCE = 1e-4
SIZES = [(1, 1), (5, 7), (33, 64), (96, 61)]


def structured_pair(height, width, gain=1.0):
    """Edges, gradients and a textured half, and the same moved by two pixels with noise."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    waves, step, ramp = 0.5 + 0.5 * torch.sin(9 * x + 3 * y * y), 0.7 * (x > 0.5) + 0.1 * y, x * y
    image = torch.stack([waves, step, ramp])[None]
    moved = image.roll(2, dims=3) * 0.9 + 0.02 * torch.rand(1, 3, height, width)
    return moved * gain, image * gain


def random_pair(height, width, gain=1.0):
    return torch.rand(1, 3, height, width) * gain, torch.rand(1, 3, height, width) * gain


def as_numpy(image):
    return np.ascontiguousarray(image[0].permute(1, 2, 0).float().numpy())


def evaluator(image, reference, kind, **parameters):
    """NVIDIA's error map. It exits the process on a black HDR reference: never call it so."""
    if kind == "LDR":
        image, reference = (linear_to_srgb(x.clamp(0, 1)) for x in (image, reference))
    error, _, used = flip_evaluator.evaluate(
        as_numpy(reference), as_numpy(image), kind, applyMagma=False, parameters=parameters
    )
    return torch.from_numpy(np.array(error)).reshape(1, 1, *image.shape[2:]), used


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("gain", [1.0, 8.0])
@pytest.mark.parametrize("make", [random_pair, structured_pair])
@pytest.mark.parametrize("size", SIZES)
class TestAgainstEvaluator:
    def test_ldr(self, size, make, gain, dtype):
        image, reference = make(*size, gain)
        expected, _ = evaluator(image, reference, "LDR")
        error = flip_ldr(image.to(dtype), reference.to(dtype))
        torch.testing.assert_close(error.float(), expected, rtol=0, atol=TOLERANCE)
        assert error.dtype == dtype

    def test_hdr(self, size, make, gain, dtype):
        image, reference = make(*size, gain)
        expected, _ = evaluator(image, reference, "HDR")
        error = flip_hdr(image.to(dtype), reference.to(dtype))
        torch.testing.assert_close(error.float(), expected, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize(("level", "other"), [(0.2, 0.2), (0.2, 0.5), (0.5, 0.51), (0.0, 0.3)])
def test_constant_images_agree_with_the_evaluator(level, other):
    image, reference = torch.full((1, 3, 20, 24), other), torch.full((1, 3, 20, 24), level)
    expected, _ = evaluator(image, reference, "LDR")
    torch.testing.assert_close(flip_ldr(image, reference), expected, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("ppd", [20.0, 40.0, 120.0])
def test_viewing_distance_agrees_with_the_evaluator(ppd):
    image, reference = structured_pair(40, 50)
    expected, _ = evaluator(image, reference, "LDR", ppd=ppd)
    error = flip_ldr(image, reference, pixels_per_degree=ppd)
    torch.testing.assert_close(error, expected, rtol=0, atol=TOLERANCE)
    assert (error - flip_ldr(image, reference)).abs().max() > 0.01


def wide_range_pair():
    image, reference = structured_pair(40, 50)
    stops = torch.linspace(-6, 4, 50)
    return image * 2**stops, reference * 2**stops


def test_a_wide_range_takes_as_many_exposures_as_the_evaluator():
    image, reference = wide_range_pair()
    expected, used = evaluator(image, reference, "HDR")
    prepared = prepare_flip_hdr(reference)
    start, stop = exposure_range(reference)
    assert used["numExposures"] > 3
    assert prepared.exposures.shape == (1, used["numExposures"])
    assert float(start) == pytest.approx(used["startExposure"], abs=1e-5)
    assert float(stop) == pytest.approx(used["stopExposure"], abs=1e-5)
    torch.testing.assert_close(prepared.error(image), expected, rtol=0, atol=TOLERANCE)


def test_given_exposures_agree_with_the_evaluator():
    image, reference = wide_range_pair()
    given = {"startExposure": -1.5, "stopExposure": 3.0, "numExposures": 3}
    expected, _ = evaluator(image, reference, "HDR", **given)
    error = flip_hdr(image, reference, start_exposure=-1.5, stop_exposure=3.0, num_exposures=3)
    torch.testing.assert_close(error, expected, rtol=0, atol=TOLERANCE)
    assert (error - flip_hdr(image, reference)).abs().max() > 0.01


def test_default_viewing_condition_is_that_of_the_paper():
    assert pytest.approx(67.0206, abs=1e-4) == DEFAULT_PPD


def test_hand_computed_gray():
    # Gray has no chroma and no features: only the lightness difference of L* = 116 f(Y) - 16.
    low, high = 0.2, 0.5
    lightness = 116 * (high ** (1 / 3) - low ** (1 / 3))
    greatest = 41.2760  # HyAB of green and blue, Hunt-adjusted, to the power 0.7
    distance = lightness**0.7
    expected = distance * 0.95 / (0.4 * greatest)
    assert distance < 0.4 * greatest
    size = (1, 3, 16, 16)
    error = flip_ldr(torch.full(size, high).double(), torch.full(size, low).double())
    torch.testing.assert_close(error, torch.full_like(error, expected), rtol=1e-3, atol=0)


def test_exposures_by_hand():
    # ACES maps 2.1187 to 0.85: 0.9036 x² + 0.018 x = 0.85 (0.8748 x² + 0.354 x + 0.14).
    reference = torch.tensor([0.25, 0.5, 4.0]).view(1, 1, 1, 3).expand(1, 3, 1, 3)
    start, stop = exposure_range(reference)
    assert float(start) == pytest.approx(math.log2(2.1187 / 4), abs=1e-3)
    assert float(stop) == pytest.approx(math.log2(2.1187 / 0.5), abs=1e-3)


class TestBlackReference:
    """The evaluator exits the process here: these are our own rules."""

    def test_all_black_is_finite(self):
        black = torch.zeros(1, 3, 12, 12)
        assert float(flip_hdr(black, black).max()) == 0
        error = flip_hdr(torch.full_like(black, 0.5), black)
        assert 0.5 < float(error.min()) <= float(error.max()) <= 1

    def test_a_black_median_is_that_of_the_lit_pixels(self):
        reference = torch.zeros(1, 3, 4, 4)
        reference[..., 0, :3] = torch.tensor([1.0, 2.0, 4.0])
        start, stop = exposure_range(reference)
        assert float(stop - start) == pytest.approx(1.0, abs=1e-5)


class TestBatch:
    def test_each_image_is_compared_on_its_own(self):
        pairs = [structured_pair(24, 30), random_pair(24, 30), wide_range_pair()]
        pairs = [(i[..., :24, :30], r[..., :24, :30]) for i, r in pairs]
        image, reference = (torch.cat(x) for x in zip(*pairs, strict=True))
        for metric in (flip_ldr, flip_hdr):
            alone = torch.cat([metric(i, r) for i, r in pairs])
            torch.testing.assert_close(metric(image, reference), alone, rtol=0, atol=1e-5)

    @pytest.mark.parametrize("prepare", [prepare_flip_ldr, prepare_flip_hdr])
    def test_a_large_batch_is_the_same_in_parts(self, prepare, monkeypatch):
        reference = torch.rand(5, 3, 12, 9)
        image = torch.rand(5, 3, 12, 9)
        whole = prepare(reference).error(image)
        monkeypatch.setattr("torchblur.metrics.flip._CHUNK_PIXELS", 2 * 12 * 9)
        torch.testing.assert_close(prepare(reference).error(image), whole, rtol=0, atol=1e-5)

    @pytest.mark.parametrize(
        ("prepare", "metric"), [(prepare_flip_ldr, flip_ldr), (prepare_flip_hdr, flip_hdr)]
    )
    def test_one_prepared_reference_serves_many(self, prepare, metric):
        images, reference = torch.rand(4, 3, 20, 22), torch.rand(1, 3, 20, 22)
        expected = torch.cat([metric(image[None], reference) for image in images])
        torch.testing.assert_close(prepare(reference).error(images), expected, rtol=0, atol=1e-5)
        torch.testing.assert_close(metric(images, reference), expected, rtol=0, atol=1e-5)


def test_a_firefly_is_finite():
    # Its square overflows float32 in the tone curve.
    image, reference = torch.ones(1, 3, 12, 12), torch.ones(1, 3, 12, 12)
    image[..., 5, 5] = 1e30
    image.requires_grad_()
    error = flip_hdr(image, reference)
    error.sum().backward()
    assert torch.isfinite(error).all()
    assert float(error.detach()[..., 5, 5]) > 0.05
    assert torch.isfinite(image.grad).all()


def test_properties():
    image, reference = structured_pair(32, 40)
    error = flip_ldr(image, reference)
    assert error.shape == (1, 1, 32, 40)
    assert 0 <= float(error.min()) < float(error.max()) <= 1
    torch.testing.assert_close(flip_ldr(reference, image), error, rtol=0, atol=1e-5)
    mirrored = flip_ldr(image.flip(3), reference.flip(3))
    torch.testing.assert_close(mirrored.flip(3), error, rtol=0, atol=1e-4)
    assert float(flip_ldr(reference, reference).max()) == 0
    assert float(flip_ldr(image * 0 + 3, image * 0 + 7).max()) == 0  # both are white


@pytest.mark.parametrize("metric", [flip_ldr, flip_hdr])
class TestGradient:
    @pytest.mark.parametrize("level", [0.0, 0.3, 1.0, 5.0])
    def test_is_zero_at_equality(self, metric, level):
        reference = torch.full((1, 3, 12, 12), level)
        image = reference.clone().requires_grad_()
        metric(image, reference).sum().backward()
        assert torch.equal(image.grad, torch.zeros_like(image))

    def test_is_zero_at_equal_texture(self, metric):
        reference = torch.rand(2, 3, 14, 14)
        image = reference.clone().requires_grad_()
        metric(image, reference).sum().backward()
        assert torch.equal(image.grad, torch.zeros_like(image))

    @pytest.mark.parametrize("scale", [0.0, 1e-8, 1e-4, 1.0, 1e4])
    def test_is_finite(self, metric, scale):
        reference = torch.rand(1, 3, 12, 12) * 2
        reference[..., :4] = 0
        image = (torch.rand(1, 3, 12, 12) * scale).requires_grad_()
        metric(image, reference).sum().backward()
        assert torch.isfinite(image.grad).all()

    def test_is_finite_next_to_equality(self, metric):
        reference = torch.rand(1, 3, 12, 12)
        image = (reference + 1e-7 * torch.randn_like(reference)).requires_grad_()
        metric(image, reference).mean().backward()
        assert torch.isfinite(image.grad).all()
        assert float(image.grad.abs().max()) < 1e3

    def test_gradcheck(self, metric):
        # A coarse display keeps the filters short; away from clipping and from equality.
        reference = (0.3 + 0.2 * torch.rand(1, 3, 5, 6)).double()
        image = (reference + 0.1 + 0.1 * torch.rand(1, 3, 5, 6)).requires_grad_()
        assert torch.autograd.gradcheck(
            lambda i, r: metric(i, r, pixels_per_degree=15.0), (image, reference), atol=1e-6
        )

    def test_descends(self, metric):
        image, reference = structured_pair(16, 16)
        image = image.clone().requires_grad_()
        before = metric(image, reference).mean()
        before.backward()
        step = 0.05 * image.grad / image.grad.norm()
        after = metric(image.detach() - step, reference).mean()
        assert float(after) < float(before.detach())


def test_gradient_reaches_the_reference():
    image, reference = (x.requires_grad_() for x in random_pair(10, 10))
    prepare_flip_ldr(reference).error(image).mean().backward()
    assert float(reference.grad.abs().max()) > 0


class TestRefusals:
    def test_names_the_size(self):
        with pytest.raises(FrameError, match=r"one shape.*\(1, 3, 8, 8\) and \(1, 3, 8, 9\)"):
            flip_ldr(torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 9))

    def test_names_the_channels(self):
        with pytest.raises(FrameError, match=r"`reference`.*\(B, 3, H, W\), got \(1, 4, 8, 8\)"):
            flip_hdr(torch.zeros(1, 3, 8, 8), torch.zeros(1, 4, 8, 8))

    def test_names_the_place_of_a_nan(self):
        image = torch.zeros(2, 3, 8, 8)
        image[1, 2, 4, 5] = math.nan
        with pytest.raises(FrameError, match=r"`image`.*1 values.*nan in channel 2 at x=5, y=4 of"):
            flip_ldr(image, torch.zeros(2, 3, 8, 8))

    def test_prepared_names_the_size(self):
        prepared = prepare_flip_ldr(torch.zeros(2, 3, 8, 8))
        with pytest.raises(FrameError, match=r"prepared reference.*\(3, 3, 8, 8\) and \(2, 3, 8"):
            prepared.error(torch.zeros(3, 3, 8, 8))

    def test_prepared_names_the_type(self):
        prepared = prepare_flip_ldr(torch.zeros(1, 3, 8, 8))
        with pytest.raises(FrameError, match=r"one dtype, got torch.float64 and torch.float32"):
            prepared.error(torch.zeros(1, 3, 8, 8).double())

    def test_names_the_setting(self):
        image = torch.ones(1, 3, 8, 8)
        with pytest.raises(FrameError, match=r"`pixels_per_degree` must be above 0, got -3"):
            flip_ldr(image, image, pixels_per_degree=-3.0)
        with pytest.raises(FrameError, match=r"`num_exposures` must be at least 2, got 1"):
            flip_hdr(image, image, num_exposures=1)
        with pytest.raises(FrameError, match=r"`start_exposure` must not exceed.*got 3 and 1"):
            flip_hdr(image, image, start_exposure=3.0, stop_exposure=1.0)
