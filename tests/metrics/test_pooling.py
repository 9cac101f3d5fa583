"""The weighted median: by hand, by counting, and what is refused."""

import pytest
import torch

from torchblur.errors import FrameError
from torchblur.metrics.pooling import weighted_median


def test_by_hand():
    maps = torch.tensor([[0.1, 0.2, 0.3, 0.0], [0.5, 0.5, 0.5, 0.5], [0.0, 0.0, 0.0, 0.9]])
    # sums: 0, .1, .3, .6: the half, .3, is reached at .2; one error alone is the median
    assert weighted_median(maps.view(3, 1, 2, 2)).tolist() == pytest.approx([0.2, 0.5, 0.9])


def test_is_where_half_of_the_sum_is_reached():
    errors = torch.rand(2, 1, 30, 40) ** 3
    found = weighted_median(errors)
    for image, median in zip(errors, found, strict=True):
        share_below = float(image[image < median].sum() / image.sum())
        share_up_to = float(image[image <= median].sum() / image.sum())
        assert share_below < 0.5 <= share_up_to
        assert float(median) > float(image.median())


def test_without_error_it_is_zero():
    assert weighted_median(torch.zeros(1, 1, 4, 4)).tolist() == [0.0]


@pytest.mark.parametrize("value", [-0.1, float("nan")])
def test_refuses_what_is_no_error(value):
    errors = torch.zeros(1, 1, 4, 4)
    errors[0, 0, 1, 1] = value
    with pytest.raises(FrameError, match=r"`map`.*negative one or NaN"):
        weighted_median(errors)
