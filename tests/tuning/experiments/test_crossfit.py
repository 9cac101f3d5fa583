"""Crossfit: no fit sees its case, intervals are those of a bootstrap, a stopped run goes on."""

import csv
import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_shots import box_blur, moving_square
from typer.testing import CliRunner

import tuning.experiments.crossfit.run
import tuning.methods.gradient_state
from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.frame import Shutter
from torchblur.io import load_yaml, read_frame, read_image, save_yaml, write_frame, write_image
from torchblur.metrics import border_band, evaluate
from torchblur.params import build
from tuning.cli.app import app
from tuning.config.fit import TuneConfig
from tuning.experiments.crossfit.bootstrap import (
    GAINS,
    METRICS,
    Figure,
    Sums,
    draws_of,
    figures_of,
    summarize,
)
from tuning.experiments.crossfit.config import Bootstrap, load_crossfit_config
from tuning.experiments.crossfit.run import run_crossfit
from tuning.experiments.crossfit.summary import (
    MEAN,
    final_variants,
    is_met,
    mean_names,
    summary_of,
    verdicts,
)
from tuning.experiments.crossfit.write import write_crossfit
from tuning.objective.prepare import prepare

FILES = {"sharp": "sharp.####.exr", "reference": "reference.####.exr"}
CASES = {"one": 1, "two": 2, "three": 1}


def write_cases(root):
    """Write three shots of a square, each of its own speed."""
    for index, (name, count) in enumerate(CASES.items()):
        (root / name).mkdir()
        for number in range(1, count + 1):
            frame = moving_square(shift=number, speed=8.0 + 4 * index)
            write_frame(root / name / f"sharp.{number:04d}.exr", frame)
            write_image(root / name / f"reference.{number:04d}.exr", box_blur(frame))


def item(name, **changes):
    return {"kind": "exr", "path": name, **FILES, **changes}


def crossfit_data(root):
    """Three cases, one of them of two frames; a filter that is fitted and two that are not."""
    return {
        "title": "Tiny",
        "data": {"root": str(root), "cases": {name: [item(name)] for name in CASES}},
        "filters": {
            "line": {"filter": {"kind": "line"}},
            "guertin": {
                "filter": {
                    "kind": "guertin2014",
                    "params": {"num_samples": 9, "tile_size": 8},
                    "free": {"third_gain": {"high": 16}, "noise": {"choices": ["none"]}},
                },
                "methods": [
                    {"kind": "blackbox", "sampler": "random", "trials": 3},
                    {"kind": "gradient", "steps": 3, "starts": 1, "continue_from_best": True},
                ],
            },
            "mcguire": {"filter": {"kind": "mcguire2012", "params": {"num_samples": 7}}},
        },
        "bootstrap": {"tile": 16, "draws": 200},
        "targets": {"flip_ratio": 0.9, "psnr_band_gain": 0.5},
        "seed": 3,
        "device": "cpu",
        "engine": "eager",
    }


def loaded(root, change=lambda data: None, name="crossfit.yaml"):
    data = crossfit_data(root)
    change(data)
    save_yaml(root / name, data, overwrite=True)
    return load_crossfit_config(root / name)


class Finished:
    """A crossfit that is over."""

    def __init__(self, root):
        self.root, self.events = root, []
        write_cases(root)
        self.config = loaded(root)
        self.folder = root / "out"
        self.found = run_crossfit(self.config, self.folder, self.events.append)
        self.rows = summary_of(self.config, self.found)
        self.files = write_crossfit(self.folder, self.config, self.found)

    def row(self, case, name, variant):
        key = (case, name, variant)
        (row,) = [r for r in self.rows if (r.case, r.filter, r.variant) == key]
        return row


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return Finished(tmp_path_factory.mktemp("crossfit"))


def timeless(found):
    folds = [dataclasses.replace(fold, cpu_seconds=0) for fold in found.folds]
    scored = [(o.case, o.filter, o.variant, o.sums.plain()) for o in found.scored]
    return folds, scored


