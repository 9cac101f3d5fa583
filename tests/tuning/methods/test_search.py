"""Searches by populations, with pruning, and with polishing: what they evaluate and remember."""

import contextlib
import dataclasses
import json
import math

import pytest
import torch
from planted import FIXED, PLANTED, planted_case

import tuning.methods.blackbox
from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.params import build
from tuning.config.fit import FilterSpec, TuneConfig, resolve
from tuning.config.methods import BlackBoxMethod, PruningSpec
from tuning.config.objective import ObjectiveSpec
from tuning.files.run_folder import RunFolder
from tuning.fit.run import run_fit
from tuning.methods.blackbox import BlackBoxJob, fit_blackbox
from tuning.methods.polish import is_promising
from tuning.methods.pruning import Ladder, rung_sizes
from tuning.methods.search import Journal
from tuning.objective.batches import FrameGroup
from tuning.objective.candidates import evaluate_candidates
from tuning.objective.problem import Problem
from tuning.objective.space import make_space
from tuning.objective.windows import make_samples

FREE = {
    "kappa": {"low": 1, "high": 50}, "third_gain": {"high": 10},
    "direction_exponent": {"low": 0.5, "high": 8}, "tile_size": {"choices": [8, 12]},
}  # fmt: skip
MODES = {
    "population": {"sampler": "tpe", "trials": 13, "population": 4},
    "generations": {"sampler": "cmaes", "trials": 13, "population": 4},
    "gp": {"sampler": "gp", "trials": 15, "population": 3},
    "sha": {"trials": 14, "pruning": {"startup": 2}},
    "hyperband": {"trials": 14, "pruning": {"pruner": "hyperband", "startup": 2}},
    "median": {"trials": 14, "population": 3, "pruning": {"pruner": "median", "startup": 2}},
    "parts": {"trials": 14, "pruning": {"startup": 2, "crop": 0.5}},
    "polish": {"trials": 8, "polish": {"steps": 3}},
    "all": {"trials": 10, "population": 3, "polish": {"steps": 2}, "pruning": {"startup": 1}},
}


class StoppedError(Exception):
    """Stands for a kill."""


@pytest.fixture(scope="module")
def samples():
    """Eight windows of four frames."""
    frames = [planted_case(seed) for seed in (1, 2, 3, 4)]
    case = [dataclasses.replace(frame, name=f"{frame.name} again") for frame in frames]
    return make_samples([*frames, *case], None, tile_size=12, seed=0)


@pytest.fixture
def problem(samples):
    blur = get_filter("guertin2014")(**FIXED).requires_grad_(False)
    objective = ObjectiveSpec(terms={"mse": 1.0}, color_space="linear")
    return Problem(blur, samples, objective, tuple(FREE))


def job_of(free=None, **settings):
    space = make_space(FilterSpec(kind="guertin2014", params=FIXED, free=free or FREE))
    return BlackBoxJob(
        method=BlackBoxMethod(kind="blackbox", **settings), index=0, name="search", space=space,
        fixed={}, first=(space.start(),), seed=3,
        polished=tuple(name for name in space.names if name in PLANTED),
    )  # fmt: skip


def lines(folder):
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def told(folder):
    """Return what must not depend on time."""
    return [{k: v for k, v in line.items() if k != "cpu_seconds"} for line in lines(folder)]


def logged(problem, path, job):
    path.mkdir(exist_ok=True)
    result = fit_blackbox(problem, job, RunFolder(path))
    return result, lines(path)


