"""The front of quality against cost: planted ones come back, and a stopped search goes on."""

import json
import math

import pytest
import torch
from planted import FIXED, PLANTED

from tuning.config.cost import cost_of
from tuning.config.fit import FilterSpec
from tuning.config.methods import ParetoMethod, PolishSteps
from tuning.files.run_folder import RunFolder
from tuning.methods.gradient_state import FitError
from tuning.methods.pareto import ParetoJob, fit_pareto
from tuning.objective.space import make_space
from tuning.results.front import ParetoPoint, front_of, pick

TAPS = (3, 7, 11, 24)


class StoppedError(Exception):
    """Stands for a kill between two evaluations."""


def job_of(free, fixed=None, **settings):
    space = make_space(FilterSpec(kind="guertin2014", params=dict(FIXED), free=free))
    return ParetoJob(
        method=ParetoMethod(kind="pareto", **settings),
        index=0,
        name="pareto",
        space=space,
        fixed=fixed or {},
        first=(space.start(),),
        seed=4,
    )


def point(number, objective, cost, **changes):
    return ParetoPoint(
        number=number, origin="search", params={}, objective=objective, cost=cost, taps=1,
        lookups=1, passes=1, **changes,
    )  # fmt: skip


class TestFront:
    def test_by_hand(self):
        points = [
            point(0, 5.0, 1.0),
            point(1, 4.0, 2.0),
            point(2, 4.0, 3.0),  # as good as 1, and dearer
            point(3, 6.0, 2.0),
            point(4, 1.0, 9.0),
            point(5, 5.0, 1.0),  # the same as 0
        ]
        assert front_of(points) == (0, 1, 4)
        assert front_of(reversed(points)) == (0, 1, 4)
        assert front_of([]) == ()

    def test_no_point_beats_one_of_it(self):
        points = [point(n, (n * 37 % 101) / 101, (n * 53 % 97) / 97) for n in range(90)]
        front = {n: points[n] for n in front_of(points)}
        for p in points:
            beaten = any(q.objective <= p.objective and q.cost <= p.cost and q != p for q in points)
            assert beaten == (p.number not in front)

    def test_budgets_pay_for_the_best_they_can(self):
        points = [point(0, 5.0, 0.3), point(1, 4.0, 1.0), point(2, 4.5, 0.9), point(3, 1.0, 5.0)]
        picks = pick(points, {"b": 1.0, "a": 0.25, "c": 1.9})
        assert [(p.name, p.budget, p.number) for p in picks] == [
            ("a", 0.25, None), ("b", 1.0, 1), ("c", 1.9, 1),
        ]  # fmt: skip


