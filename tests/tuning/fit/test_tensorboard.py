"""TensorBoard: what the log has, once, whatever happened to the run."""

import json
import math
import sys
import warnings

import numpy as np
import pytest
from typer.testing import CliRunner

from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.io import save_yaml
from torchblur.params import build
from tuning.cli.app import app
from tuning.config.fit import TuneConfig
from tuning.fit.run import run_fit
from tuning.fit.tensorboard import Tracker, tracking
from tuning.progress import ProgressEvent

pytest.importorskip("tensorboard")


def events_of(folder):
    """Return the scalars by tag, as (step, value), and the names of images and other summaries."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        sizes = {"scalars": 0, "images": 0, "tensors": 0}
        events = EventAccumulator(str(folder), size_guidance=sizes)
        events.Reload()
    tags = events.Tags()
    scalars = {t: [(e.step, e.value) for e in events.Scalars(t)] for t in tags["scalars"]}
    images = {t: events.Images(t) for t in tags["images"]}
    return scalars, images, events


def expected(folder, names):
    """Return the scalars that a log asks for, by tag."""
    want = {}
    for line in (folder / "log.jsonl").read_text().splitlines():
        record = json.loads(line)
        if "loss" not in record:
            continue
        name, several = names[record["method"]], len(record["loss"]) > 1
        finite = [loss for loss in record["loss"] if loss is not None]
        want.setdefault(f"{name}/loss", []).append((record["step"], min(finite)))
        for key, values in {"loss": record["loss"] * several, **record["params"]}.items():
            for start, value in enumerate(values):
                tag = f"{name}/{key}" + (f"_of_start_{start + 1}" if several else "")
                if not isinstance(value, str):
                    want.setdefault(tag, []).append((record["step"], float(value)))
    return want


def same(got, want):
    return [s for s, _ in got] == [s for s, _ in want] and np.allclose(
        [v for _, v in got], [v for _, v in want], rtol=1e-6
    )


@pytest.fixture
def config(planted_folders):
    return planted_folders


class TestRun:
    def test_command(self, config, tmp_path):
        """Scalars are those of the log; figures and images come at the end; the result stays."""
        config["filter"]["params"]["noise"] = "none"
        save_yaml(tmp_path / "fit.yaml", config)
        run, logs = tmp_path / "runs" / "one", tmp_path / "logs"
        args = ["tune", str(tmp_path / "fit.yaml"), "-o", str(run), "--track", str(logs)]
        result = CliRunner().invoke(app, args)
        assert result.exit_code == 0, result.output
        scalars, images, events = events_of(logs / "one")
        want = expected(run, ["gradient", "tpe"])
        assert len(want) > 8
        for tag, points in want.items():
            assert same(scalars[tag], points), tag
        best = [value for _, value in scalars["gradient/best"]]
        assert best == sorted(best, reverse=True)
        found = json.loads((run / "result.json").read_text())
        flips = [
            s["scores"]["flip"] for s in found["scores"]
            if (s["variant"], s["split"]) == ("tuned", "holdout")
        ]  # fmt: skip
        assert scalars["holdout_flip/tuned"] == [(0, pytest.approx(flips[0], rel=1e-6))]
        assert scalars["objective"] == [(0, pytest.approx(found["objective"], rel=1e-6))]
        assert "_hparams_/session_start_info" in events.summary_metadata
        kinds = "sharp default tuned reference error_of_default error_of_tuned".split()
        names = {f"{case}/{kind}" for case in ("train first", "holdout second") for kind in kinds}
        assert set(images) == names
        assert {(i[0].width, i[0].height) for i in images.values()} == {(64, 48)}
        assert len({i[0].encoded_image_string for i in images.values()}) == len(images)
        plain = run_fit(build(TuneConfig, config), tmp_path / "plain")
        assert (plain.params, plain.objective) == (found["params"], found["objective"])

    def test_stopped_and_resumed(self, config, tmp_path):
        """Each step stands once, and what the killed process wrote is gone."""
        built, run, logs = build(TuneConfig, config), tmp_path / "run", tmp_path / "logs"

        def stop(event):
            if event.stage == "tpe" and event.done == 2:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt), tracking(logs, run, built, stop) as tracker:
            run_fit(built, run, progress=tracker)
        with tracking(logs, run, built, lambda event: None) as tracker:
            result = run_fit(built, run, resume=True, progress=tracker)
            tracker.finish(result)
        scalars, images, _ = events_of(logs / "run")
        for tag, points in expected(run, ["gradient", "tpe"]).items():
            assert same(scalars[tag], points), tag
        assert len(list((logs / "run").iterdir())) == 1
        # Once more, when all is done: the same again.
        with tracking(logs, run, built, lambda event: None) as tracker:
            tracker.finish(run_fit(built, run, resume=True, progress=tracker))
        again, images_again, _ = events_of(logs / "run")
        assert again == scalars
        assert set(images_again) == set(images)
        assert run_fit(built, tmp_path / "whole").params == result.params

    def test_a_refused_run_leaves_the_events(self, config, tmp_path):
        save_yaml(tmp_path / "fit.yaml", config)
        run, logs = tmp_path / "run", tmp_path / "logs" / "run"
        run.mkdir()
        (run / "config.yaml").write_text("{}")
        logs.mkdir(parents=True)
        old = logs / "events.out.tfevents.1.host.1.0.torchblur"
        old.write_bytes(b"old")
        args = ["tune", str(tmp_path / "fit.yaml"), "-o", str(run), "--track", str(logs.parent)]
        assert CliRunner().invoke(app, args).exit_code == 2
        assert [(f.name, f.read_bytes()) for f in logs.iterdir()] == [(old.name, b"old")]


class TestLog:
    @pytest.fixture
    def tracker(self, config, tmp_path):
        config["filter"]["free"] = {"noise": {}, "third_gain": {}, "center_weight": {}}
        config["methods"] = [
            {"kind": "blackbox", "sampler": "tpe", "trials": 5},
            {"kind": "blackbox", "sampler": "tpe", "trials": 5},
        ]
        (tmp_path / "run").mkdir()
        built = build(TuneConfig, config)
        with tracking(tmp_path / "logs", tmp_path / "run", built, lambda event: None) as tracker:
            yield tracker

    def step(self, tracker, *records, mode="a"):
        with tracker._log.open(mode) as file:
            for record in records:
                file.write(record if isinstance(record, str) else json.dumps(record) + "\n")
        tracker(ProgressEvent(stage="tpe", done=1, total=5))

    def test_choices_switches_and_gaps(self, tracker):
        params = {"noise": ["none"], "third_gain": [3.0], "center_weight": [True]}
        self.step(
            tracker,
            {"note": "a warning"},
            {"method": 1, "step": 0, "loss": [None], "pruned": 0.7, "params": params},
            {"method": 1, "step": 1, "loss": [0.5], "cost": math.nan, "params": {}},
        )
        scalars = events_of(tracker.folder)[0]
        assert scalars == {
            "tpe_2/pruned": [(0, pytest.approx(0.7))],
            "tpe_2/noise": [(0, 2.0)],
            "tpe_2/third_gain": [(0, 3.0)],
            "tpe_2/center_weight": [(0, 1.0)],
            "tpe_2/loss": [(1, 0.5)],
            "tpe_2/best": [(1, 0.5)],
        }

    def test_torn_lines_and_a_log_written_anew(self, tracker):
        first = {"method": 0, "step": 0, "loss": [3.0], "params": {}}
        second = {"method": 0, "step": 1, "loss": [2.0], "params": {}}
        half = json.dumps(second)
        self.step(tracker, first, half[:20])
        assert events_of(tracker.folder)[0]["tpe/loss"] == [(0, 3.0)]
        self.step(tracker, half[20:] + "\n")
        second["cpu_seconds"] = 1.23456
        third = {"method": 0, "step": 2, "loss": [1.0], "params": {}}
        self.step(tracker, first, second, third, mode="w")
        assert events_of(tracker.folder)[0]["tpe/loss"] == [(0, 3.0), (1, 2.0), (2, 1.0)]

    def test_other_files_of_the_folder_stay(self, tracker):
        tracker.folder.mkdir(parents=True)
        other = tracker.folder / "events.out.tfevents.1.host.1.0"
        other.write_bytes(b"x")
        self.step(tracker, {"method": 0, "step": 0, "loss": [3.0], "params": {}})
        assert other.exists()


def test_without_tensorboard(config, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ConfigError, match=r"needs TensorBoard.*pip install 'torchblur\[track\]'"):
        Tracker(tmp_path / "logs", tmp_path / "run", build(TuneConfig, config))
    assert not (tmp_path / "logs").exists()


def test_choice_numbers_are_those_of_the_export():
    """The position of a choice is its number in shaders, too."""
    from torchblur.export import constants_of
    from torchblur.params import choices
    from torchblur.presets import Preset

    noise = next(c for c in constants_of(Preset(filter="guertin2014")) if c.name == "noise")
    assert noise.choices == choices(get_filter("guertin2014").config_class, "noise")