class TestPopulation:
    def test_a_batch_is_what_its_members_are(self, problem):
        space = job_of().space
        generator = torch.Generator().manual_seed(2)
        kappas = torch.rand(6, generator=generator) * 40 + 1
        candidates = [
            space.start() | {"kappa": float(kappa), "tile_size": 8 if index % 3 else 12}
            for index, kappa in enumerate(kappas)
        ]
        alone = [float(problem.mean(candidate)) for candidate in candidates]
        for together in (1, 3, 100):
            arguments = (problem, space, {}, candidates)
            found = evaluate_candidates(*arguments, together=together)
            assert [float(one.losses) for one in found] == pytest.approx(alone, rel=1e-5)
            found = evaluate_candidates(*arguments, by_window=True, together=together)
            assert [len(one.losses) for one in found] == [8] * 6
            assert [float(one.losses.mean()) for one in found] == pytest.approx(alone, rel=1e-5)

    def test_what_differs_in_floats_alone_is_filtered_in_one_call(self, problem, monkeypatch):
        calls = []
        each = Problem.each

        def watched(self, values, count=1, chosen=None):
            assert torch.as_tensor(values["kappa"]).numel() == count
            calls.append((values["tile_size"], count))
            return each(self, values, count, chosen)

        monkeypatch.setattr(Problem, "each", watched)
        space = job_of().space
        candidates = [
            space.start() | {"kappa": 2.0 + index, "tile_size": (8, 12, 8, 8)[index]}
            for index in range(4)
        ]
        evaluate_candidates(problem, space, {}, candidates, by_window=True, together=9)
        assert calls == [(8, 3), (12, 1)]

    @pytest.mark.parametrize("sampler", ["tpe", "cmaes"])
    def test_how_many_go_together_has_no_say(self, problem, tmp_path, sampler):
        found = []
        for together in (1, 3, 100):
            job = job_of(sampler=sampler, trials=13, population=4, together=together)
            found.append(logged(problem, tmp_path / str(together), job)[1])
        for log in found[1:]:
            assert [line["params"] for line in log] == [line["params"] for line in found[0]]
            losses = [[line["loss"][0] for line in lines] for lines in (log, found[0])]
            assert losses[0] == pytest.approx(losses[1], rel=1e-5)

    def test_none_of_a_population_knows_the_others(self, problem, tmp_path):
        """Its first member is drawn alike whatever its size; later ones are not."""
        settings = {"sampler": "gp", "trials": 18}
        small = logged(problem, tmp_path / "1", job_of(**settings, population=1))[1]
        large = logged(problem, tmp_path / "8", job_of(**settings, population=8))[1]
        same = [a["params"] == b["params"] for a, b in zip(small, large, strict=True)]
        assert same[:10] == [True] * 10  # still random
        assert not any(same[11:17])

    def test_generations_of_cmaes(self, problem, tmp_path):
        logged(problem, tmp_path / "run", job_of(sampler="cmaes", trials=13, population=4))
        trials = Journal(RunFolder(tmp_path / "run"), 0).trials()
        generations = [trial.system_attrs.get("cma:generation") for trial in trials]
        assert generations == [None, *[0] * 4, *[1] * 4, *[2] * 4]


