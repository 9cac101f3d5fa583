"""Tables of claims: the figures, the verdict, the files, and what is refused."""

import json
import re

import pytest
import torch
from tiny_shots import box_blur, moving_square
from typer.testing import CliRunner

import tuning.data.loading
from torchblur.errors import ConfigError, OutputError
from torchblur.filters import get_filter
from torchblur.io import write_frame, write_image
from torchblur.metrics import evaluate
from tuning.cli.app import app
from tuning.experiments.ablation.run import (
    AblationConfig,
    load_ablation_config,
    run_ablation,
    verdict_of,
)
from tuning.experiments.ablation.write import write_ablation

SCENE = """
camera: {position: [0, 0, 5]}
bodies:
  - kind: plane
    position: [0, 0, -1]
    texture: {kind: checker, color: [0.2, 0.4, 0.2], background: [0.8, 0.8, 0.9], size: 0.5}
  - {kind: sphere, radius: 1, velocity: [1.5, 0, 0], texture: {kind: solid, color: [0.9, 0.2, 0.1]}}
"""
TABLE = """
title: Tiny claims
size: 40x28
spp: 16
color_spp: 4
time_runs: 1
rows:
  - name: blurring helps
    claim: "Section 1: a blur is nearer to the truth | than none"
    scene: ball.yaml
    filter: line
    off: {num_samples: 1, lookup: nearest}
    on: {num_samples: 15}
  - name: the other way
    claim: "Section 2: fewer taps are better"
    scene: ball.yaml
    filter: guertin2014
    params: {tile_size: 10}
    off: {num_samples: 25}
    on: {num_samples: 1}
"""


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "140")
    (tmp_path / "ball.yaml").write_text(SCENE)
    (tmp_path / "table.yaml").write_text(TABLE)
    return tmp_path / "table.yaml"


def edited(table, old, new):
    text = table.read_text()
    assert old in text
    table.write_text(text.replace(old, new, 1))
    return table


class TestRun:
    @torch.no_grad()
    def test_figures_are_those_of_the_filters(self, table):
        first, second = run_ablation(load_ablation_config(table))
        case = second.case
        image = get_filter("guertin2014")(tile_size=10, num_samples=25)(case.frame)
        assert torch.equal(second.images["off"], image)
        want = evaluate(image, case.reference, masks={"band": case.band})
        assert second.scores["off"] == {key: float(value) for key, value in want.items()}
        assert second.gain("psnr") == second.scores["on"]["psnr"] - second.scores["off"]["psnr"]
        assert first.seconds["on"] > 0
        assert first.time_ratio == first.seconds["on"] / first.seconds["off"]

    def test_verdicts(self, table):
        first, second = run_ablation(load_ablation_config(table))
        assert (first.verdict, second.verdict) == ("shows", "does not show")
        assert first.gain("flip_band") > 0.01
        assert second.gain("psnr_band") < 0

    def test_scene_is_rendered_once(self, table, monkeypatch):
        monkeypatch.setenv("TORCHBLUR_CACHE", str(table.parent / "cache"))
        calls = []
        original = tuning.data.loading.render_reference

        def counted(*args, **kwargs):
            calls.append(args)
            return original(*args, **kwargs)

        monkeypatch.setattr(tuning.data.loading, "render_reference", counted)
        first, second = run_ablation(load_ablation_config(table, ["time_runs=0"]))
        assert len(calls) == 1
        assert first.case is second.case

    def test_row_has_its_own_shutter(self, table):
        config = load_ablation_config(table, ["rows.1.shutter=0.1", "time_runs=0"])
        first, second = run_ablation(config)
        assert (first.case.shutter.open, second.case.shutter.open) == (0.5, 0.1)
        assert second.time_ratio is None
        blur = get_filter("guertin2014")(tile_size=10, num_samples=25, shutter=0.1)
        assert torch.allclose(second.images["off"], blur(second.case.frame), atol=1e-6)

    def test_exr_files(self, tmp_path):
        frame = moving_square()
        write_frame(tmp_path / "sharp.exr", frame)
        write_image(tmp_path / "reference.exr", box_blur(frame))
        row = {"name": "a", "claim": "b", "filter": "line", "exr": {"path": str(tmp_path)}}
        row |= {"off": {"num_samples": 1, "lookup": "nearest"}, "on": {"num_samples": 31}}
        (measured,) = run_ablation(AblationConfig(rows=[row], time_runs=0))
        assert measured.case.frame.size == frame.size
        assert "noise" not in measured.scores


