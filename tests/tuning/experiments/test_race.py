"""Races: curves are what the logs say, planted values are found, a stopped race goes on."""

import copy
import csv
import json
import statistics

import pytest
from planted import FIXED, write_planted
from typer.testing import CliRunner

import tuning.experiments.race.run
from torchblur.errors import ConfigError
from torchblur.io import save_yaml
from tuning.cli.app import app
from tuning.experiments.race.config import load_race_config
from tuning.experiments.race.run import Curve, Point, _best_by, _Event, grid, run_race
from tuning.experiments.race.summary import at, median_curve, standings, target_of
from tuning.experiments.race.write import write_race

PLANT = {"kappa": 6.0, "third_gain": 4.0}
FREE = {
    "kappa": {"low": 1, "high": 40},
    "third_gain": {"high": 10},
    "tile_size": {"choices": [8, 12]},
}


def race_data(root):
    """Two problems, three entrants, two seeds, over two planted frames on disk."""
    if not (root / "frames").exists():
        write_planted(root / "frames")
    data = {
        "root": str(root / "frames"),
        "train": [{"kind": "exr", "path": "first", "shutter": 1.0}],
        "holdout": [{"kind": "exr", "path": "second", "shutter": 1.0}],
    }
    shared = {"data": data, "objective": {"terms": {"mse": 1.0}, "color_space": "linear"}}
    params = FIXED | {"direction_exponent": 2.5}
    return {
        "title": "Tiny",
        "problems": [
            {
                "name": "frames",
                "filter": {"kind": "guertin2014", "params": params, "free": dict(FREE)},
                **shared,
            },
            {
                "name": "planted",
                "filter": {"kind": "guertin2014", "params": params, "free": dict(FREE)},
                "planted": dict(PLANT),
                **shared,
            },
        ],
        "entrants": [
            {
                "name": "gradient",
                "methods": [
                    {"kind": "gradient", "steps": 12, "starts": 1, "learning_rate": 0.2},
                ],
            },
            {
                "name": "search",
                "methods": [{"kind": "blackbox", "sampler": "random", "trials": 7}],
            },
            {
                "name": "both",
                "methods": [
                    {"kind": "blackbox", "trials": 3, "polish": {"steps": 2}},
                    {"kind": "gradient", "steps": 2, "starts": 1, "continue_from_best": True},
                ],
                "only": ["planted"],
            },
        ],
        "seeds": [1, 2],
        "device": "cpu",
    }  # fmt: skip


class Finished:
    """A race that is over."""

    def __init__(self, root):
        self.root, self.events = root, []
        save_yaml(root / "race.yaml", race_data(root))
        self.config = load_race_config(root / "race.yaml")
        self.folder = root / "out"
        self.curves = run_race(self.config, self.folder, self.events.append)
        self.files = write_race(self.folder, self.config, self.curves)

    def curve(self, problem, entrant, seed=1):
        found = [
            c for c in self.curves
            if (c.problem, c.entrant, c.seed) == (problem, entrant, seed)
        ]  # fmt: skip
        assert len(found) == 1
        return found[0]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return Finished(tmp_path_factory.mktemp("race"))


def timeless(curves):
    return [
        (c.problem, c.entrant, c.seed, [(p.passes, p.train, p.holdout, p.params) for p in c.points])
        for c in curves
    ]


class TestRun:
    def test_everybody_ran(self, finished):
        found = [(c.problem, c.entrant, c.seed) for c in finished.curves]
        assert found == [
            *(("frames", name, seed) for name in ("gradient", "search") for seed in (1, 2)),
            *(("planted", name, s) for name in ("gradient", "search", "both") for s in (1, 2)),
        ]  # fmt: skip
        assert [e.done for e in finished.events] == [*range(10), 10]

    def test_costs(self, finished):
        assert finished.curve("frames", "gradient").points[-1].passes == 12
        assert finished.curve("frames", "search").points[-1].passes == 7
        both = finished.curve("planted", "both").points[-1]
        assert both.passes >= 3 + 3 + 2  # the first trial is polished: two steps, and its end
        for curve in finished.curves:
            seconds = [point.cpu_seconds for point in curve.points]
            assert seconds == sorted(seconds)
            assert seconds[-1] > 0
            assert [p.passes for p in curve.points[:-1]] == grid(curve.points[-1].passes)

    def test_training_objective_never_rises(self, finished):
        for curve in finished.curves:
            train = [point.train for point in curve.points]
            assert train == pytest.approx(sorted(train, reverse=True), rel=1e-3), curve

    def test_points_are_what_the_log_says(self, finished):
        curve = finished.curve("frames", "search")
        folder = next((finished.folder / "fits").glob("frames.search.1.*"))
        log = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
        losses = [record["loss"][0] for record in log]
        by_passes = {point.passes: point for point in curve.points}
        for count in (1, 2, 3, 4, 6):
            assert by_passes[count].train == pytest.approx(min(losses[:count]), rel=1e-4)
        assert curve.points[0].params["kappa"] == 40.0  # the start values

    def test_gradient_takes_what_is_smooth(self, finished):
        point = finished.curve("frames", "gradient").points[-1]
        assert point.params["tile_size"] == 12
        assert point.params["third_gain"] != 2.0

    def test_planted_references_are_the_filter_s_own(self, finished, monkeypatch):
        track = tuning.experiments.race.run._load(finished.config, finished.config.problems[1])
        planted = PLANT | {"tile_size": 12}
        assert float(track.train.mean(planted)) == 0
        assert float(track.holdout.mean(planted)) == 0
        real = tuning.experiments.race.run._load(finished.config, finished.config.problems[0])
        assert float(real.train.mean(planted)) > 1e-7

    def test_distance_is_of_the_unit_cube(self, finished):
        assert all(p.distance is None for p in finished.curve("frames", "search").points)
        start = finished.curve("planted", "search").points[0]
        space = tuning.experiments.race.run._load(
            finished.config, finished.config.problems[1]
        ).space
        unit = space.subset(("kappa", "third_gain"))
        gaps = (unit.to_unit(start.params) - unit.to_unit(PLANT)).abs()
        assert start.distance == pytest.approx(float(gaps.max()))
        assert finished.curve("planted", "gradient").points[-1].params["third_gain"] == (
            pytest.approx(PLANT["third_gain"], abs=0.2)
        )

    def test_seeds_differ(self, finished):
        one, two = (finished.curve("frames", "search", seed).points[-1] for seed in (1, 2))
        assert one.params != two.params