class TestPruning:
    @pytest.mark.parametrize(
        ("total", "first", "factor", "sizes"),
        [
            (16, 0.25, 2, (4, 8, 16)),
            (10, 0.1, 3, (1, 3, 9, 10)),
            (4, 0.01, 2, (1, 2, 3, 4)),
            (3, 0.5, 2, (2, 3)),
            (1, 0.5, 2, (1,)),
        ],
    )
    def test_rungs(self, total, first, factor, sizes):
        assert rung_sizes(total, PruningSpec(first=first, factor=factor)) == sizes

    def test_order_is_of_the_seed(self, problem):
        orders = [Ladder(problem, PruningSpec(), seed).order for seed in (1, 1, 2)]
        assert orders[0] == orders[1] != orders[2]
        assert sorted(orders[0]) == list(range(8))

    @pytest.mark.parametrize("pruner", ["sha", "hyperband", "median"])
    @pytest.mark.parametrize("population", [1, 4])
    def test_what_pruned_trials_cost(self, problem, monkeypatch, tmp_path, pruner, population):
        filtered = []
        parts = FrameGroup.parts

        def counted(group, blur, values, *args):
            kappa = values["kappa"]
            sets = len(kappa) if isinstance(kappa, torch.Tensor) else 1
            filtered.append(sets * len(group.inner))
            yield from parts(group, blur, values, *args)

        monkeypatch.setattr(FrameGroup, "parts", counted)
        job = job_of(trials=24, population=population, pruning={"pruner": pruner, "startup": 3})
        result, log = logged(problem, tmp_path / "run", job)
        pruned = [line for line in log if "pruned" in line]
        assert 0 < len(pruned) == result.pruned < 21
        assert all(line["loss"] == [None] for line in pruned)
        assert {line["passes"] for line in pruned} <= {0.25, 0.5}
        assert not any("pruned" in line for line in log[:3])
        assert result.passes == sum(line["passes"] for line in log) < 24
        assert sum(filtered) == 8 * (result.passes + 1)  # and the best once more
        assert result.evaluations == 24

    @pytest.mark.parametrize("reduction", ["mean", "cvar"])
    def test_all_windows_are_the_whole_objective(self, problem, tmp_path, reduction):
        problem.objective = problem.objective.model_copy(
            update={"reduction": reduction, "tail": 0.3}
        )
        result, log = logged(problem, tmp_path / "run", job_of(trials=6, pruning={}))
        whole = [line for line in log if line["loss"][0] is not None]
        assert len(whole) >= 5
        for line in whole:
            values = {name: value[0] for name, value in line["params"].items()}
            assert line["loss"][0] == pytest.approx(float(problem.mean(values)), rel=1e-5)
        assert result.objective == pytest.approx(min(line["loss"][0] for line in whole), rel=1e-3)

    def test_rungs_are_nested_windows(self, problem, monkeypatch, tmp_path):
        """A pruned trial's figure is the objective of the first windows in the order."""
        job = job_of(trials=20, pruning={"startup": 2})
        _, log = logged(problem, tmp_path / "run", job)
        seeds = []
        monkeypatch.setattr(
            "tuning.methods.blackbox.Ladder",
            lambda p, s, seed: seeds.append(seed) or Ladder(p, s, seed),
        )
        tuning.methods.blackbox._Search(problem, job)
        order = Ladder(problem, PruningSpec(), seeds[0]).order
        pruned = [line for line in log if "pruned" in line]
        assert len(pruned) > 4
        for line in pruned:
            values = {name: value[0] for name, value in line["params"].items()}
            seen = order[: int(8 * line["passes"])]
            expected = problem.each(values)[list(seen)].mean()
            assert line["pruned"] == pytest.approx(float(expected), rel=1e-5)

    def test_a_loss_that_is_not_finite_is_a_failed_trial(self, problem, monkeypatch, tmp_path):
        each = Problem.each

        def broken(self, values, count=1, chosen=None):
            bad = float(values["kappa"]) > 20
            return each(self, values, count, chosen) * (math.nan if bad else 1.0)

        monkeypatch.setattr(Problem, "each", broken)
        result, log = logged(problem, tmp_path / "run", job_of(trials=12, pruning={}))
        assert 0 < result.dropped < 12
        for line in log:
            if line["params"]["kappa"][0] > 20:
                assert line["loss"] == [None]
                assert "pruned" not in line
                assert line["passes"] == 0.25

    def test_too_few_windows(self, problem):
        problem.samples = problem.samples[:1]
        with pytest.raises(ConfigError, match=r"`pruning` needs two rungs.*0\.25` of 1 window "):
            fit_blackbox(problem, job_of(trials=3, pruning={}))