class TestVerdict:
    @pytest.mark.parametrize(
        ("flip", "psnr", "better", "comparable"),
        [
            (0.08, 31.0, "shows", "shows"),
            (0.0995, 30.01, "does not show", "shows"),
            (0.08, 29.0, "mixed", "mixed"),
            (0.12, 31.0, "mixed", "mixed"),
            (0.104, 29.8, "does not show", "shows"),
            (0.12, 29.0, "does not show", "does not show"),
        ],
    )
    def test_needs_both_metrics(self, flip, psnr, better, comparable):
        off = {"flip": 0.2, "psnr": 20.0, "flip_band": 0.1, "psnr_band": 30.0}
        on = {"flip": 0.2, "psnr": 20.0, "flip_band": flip, "psnr_band": psnr}
        assert verdict_of(off, on) == better
        assert verdict_of(off, on, "comparable") == comparable

    def test_without_a_band_the_image_counts(self):
        off = {"flip": 0.2, "psnr": 20.0, "flip_band": None, "psnr_band": None}
        on = off | {"flip": 0.1, "psnr": 22.0}
        assert verdict_of(off, on) == "shows"
        assert verdict_of(on, off) == "does not show"


class TestCommand:
    def run(self, *args, code=0):
        result = CliRunner().invoke(app, ["ablate", *map(str, args)])
        assert result.exit_code == code, result.output
        return result

    def test_writes_table_and_page(self, table):
        folder = table.parent / "out"
        output = self.run(table, "-o", folder, "--set", "time_runs=1").stdout
        assert re.search(r"blurring helps +shows", output)
        assert re.search(r"the other way +does not show", output)
        assert "2 claims: 1 show, 0 mixed, 1 do not show" in output
        data = json.loads((folder / "table.json").read_text())
        assert [row["verdict"] for row in data["rows"]] == ["shows", "does not show"]
        scores = data["rows"][1]["scores"]["on"]
        markdown = (folder / "table.md").read_text()
        lines = [line for line in markdown.splitlines() if line.startswith("| ")]
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines}) == 1
        assert f"{scores['flip_band']:.4f}" in lines[3]
        assert "than none" in markdown
        page = (folder / "ablation.html").read_text()
        assert f"{scores['psnr_band']:.2f}" in page
        assert page.count("data:image/webp;base64,") == 2 * (4 + 2)  # pictures, error maps
        assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//", page)
        assert sorted(path.name for path in folder.iterdir()) == [
            "ablation.html",
            "table.json",
            "table.md",
        ]

    def test_replaces_nothing_unasked(self, table, monkeypatch):
        folder = table.parent / "out"
        folder.mkdir()
        (folder / "table.json").write_text("precious")
        result = self.run(table, "-o", folder, code=2)
        assert "table.json exists" in result.stderr
        assert (folder / "table.json").read_text() == "precious"
        self.run(table, "-o", folder, "--overwrite")
        assert json.loads((folder / "table.json").read_text())["title"] == "Tiny claims"

    def test_writes_all_files_or_none(self, table):
        config = load_ablation_config(table, ["time_runs=0"])
        rows = run_ablation(config)
        (table.parent / "out" / "ablation.html").mkdir(parents=True)
        with pytest.raises(OutputError, match=r"ablation\.html is a folder"):
            write_ablation(table.parent / "out", config, rows, overwrite=True)
        assert [path.name for path in (table.parent / "out").iterdir()] == ["ablation.html"]


class TestRefused:
    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("filter: line", "filter: lime", r"`lime`.*`line`.*table\.yaml: rows\.0\.filter"),
            (
                "off: {num_samples: 25}",
                "off: {num_sample: 25}",
                r"unknown key `num_sample` \(did you mean `num_samples`\?\).*rows\.1\.off",
            ),
            ("on: {num_samples: 1}", "on: {num_samples: 0}", r"`num_samples`.*0.*rows\.1\.on"),
            ("on: {num_samples: 1}", "on: {num_samples: 25}", r"same parameters.*rows\.1\.on"),
            ("on: {num_samples: 1}", "on: {shutter: 1}", r"`shutter` belongs.*rows\.1\.on"),
            ("scene: ball.yaml", "scene: fens", r"no scene `fens`.*`fence`.*rows\.0\.scene"),
            ("scene: ball.yaml", "frame: 1", r"needs `scene` or `exr`.*rows\.0"),
            ("scene: ball.yaml", "scene: ball.yaml\n    size: big", r"`size`.*'big'.*rows\.0"),
            ("scene: ball.yaml", "exr: {}\n    size: 9x9", r"`size` is for scenes.*rows\.0"),
            ("name: the other way", "name: blurring helps", r"two rows.*rows\.1\.name"),
            ("spp: 16", "spp: 1", r"`spp`.*got 1"),
        ],
    )
    def test_bad_table(self, table, old, new, message):
        load_ablation_config(table)
        with pytest.raises(ConfigError, match=message):
            load_ablation_config(edited(table, old, new))

    def test_command_says_it_in_one_line(self, table):
        result = CliRunner().invoke(app, ["ablate", str(table), "--set", "rows.0.filter=nope"])
        assert result.exit_code == 2
        assert re.fullmatch(r"error: .*nope.*rows\.0\.filter\)\n", result.stderr)


def test_tables_in_configs_load(repository):
    files = sorted((repository / "configs" / "ablations").glob("*.yaml"))
    assert files
    for file in files:
        assert len(load_ablation_config(file).rows) > 1
