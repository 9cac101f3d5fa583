"""Fits: planted parameters come back, bad losses are survived, a run keeps its promises."""

import json

import pytest
import torch
from planted import FIXED, PLANTED, write_planted

import tuning.methods.gradient_state
import tuning.objective.batches
from torchblur.errors import ConfigError, OutputError
from torchblur.io import load_yaml, read_frame, read_image
from torchblur.metrics import psnr
from torchblur.params import build
from torchblur.presets import create_filter, load_preset
from tuning.config.fit import FilterSpec, TuneConfig
from tuning.config.methods import BlackBoxMethod, GradientMethod
from tuning.data.blurring import blurred
from tuning.fit.run import run_fit
from tuning.methods.blackbox import BlackBoxJob, fit_blackbox
from tuning.methods.gradient import fit_gradient
from tuning.methods.gradient_state import FitError, GradientJob
from tuning.objective.sensitivity import sensitivities
from tuning.objective.space import make_space
from tuning.results.fit import FitResult


def space_of(free, **params):
    return make_space(FilterSpec(kind="guertin2014", params=params, free=free))


def gradient_job(space, **settings):
    return GradientJob(
        method=GradientMethod(kind="gradient", **settings),
        index=0, name="gradient", space=space, fixed={}, first=(space.start(),), seed=3,
    )  # fmt: skip


def search_job(space, **settings):
    return BlackBoxJob(
        method=BlackBoxMethod(kind="blackbox", **settings),
        index=0, name="search", space=space, fixed={}, first=(space.start(),), seed=3,
    )  # fmt: skip


class TestRecovery:
    def test_gradient_from_three_starts(self, planted_problem):
        planted_problem.objective = planted_problem.objective.model_copy(
            update={"terms": {"l1": 1.0}}
        )
        job = gradient_job(space_of(list(PLANTED)), steps=130, starts=3, learning_rate=0.08)
        result = fit_gradient(planted_problem, job)
        assert result.starts[0].first == {
            "kappa": 40.0, "third_gain": 2.0, "direction_exponent": 1.0,
        }  # fmt: skip
        for start in result.starts:
            assert start.params == pytest.approx(PLANTED, rel=0.01), start

    @pytest.mark.parametrize("seed", [1, 2, 3])
    def test_blackbox_from_three_seeds(self, planted_problem, seed):
        """Two parameters, so that a search of this length can be that exact."""
        free = {"kappa": {"low": 1, "high": 50}, "third_gain": {"low": 0, "high": 16}}
        space = space_of(free, direction_exponent=PLANTED["direction_exponent"])
        job = search_job(space, sampler="cmaes", trials=200)
        job = BlackBoxJob(**(vars(job) | {"seed": seed, "fixed": {"direction_exponent": 2.5}}))
        result = fit_blackbox(planted_problem, job)
        assert result.params == pytest.approx(PLANTED, rel=0.01)

    def test_search_over_all_classes(self, planted_problem):
        free = {
            "num_samples": {"choices": [3, 11, 24]},
            "directions": {},
            "tile_size": {"low": 8, "high": 16},
            "tau": {},
        }
        space = space_of(free, num_samples=11, tile_size=12)
        result = fit_blackbox(planted_problem, search_job(space, trials=12))
        assert set(result.params) == set(free)
        assert isinstance(result.params["tile_size"], int)
        assert result.params["num_samples"] in (3, 11, 24)
        assert result.evaluations == 12

    def test_windows_drawn_anew_find_the_same(self, planted_problem):
        planted_problem.objective = planted_problem.objective.model_copy(
            update={"terms": {"l1": 1.0}}
        )
        space = space_of({"third_gain": {"high": 10}}, kappa=3.0)
        job = gradient_job(space, steps=80, starts=2, learning_rate=0.08, batch=1)
        fixed = {"kappa": 3.0, "direction_exponent": 2.5}
        job = GradientJob(**(vars(job) | {"fixed": fixed}))
        result = fit_gradient(planted_problem, job)
        assert result.params["third_gain"] == pytest.approx(5.0, rel=0.02)

    def test_points_stay_in_the_range(self, planted_problem):
        space = space_of({"third_gain": {"low": 0.0, "high": 3.0}})
        job = gradient_job(space, steps=25, starts=2, learning_rate=0.2)
        result = fit_gradient(planted_problem, job)
        assert result.params == {"third_gain": 3.0}

    def test_scale_of_the_objective_does_not_matter(self, planted_problem):
        job = gradient_job(space_of(["third_gain"]), steps=4, starts=2)
        found = []
        for weight in (1.0, 1e-6):
            terms = {"terms": {"l1": weight}}
            planted_problem.objective = planted_problem.objective.model_copy(update=terms)
            planted_problem._single.clear()
            found.append(
                [s.params["third_gain"] for s in fit_gradient(planted_problem, job).starts]
            )
        assert found[1] == pytest.approx(found[0], rel=1e-4)

    def test_points_do_not_get_lost_outside_the_cube(self, planted_problem):
        """Outside, where the range is clamped, there is no gradient that leads back."""
        job = gradient_job(space_of({"third_gain": {"high": 3.0}}), starts=3, learning_rate=1.0)
        state = tuning.methods.gradient_state.AdamState(job)
        for _ in range(3):
            state.advance(planted_problem)
            assert bool(((state.unit >= 0) & (state.unit <= 1)).all())