class TestFolds:
    def test_no_fit_sees_its_case(self, finished):
        folders = sorted((finished.folder / "folds").iterdir())
        assert [f.name.rpartition(".")[0] for f in folders] == [
            "guertin.without-one", "guertin.without-three", "guertin.without-two",
        ]  # fmt: skip
        for folder in folders:
            left_out = folder.name.rpartition(".")[0].rpartition("-")[2]
            data = load_yaml(folder / "config.yaml")["data"]
            assert [one["path"] for one in data["holdout"]] == [left_out]
            others = [name for name in CASES if name != left_out]
            assert [one["path"] for one in data["train"]] == others

    def test_objective_is_of_the_other_cases(self, finished):
        """The start's loss is that over these two cases alone, by a fit made by hand."""
        fold = finished.found.folds[1]
        assert (fold.filter, fold.case) == ("guertin", "two")
        spec = finished.config.filters["guertin"].filter.model_dump()
        config = {
            "filter": spec,
            "data": {"root": str(finished.root), "train": [item("one"), item("three")]},
            "engine": "eager",
        }
        problem = prepare(build(TuneConfig, config | {"methods": [{"kind": "blackbox"}]})).problem
        expected = float(problem.mean(fold.start))
        assert fold.start_objective == pytest.approx(expected, rel=1e-6)

    def test_always_is_fitted_and_never_scored(self, finished, tmp_path):
        def change(data):
            data["data"]["always"] = [data["data"]["cases"].pop("three")[0] | {"weight": 2.0}]

        config = loaded(finished.root, change, "always.yaml")
        for case, other in (("one", "two"), ("two", "one")):
            fold = config.fold("guertin", case)
            assert [one.path for one in fold.data.train] == [other, "three"]
            assert [one.path for one in fold.data.holdout] == [case]
        assert config.fold("guertin", "one").data.train[1].weight == 2.0

    def test_always_may_name_a_family(self, finished):
        def change(data, path="everyday"):
            data["data"]["always"] = [{"kind": "family", "path": path, "scenes": 1}]

        item = loaded(finished.root, change, "family.yaml").fold("guertin", "one").data.train[-1]
        assert item.path.endswith("configs/families/everyday.yaml")
        assert Path(item.path).is_file()
        with pytest.raises(ConfigError, match=r"no scene `everydey` .did you mean `everyday`"):
            loaded(finished.root, lambda data: change(data, "everydey"), "typo.yaml")

    def test_weights_are_of_the_fit_alone(self, finished):
        def change(data):
            data["data"]["cases"]["two"][0]["weight"] = 3.0

        config = loaded(finished.root, change, "weights.yaml")
        assert config.fold("guertin", "one").data.train[0].weight == 3.0
        assert config.fold("guertin", "two").data.holdout[0].weight is None

    def test_fits_improve(self, finished):
        for fold in finished.found.folds:
            assert fold.objective < fold.start_objective
            assert fold.passes == 6
            assert fold.chosen in ("random", "gradient")
        folds = finished.found.folds
        assert len({fold.tuned["third_gain"] for fold in folds}) == len(folds)

    def test_a_fold_is_a_run(self, finished, tmp_path):
        """`tune --resume` on its folder gives the report, with the same parameters."""
        folder = next((finished.folder / "folds").glob("guertin.without-one.*"))
        found = CliRunner().invoke(
            app, ["tune", str(folder / "config.yaml"), "-o", str(folder), "--resume"]
        )
        assert found.exit_code == 0, found.output
        assert (folder / "report.html").is_file()
        params = load_yaml(folder / "preset.yaml")["params"]
        assert params["third_gain"] == finished.found.folds[0].tuned["third_gain"]


