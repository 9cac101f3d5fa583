"""Reductions over frames: values by hand, gradients, and what a fit makes of them."""

import pytest
import torch
from planted import FIXED, PLANTED, planted_case

from torchblur.filters import get_filter
from tuning.config.data import Crops
from tuning.config.objective import ObjectiveSpec
from tuning.objective.problem import Problem
from tuning.objective.terms import tail_weights
from tuning.objective.windows import make_samples


def spec(reduction, tail=0.25, **options):
    return ObjectiveSpec(reduction=reduction, tail=tail, **options)


def column(*losses):
    return torch.tensor(losses, dtype=torch.float64)[:, None]


def problem_of(objective):
    blur = get_filter("guertin2014")(**FIXED).requires_grad_(False)
    cases = [planted_case(1), planted_case(2)]
    crops = Crops(size=16, per_frame=3, context=12)
    samples = make_samples(cases, crops, tile_size=12, seed=0)
    return Problem(blur, samples, objective, tuple(PLANTED))


class TestWeights:
    @pytest.mark.parametrize(
        ("reduction", "tail", "expected"),
        [
            ("mean", 0.25, [0.2, 0.2, 0.2, 0.2, 0.2]),
            ("worst", 0.9, [0, 0, 1, 0, 0]),
            ("cvar", 0.4, [0.5, 0, 0.5, 0, 0]),
            ("cvar", 0.5, [0.4, 0, 0.4, 0, 0.2]),  # two and a half of five
            ("cvar", 0.01, [0, 0, 1, 0, 0]),  # never less than one
            ("cvar", 1.0, [0.2, 0.2, 0.2, 0.2, 0.2]),
        ],
    )
    def test_by_hand(self, reduction, tail, expected):
        got = tail_weights(column(4.0, 1.0, 5.0, 2.0, 3.0), spec(reduction, tail))
        assert got[:, 0].tolist() == pytest.approx(expected)

    def test_each_set_has_its_own_worst(self):
        losses = torch.tensor([[1.0, 9.0], [5.0, 2.0], [3.0, 4.0]])
        got = tail_weights(losses, spec("cvar", 2 / 3))
        assert got.tolist() == [[0.0, 0.5], [0.5, 0.0], [0.5, 0.5]]

    def test_a_whole_number_of_windows_is_whole_in_floats(self):
        got = tail_weights(torch.arange(30.0)[:, None], spec("cvar", 0.1))
        assert int((got > 0).sum()) == 3

    def test_nan_is_the_worst(self):
        got = tail_weights(column(4.0, float("nan"), 5.0), spec("worst"))
        assert got[:, 0].tolist() == [0, 1, 0]


class TestProblem:
    values = {"kappa": 8.0, "third_gain": 4.0, "direction_exponent": 2.0}

    def sets(self, *factors):
        return {
            n: torch.tensor([v * f for f in factors], dtype=torch.float64)
            for n, v in self.values.items()
        }

    @pytest.mark.parametrize("count", [1, 3])
    @pytest.mark.parametrize("reduction", ["cvar", "worst"])
    def test_is_the_mean_of_the_worst_windows(self, count, reduction):
        problem = problem_of(spec(reduction, 0.5, terms={"l1": 1.0}))
        values = self.sets(1.0, 2.0, 0.7) if count == 3 else self.values
        each = problem.each(values, count)
        assert each.shape == (6, count)
        size = 3 if reduction == "cvar" else 1
        by_hand = each.sort(dim=0, descending=True).values[:size].mean(dim=0)
        assert torch.allclose(problem.mean(values, count), by_hand, rtol=1e-12)
        with torch.enable_grad():
            leaves = {n: torch.as_tensor(v).requires_grad_(True) for n, v in values.items()}
            parts = list(problem.losses(leaves, count))
        assert torch.allclose(sum(parts).double(), by_hand, rtol=1e-5)

    def test_windows_that_do_not_count_cost_no_gradient(self):
        problem = problem_of(spec("worst", terms={"l1": 1.0}))
        leaves = {n: v.requires_grad_(True) for n, v in self.sets(1.0, 1.01).items()}
        assert len(list(problem.losses(leaves, 2))) <= 2 < len(problem.samples)

    @pytest.mark.parametrize("reduction", ["cvar", "worst"])
    @pytest.mark.parametrize("chosen", [None, [0, 2, 3, 5]])
    def test_gradient_is_that_of_finite_differences(self, reduction, chosen):
        problem = problem_of(spec(reduction, 0.4, terms={"mse": 1.0}, color_space="linear"))
        values = {n: v.requires_grad_(True) for n, v in self.sets(1.0, 1.6).items()}
        for part in problem.losses(values, 2, chosen):
            part.sum().backward()
        for name, value in values.items():
            step = 2e-2 * self.values[name]
            ends = []
            for sign in (1, -1):
                moved = {n: v.detach().clone() for n, v in values.items()}
                moved[name] += sign * step
                with torch.no_grad():
                    ends.append(sum(problem.losses(moved, 2, chosen)).double())
            slope = (ends[0] - ends[1]) / (2 * step)
            assert torch.allclose(value.grad, slope, rtol=0.02, atol=1e-7), name

    def test_a_set_without_a_finite_window_is_alone_with_it(self, monkeypatch):
        problem = problem_of(spec("cvar", 0.5, terms={"l1": 1.0}))
        each = problem.each(self.sets(1.0, 1.0), 2)
        each[4, 1] = float("nan")
        monkeypatch.setattr(problem, "each", lambda *_: each)
        assert torch.isfinite(problem.mean(self.sets(1.0, 1.0), 2)).tolist() == [True, False]
