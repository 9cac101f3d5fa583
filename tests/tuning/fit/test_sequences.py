"""Fits over sequences: the objective, truncation, warm-up, planted parameters, a whole run."""

import dataclasses
import json
import math

import pytest
import torch
from planted import planted_case
from planted_sequences import PLANTED_GAIN, Recall, moving_sequence, sequence_case, write_sequences

import tuning.objective.batches
from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.metrics import flip_ldr, temporal_errors
from torchblur.metrics.pooling import weighted_median
from torchblur.params import build
from tuning.config.data import Crops
from tuning.config.fit import FilterSpec, TuneConfig
from tuning.config.methods import BlackBoxMethod, GradientMethod
from tuning.config.objective import ObjectiveSpec
from tuning.data.blurring import arguments, blurred_sequence
from tuning.data.variants import Variant
from tuning.fit.run import run_fit
from tuning.methods.blackbox import BlackBoxJob, fit_blackbox
from tuning.methods.gradient import fit_gradient
from tuning.methods.gradient_state import FitError, GradientJob
from tuning.objective.problem import Problem
from tuning.objective.space import make_space
from tuning.objective.windows import make_samples
from tuning.results.fit import FitResult
from tuning.scoring.cases import score_cases

LINEAR = {"terms": {"mse": 1.0}, "color_space": "linear"}


def problem_of(*cases, crops=None, **objective):
    blur = Recall().requires_grad_(False)
    samples = make_samples(cases, crops, tile_size=1, seed=0, blur=blur)
    return Problem(blur, samples, ObjectiveSpec(**(LINEAR | objective)), ("gain",))


def own_colors(case, gain):
    with torch.no_grad():
        return Recall().sequence(case.samples[0], gain=torch.tensor(gain))


def gains(*values):
    return {"gain": torch.tensor(values, dtype=torch.float64)}


class TestObjective:
    def test_mean_over_the_frames(self):
        case = sequence_case(4)
        got = problem_of(case).mean(gains(0.7))
        want = [
            float(((image - reference) ** 2).mean())
            for image, reference in zip(own_colors(case, 0.7), case.references, strict=True)
        ]
        assert float(got) == pytest.approx(sum(want) / 4, rel=1e-5)
        assert want[0] == 0  # the first frame has no past

    def test_temporal_term(self):
        case = sequence_case(5, cuts=(2,))
        here = problem_of(case, temporal=3.0).mean(gains(0.7))
        without = problem_of(case).mean(gains(0.7))
        errors = temporal_errors(own_colors(case, 0.7), case.references, cuts=(2,), space="linear")
        assert float(here - without) == pytest.approx(3 * float(errors.nanmean()), rel=1e-5)

    def test_warm_up_is_filtered_and_not_scored(self):
        case = sequence_case(6)
        images = own_colors(case, 0.7)
        spoiled = dataclasses.replace(
            case,
            warm_up=3,
            references=(*(torch.rand(1, 3, 48, 64) for _ in range(3)), *case.references[3:]),
        )
        got = problem_of(spoiled, temporal=2.0).mean(gains(0.7))
        squares = [((images[k] - case.references[k]) ** 2).mean() for k in (3, 4, 5)]
        changes = temporal_errors(images[3:], case.references[3:], space="linear")
        want = float(sum(squares) / 3 + 2 * changes.nanmean())
        assert float(got) == pytest.approx(want, rel=1e-5)

    def test_many_sets_at_once_are_single_sets(self):
        problem = problem_of(
            sequence_case(4), sequence_case(4, seed=1), crops=Crops(size=16, context=4),
            temporal=1.0, band_weight=0.3,
        )  # fmt: skip
        points = [0.2, 0.35, 0.9]
        together = problem.mean(gains(*points), 3)
        alone = [float(problem.mean({"gain": point})) for point in points]
        assert together.tolist() == pytest.approx(alone, rel=1e-5)

    def test_windows_of_a_pointwise_filter_are_crops_of_the_frames(self):
        case = sequence_case(3)
        crops = Crops(size=16, per_frame=3, context=0)
        samples = make_samples([case], crops, tile_size=1, seed=0, blur=Recall())
        got = problem_of(case, crops=crops).mean(gains(0.7))
        images, want = own_colors(case, 0.7), []
        for sample in samples:
            for image, reference, whole in zip(
                images, sample.references, case.references, strict=True
            ):
                (place,) = [
                    (y, x)
                    for y in range(48 - 15)
                    for x in range(64 - 15)
                    if torch.equal(whole[..., y : y + 16, x : x + 16], reference)
                ]
                y, x = place
                want.append(float(((image[..., y : y + 16, x : x + 16] - reference) ** 2).mean()))
        assert float(got) == pytest.approx(sum(want) / len(want), rel=1e-5)

    def test_frames_and_sequences_in_one_problem(self):
        blur = get_filter("line")().requires_grad_(False)
        cases = [planted_case(1), sequence_case(3)]
        objective = ObjectiveSpec(**LINEAR)
        parts = [
            float(Problem(blur, make_samples([c], None, tile_size=1, seed=0), objective).mean({}))
            for c in cases
        ]
        samples = make_samples(cases, None, tile_size=1, seed=0)
        got = float(Problem(blur, samples, objective).mean({}))
        assert got == pytest.approx(sum(parts) / 2, rel=1e-5)