class TestScores:
    def test_rows(self, finished):
        names = ["sharp", "line default", "guertin default", "guertin given", "guertin tuned"]
        names += ["mcguire default", "mcguire given"]
        for case in (*CASES, MEAN):
            assert [row.label for row in finished.rows if row.case == case] == names

    def test_figures_are_those_of_evaluate(self, finished):
        """Of one frame, by the filter with the values of the fit that did not see it."""
        fold = finished.found.folds[2]
        frame = read_frame(finished.root / "three" / "sharp.0001.exr", "auto")
        reference = read_image(finished.root / "three" / "reference.0001.exr")
        params = {"num_samples": 9, "tile_size": 8} | dict(fold.tuned)
        with torch.no_grad():
            image = get_filter("guertin2014")(**params)(frame, shutter=0.5)
        band = border_band(frame, Shutter(0.5))
        expected = evaluate(image, reference, masks={"band": band})
        figures = finished.row("three", "guertin", "tuned").figures
        for name in METRICS:
            assert figures[name].value == pytest.approx(float(expected[name]), rel=1e-5), name

    def test_frames_of_a_case_are_pooled(self, finished):
        errors = []
        for number in (1, 2):
            frame = read_frame(finished.root / "two" / f"sharp.{number:04d}.exr", "auto")
            reference = read_image(finished.root / "two" / f"reference.{number:04d}.exr")
            errors.append(float(((frame.color - reference) ** 2).mean()))
        figures = finished.row("two", "sharp", "").figures
        assert figures["psnr"].value == pytest.approx(-10 * np.log10(np.mean(errors)), rel=1e-5)

    def test_against_line(self, finished):
        for case in CASES:
            line = finished.row(case, "line", "default").figures
            assert line["flip_ratio"] == Figure(1.0, 1.0, 1.0)
            assert line["psnr_band_gain"] == Figure(0.0, 0.0, 0.0)
            own = finished.row(case, "guertin", "tuned").figures
            ratio = own["flip"].value / line["flip"].value
            assert own["flip_ratio"].value == pytest.approx(ratio)
            gain = own["psnr_band"].value - line["psnr_band"].value
            assert own["psnr_band_gain"].value == pytest.approx(gain)
            assert own["flip"].low < own["flip"].value < own["flip"].high

    def test_mean(self, finished):
        for name in (*METRICS, *GAINS):
            each = [finished.row(c, "guertin", "tuned").figures[name].value for c in CASES]
            mean = finished.row(MEAN, "guertin", "tuned").figures[name]
            assert mean.value == pytest.approx(np.mean(each))
            assert mean.low <= mean.value <= mean.high


def sums_of(flip, count=None):
    """Tiles with sums of FLIP; the other sums are the same, the band has the first tile alone."""
    count = [1.0] * len(flip) if count is None else count
    first = [1.0] + [0.0] * (len(flip) - 1)
    plain = {"count": count, "flip": flip, "square": flip, "ssim": flip}
    return Sums(plain | {f"{n}_band": np.multiply(v, first) for n, v in plain.items()})


