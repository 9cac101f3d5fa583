"""Half-precision storage: every filter takes it, and says no to other names."""

import pytest
import torch

from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.presets import create_filter
from torchblur.testing.frames import moving_square

WITH_TAPS = ["guertin2014", "jimenez2014", "line", "mcguire2012", "sousa2013", "torchblur"]
WITH_THRESHOLDS = ["notes2025", "tan2022"]  # on rounded depths another pixel may win


@pytest.mark.parametrize("name", WITH_TAPS + WITH_THRESHOLDS)
def test_error_is_small(name):
    frame = moving_square()
    full, half = (create_filter(name, storage=storage)(frame) for storage in ("full", "half"))
    assert half.dtype == torch.float32
    error = float((full - half).square().mean().sqrt())
    assert 0 < error < (1e-2 if name in WITH_THRESHOLDS else 1e-3)


def test_layers_too():
    blur = get_filter("line")(storage="half")
    frame = moving_square()
    assert torch.equal(blur.layers(frame)["color"], blur(frame))


def test_other_names_are_refused():
    with pytest.raises(ConfigError, match="`storage` must be 'full' or 'half', got 'fp8'"):
        get_filter("line")(storage="fp8")
