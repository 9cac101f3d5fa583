"""L-BFGS in the unit cube: what it finds, what it counts, and that it goes on after a kill."""

import dataclasses
import itertools
import json
import math

import pytest
import torch
from planted import PLANTED

from torchblur.errors import ConfigError
from torchblur.params import build
from tuning.config.fit import FilterSpec, TuneConfig, resolve
from tuning.config.methods import GradientMethod
from tuning.files.run_folder import RunFolder
from tuning.methods.gradient import fit_gradient
from tuning.methods.gradient_state import FitError, GradientJob, losses_and_slopes
from tuning.methods.lbfgs import LbfgsState
from tuning.objective.batches import FrameGroup
from tuning.objective.problem import Problem
from tuning.objective.space import make_space

TIMES = {"seconds", "cpu_seconds", "spent"}


def job_of(free, fixed=None, first=None, **settings):
    space = make_space(FilterSpec(kind="guertin2014", params={}, free=free))
    method = GradientMethod(kind="gradient", optimizer="lbfgs", **settings)
    return GradientJob(
        method=method, index=0, name="gradient", space=space, fixed=fixed or {},
        first=(space.start() | (first or {}),), seed=3,
    )  # fmt: skip


def log_of(path):
    lines = [json.loads(line) for line in (path / "log.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k not in TIMES} for line in lines]


def test_it_finds_what_was_planted(planted_problem, monkeypatch):
    """Squared errors: their minimum is smooth; and all that is filtered is counted."""
    calls = []
    parts = FrameGroup.parts

    def counted(group, *args):
        calls.append(len(group.inner))
        yield from parts(group, *args)

    monkeypatch.setattr(FrameGroup, "parts", counted)
    result = fit_gradient(planted_problem, job_of(list(PLANTED), steps=12, starts=2))
    monkeypatch.setattr(FrameGroup, "parts", parts)
    assert sum(calls) == 2 * (result.evaluations + 2)  # two windows; and each end once more
    assert result.passes == result.evaluations < 60
    assert result.params == pytest.approx(PLANTED, rel=0.05)
    method = GradientMethod(kind="gradient", steps=result.evaluations // 2, starts=2)
    adam = dataclasses.replace(job_of(list(PLANTED)), method=method)
    assert result.objective < 0.1 * fit_gradient(planted_problem, adam).objective


def test_the_end_of_a_range(planted_problem):
    """The best lies beyond one range: that parameter stays at its end, the other goes on."""
    free = {"third_gain": {"low": 0.0, "high": 4.0}, "kappa": {"low": 1, "high": 50}}
    fixed = {"direction_exponent": PLANTED["direction_exponent"]}
    result = fit_gradient(planted_problem, job_of(free, fixed, steps=15, starts=1))
    kappas = torch.linspace(4, 8, 9, dtype=torch.float64)
    values = fixed | {"third_gain": torch.full_like(kappas, 4.0), "kappa": kappas}
    losses = planted_problem.mean(values, 9)
    assert 0 < int(losses.argmin()) < 8
    assert result.params["third_gain"] == 4.0
    assert result.objective < 1.01 * float(losses.min())
    # Back from the end, where the best is within.
    free["third_gain"]["high"] = 9.0
    at_end = job_of(free, fixed, {"third_gain": 9.0, "kappa": 1.0}, steps=15, starts=1)
    result = fit_gradient(planted_problem, at_end)
    assert result.starts[0].first == {"third_gain": 9.0, "kappa": 1.0}
    assert result.params == pytest.approx(PLANTED, rel=0.05)


def test_steps_only_go_down(planted_problem, tmp_path):
    fit_gradient(planted_problem, job_of(list(PLANTED), steps=8, starts=3), RunFolder(tmp_path))
    losses = [line["loss"] for line in log_of(tmp_path)]
    for before, after in itertools.pairwise(losses):
        assert all(b <= a for a, b in zip(before, after, strict=True))
    line = log_of(tmp_path)[3]
    for index, loss in enumerate(line["loss"]):
        values = {name: value[index] for name, value in line["params"].items()}
        assert loss == pytest.approx(float(planted_problem.mean(values)), rel=1e-5)


def test_first_step_is_of_the_length_that_is_asked_for(planted_problem):
    """Whatever the size of the objective; a line search may make it longer, not shorter."""
    for weight in (1.0, 1e-7):
        planted_problem.objective = planted_problem.objective.model_copy(
            update={"terms": {"mse": weight}}
        )
        planted_problem._joined = None
        job = job_of(list(PLANTED), steps=1, starts=1, learning_rate=0.01)
        seen = []

        class Seeing(LbfgsState):
            def evaluate(self, problem, point, seen=seen):
                seen.append(point.clone())
                return super().evaluate(problem, point)

        Seeing(job).advance(planted_problem)
        assert float((seen[1] - seen[0]).abs().sum()) == pytest.approx(0.01, rel=1e-6)


def test_killed_between_and_within_steps(planted_problem, tmp_path, monkeypatch):
    job = job_of(list(PLANTED), steps=7, starts=2)
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    whole = fit_gradient(planted_problem, job, RunFolder(tmp_path / "whole"))
    weighted = Problem.weighted

    class StoppedError(Exception):
        pass

    for stop_at in (1, 3, 4, 6, 5, 2):
        count = iter(range(1000))

        def stopping(*args, count=count, stop_at=stop_at, **options):
            if next(count) == stop_at:
                raise StoppedError
            yield from weighted(*args, **options)

        monkeypatch.setattr(Problem, "weighted", stopping)
        with pytest.raises(StoppedError):
            fit_gradient(planted_problem, job, RunFolder(tmp_path / "parts"))
    monkeypatch.setattr(Problem, "weighted", weighted)
    resumed = fit_gradient(planted_problem, job, RunFolder(tmp_path / "parts"))
    assert resumed.model_dump(exclude=TIMES) == whole.model_dump(exclude=TIMES)
    assert log_of(tmp_path / "parts") == log_of(tmp_path / "whole")


def test_a_hole_in_the_objective(planted_problem, monkeypatch):
    """Where there is no loss a line search goes back; a start without one is taken out."""
    each = losses_and_slopes
    for bad, dropped in ((lambda third: third > 4.5, 0), (lambda third: third < 2.05, 1)):

        def broken(problem, job, points, chosen=None, bad=bad):
            losses, slopes = each(problem, job, points, chosen)
            third = job.space.from_unit(points)["third_gain"]
            return torch.where(bad(third), torch.nan, losses), slopes

        monkeypatch.setattr("tuning.methods.lbfgs.losses_and_slopes", broken)
        fixed = {"kappa": 3.0, "direction_exponent": 2.5}
        job = job_of({"third_gain": {"high": 10}}, fixed, steps=10, starts=2)
        result = fit_gradient(planted_problem, job)
        assert result.dropped == dropped
        assert math.isfinite(result.objective)
        assert not bad(torch.tensor(result.params["third_gain"]))
    assert result.params["third_gain"] == pytest.approx(5.0, rel=0.02)

    monkeypatch.setattr(
        "tuning.methods.lbfgs.losses_and_slopes",
        lambda problem, job, points: (torch.full((1,), torch.nan), torch.zeros_like(points)),
    )
    with pytest.raises(FitError, match=r"no start has a finite loss at step 0; losses \[nan, nan"):
        fit_gradient(planted_problem, job)


def test_a_start_that_is_done_costs_nothing(planted_problem):
    """No gradient at all: one evaluation, however many steps."""
    free = {"soft_depth_extent": {}}  # acts with another comparison of depths alone
    result = fit_gradient(planted_problem, job_of(free, dict(PLANTED), steps=5, starts=2))
    assert result.evaluations == 2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"batch": 3}, r"lbfgs compares losses.*`batch` out.*\(x: methods\.0\.batch\)"),
        ({"refresh": {}}, r"lbfgs compares losses.*`refresh` out.*\(x: methods\.0\.refresh\)"),
        ({"optimizer": "sgd"}, r"`optimizer`: .*got 'sgd'"),
    ],
)
def test_mistakes(settings, message):
    data = {
        "filter": {"kind": "guertin2014", "free": ["kappa"]},
        "data": {"train": [{"kind": "family", "path": "a.yaml"}]},
        "methods": [{"kind": "gradient", "optimizer": "lbfgs"} | settings],
    }
    with pytest.raises(ConfigError, match=message):
        resolve(build(TuneConfig, data, "x"), "x")
