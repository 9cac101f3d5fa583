"""A whole run that searches for a front: files, presets with evidence, report, mistakes."""

import copy
import csv

import pytest
import torch
from planted import write_planted

from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.io import load_yaml, read_frame, save_yaml
from torchblur.params import build
from torchblur.presets import create_filter, load_preset
from tuning.config.cost import cost_of
from tuning.config.fit import TuneConfig, load_tune_config
from tuning.fit.run import run_fit
from tuning.results.fit import FitResult

SEARCH = {
    "kind": "pareto",
    "sampler": "nsga2",
    "trials": 10,
    "population": 3,
    "sweep": 3,
    "budgets": {"tiny": 0.01, "low": 0.25, "ultra": 2.0, "sky": 9.0},
    "polish": {"steps": 2},
}


class StoppedError(Exception):
    """Stands for a kill between two steps."""


def planted(root):
    data = write_planted(root)
    data["filter"]["free"] = {"num_samples": {"low": 2, "high": 24}, "kappa": {}, "directions": {}}
    return data | {"methods": [copy.deepcopy(SEARCH)]}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run that was never stopped: its folder and its result."""
    root = tmp_path_factory.mktemp("front")
    config = build(TuneConfig, planted(root / "frames"))
    return root / "run", run_fit(config, root / "run")


def test_presets_keep_their_budgets_and_say_why(run):
    folder, result = run
    assert sorted(p.name for p in (folder / "presets").iterdir()) == [
        "low.yaml", "sky.yaml", "ultra.yaml",
    ]  # fmt: skip
    for name, budget in (("low", 0.25), ("ultra", 2.0)):
        preset = load_preset(folder / "presets" / f"{name}.yaml")
        cost = cost_of(preset.filter, preset.params).relative
        assert cost <= budget
        evidence = preset.evidence
        assert evidence["cost"] == pytest.approx(cost, abs=1e-4)
        assert (evidence["budget"], evidence["seed"]) == (budget, 5)
        assert evidence["train"] == ["first"]
        assert evidence["holdout"] == ["second"]
        for split in ("train", "holdout"):
            assert evidence["figures"][split][name]["flip"] == result.mean(name, split, "flip")
            assert set(evidence["figures"][split]) == {"default", name}
        assert evidence["holdout_after"] > 0
        assert evidence["cost_as_published"] == 1
        assert preset.params["shutter"] == 1.0


def test_presets_filter_what_they_were_scored_on(run):
    folder, result = run
    blur = create_filter(folder / "presets" / "low.yaml")
    root = load_yaml(folder / "config.yaml")["data"]["root"]
    frame = read_frame(f"{root}/second/sharp.exr")
    with torch.no_grad():
        image = blur(frame)
    assert image.shape == frame.color.shape
    picked = result.methods[0].pareto.picked()["low"]
    assert int(blur.config.num_samples) == picked.params["num_samples"]


def test_gradient_steps_count_in_its_time(run):
    folder, result = run
    names = ("polished-0.pt", "swept-0.pt")
    later = [torch.load(folder / name, weights_only=True)["cpu_seconds"] for name in names]
    assert min(later) > 0
    assert result.methods[0].cpu_seconds > sum(later)


def test_dear_presets_are_better_where_they_were_searched(run):
    _, result = run
    picked = result.methods[0].pareto.picked()
    assert picked["ultra"].objective < picked["low"].objective
    assert result.objective == picked["ultra"].objective


def test_front_and_presets_have_the_holdout(run):
    folder, result = run
    found = FitResult.load(folder / "result.json").methods[0].pareto
    assert found == result.methods[0].pareto
    for point in found.points:
        known = point.number in found.front or point in found.picked().values()
        assert (point.holdout is not None) == known
    published, start, line = found.landmarks
    assert [m.origin for m in found.landmarks] == ["published", "start", "line"]
    assert published.cost == 1
    assert line.cost == cost_of("line").relative
    assert line.objective != published.objective
    assert published.holdout > 0
    assert start.objective == pytest.approx(result.start_objective)
    assert start.objective == found.point(0).objective


def test_the_table_has_all_settings(run):
    folder, result = run
    rows = list(csv.DictReader((folder / "pareto.csv").read_text().splitlines()))
    found = result.methods[0].pareto
    assert len(rows) == len(found.points) + 3
    assert [r["origin"] for r in rows[:4]] == ["published", "start", "line", "given"]
    on_front = {int(r["number"]) for r in rows if r["front"] == "1"}
    assert on_front == set(found.front)
    by_number = {r["number"]: r for r in rows}
    point = found.point(found.front[0])
    row = by_number[str(point.number)]
    assert float(row["objective"]) == point.objective
    assert int(row["num_samples"]) == point.params["num_samples"]


def test_report_and_plot(run):
    folder, _ = run
    page = (folder / "report.html").read_text()
    assert "Quality against cost" in page
    assert "front, training frames" in page
    assert (folder / "pareto.png").read_bytes()[:4] == b"\x89PNG"
    for name in ("low", "ultra"):
        assert f'<option value="{name}"' in page
    assert "No setting costs 0.01 or less: there is no preset `tiny`" in page
    assert "Preset `sky` is the same as `ultra`" in page


@pytest.mark.parametrize("moment", [("pareto", 4), ("pareto", 7), ("evaluation", 1), ("report", 1)])
def test_stopped_and_resumed(run, tmp_path, moment):
    def watch(event):
        if (event.stage, event.done) == moment:
            raise StoppedError

    config = build(TuneConfig, load_yaml(run[0] / "config.yaml"))
    with pytest.raises(StoppedError):
        run_fit(config, tmp_path / "run", progress=watch)
    resumed = run_fit(config, tmp_path / "run", resume=True)
    times = {"seconds", "command", "methods"}
    assert resumed.model_dump(exclude=times) == run[1].model_dump(exclude=times)
    assert resumed.methods[0].pareto == run[1].methods[0].pareto
    assert (tmp_path / "run" / "pareto.csv").read_text() == (run[0] / "pareto.csv").read_text()


def test_begins_at_the_best_of_methods_before_it(tmp_path):
    data = planted(tmp_path / "frames")
    data["methods"] = [
        {"kind": "blackbox", "sampler": "random", "trials": 6},
        SEARCH | {"continue_from_best": True, "polish": None, "trials": 5, "sampler": "tpe"},
    ]
    result = run_fit(build(TuneConfig, data), tmp_path / "run")
    assert [m.name for m in result.methods] == ["random", "pareto"]
    points = result.methods[1].pareto.points
    assert points[1].params == result.methods[0].params
    assert points[2].params["kappa"] == result.methods[0].params["kappa"]


BASE = {
    "filter": {"kind": "guertin2014", "free": {"num_samples": {}, "kappa": {}}},
    "data": {"train": [{"kind": "scene", "path": "a.yaml"}]},
    "methods": [{"kind": "pareto"}],
}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"filter": {"kind": "guertin2014", "free": ["kappa", "gamma"]}},
            r"none of kappa, gamma changes what the filter costs, so there is no front; free one "
            r"that does: num_samples, tile_size.*\(x\.yaml: methods\.0\.free\)",
        ),
        (
            {"filter": {"kind": "guertin2014", "free": {"num_samples": {"choices": [9]}}}},
            r"none of num_samples changes what the filter costs",
        ),
        (
            {"objective": {"cost": 0.1}},
            r"leave `cost` out of the sum, got 0\.1 \(x\.yaml: objective\.cost\)",
        ),
        (
            {"methods": [{"kind": "pareto"}, {"kind": "pareto"}]},
            r"one `pareto` method is enough.*\(x\.yaml: methods\.1\.kind\)",
        ),
        (
            {"methods": [{"kind": "pareto", "budgets": {"tuned": 1.0}}]},
            r"`tuned` is the name of another image.*\(x\.yaml: methods\.0\.budgets\.tuned\)",
        ),
        (
            {"methods": [{"kind": "pareto", "budgets": {"low": 0}}]},
            r"`low`: .*greater than 0, got 0 \(x\.yaml: methods\.0\.budgets\.low\)",
        ),
        (
            {"methods": [{"kind": "pareto", "budgets": {"../x": 1.0}}]},
            r"should match pattern.*x\.yaml: methods\.0\.budgets",
        ),
        ({"methods": [{"kind": "pareto", "sampler": "nsga"}]}, r"'nsga2' or 'tpe', got 'nsga'"),
        (
            {"methods": [{"kind": "pareto", "population": 1}]},
            r"`population`: .*2, got 1 \(x\.yaml: methods\.0\.population\)",
        ),
    ],
)
def test_mistakes_name_rule_value_and_place(tmp_path, monkeypatch, changes, message):
    monkeypatch.chdir(tmp_path)
    save_yaml("x.yaml", BASE | changes)
    with pytest.raises(ConfigError, match=message):
        load_tune_config("x.yaml")


@pytest.mark.parametrize("section", [{"methods": [{"kind": "pareto"}]}, {"objective": {"cost": 1}}])
def test_a_filter_without_a_known_cost(tmp_path, monkeypatch, section):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delattr(get_filter("guertin2014"), "cost")
    save_yaml("x.yaml", BASE | {"methods": [{"kind": "gradient", "free": ["kappa"]}]} | section)
    place = "methods.0.kind" if "methods" in section else "objective.cost"
    with pytest.raises(ConfigError, match=rf"cost of `guertin2014` is not known.*{place}"):
        load_tune_config("x.yaml")