class TestBootstrap:
    def test_by_hand(self):
        """Two tiles are drawn as both, or twice the one or the other: three possible figures."""
        flip, line = [1.0, 6.0], [2.0, 4.0]
        count = [10.0, 20.0]
        draws = draws_of(2, Bootstrap(draws=4000, seed=1), [7])
        found = figures_of(sums_of(flip, count), sums_of(line, count), draws)
        assert found["flip"][0] == pytest.approx(7 / 30)
        assert set(found["flip"].round(9)) == {0.1, 0.3, round(7 / 30, 9)}
        shares = [np.mean(np.isclose(found["flip"][1:], v)) for v in (0.1, 7 / 30, 0.3)]
        assert shares == pytest.approx([0.25, 0.5, 0.25], abs=0.03)
        ratio = summarize(found["flip_ratio"], 0.95)
        assert ratio == Figure(*map(pytest.approx, (7 / 6, 1 / 2, 3 / 2)))
        half = summarize(found["flip_ratio"], 0.4)  # quantiles 0.3 and 0.7 are the draw of both
        assert (half.low, half.high) == pytest.approx((7 / 6, 7 / 6))

    def test_against_a_loop(self):
        generator = np.random.default_rng(5)
        flip, line, count = (generator.random(12) + 0.1 for _ in range(3))
        draws = draws_of(12, Bootstrap(draws=50), [1])
        found = figures_of(sums_of(flip, count), sums_of(line, count), draws)
        gains = []
        for row in draws:
            tiles = list(itertools.chain(*([i] * int(n) for i, n in enumerate(row))))
            assert len(tiles) == 12
            own, other = (sum(x[i] for i in tiles) / sum(count[i] for i in tiles)
                          for x in (flip, line))  # fmt: skip
            gains.append(10 * np.log10(other / own))
        assert found["psnr_gain"] == pytest.approx(gains)
        figure = summarize(np.array(gains), 0.9)
        assert (figure.low, figure.high) == pytest.approx(np.quantile(gains[1:], [0.05, 0.95]))

    def test_pairs_share_their_draws(self):
        """An image that is half as wrong everywhere is so in each draw, whatever the tiles."""
        line = np.linspace(0.1, 3, 20)
        found = figures_of(sums_of(line / 2), sums_of(line), draws_of(20, Bootstrap(), [1]))
        assert summarize(found["flip_ratio"], 0.95) == Figure(*[pytest.approx(0.5)] * 3)

    def test_draws_without_a_band_do_not_count(self):
        found = figures_of(sums_of([3.0, 1.0]), sums_of([1.0, 1.0]), draws_of(2, Bootstrap(), [1]))
        assert np.isnan(found["flip_band"]).mean() == pytest.approx(0.25, abs=0.05)
        assert summarize(found["flip_band"], 0.95) == Figure(3.0, 3.0, 3.0)

    def test_no_figure(self):
        assert summarize(np.array([np.nan, 1.0]), 0.95) == Figure(None, None, None)
        assert summarize(np.array([1.0, np.nan, np.inf]), 0.95) == Figure(1.0, None, None)

    def test_seeds(self):
        one, again = (draws_of(9, Bootstrap(seed=1), [4]) for _ in range(2))
        assert np.array_equal(one, again)
        assert not np.array_equal(one, draws_of(9, Bootstrap(seed=2), [4]))
        assert not np.array_equal(one, draws_of(9, Bootstrap(seed=1), [5]))

    def test_cut_tiles_count_by_their_pixels(self, finished):
        """48x64 px in tiles of 20 px: the last row and column are smaller."""
        config = loaded(finished.root, lambda d: d["bootstrap"].update(tile=20), "tiles.yaml")
        cases = tuning.experiments.crossfit.run._load(config, config.scored("one"), "cases.one")
        sums = tuning.experiments.crossfit.run.tile_sums(
            cases, tuning.experiments.crossfit.run.Variant(name="sharp"), 20
        )
        assert sums.arrays["count"].tolist() == [*[400.0, 400, 400, 80] * 2, 160, 160, 160, 32]
        whole = figures_of(sums, sums, np.ones((1, 12)))
        figure = finished.row("one", "sharp", "").figures["flip"]
        assert whole["flip"][0] == pytest.approx(figure.value, rel=1e-6)


@pytest.fixture(scope="module")
def several(finished):
    """Case "one" is of 48 lines, "three" of 1080, "two" has a frame of each."""

    def change(data):
        data["data"]["cases"] = {
            "one": [item("one")],
            "two": [item("two", frames=[1]), item("two", frames=[2], lines=1080)],
            "three": [item("three", lines=1080)],
        }
        data["filters"].pop("guertin")

    config = loaded(finished.root, change, "heights.yaml")
    found = run_crossfit(config, finished.root / "heights")
    return config, found, summary_of(config, found)


class TestHeights:
    def test_means_of_each_height_then_of_all(self, finished, several):
        config, found, rows = several
        assert mean_names(config, rows) == ("mean, 1080 lines", "mean, 48 lines", "mean")
        flips = {r.case: r.figures["flip"].value for r in rows if r.label == "mcguire given"}
        whole = {case: finished.row(case, "mcguire", "given").figures["flip"] for case in CASES}
        for case, figure in whole.items():
            assert flips[case] == pytest.approx(figure.value)
        assert flips["mean"] == pytest.approx(np.mean([figure.value for figure in whole.values()]))
        (two,) = [
            one
            for one in found.scored
            if (one.case, one.filter) == ("two", "mcguire") and one.variant == "given"
        ]
        parts = {
            lines: s.metrics(np.ones((1, len(s))))["flip"][0] for lines, s in two.heights.items()
        }
        assert set(parts) == {48, 1080}
        for lines, case in ((48, "one"), (1080, "three")):
            want = (whole[case].value + parts[lines]) / 2
            assert flips[f"mean, {lines} lines"] == pytest.approx(want)

    def test_tables_have_them(self, finished, several):
        config, found, _ = several
        files = write_crossfit(finished.root / "heights", config, found)
        text = files[0].read_text()
        heads = [line for line in text.splitlines() if line.startswith("## ")]
        assert heads[:4] == [
            "## Mean over the cases, 1080 lines", "## Mean over the cases, 48 lines",
            "## Mean over the cases", "## one",
        ]  # fmt: skip
        assert "| one | two | three | mean, 1080 lines | mean, 48 lines | mean |" in text
        command = ["crossfit", str(finished.root / "heights.yaml")]
        output = CliRunner().invoke(app, [*command, "-o", str(finished.root / "heights")]).output
        assert "Mean over the cases that were left out, 1080 lines" in output