class TestSensitivity:
    def test_finite_differences_at_the_optimum(self, planted_problem):
        space = space_of([*PLANTED, "soft_depth_extent"])
        values = dict(PLANTED, soft_depth_extent=0.1)
        values["third_gain"] = 5.2  # not exactly the optimum, whose loss is 0
        rises = sensitivities(planted_problem, space, values)
        assert rises["soft_depth_extent"] == 0  # acts only with depth_compare="absolute"
        here = float(planted_problem.mean(values))
        losses = []
        for step in (0.05, -0.05):
            point = space.to_unit(values)
            point[1] += step
            moved = {n: float(v) for n, v in space.from_unit(point[None]).items()}
            losses.append(float(planted_problem.mean(moved)))
        assert rises["third_gain"] == pytest.approx(max(losses) / here - 1, rel=1e-3)


class TestBadLosses:
    @pytest.fixture
    def break_above(self, monkeypatch):
        """Make the image NaN for all values of kappa above a limit."""

        def break_it(limit):
            def broken(blur, frame, shutter, position, values, free):
                image = blurred(blur, frame, shutter, position, values, free)
                kappa = torch.as_tensor(values["kappa"]).view(-1, 1, 1, 1)
                return torch.where(kappa > limit, torch.nan, image)

            monkeypatch.setattr(tuning.objective.batches, "blurred", broken)

        return break_it

    def test_a_start_is_dropped(self, planted_problem, break_above):
        space = space_of(["kappa"])
        job = gradient_job(space, steps=1, starts=4)
        firsts = [s.first["kappa"] for s in fit_gradient(planted_problem, job).starts]
        limit = sum(sorted(firsts)[1:3]) / 2
        break_above(limit)
        result = fit_gradient(planted_problem, job)
        lost = [start.objective is None for start in result.starts]
        assert lost == [first > limit for first in firsts]
        assert result.dropped == sum(lost) == 2

    def test_no_start_is_left(self, planted_problem, break_above):
        break_above(0.0)
        with pytest.raises(FitError, match="no start has a finite loss at step 0"):
            fit_gradient(planted_problem, gradient_job(space_of(["kappa"]), starts=2))

    def test_failed_trials_are_passed_over(self, planted_problem, break_above):
        break_above(45.0)
        job = search_job(space_of(["kappa"]), sampler="random", trials=8)
        result = fit_blackbox(planted_problem, job)
        assert result.evaluations == 8
        assert 0 < result.dropped < 8
        assert result.params["kappa"] <= 45.0
        break_above(0.0)
        with pytest.raises(FitError, match="none of 8 trials has a finite loss"):
            fit_blackbox(planted_problem, job)


class Finished:
    """A run that is over, and what it told while it went on."""

    def __init__(self, root):
        self.frames, self.folder, self.events = root / "frames", root / "run", []
        config = build(TuneConfig, write_planted(self.frames))
        self.result = run_fit(config, self.folder, progress=self.events.append)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return Finished(tmp_path_factory.mktemp("finished"))


