"""Sums of the 2025 notes' filter that are next to nothing."""

import pytest
import torch

from torchblur.filters import get_filter
from torchblur.filters.front_back import Sums, compose
from torchblur.testing.frames import moving_square


@pytest.mark.parametrize("separate_sums", [False, True])
@pytest.mark.parametrize("size", [1e-40, 1e-36, 1e-3])
def test_gradients_of_tiny_sums_are_finite(separate_sums, size):
    """Direction weights are powers, so that a sum may be 1e-40 where little agrees."""
    frame = moving_square()
    height, width = frame.size
    planes = {
        name: torch.full((1, channels, height, width), size, requires_grad=True)
        for name, channels in (("background_color", 3), ("background", 1), ("foreground_color", 3),
                               ("foreground", 1), ("alpha", 1), ("influence", 1))
    }  # fmt: skip
    blur = get_filter("notes2025")(separate_sums=separate_sums)
    moving = torch.ones(1, 1, height, width, dtype=torch.bool)
    result = compose(frame, [Sums(**planes)], moving, blur.current_config())
    assert bool(torch.isfinite(result.color).all())
    result.color.sum().backward()
    for name, plane in planes.items():
        assert plane.grad is None or bool(torch.isfinite(plane.grad).all()), name