class TestPlanted:
    @pytest.mark.parametrize("sampler", ["nsga2", "tpe"])
    def test_the_front_of_all_settings_is_found(self, planted_problem, sampler):
        """Few enough settings that the front is known from trying all of them."""
        free = {"num_samples": {"choices": TAPS}, "directions": {}, "color_lookup": {}}
        job = job_of(free, fixed=PLANTED, sampler=sampler, trials=60, population=6)
        found = fit_pareto(planted_problem, job).pareto
        every = []
        for number in range(16):
            values = {
                "num_samples": TAPS[number % 4],
                "directions": ("one", "two")[number // 4 % 2],
                "color_lookup": ("nearest", "bilinear")[number // 8],
            }
            cost = cost_of("guertin2014", FIXED | values).relative
            every.append(point(number, float(planted_problem.mean(PLANTED | values)), cost))
        by_hand = [(every[n].cost, every[n].objective) for n in front_of(every)]
        assert len(by_hand) >= 3
        got = [(found.point(n).cost, found.point(n).objective) for n in found.front]
        assert torch.allclose(torch.tensor(got), torch.tensor(by_hand))

    def test_the_best_end_is_what_was_planted(self, planted_problem):
        free = {"num_samples": {"choices": TAPS}}
        job = job_of(free, fixed=PLANTED, sampler="tpe", trials=8)
        result = fit_pareto(planted_problem, job)
        assert result.params == PLANTED | {"num_samples": FIXED["num_samples"]}
        assert result.objective < 1e-12
        # What is dearer and worse is not on the front.
        found = result.pareto
        assert [found.point(n).params["num_samples"] for n in found.front] == [3, 7, 11]

    def test_a_front_over_numbers(self, planted_problem):
        """Half of the reference's taps, best with another kappa: quality falls with the cost."""
        job = job_of(["num_samples", "kappa"], sampler="tpe", trials=30)
        found = fit_pareto(planted_problem, job).pareto
        front = [found.point(n) for n in found.front]
        assert [p.objective for p in front] == sorted((p.objective for p in front), reverse=True)
        assert [p.cost for p in front] == sorted(p.cost for p in front)

    def test_polish_makes_presets_better_at_their_cost(self, planted_problem):
        free = {"num_samples": {"choices": (3, 11)}, "kappa": {}, "third_gain": {}}
        options = {"sampler": "tpe", "trials": 8, "budgets": {"cheap": 0.3, "dear": 1.0}}
        rough = fit_pareto(planted_problem, job_of(free, **options))
        steps = PolishSteps(steps=12, learning_rate=0.05)
        result = fit_pareto(planted_problem, job_of(free, polish=steps, **options))
        assert result.polished == 2
        for name, before in rough.pareto.picked().items():
            after = result.pareto.picked()[name]
            assert after.origin == "polished"
            assert after.objective < before.objective
            assert after.cost == before.cost
            again = float(planted_problem.mean(after.params))
            assert after.objective == pytest.approx(again, rel=1e-6)
        # What the steps found is tried at the other costs.
        best = min(result.pareto.points, key=lambda p: p.objective)
        swept = [p for p in result.pareto.points if p.origin == "sweep"]
        (other,) = {3, 11} - {best.params["num_samples"]}
        assert [p.params for p in swept] == [best.params | {"num_samples": other}]
        assert swept[0].objective == pytest.approx(float(planted_problem.mean(swept[0].params)))


class TestSearch:
    def test_begins_with_the_start_and_its_other_numbers_of_taps(self, planted_problem):
        free = {"num_samples": {"low": 2, "high": 32}, "tile_size": {"low": 8, "high": 16}}
        job = job_of(free, sampler="tpe", trials=6, sweep=5)
        points = fit_pareto(planted_problem, job).pareto.points
        assert [p.params["num_samples"] for p in points] == [11, 2, 4, 8, 16, 32]
        assert {p.params["tile_size"] for p in points} == {12}
        assert {p.origin for p in points} == {"given"}

    def test_settings_are_evaluated_once(self, planted_problem, monkeypatch):
        calls = []
        mean = type(planted_problem).mean
        monkeypatch.setattr(
            type(planted_problem),
            "mean",
            lambda self, values, count=1: calls.append(dict(values)) or mean(self, values, count),
        )
        free = {"num_samples": {"choices": TAPS}}
        result = fit_pareto(planted_problem, job_of(free, trials=24, population=6))
        assert len(calls) == len(TAPS)
        assert len(result.pareto.points) == 24

    def test_trials_without_a_finite_loss_are_left_out(self, planted_problem, monkeypatch):
        mean = type(planted_problem).mean

        def broken(self, values, count=1):
            return mean(self, values, count) * (math.nan if values["num_samples"] > 7 else 1)

        monkeypatch.setattr(type(planted_problem), "mean", broken)
        free = {"num_samples": {"choices": TAPS}}
        result = fit_pareto(planted_problem, job_of(free, trials=16, population=4))
        assert {p.params["num_samples"] for p in result.pareto.points} == {3, 7}
        assert result.dropped == 16 - len(result.pareto.points) > 0
        job = job_of({"num_samples": {"choices": (11, 24)}}, trials=4)
        with pytest.raises(FitError, match="pareto: none of 4 trials has a finite loss"):
            fit_pareto(planted_problem, job)

    @pytest.mark.parametrize("sampler", ["nsga2", "tpe"])
    def test_same_seed_same_trials(self, planted_problem, sampler):
        free = {"num_samples": {"low": 2, "high": 24}, "kappa": {}, "directions": {}}
        job = job_of(free, sampler=sampler, trials=20, population=5)
        first, second = (fit_pareto(planted_problem, job).pareto for _ in range(2))
        assert first == second
        other = ParetoJob(**(vars(job) | {"seed": 5}))
        assert fit_pareto(planted_problem, other).pareto != first


@pytest.mark.parametrize("sampler", ["nsga2", "tpe"])
def test_goes_on_after_a_kill_as_it_would_have(planted_problem, tmp_path, sampler):
    free = {"num_samples": {"low": 2, "high": 24}, "kappa": {}, "directions": {}}
    job = job_of(
        free, sampler=sampler, trials=24, population=5 if sampler == "nsga2" else None, sweep=3,
        budgets={"low": 0.3, "high": 1.0}, polish=PolishSteps(steps=2),
    )  # fmt: skip

    def run(name, stop_at=None):
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        counter = iter(range(1000))
        mean = type(planted_problem).mean

        def stopping(self, values, count=1):
            if next(counter) == stop_at:
                raise StoppedError
            return mean(self, values, count)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(type(planted_problem), "mean", stopping)
            return fit_pareto(planted_problem, job, RunFolder(folder))

    whole = run("whole")
    for stop_at in (0, 2, 9, 9, 4):
        with pytest.raises(StoppedError):
            run("parts", stop_at)
    resumed = run("parts")
    assert resumed.pareto == whole.pareto
    assert resumed.params == whole.params
    assert lines(tmp_path / "parts") == lines(tmp_path / "whole")
    assert run("parts", 0).pareto == whole.pareto  # nothing is evaluated again


def lines(folder):
    records = map(json.loads, (folder / "log.jsonl").read_text().splitlines())
    return [(r["step"], r["loss"], r["cost"], r["params"]) for r in records]