@pytest.mark.filterwarnings("error")
def test_what_is_cut_is_told(finished):
    """Half spreads are 2, 3 and 4 px; two frames are of the second case."""
    assert not (finished.folder / "tables.md").read_text().count("Cut short")

    def change(data):
        data["filters"].pop("guertin")
        data["filters"]["mcguire"]["filter"]["params"]["tile_size"] = 2

    config = loaded(finished.root, change, "cut.yaml")
    files = write_crossfit(
        finished.root / "cut", config, run_crossfit(config, finished.root / "cut")
    )
    text = files[0].read_text()
    assert "- mcguire given: on 3 of 4 frames it cuts short up to 4.7 % of the pixels" in text
    assert "goes up to 4 px to each side." in text


class TestTargets:
    def test_sides(self):
        assert is_met("flip_ratio", 0.75, 0.75)
        assert not is_met("flip_band_ratio", 0.76, 0.75)
        assert is_met("psnr_gain", 1.5, 1.5)
        assert not is_met("psnr_band_gain", 1.4, 1.5)

    def test_verdicts(self, finished):
        assert final_variants(finished.config, finished.found) == {
            "line": "default", "guertin": "tuned", "mcguire": "given",
        }  # fmt: skip
        found = verdicts(finished.config, finished.found, finished.rows)
        assert len(found) == 2 * 2 * 4  # filters, targets, cases and their mean
        for one in found:
            variant = {"guertin": "tuned", "mcguire": "given"}[one.filter]
            figure = finished.row(one.case, one.filter, variant).figures[one.target]
            is_ratio = one.target == "flip_ratio"
            assert one.met == (figure.value <= 0.9 if is_ratio else figure.value >= 0.5)
            ends = [(e <= 0.9 if is_ratio else e >= 0.5) for e in (figure.low, figure.high)]
            assert one.sure == (ends[0] == ends[1])
            assert one.text.startswith("met" if one.met else "not met")
            assert one.text.endswith("?") != one.sure