class TestPolish:
    @pytest.mark.parametrize(
        ("loss", "before", "quantile", "expected"),
        [
            (9.0, [], 0.1, True),
            (2.0, [1.0], 0.25, False),
            (0.5, [1.0], 0.25, True),
            (2.0, [1.0, 3.0, 4.0, 5.0], 0.25, True),
            (2.0, [1.0, 3.0, 4.0], 0.25, False),
            (9.0, [1.0, 3.0, 4.0], 1.0, True),
            (math.inf, [], 1.0, False),
        ],
    )
    def test_promising(self, loss, before, quantile, expected):
        assert is_promising(loss, before, quantile) is expected

    def test_what_is_found_is_a_trial(self, problem, tmp_path):
        result, log = logged(problem, tmp_path / "run", job_of(trials=8, polish={"steps": 4}))
        drawn = {line["step"]: line for line in log if "polish_of" not in line}
        polished = [line for line in log if "polish_of" in line]
        assert len(drawn) == 8
        assert 0 < len(polished) == result.polished < 8
        assert result.evaluations == 8 + 5 * len(polished)
        for line in polished:
            origin = drawn[line["polish_of"]]
            assert line["loss"][0] < origin["loss"][0]
            assert line["params"]["tile_size"] == origin["params"]["tile_size"]
            assert all(line["params"][name] != origin["params"][name] for name in PLANTED)
            values = {name: value[0] for name, value in line["params"].items()}
            assert line["loss"][0] == float(problem.mean(values))
        assert result.objective == min(line["loss"][0] for line in polished)
        losses, expected = [], []
        for step, line in sorted(drawn.items()):
            if is_promising(line["loss"][0], losses, 0.25):
                expected.append(step)
            losses.append(line["loss"][0])
        assert [line["polish_of"] for line in polished] == expected

    def test_the_sampler_learns_from_it(self, problem, tmp_path):
        """After the first polished trial, GP and TPE draw otherwise than without it."""
        for sampler in ("tpe", "gp"):
            settings = {"sampler": sampler, "trials": 16}
            _, plain = logged(problem, tmp_path / sampler, job_of(**settings))
            job = job_of(**settings, polish={"steps": 2, "quantile": 0.01})
            _, log = logged(problem, tmp_path / f"{sampler} polished", job)
            drawn = [line["params"] for line in log if "polish_of" not in line]
            assert drawn[-1] != plain[-1]["params"]

    def test_it_finds_what_was_planted_sooner(self, problem):
        plain = fit_blackbox(problem, job_of(trials=12))
        polish = {"steps": 12, "learning_rate": 0.06}
        polished = fit_blackbox(problem, job_of(trials=12, polish=polish))
        assert polished.objective < 0.3 * plain.objective

    def test_only_what_is_named(self, problem, tmp_path):
        job = dataclasses.replace(job_of(trials=4, polish={"steps": 2}), polished=("third_gain",))
        _, log = logged(problem, tmp_path / "run", job)
        drawn = {line["step"]: line["params"] for line in log}
        polished = [line for line in log if "polish_of" in line]
        assert polished
        for line in polished:
            before = drawn[line["polish_of"]]
            assert {n for n in before if before[n] != line["params"][n]} == {"third_gain"}


class TestResume:
    @pytest.mark.parametrize("mode", MODES)
    def test_killed_wherever_it_was(self, problem, tmp_path, monkeypatch, mode):
        whole, _ = logged(problem, tmp_path / "whole", job_of(**MODES[mode]))
        parts = FrameGroup.parts
        for stop_at in (1, 40, 17, 90):
            count = iter(range(10000))

            def stopping(group, *args, count=count, stop_at=stop_at):
                if next(count) == stop_at:
                    raise StoppedError
                yield from parts(group, *args)

            monkeypatch.setattr(FrameGroup, "parts", stopping)
            with contextlib.suppress(StoppedError):  # the last may be done before
                logged(problem, tmp_path / "parts", job_of(**MODES[mode]))
        monkeypatch.setattr(FrameGroup, "parts", parts)
        resumed, _ = logged(problem, tmp_path / "parts", job_of(**MODES[mode]))
        timeless = {"seconds", "cpu_seconds"}
        assert resumed.model_dump(exclude=timeless) == whole.model_dump(exclude=timeless)
        assert told(tmp_path / "parts") == told(tmp_path / "whole")

    def test_killed_between_the_lines_of_a_round(self, problem, tmp_path, monkeypatch):
        job = job_of(**MODES["all"])
        logged(problem, tmp_path / "whole", job)
        add, count = Journal.add, iter(range(100))

        def killed(journal, trial, *, ends_round):
            add(journal, trial, ends_round=ends_round)
            if next(count) == 3:
                assert not ends_round
                raise StoppedError

        monkeypatch.setattr(Journal, "add", killed)
        with pytest.raises(StoppedError):
            logged(problem, tmp_path / "parts", job)
        monkeypatch.setattr(Journal, "add", add)
        logged(problem, tmp_path / "parts", job)
        assert told(tmp_path / "parts") == told(tmp_path / "whole")