class TestFinishedRun:
    def test_files(self, finished):
        assert {file.name for file in finished.folder.iterdir()} == {
            "config.yaml", "log.jsonl", "preset.yaml", "result.json", "report.html", "run.lock",
            "checkpoint-0.pt", "study-1.log",
        }  # fmt: skip
        assert FitResult.load(finished.folder / "result.json") == finished.result

    def test_result(self, finished):
        result = finished.result
        assert result.variants() == (
            "sharp", "line", "default", "start", "gradient", "tpe", "tuned",
        )  # fmt: skip
        assert {(s.case, s.split) for s in result.scores} == {
            ("first", "train"), ("second", "holdout"),
        }  # fmt: skip
        assert result.objective < result.start_objective
        assert result.objective == min(method.objective for method in result.methods)
        assert result.mean("tuned", "holdout", "psnr") > result.mean("default", "holdout", "psnr")
        flip = [s.scores["flip"] for s in result.scores if s.variant == "line"]
        assert result.mean("line", "train", "flip") == flip[0]
        assert result.mean("nothing", "train", "flip") is None

    def test_progress(self, finished):
        stages = list(dict.fromkeys(event.stage for event in finished.events))
        then = ["gradient", "tpe", "evaluation", "sensitivity", "report"]
        assert stages == ["data", "what acts", *then]
        steps = [e for e in finished.events if e.stage == "gradient"]
        assert [e.done for e in steps] == [1, 2, 3, 4]
        assert steps[0].eta > 0
        assert steps[-1].eta == 0
        assert steps[-1].best <= steps[0].loss

    def test_log_has_a_line_for_each_step(self, finished):
        lines = (finished.folder / "log.jsonl").read_text().splitlines()
        records = [json.loads(line) for line in lines]
        steps = [(r["method"], r["step"]) for r in records if "loss" in r]
        assert steps == [(0, step) for step in range(4)] + [(1, step) for step in range(5)]
        assert records[0]["params"]["kappa"][0] == pytest.approx(40.0)
        assert len(records[0]["params"]["kappa"]) == 2

    def test_preset_is_what_was_scored(self, finished):
        path = finished.folder / "preset.yaml"
        assert load_preset(path).params == finished.result.params
        blur = create_filter(path)
        frame = read_frame(finished.frames / "second" / "sharp.exr")
        target = read_image(finished.frames / "second" / "reference.exr")
        with torch.no_grad():
            got = float(psnr(blur(frame), target))
        assert got == pytest.approx(finished.result.mean("tuned", "holdout", "psnr"), abs=1e-3)
        evidence = load_yaml(path)["evidence"]
        assert (evidence["train"], evidence["holdout"]) == (["first"], ["second"])
        figures = evidence["figures"]["holdout"]
        assert figures["tuned"]["psnr"] > figures["default"]["psnr"]
        assert evidence["objective"]["color_space"] == "linear"