class TestResume:
    def test_stopped_within_a_fit(self, finished, tmp_path, monkeypatch):
        count, advance = iter(range(1000)), tuning.methods.gradient_state.AdamState.advance

        def interrupted(state, problem):
            if next(count) == 4:  # in the second fit
                raise KeyboardInterrupt
            return advance(state, problem)

        monkeypatch.setattr(tuning.methods.gradient_state.AdamState, "advance", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_crossfit(finished.config, tmp_path)
        assert len(list(tmp_path.glob("folds/*/fold.json"))) == 1
        assert timeless(run_crossfit(finished.config, tmp_path)) == timeless(finished.found)
        assert next(count) == 10  # one step was stopped; nine were made
        for folder in (finished.folder, tmp_path):
            (log,) = folder.glob("folds/guertin.without-two.*/log.jsonl")
            records = [json.loads(line) for line in log.read_text().splitlines()]
            steps = [(r["method"], r["step"]) for r in records]
            assert steps == [(m, step) for m in (0, 1) for step in range(3)]

    def test_what_is_there_is_not_done_again(self, finished, monkeypatch):
        monkeypatch.setattr(tuning.experiments.crossfit.run, "prepare", None)
        monkeypatch.setattr(tuning.experiments.crossfit.run, "tile_sums", None)
        events = []
        found = run_crossfit(finished.config, finished.folder, events.append)
        assert timeless(found) == timeless(finished.found)
        assert [(e.done, e.total) for e in events] == [(6, 6)]

    def test_new_source_scores_anew_and_keeps_the_fits(self, finished, monkeypatch):
        monkeypatch.setattr(
            tuning.experiments.crossfit.run, "figures_hash", lambda: "another filter"
        )
        monkeypatch.setattr(tuning.experiments.crossfit.run, "prepare", None)
        scored, score = [], tuning.experiments.crossfit.run.tile_sums
        monkeypatch.setattr(
            tuning.experiments.crossfit.run,
            "tile_sums",
            lambda *given: scored.append(given) or score(*given),
        )
        run_crossfit(finished.config, finished.folder)
        assert len(scored) == 3 * 7

    @pytest.mark.slow
    def test_workers_find_the_same(self, finished, tmp_path):
        found = run_crossfit(finished.config, tmp_path, workers=2)
        assert timeless(found) == timeless(finished.found)


class TestFiles:
    def test_all_of_them(self, finished):
        names = [path.name for path in finished.files]
        assert names == ["tables.md", "crossfit.json", "points.csv", "ratios.png"]
        assert all(path.stat().st_size > 100 for path in finished.files)

    def test_points(self, finished):
        text = (finished.folder / "points.csv").read_text()
        rows = list(csv.DictReader(text.splitlines()))
        assert len(rows) == 4 * 7 * 10
        row = next(
            r for r in rows
            if (r["case"], r["filter"], r["variant"], r["metric"])
            == ("two", "guertin", "tuned", "flip_ratio")
        )  # fmt: skip
        figure = finished.row("two", "guertin", "tuned").figures["flip_ratio"]
        ends = [float(row[key]) for key in ("value", "low", "high")]
        assert ends == pytest.approx([figure.value, figure.low, figure.high], rel=1e-5)

    def test_tables(self, finished):
        text = (finished.folder / "tables.md").read_text()
        figure = finished.row("one", "guertin", "tuned").figures["flip_ratio"]
        assert f"| {figure.value:.3f} ({figure.low:.3f} to {figure.high:.3f}) |" in text
        assert "| guertin | start | without one | without two | without three |" in text
        assert "FLIP at most 0.9 of line's" in text

    def test_json(self, finished):
        data = json.loads((finished.folder / "crossfit.json").read_text())
        assert len(data["rows"]) == 4 * 7
        assert [fold["case"] for fold in data["folds"]] == list(CASES)

    def test_command(self, finished):
        found = CliRunner().invoke(
            app, ["crossfit", str(finished.root / "crossfit.yaml"), "-o", str(finished.folder)]
        )
        assert found.exit_code == 0, found.output
        assert "guertin tuned" in found.output
        assert "PSNR at borders at least 0.5 dB above line's" in found.output


class TestMistakes:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda d: d["data"]["cases"].pop("one") and d["data"]["cases"].pop("two"), "cases"),
            (lambda d: d["data"]["cases"].update(two=[]), r"data\.cases\.two"),
            (lambda d: d["data"]["cases"].update(mean=[item("x")]), "'mean' is what .*cases.mean"),
            (lambda d: d["targets"].update(flip=0.5), "targets.flip"),
            (lambda d: d["filters"]["guertin"].pop("methods"), "'guertin' has free .*guertin"),
            (lambda d: d["filters"]["line"].update(methods=[{"kind": "gradient"}]), "'line' h"),
            (lambda d: d["filters"].update(sharp={"filter": {"kind": "warp"}}), "'sharp' is what"),
            (lambda d: d["filters"]["mcguire"]["filter"]["params"].update(taps=3), "taps"),
            (lambda d: d["filters"]["mcguire"]["filter"].update(kind="mcgire2012"), "mcguire2012"),
            (lambda d: d["filters"]["guertin"]["filter"]["free"].update(kapa={}), "kappa.*guertin"),
            (lambda d: d["bootstrap"].update(level=1.5), "bootstrap.level"),
        ],
    )  # fmt: skip
    def test_refused(self, tmp_path, change, message):
        with pytest.raises(ConfigError, match=message):
            loaded(tmp_path, change)

    def test_gradient_of_choices_alone(self, tmp_path):
        def change(data):
            data["filters"]["guertin"]["filter"]["free"].pop("third_gain")

        with pytest.raises(ConfigError, match=r"`noise`.*filters\.guertin, without 'one'"):
            loaded(tmp_path, change)

    def test_missing_folder(self, tmp_path):
        write_cases(tmp_path)
        config = loaded(tmp_path, lambda d: d["data"]["cases"].update(two=[item("tow")]))
        with pytest.raises(ConfigError, match=r"tow does not exist.*data\.cases\.two\.0\.path"):
            run_crossfit(config, tmp_path / "out")
