"""Temporal errors in closed form: what is no error, noise, a flicker by hand, gradients."""

import math

import pytest
import torch

from torchblur.errors import FrameError
from torchblur.metrics.temporal import flip_change_error, temporal_error, temporal_errors


@pytest.fixture
def references():
    """A sequence that changes a lot, between 0.2 and 0.7."""
    return [0.2 + 0.5 * torch.rand(2, 3, 40, 50, dtype=torch.float64) for _ in range(4)]


class TestNoError:
    def test_the_reference_itself(self, references):
        errors = temporal_errors(references, references)
        assert torch.isnan(errors[0]).all()
        assert torch.equal(errors[1:], torch.zeros(3, 2, dtype=torch.float64))

    def test_an_offset_that_stays(self, references):
        offset = 0.1 * torch.rand_like(references[0])
        images = [image + offset for image in references]
        assert float(temporal_errors(images, references, space="linear")[1:].max()) < 1e-12
        assert float(temporal_errors(images, references)[1:].min()) > 1e-3  # the curve bends

    def test_in_display_values_what_is_clipped_does_not_count(self, references):
        images = [image + 5 + index for index, image in enumerate(references)]
        brighter = [image + 9 for image in references]
        assert float(temporal_errors(images, brighter)[1:].max()) == 0
        assert float(temporal_errors(images, brighter, space="linear")[1:].min()) > 0.9

    def test_change_of_the_reference(self, references):
        """Frames that stay while the reference changes are as wrong as the reverse."""
        still = [references[0]] * 4
        assert torch.allclose(
            temporal_errors(still, references), temporal_errors(references, still), equal_nan=True
        )


class TestValues:
    @pytest.mark.parametrize(
        ("norm", "factor"), [("l1", 2 / math.sqrt(math.pi)), ("rms", math.sqrt(2))]
    )
    def test_noise(self, references, norm, factor):
        sigma = 0.02
        images = [image + sigma * torch.randn_like(image) for image in references]
        errors = temporal_errors(images, references, space="linear", norm=norm)[1:]
        assert errors.numel() == 6
        assert errors.flatten().tolist() == pytest.approx([sigma * factor] * 6, rel=0.05)

    def test_flicker_by_hand(self):
        flat = torch.full((1, 3, 6, 8), 0.25, dtype=torch.float64)
        bright = flat.clone()
        bright[:, 0, :, :4] += 0.3  # one of three channels, half of the pixels
        images, truth = [flat, bright, flat, flat], [flat] * 4
        errors = temporal_errors(images, truth, space="linear")[:, 0]
        assert errors[1:].tolist() == pytest.approx([0.05, 0.05, 0.0])
        rms = temporal_errors(images, truth, space="linear", norm="rms")[:, 0]
        assert rms[1:].tolist() == pytest.approx([0.3 / math.sqrt(6)] * 2 + [0.0])
        map = temporal_error(bright, flat, flat, flat, space="linear")
        assert map.shape == (1, 1, 6, 8)
        assert map[0, 0, 0].tolist() == pytest.approx([0.1] * 4 + [0.0] * 4)

    def test_spaces(self):
        a, b = (torch.full((1, 3, 6, 6), v, dtype=torch.float64) for v in (0.5, 0.0))
        error = {s: float(temporal_error(a, b, b, b, space=s).mean()) for s in ("srgb", "log")}
        assert error["srgb"] == pytest.approx(1.055 * 0.5 ** (1 / 2.4) - 0.055)
        assert error["log"] == pytest.approx(math.log(1.5))

    def test_map_and_mean_agree(self, references):
        images = [torch.rand_like(image) for image in references]
        map = temporal_error(images[1], images[0], references[1], references[0])
        assert torch.allclose(temporal_errors(images, references)[1], map.flatten(1).mean(1))

    def test_a_cut_is_no_error(self, references):
        images = [torch.rand_like(image) for image in references]
        whole = temporal_errors(images, references)
        cut = temporal_errors(images, references, cuts=(2,))
        assert torch.isnan(cut[2]).all()
        assert torch.equal(cut[[1, 3]], whole[[1, 3]])

    def test_one_reference_for_a_batch(self, references):
        images = [torch.rand_like(image) for image in references]
        one = [reference[:1] for reference in references]
        both = [reference[:1].expand(2, -1, -1, -1) for reference in references]
        assert torch.equal(temporal_errors(images, one)[1:], temporal_errors(images, both)[1:])


class TestFlipChange:
    def test_equal_change(self, references):
        a, b = (image.float() for image in references[:2])
        assert float(flip_change_error(a, b, a, b).max()) == 0
        assert float(flip_change_error(b, a, a, b).max()) < 1e-6  # seen the other way round

    def test_flicker_of_a_still_image(self):
        flat = torch.full((1, 3, 32, 32), 0.2)
        bright = flat + 0.4
        strong = float(flip_change_error(bright, flat, flat, flat).mean())
        faint = float(flip_change_error(flat + 0.01, flat, flat, flat).mean())
        assert 0 < 3 * faint < strong < 1


class TestGradients:
    @pytest.mark.parametrize("norm", ["l1", "rms"])
    def test_are_right(self, norm):
        values = torch.rand(3, 1, 3, 3, 4, dtype=torch.float64) * 0.6 + 0.2
        truth = [torch.rand(1, 3, 3, 4, dtype=torch.float64) for _ in range(3)]
        assert torch.autograd.gradcheck(
            lambda x: temporal_errors(list(x), truth, norm=norm)[1:], values.requires_grad_()
        )

    @pytest.mark.parametrize("norm", ["l1", "rms"])
    def test_are_finite_without_error(self, references, norm):
        images = [image.clone().requires_grad_() for image in references]
        temporal_errors(images, references, norm=norm)[1:].sum().backward()
        assert all(torch.equal(i.grad, torch.zeros_like(i)) for i in images)


class TestRefusals:
    def test_what_cannot_be_compared(self, references):
        image = references[0]
        with pytest.raises(FrameError, match="got 4 images and 3 references"):
            temporal_errors(references, references[:3])
        with pytest.raises(FrameError, match="one reference for each image, got 0"):
            temporal_errors([], [])
        with pytest.raises(
            FrameError, match="`space` must be 'srgb', 'linear' or 'log', got 'xyz'"
        ):
            temporal_error(image, image, image, image, space="xyz")
        with pytest.raises(FrameError, match="`norm` must be 'l1' or 'rms', got 'l2'"):
            temporal_errors(references, references, norm="l2")
        with pytest.raises(FrameError, match=r"`previous` must have the shape.*\(1, 3, 40, 50\)"):
            temporal_error(image, image[:1], image, image[:1])
        bad = image.clone()
        bad[0, 0, 1, 2] = math.nan
        with pytest.raises(FrameError, match=r"must be finite, got 1 values.*x=2, y=1"):
            temporal_errors([image, bad], [image, image])
