"""Sensitivities by gradient and by differences, and how a report shows them."""

import math

import pytest
import torch
from planted import FIXED, PLANTED

from tuning.config.fit import FilterSpec
from tuning.objective.sensitivity import (
    Differences,
    differences,
    gradient_slopes,
    measure_sensitivity,
)
from tuning.objective.space import make_space
from tuning.report.sensitivity import _is_misled
from tuning.results.fit import SensitivityResult

START = dict(PLANTED, third_gain=8.0, kappa=12.0)


@pytest.fixture
def space():
    free = {"kappa": {"high": 100}, "third_gain": {"high": 10}, "direction_exponent": {}}
    return make_space(FilterSpec(kind="guertin2014", params=FIXED, free=free))


def test_gradient_is_what_small_steps_find(planted_problem, space):
    by_gradient = gradient_slopes(planted_problem, space, START)
    tried = differences(planted_problem, space, START, 1e-3).slopes()
    assert by_gradient.tolist() == pytest.approx(tried.tolist(), rel=0.03, abs=0.02)
    assert by_gradient[0] > 0.5  # kappa is far above what was planted
    assert by_gradient[1] > 0.5
    loss = float(planted_problem.mean(START))
    unit = space.to_unit(START)
    unit[1] += 1e-3
    moved = {name: float(value) for name, value in space.from_unit(unit[None]).items()}
    expected = (float(planted_problem.mean(moved)) / loss - 1) / 1e-3
    assert float(by_gradient[1]) == pytest.approx(expected, rel=0.03)


def test_figures_of_known_losses():
    found = Differences(
        center=2.0, up=torch.tensor([3.0, math.nan, 1.0]), down=torch.tensor([2.5, 1.0, math.nan]),
        step=0.1,
    )  # fmt: skip
    assert found.slopes().tolist() == pytest.approx([0.5 / 0.2 / 2, 1 / 0.1 / 2, -1 / 0.1 / 2])
    assert found.rises().tolist() == pytest.approx([0.5, -0.5, -0.5])


def test_ends_of_a_range(planted_problem, space):
    at_end = dict(START, third_gain=10.0)
    found = differences(planted_problem, space, at_end, 0.01)
    assert found.up.isnan().tolist() == [False, True, False]
    assert not bool(found.down.isnan().any())
    assert float(found.slopes()[1]) > 0


def test_all_columns(planted_problem):
    free = {"kappa": {"high": 100}, "third_gain": {"high": 10}, "tile_size": {"choices": [8, 12]}}
    space = make_space(FilterSpec(kind="guertin2014", params=FIXED, free=free))
    start = {"kappa": 12.0, "third_gain": 8.0, "tile_size": 12}
    tuned = {"kappa": 3.0, "third_gain": 5.0, "tile_size": 12}
    planted_problem.blur.config = planted_problem.blur.config.model_copy(
        update={"direction_exponent": 2.5}
    )
    found = measure_sensitivity(planted_problem, space, start, tuned)
    assert list(found) == ["kappa", "third_gain"]
    one = found["third_gain"]
    before = gradient_slopes(planted_problem, space.continuous(), start)
    after = gradient_slopes(planted_problem, space.continuous(), tuned)
    assert one.start_gradient == pytest.approx(float(before[1]))
    assert one.gradient == pytest.approx(float(after[1]))
    tried = differences(planted_problem, space.continuous(), start, 0.01)
    assert one.start_difference == pytest.approx(float(tried.slopes()[1]))
    around = differences(planted_problem, space.continuous(), tuned, 0.05)
    assert one.difference == pytest.approx(float(around.slopes()[1]))
    assert one.rise == pytest.approx(float(around.rises()[1]))
    assert measure_sensitivity(planted_problem, space.subset(("tile_size",)), start, tuned) == {}


@pytest.mark.parametrize(
    ("gradient", "tried", "misled"),
    [
        (1.0, 1.1, False),
        (1.0, -1.0, True),
        (0.0, 0.9, True),
        (0.01, -0.02, False),
        (None, 1.0, False),
    ],
)
def test_who_is_misled(gradient, tried, misled):
    one = SensitivityResult(
        start_gradient=gradient, start_difference=tried, gradient=0, difference=0, rise=0
    )
    assert _is_misled(one) is misled