class TestTruncation:
    def gradient(self, unroll, count=6, temporal=0.0):
        case = sequence_case(count)
        values = {"gain": torch.tensor([0.7], dtype=torch.float64, requires_grad=True)}
        parts = 0
        for part in problem_of(case, temporal=temporal).losses(values, 1, unroll=unroll):
            if part.requires_grad:  # the first frame has no past and depends on nothing
                part.sum().backward()
            parts += 1
        return float(values["gain"].grad), parts

    def test_each_part_goes_backward_alone(self):
        assert [self.gradient(unroll)[1] for unroll in (None, 1, 2, 4, 6, 9)] == [1, 6, 3, 2, 1, 1]

    def test_as_long_as_the_sequence_is_the_whole(self):
        whole, _ = self.gradient(None)
        assert self.gradient(6)[0] == pytest.approx(whole, rel=1e-9)
        assert self.gradient(9)[0] == pytest.approx(whole, rel=1e-9)
        assert abs(self.gradient(1)[0] - whole) > 0.05 * abs(whole)

    @pytest.mark.parametrize("temporal", [0.0, 2.0])
    @pytest.mark.parametrize("unroll", [1, 2, 4])
    def test_gradient_is_that_of_a_detached_history(self, unroll, temporal):
        """By hand, with the filter's own truncation: what ended a part is a constant."""
        case = sequence_case(6)
        gain = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
        images = Recall().sequence(case.samples[0], detach_every=unroll, gain=gain)
        truth = case.references
        loss = sum(((i - r) ** 2).mean() for i, r in zip(images, truth, strict=True)) / 6
        for k in range(1, 6):
            before = images[k - 1].detach() if k % unroll == 0 else images[k - 1]
            change = (images[k] - before) - (truth[k] - truth[k - 1])
            loss = loss + temporal * change.abs().mean() / 5
        (want,) = torch.autograd.grad(loss, gain)
        assert self.gradient(unroll, temporal=temporal)[0] == pytest.approx(float(want), rel=1e-4)

    def test_whole_gradient_is_the_slope(self):
        case = sequence_case(6)
        problem = problem_of(case, temporal=2.0)
        low, high = problem.mean(gains(0.699, 0.701), 2).tolist()
        got, _ = self.gradient(None, temporal=2.0)
        assert got == pytest.approx((high - low) / 0.002, rel=1e-2)

    @pytest.mark.parametrize("temporal", [0.0, 2.0])
    def test_changes_no_value(self, temporal):
        problem = problem_of(sequence_case(6), temporal=temporal)
        values = gains(0.3, 0.8)
        whole = sum(problem.losses(values, 2)).tolist()
        assert sum(problem.losses(values, 2, unroll=4)).tolist() == pytest.approx(whole, rel=1e-6)


def space():
    return make_space(FilterSpec(kind="recall", free=["gain"]))


def job(kind, method, **changes):
    parts = {
        "method": method, "index": 0, "name": "job", "space": space(), "fixed": {},
        "first": (space().start(),), "seed": 3,
    }  # fmt: skip
    return kind(**(parts | changes))