class TestRun:
    @pytest.fixture
    def config(self, planted_folders):
        return build(TuneConfig, planted_folders)

    def test_same_seed_same_result(self, config, tmp_path, finished):
        one = run_fit(config, tmp_path / "one")
        assert one.params == finished.result.params
        assert one.scores == finished.result.scores
        other = config.model_copy(update={"seed": 6})
        assert run_fit(other, tmp_path / "other").methods[1].params != one.methods[1].params

    def test_command_that_makes_it_again(self, config, tmp_path, monkeypatch):
        words = "/bin/torchblur tune a.yaml --resume -o runs/a --set seed=2 --overwrite".split()
        monkeypatch.setattr("sys.argv", words)
        result = run_fit(config, tmp_path / "run")
        assert result.command == "torchblur tune a.yaml -o runs/a --set seed=2"

    def test_holdout_has_no_say(self, planted_folders, tmp_path, finished):
        planted_folders["data"]["holdout"] = []
        without = run_fit(build(TuneConfig, planted_folders), tmp_path / "without")
        assert finished.result.params == without.params
        assert any("no hold-out" in note for note in without.notes)

    @pytest.mark.parametrize("starts", [1, 2])
    def test_sequence_of_methods(self, planted_folders, tmp_path, starts):
        """The gradient goes on from the search, with what it cannot fit as the search left it."""
        planted_folders["filter"]["free"] = {
            "kappa": {}, "third_gain": {}, "tile_size": {"choices": [6, 12]},
        }  # fmt: skip
        planted_folders["filter"]["params"]["tile_size"] = 6
        planted_folders["methods"] = [
            {"kind": "blackbox", "sampler": "random", "trials": 6},
            {
                "kind": "gradient", "steps": 3, "starts": starts, "continue_from_best": True,
                "free": ["kappa", "third_gain"],
            },
        ]  # fmt: skip
        result = run_fit(build(TuneConfig, planted_folders), tmp_path / "run")
        search, gradient = result.methods
        assert gradient.params["tile_size"] == search.params["tile_size"]
        assert gradient.starts[-1].first["kappa"] == pytest.approx(search.params["kappa"], rel=1e-5)
        assert gradient.objective <= search.objective
        assert result.chosen == "gradient"

    def test_nothing_better_than_the_start(self, planted_folders, tmp_path):
        planted_folders["filter"]["params"] |= PLANTED
        result = run_fit(build(TuneConfig, planted_folders), tmp_path / "run")
        assert result.chosen == "start"
        assert {p.name: p.tuned for p in result.parameters} == PLANTED

    def test_ceiling_is_at_least_as_good(self, planted_folders, tmp_path):
        planted_folders |= {"ceiling_steps": 4, "methods": planted_folders["methods"][:1]}
        result = run_fit(build(TuneConfig, planted_folders), tmp_path / "run")
        ceiling = result.mean("ceiling", "holdout", "psnr")
        assert ceiling >= result.mean("tuned", "holdout", "psnr") - 1e-6

    def test_a_parameter_at_the_edge_of_its_range_is_told(self, planted_folders, tmp_path):
        descent = {"kind": "gradient", "steps": 8, "starts": 1, "learning_rate": 0.3}
        data = planted_folders | {"methods": [descent]}
        data["filter"] = {
            "kind": "guertin2014",
            "params": FIXED | PLANTED | {"third_gain": 2.0},
            "free": {"third_gain": {"low": 1.5, "high": 2.2}},
        }
        result = run_fit(build(TuneConfig, data), tmp_path / "run")
        (note,) = (note for note in result.notes if "edge" in note)
        assert note.startswith("`third_gain` ended at the edge of its range, 2")
        assert note.endswith(" of 2.2; widen it.")
        assert note in (tmp_path / "run" / "report.html").read_text()

    def test_what_changes_nothing_is_told_before_the_first_trial(self, planted_folders, tmp_path):
        free = ["kappa", "soft_depth_extent", "depth_compare"]  # the two depths lie far apart
        data = planted_folders | {"methods": [{"kind": "blackbox", "trials": 2}]}
        data["filter"] = data["filter"] | {"free": free}
        events = []
        result = run_fit(build(TuneConfig, data), tmp_path / "run", progress=events.append)
        (place,) = (i for i, e in enumerate(events) if "`soft_depth_extent` changes" in e.message)
        assert not any(event.stage.startswith("tpe") for event in events[:place])
        assert sum("changes nothing" in note for note in result.notes) == 2

    def test_folder_that_is_there(self, config, tmp_path):
        (tmp_path / "mine").mkdir()
        (tmp_path / "mine" / "thesis.tex").write_text("x")
        with pytest.raises(OutputError, match="mine has files that are no run"):
            run_fit(config, tmp_path / "mine", overwrite=True)
        run = tmp_path / "run"
        run_fit(config, run)
        with pytest.raises(OutputError, match=r"has a run already; resume=True \(--resume\)"):
            run_fit(config, run)
        other = config.model_copy(update={"seed": 9})
        with pytest.raises(ConfigError, match=r"(?s)another configuration.*seed: was 5, now 9"):
            run_fit(other, run, resume=True)
        assert run_fit(other, run, overwrite=True).seed == 9
        assert load_yaml(run / "config.yaml")["seed"] == 9

    def test_folder_that_cannot_be_written(self, config, tmp_path):
        (tmp_path / "file").write_text("")
        with pytest.raises(OutputError, match=r"cannot write into .*file/run"):
            run_fit(config, tmp_path / "file" / "run")
        with pytest.raises(OutputError, match="is a file; a folder for the run is needed"):
            run_fit(config, tmp_path / "file")

    def test_unknown_device(self, config, tmp_path):
        broken = config.model_copy(update={"device": "tpu:7"})
        with pytest.raises(ConfigError, match="`device` 'tpu:7' cannot be used"):
            run_fit(broken, tmp_path / "run")