class TestConfig:
    @pytest.mark.parametrize(
        ("method", "message"),
        [
            (
                {"sampler": "cmaes", "polish": {}},
                r"`polish` needs a sampler that learns.*got cmaes \(x\.yaml: methods\.0\.polish\)",
            ),
            (
                {"free": ["tile_size"], "polish": {}},
                r"`polish` needs a smooth parameter, and the search has tile_size \(x\.yaml: "
                r"methods\.0\.polish\)",
            ),
            (
                {"polish": {"free": ["kapa"]}},
                r"`kapa` is not among the parameters of the search \(did you mean `kappa`\?\) "
                r"\(x\.yaml: methods\.0\.polish\.free\)",
            ),
            (
                {"polish": {"free": ["tile_size"]}},
                r"`tile_size` is discrete and cannot be polished.*methods\.0\.polish\.free",
            ),
            ({"polish": {"quantile": 0}}, r"`quantile`: .*0, got 0 \(.*methods\.0\.polish"),
            (
                {"sampler": "cmaes", "population": 3},
                r"cmaes needs at least 4 candidates, got `population: 3`.*methods\.0\.population\)",
            ),
            ({"population": 0}, r"`population`: .*1, got 0 \(.*methods\.0\.population"),
            ({"pruning": {"pruner": "asha"}}, r"`pruner`: .*got 'asha' \(.*methods\.0\.pruning"),
            ({"pruning": {"first": 1.0}}, r"`first`: .*less than 1, got 1\.0"),
            ({"pruning": {"factor": 1}}, r"`factor`: .*2, got 1"),
            ({"pruning": {"crop": 1.0}}, r"`crop`: .*less than 1, got 1\.0"),
            ({"pruning": {"rungs": 3}}, r"unknown key `rungs`"),
        ],
    )
    def test_mistakes(self, method, message):
        data = {
            "filter": {"kind": "guertin2014", "free": FREE},
            "data": {"train": [{"kind": "scene", "path": "a.yaml"}]},
            "methods": [{"kind": "blackbox"} | method],
        }
        with pytest.raises(ConfigError, match=message) as caught:
            resolve(build(TuneConfig, data, "x.yaml"), "x.yaml")
        assert len(str(caught.value).splitlines()) == 1


def test_a_whole_run(planted_folders, tmp_path):
    """All of it at once, on windows, through to the report."""
    planted_folders["filter"]["free"] = dict(FREE)
    planted_folders["data"]["crops"] = {"size": 24, "per_frame": 4, "context": 8}
    planted_folders["methods"] = [
        {
            "kind": "blackbox", "trials": 16, "population": 4, "polish": {"steps": 3, "batch": 2},
            "pruning": {"pruner": "median", "startup": 4},
        }
    ]  # fmt: skip
    result = run_fit(build(TuneConfig, planted_folders), tmp_path / "run")
    search = result.methods[0]
    assert result.objective < result.start_objective
    assert search.pruned > 0
    assert search.polished > 0
    assert search.passes < search.evaluations
    page = (tmp_path / "run" / "report.html").read_text()
    assert f"{search.pruned} pruned, {search.polished} polished" in page