@pytest.mark.usefixtures("recall")
class TestRecovery:
    @pytest.mark.parametrize("unroll", [None, 2])
    def test_gradient(self, unroll):
        method = GradientMethod(
            kind="gradient", steps=60, starts=3, learning_rate=0.08, unroll=unroll
        )
        problem = problem_of(sequence_case(5), temporal=0.5)
        result = fit_gradient(problem, job(GradientJob, method))
        assert result.starts[0].first["gain"] == 0.8
        for start in result.starts:
            assert start.params["gain"] == pytest.approx(PLANTED_GAIN, rel=0.02)

    def test_gradient_on_windows_drawn_anew(self):
        method = GradientMethod(kind="gradient", steps=60, starts=2, learning_rate=0.08, batch=2)
        cases = [sequence_case(4, seed) for seed in (0, 1)]
        problem = problem_of(*cases, crops=Crops(size=16, per_frame=3, context=4))
        result = fit_gradient(problem, job(GradientJob, method))
        assert result.params["gain"] == pytest.approx(PLANTED_GAIN, rel=0.02)

    def test_blackbox(self):
        method = BlackBoxMethod(kind="blackbox", sampler="cmaes", trials=60)
        result = fit_blackbox(problem_of(sequence_case(5)), job(BlackBoxJob, method))
        assert result.params["gain"] == pytest.approx(PLANTED_GAIN, rel=0.02)

    def test_a_filter_without_memory_on_a_sequence(self):
        """Frame by frame: the shutter comes back from the filter's own output."""
        case = sequence_case(3)
        line = get_filter("line")(num_samples=9)
        with torch.no_grad():
            references = [line(frame, shutter=0.4) for frame in case.samples[0]]
        case = dataclasses.replace(case, references=tuple(references))
        free = make_space(FilterSpec(kind="line", params={"num_samples": 9}, free=["shutter"]))
        blur = line.requires_grad_(False)
        samples = make_samples([case], None, tile_size=1, seed=0, blur=blur)
        problem = Problem(blur, samples, ObjectiveSpec(**LINEAR), ("shutter",))
        method = BlackBoxMethod(kind="blackbox", sampler="tpe", trials=40)
        result = fit_blackbox(problem, job(BlackBoxJob, method, space=free, first=(free.start(),)))
        assert result.params["shutter"] == pytest.approx(0.4, abs=0.1)


@pytest.mark.usefixtures("recall")
class TestBadLosses:
    @pytest.fixture
    def break_above(self, monkeypatch):
        """Make one frame NaN for gains above a limit; what follows inherits it."""

        def break_it(limit):
            def broken(blur, steps, cuts, given, *, unroll=None):
                for index, image in enumerate(
                    blurred_sequence(blur, steps, cuts, given, unroll=unroll)
                ):
                    gain = torch.as_tensor(given["gain"]).view(-1, 1, 1, 1)
                    yield torch.where((gain > limit) & (index == 2), torch.nan, image)

            monkeypatch.setattr(tuning.objective.batches, "blurred_sequence", broken)

        return break_it

    def test_a_set_is_alone_with_it(self, break_above):
        problem = problem_of(sequence_case(4), temporal=1.0)
        fine = problem.mean(gains(0.2, 0.4), 2).tolist()
        break_above(0.5)
        got = problem.mean(gains(0.2, 0.9, 0.4), 3).tolist()
        assert math.isnan(got[1])
        assert [got[0], got[2]] == pytest.approx(fine)

    def test_a_start_is_dropped(self, break_above):
        break_above(0.6)
        method = GradientMethod(kind="gradient", steps=2, starts=4, unroll=2)
        result = fit_gradient(problem_of(sequence_case(4)), job(GradientJob, method))
        lost = [start.objective is None for start in result.starts]
        assert lost == [start.first["gain"] > 0.6 for start in result.starts]
        assert 0 < sum(lost) < 4
        break_above(0.0)
        with pytest.raises(FitError, match="no start has a finite loss at step 0"):
            fit_gradient(problem_of(sequence_case(4)), job(GradientJob, method))


class TestFiltering:
    def test_several_samples_per_pixel(self):
        case = sequence_case(3)
        twice = dataclasses.replace(case, samples=(*case.samples, moving_sequence(3, seed=7)))
        means = [(a.color + b.color) / 2 for a, b in zip(*twice.samples, strict=True)]
        given = arguments(1.0, "centered", {"gain": 1.0}, (), torch.device("cpu"))
        for blur, values in (
            (Recall(), given),
            (get_filter("line")(num_samples=3), {"shutter": 0.0}),
        ):
            with torch.no_grad():
                got = list(blurred_sequence(blur, twice.steps(blur), (), values))
            for image, mean in zip(got, means, strict=True):
                torch.testing.assert_close(image, mean)

    def test_cuts_reset_the_memory(self):
        case = sequence_case(5, cuts=(3,))
        given = arguments(1.0, "centered", {"gain": 0.4}, (), torch.device("cpu"))
        with torch.no_grad():
            whole = list(blurred_sequence(Recall(), case.steps(), case.cuts, given))
            later = list(blurred_sequence(Recall(), case.steps()[3:], (), given))
        assert torch.equal(torch.cat(whole[3:]), torch.cat(later))
        assert torch.equal(whole[3], case.samples[0][3].color)