class TestResume:
    def test_stopped_within_a_fit(self, finished, tmp_path, monkeypatch):
        count, advance = iter(range(1000)), tuning.methods.gradient_state.AdamState.advance

        def interrupted(state, problem):
            if next(count) == 17:  # in the second fit
                raise KeyboardInterrupt
            return advance(state, problem)

        monkeypatch.setattr(tuning.methods.gradient_state.AdamState, "advance", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_race(finished.config, tmp_path)
        assert next(count) == 18
        assert timeless(run_race(finished.config, tmp_path)) == timeless(finished.curves)

    def test_what_is_there_is_not_done_again(self, finished, monkeypatch):
        monkeypatch.setattr(tuning.experiments.race.run, "prepare", None)
        assert run_race(finished.config, finished.folder) == finished.curves

    def test_another_entrant_costs_its_own_fits(self, finished, tmp_path, monkeypatch):
        data = race_data(finished.root)
        data["entrants"].append(
            {"name": "more", "methods": [{"kind": "blackbox", "trials": 2}], "only": ["frames"]}
        )
        save_yaml(finished.root / "more.yaml", data, overwrite=True)
        config = load_race_config(finished.root / "more.yaml")
        runs, run = [], tuning.experiments.race.run._run
        monkeypatch.setattr(
            tuning.experiments.race.run,
            "_run",
            lambda fit, track, path: runs.append(path) or run(fit, track, path),
        )
        curves = run_race(config, finished.folder)
        assert [path.name.rpartition(".")[0] for path in runs] == ["frames.more.1", "frames.more.2"]
        assert [c for c in curves if c.entrant != "more"] == finished.curves


class TestFiles:
    def test_all_of_them(self, finished):
        names = [path.name for path in finished.files]
        assert names == ["race.json", "tables.md", "points.csv", "frames.png", "planted.png"]
        assert all(path.stat().st_size > 100 for path in finished.files)

    def test_csv_has_every_point(self, finished):
        text = (finished.folder / "points.csv").read_text()
        rows = list(csv.DictReader(text.splitlines()))
        assert len(rows) == sum(len(curve.points) for curve in finished.curves)

    def test_table(self, finished):
        text = (finished.folder / "tables.md").read_text()
        end = [finished.curve("frames", "gradient", seed).points[-1].holdout for seed in (1, 2)]
        assert f"| {statistics.median(end):.4g} |" in text
        assert "| planted | 6 | 4 |" in text
        assert "every planted value within 2 % of its range" in text

    def test_json(self, finished):
        data = json.loads((finished.folder / "race.json").read_text())
        assert [one["entrant"] for one in data["standings"]["planted"]] == [
            "gradient", "search", "both",
        ]  # fmt: skip

    def test_command(self, finished):
        found = CliRunner().invoke(
            app, ["race", str(finished.root / "race.yaml"), "-o", str(finished.folder)]
        )
        assert found.exit_code == 0, found.output
        assert "gradient" in found.output
        assert "Medians over 2 seeds" in " ".join(found.output.split())


def curve(entrant, seed, *points, distance=None):
    return Curve(
        problem="p", entrant=entrant, seed=seed,
        points=tuple(
            Point(passes=a, cpu_seconds=10 * a, train=b, holdout=b, distance=distance, params={})
            for a, b in points
        ),
    )  # fmt: skip


class TestSummary:
    def test_places(self):
        assert grid(13) == [1, 1.5, 2, 3, 4, 6, 8, 12]
        assert grid(0.5) == []
        one = curve("a", 1, (1, 9.0), (2, 8.0), (4, 5.0))
        assert at(one, lambda p: p.passes, 3).holdout == 8.0
        assert at(one, lambda p: p.passes, 0.5) is None

    def test_median_waits_for_all_seeds(self):
        curves = [curve("a", 1, (1, 9.0), (4, 5.0)), curve("a", 2, (2, 7.0), (4, 4.0))]
        found = median_curve(curves, lambda p: p.passes, lambda p: p.holdout, [1, 2, 4, 8])
        assert found == [(2, 8.0, 7.0, 9.0), (4, 4.5, 4.0, 5.0)]

    def test_reached_for_good(self, finished):
        """A fit that comes near and leaves again has not reached it by then."""
        curves = [
            curve("a", 1, (1, 1.0), (2, 3.0), (4, 1.04)),
            curve("a", 2, (1, 9.0), (2, 1.0), (4, 1.0)),
            curve("b", 1, (1, 9.0), (4, 2.0)), curve("b", 2, (1, 1.0), (4, 1.0)),
        ]  # fmt: skip
        assert target_of(curves) == pytest.approx(1.05 * 1.02)
        problem = finished.config.problems[0].model_copy(update={"name": "p"})
        a, b = standings(finished.config, problem, curves)
        assert (a.reached, a.passes_to, a.cpu_seconds_to) == (2, 3, 30)
        assert (b.reached, b.passes_to) == (1, 1)
        assert (a.holdout, a.best, a.worst) == (1.02, 1.0, 1.04)

    def test_best_by_now(self):
        losses = [5.0, 7.0, 3.0, 4.0]
        events = [_Event(i + 1, i, loss, {"x": i}, False) for i, loss in enumerate(losses)]
        assert [p["x"] for _, _, p in _best_by(events, [1, 2, 3, 4])] == [0, 0, 2, 2]
        drawn_anew = [_Event(i + 1, i, loss, {"x": i}, True) for i, loss in enumerate(losses)]
        assert [p["x"] for _, _, p in _best_by(drawn_anew, [1, 2, 3, 4])] == [0, 1, 2, 3]


class TestConfig:
    def test_shipped(self, repository):
        config = load_race_config(repository / "configs" / "races" / "methods.yaml")
        assert len(config.seeds) == 5
        assert {p.planted is None for p in config.problems} == {True, False}
        fit = config.fit(config.problems[0], config.entrants[0])
        assert "kappa" in fit.methods[0].free
        assert "tile_size" not in fit.methods[0].free

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (
                lambda d: d["problems"][1]["planted"].update(kapa=3.0),
                r"`kapa` is planted and not free \(did you mean `kappa`\?\) "
                r"\(.*race\.yaml: problems\.1\.planted\)",
            ),
            (
                lambda d: d["problems"][1]["planted"].update(kappa=50.0),
                r"`kappa` is planted at 50\.0, where the fit cannot find it.*problems\.1\.planted",
            ),
            (
                lambda d: d["problems"][1]["planted"].update(tile_size=10),
                r"`tile_size` is planted at 10",
            ),
            (
                lambda d: d["problems"][0]["data"].update(holdout=[]),
                r"a race is judged on a hold-out, and there is none \(.*problems\.0\.data\)",
            ),
            (
                lambda d: d["entrants"][1].update(name="gradient"),
                r"two entrants are called 'gradient' \(.*race\.yaml: entrants\.1\.name\)",
            ),
            (
                lambda d: d["entrants"][2].update(only=["plantet"]),
                r"no problem is called 'plantet' \(did you mean `planted`\?\) "
                r"\(.*entrants\.2\.only\)",
            ),
            (
                lambda d: d["entrants"][0]["methods"][0].update(free=["tile_size"]),
                r"`tile_size` is discrete.*problems\.0 for 'gradient': methods\.0\.free",
            ),
            (
                lambda d: d["problems"][0]["filter"]["params"].update(gamma=-1.0),
                r"`gamma` must lie in .*problems\.0: filter\.params\.gamma",
            ),
            (
                lambda d: d.update(seeds=[1, 1]),
                r"`seeds` has one twice: \[1, 1\] \(.*race\.yaml: seeds\)",
            ),
            (lambda d: d.update(seed=3), r"unknown key `seed` \(did you mean `seeds`\?\)"),
            (
                lambda d: [e.update(only=["planted"]) for e in d["entrants"]],
                r"'frames' has no entrant \(.*problems\.0\)",
            ),
        ],
    )
    def test_mistakes(self, finished, tmp_path, change, message):
        data = copy.deepcopy(race_data(finished.root))
        change(data)
        save_yaml(tmp_path / "race.yaml", data)
        with pytest.raises(ConfigError, match=message) as caught:
            load_race_config(tmp_path / "race.yaml")
        assert len(str(caught.value).splitlines()) == 1