class TestScores:
    def test_figures_of_frames_and_means(self):
        case = sequence_case(5, warm_up=1, cuts=(3,))
        variant = Variant(name="off", blur=Recall(gain=0.7))
        (score,) = score_cases([case], [variant])
        images = own_colors(case, 0.7)
        assert [frame.scored for frame in score.frames] == [False, True, True, True, True]
        for frame, image, reference in zip(score.frames, images, case.references, strict=True):
            error = flip_ldr(image, reference)
            assert frame.scores["flip"] == pytest.approx(float(error.mean()), rel=1e-5)
            assert frame.scores["flip_median"] == pytest.approx(float(weighted_median(error)))
        flips = [frame.scores["flip"] for frame in score.frames[1:]]
        assert score.scores["flip"] == pytest.approx(sum(flips) / 4)
        changes = temporal_errors(images, case.references, cuts=(3,))[:, 0]
        assert [f.scores["temporal"] is None for f in score.frames] == [
            True, True, False, True, False,
        ]  # fmt: skip
        want = (float(changes[2]) + float(changes[4])) / 2
        assert score.scores["temporal"] == pytest.approx(want, rel=1e-5)
        assert "flip_band" in score.scores

    def test_variants_that_a_case_does_not_have(self):
        variants = [Variant(name="sharp"), Variant(name="input", stream=True)]
        scores = score_cases([planted_case(1), sequence_case(2)], variants)
        assert [(s.case, s.variant) for s in scores] == [("tiny 1", "sharp"), ("tiny", "input")]

    def test_noise_of_the_references(self):
        case = sequence_case(2)
        case = dataclasses.replace(
            case, variances=tuple(torch.full_like(r, 1e-4) for r in case.references)
        )
        (score,) = score_cases([case], [])
        assert score.variant == "noise"
        assert score.scores["psnr"] == pytest.approx(40, abs=0.3)


@pytest.fixture
def config(tmp_path, recall):
    return write_sequences(tmp_path / "frames")


class TestRun:
    def test_whole_run(self, config, tmp_path):
        result = run_fit(build(TuneConfig, config), tmp_path / "run")
        assert result.params["gain"] == pytest.approx(PLANTED_GAIN, rel=0.05)
        assert result.params["shutter"] == 1.0
        assert result.variants() == (
            "sharp",
            "input",
            "line",
            "default",
            "gradient",
            "tpe",
            "tuned",
        )
        before, after = (result.mean(v, "holdout", "temporal") for v in ("default", "tuned"))
        assert after < 0.2 * before
        stored = json.loads((tmp_path / "run" / "result.json").read_text())
        assert FitResult.load(tmp_path / "run" / "result.json") == result
        assert len(stored["scores"][0]["frames"]) == 4
        page = (tmp_path / "run" / "report.html").read_text()
        for said in (
            "fitted to 1 sequence", "Hold-out: 1 sequence", "Over the frames", "second 1-4, frame",
            "weighted median", "the stream as it is",
        ):  # fmt: skip
            assert said in page
        preset = (tmp_path / "run" / "preset.yaml").read_text()
        assert "temporal" in preset
        assert "flip_median" in preset

    def test_resumed_run_is_the_same(self, config, tmp_path):
        config["methods"] = [
            {"kind": "gradient", "steps": 8, "starts": 2, "unroll": 2},
            {"kind": "blackbox", "trials": 4},
        ]
        loaded = build(TuneConfig, config)
        whole = run_fit(loaded, tmp_path / "whole")

        def stop(event):
            if event.stage == "gradient" and event.done == 4:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            run_fit(loaded, tmp_path / "stopped", progress=stop)
        again = run_fit(loaded, tmp_path / "stopped", resume=True)
        assert again.params == whole.params
        assert [m.starts for m in again.methods] == [m.starts for m in whole.methods]
        assert again.scores == whole.scores

    def test_ceiling_of_a_sequence(self, config, tmp_path):
        config["methods"] = [{"kind": "blackbox", "trials": 2}]
        result = run_fit(build(TuneConfig, config | {"ceiling_steps": 3}), tmp_path / "run")
        assert [len(s.frames) for s in result.scores if s.variant == "ceiling"] == [4, 4]

    def test_data_without_times_is_refused(self, config, tmp_path):
        item = {"kind": "exr", "path": "first", "sharp": "center.0001.exr",
                "reference": "reference.0001.exr"}  # fmt: skip
        config["data"] |= {"train": [item], "holdout": []}
        with pytest.raises(
            ConfigError, match=r"recall needs the layer `time`.*items of kind scene_stream and exr"
        ):
            run_fit(build(TuneConfig, config), tmp_path / "run")
