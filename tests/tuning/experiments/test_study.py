"""Studies: figures against the library's own calls, memory, worth, files, resuming, refusals."""

import dataclasses
import json
import math

import pytest
import torch
from typer.testing import CliRunner

import tuning.experiments.study.run
from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.frame import Frame, Shutter
from torchblur.io import load_yaml, write_frame, write_image
from torchblur.metrics import flip_ldr, psnr, ssim
from torchblur.metrics.pooling import weighted_median
from torchblur.metrics.temporal import temporal_error
from torchblur.render import load_scene, render_reference, render_revealed, render_stream
from tuning.cli.app import app
from tuning.experiments.study.config import load_study_config
from tuning.experiments.study.frames import Moment, moments
from tuning.experiments.study.ray_mask import ray_mask_of
from tuning.experiments.study.run import FACTS, part_file, run_study
from tuning.experiments.study.scores import agreement, hidden_mask, worth_of
from tuning.experiments.study.write import curve_of, worth_table, write_study
from tuning.scoring.sequences import FrameByFrame

SCENE = """
camera: {position: [0, 0, 5]}
bodies:
  - kind: plane
    position: [0, 0, -1]
    texture: {kind: checker, color: [0.2, 0.4, 0.2], background: [0.8, 0.8, 0.9], size: 0.5}
  - {kind: sphere, radius: 1, velocity: [1.2, 0, 0], texture: {kind: solid, color: [0.9, 0.2, 0.1]}}
"""
STUDY = """
title: Tiny study
data:
  - {name: ball, kind: scene, path: ball.yaml, size: 48x32, shutter: 1.0, spp: 16, count: 3,
     color_spp: 2, stream_spp: 4, references: [center, box], first: -1}
variants:
  - {name: 1 spp, input: stream}
  - {name: 4 spp, input: stream, samples: 4}
  - {name: filtered, input: stream, filter: oberberger2022}
  - {name: pre-filter, input: stream, filter: oberberger2022, layer: prefiltered}
  - {name: line, filter: line, params: {num_samples: 15}}
masks: [moving, band]
worth: [filtered, line]
plots: [{name: time, variants: [1 spp, filtered, line]}]
"""


@pytest.fixture
def study(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "140")
    (tmp_path / "ball.yaml").write_text(SCENE)
    (tmp_path / "study.yaml").write_text(STUDY)
    return tmp_path / "study.yaml"


def edited(study, old, new):
    text = study.read_text()
    assert old in text
    study.write_text(text.replace(old, new, 1))
    return study


def row_of(rows, variant, reference="center"):
    (found,) = (r for r in rows if (r.variant, r.reference) == (variant, reference))
    return found


class TestRun:
    @torch.no_grad()
    def test_filter_with_memory_runs_through_the_sequence(self, study):
        rows = run_study(load_study_config(study), study.parent / "out")
        scene, shutter = load_scene(study.parent / "ball.yaml"), Shutter(1.0)
        blur, history, before = get_filter("oberberger2022")(), None, None
        found = row_of(rows, "filtered")
        for index in range(3):
            time = index - 1.0
            (sample, *_) = render_stream(scene, (32, 48), frame=time, shutter=shutter, spp=4)
            reference = render_reference(
                scene, (32, 48), spp=16, shutter=shutter, frame=time, seed=1, pixel="center"
            ).mean
            image, history = blur(sample, history, shutter=1.0)
            error = flip_ldr(image, reference)
            want = {
                "flip": error.mean(),
                "flip_median": weighted_median(error),
                "psnr": psnr(image, reference),
                "ssim": ssim(image, reference).mean(),
            }
            if before is not None:
                want["temporal"] = temporal_error(image, before[0], reference, before[1]).mean()
            for name, value in want.items():
                assert found.figures[name][index] == pytest.approx(float(value), rel=1e-5), name
            before = (image, reference)
        assert found.figures["temporal"][0] is None
        assert found.figures["failed"][0] is None  # nothing to find again in the first frame
        assert 0 <= found.figures["failed"][2] <= 1
        assert found.cpu_seconds > 0

    def test_memory_ends_at_a_cut(self, study):
        whole = run_study(load_study_config(study), study.parent / "a")
        cut = run_study(load_study_config(study, ["data.0.cuts=[1]"]), study.parent / "b")
        a, b = (row_of(rows, "filtered").figures["flip"] for rows in (whole, cut))
        assert a[0] == b[0]
        assert a[1] != b[1]
        assert row_of(cut, "filtered").figures["temporal"][1] is None

    def test_raw_samples_are_means_of_the_stream(self, study):
        rows = run_study(load_study_config(study), study.parent / "out")
        scene = load_scene(study.parent / "ball.yaml")
        frames = render_stream(scene, (32, 48), frame=0.0, shutter=Shutter(1.0), spp=4)
        mean = torch.stack([frame.color for frame in frames]).mean(0)
        (_, moment, _) = moments(load_study_config(study).data[0])
        torch.testing.assert_close(moment.raw[4], mean)
        assert sorted(moment.raw) == [1, 2, 4]
        want = float(psnr(mean, moment.references["box"]))
        assert row_of(rows, "4 spp", "box").figures["psnr"][1] == pytest.approx(want, rel=1e-5)
        assert row_of(rows, "4 spp").mean("flip") < row_of(rows, "1 spp").mean("flip")

    def test_layer_of_a_stage_is_the_image(self, study):
        rows = run_study(load_study_config(study), study.parent / "out")
        assert row_of(rows, "pre-filter").mean("flip") != row_of(rows, "filtered").mean("flip")
        edited(study, "layer: prefiltered", "layer: prefilter")
        with pytest.raises(ConfigError, match=r"no layer `prefilter` \(did you mean `prefiltered`"):
            run_study(load_study_config(study), study.parent / "out")

    def test_camera_of_the_item(self, study):
        still = load_study_config(study)
        moved = load_study_config(study, ["data.0.camera.velocity=[0.5, 0, 0]"])
        a, b = (next(iter(moments(config.data[0]))) for config in (still, moved))
        background = (0, slice(None), 0, 0)
        assert a.sharp.velocity[background].tolist() == [0, 0]
        assert b.sharp.velocity[0, 0, 0, 0] < -1

    def test_what_is_done_is_not_done_again(self, study, monkeypatch):
        config, folder = load_study_config(study), study.parent / "out"
        first = run_study(config, folder)
        calls = []
        original = tuning.experiments.study.run.moments
        monkeypatch.setattr(
            tuning.experiments.study.run,
            "moments",
            lambda *args: calls.append(args) or original(*args),
        )
        assert run_study(config, folder) == first
        assert calls == []
        item, variant = config.data[0], config.variants[4]
        part_file(folder, config, item, variant).unlink()
        again = run_study(config, folder)
        assert len(calls) == 1
        assert [row.figures for row in again] == [row.figures for row in first]
        edited(study, "{num_samples: 15}", "{num_samples: 9}")
        assert row_of(run_study(load_study_config(study), folder), "line") != row_of(first, "line")
        assert len(calls) == 2
        monkeypatch.setattr(tuning.experiments.study.run, "figures_hash", lambda: "another filter")
        run_study(config, folder)
        assert len(calls) == 3


class TestFiles:
    @pytest.fixture
    def folder(self, tmp_path):
        """Three frames of a stream whose samples are 0.2 too bright."""
        ramp = torch.linspace(0.2, 0.7, 24).view(1, 1, 1, 24).expand(1, 3, 16, 24).contiguous()
        velocity = torch.full((1, 2, 16, 24), 3.0)
        for number in (4, 5, 6):
            time = torch.rand(1, 1, 16, 24)
            depth = torch.ones(1, 1, 16, 24)
            layers = {"velocity": velocity, "depth": depth, "time": time}
            write_frame(tmp_path / f"stream.{number:04d}.exr", Frame(color=ramp + 0.2, **layers))
            write_frame(tmp_path / f"center.{number:04d}.exr", Frame(color=ramp, **layers))
            write_image(tmp_path / f"truth.{number:04d}.exr", ramp, half=False)
        (tmp_path / "study.yaml").write_text(f"""
title: Files
data:
  - {{name: f, kind: exr, path: {tmp_path}, first: 4, count: 3, sharp: center.####.exr,
      shutter: 1.0, stream: stream.####.exr, converged: truth,
      references: {{truth: truth.####.exr}}}}
variants:
  - {{name: 1 spp, input: stream}}
  - {{name: 4 spp, input: stream, samples: 4}}
  - {{name: filtered, input: stream, filter: oberberger2022}}
""")
        return tmp_path

    def test_more_samples_than_there_are_stand_for_their_variance(self, folder):
        rows = run_study(load_study_config(folder / "study.yaml"), folder / "out")
        one, four = row_of(rows, "1 spp", "truth"), row_of(rows, "4 spp", "truth")
        assert (one.estimated, four.estimated) == (False, True)
        assert one.mean("psnr") == pytest.approx(-20 * math.log10(0.2), abs=0.01)
        assert four.mean("psnr") - one.mean("psnr") == pytest.approx(20 * math.log10(2), abs=0.01)

    def test_without_what_they_converge_to_they_are_refused(self, folder):
        edited(folder / "study.yaml", " converged: truth,", "")
        with pytest.raises(ConfigError, match=r"'4 spp' takes 4.*'f' has 1.*variants\.1\.samples"):
            load_study_config(folder / "study.yaml")


class TestFigures:
    def test_are_over_masks(self):
        image, reference = torch.rand(2, 1, 3, 16, 20)
        mask = torch.rand(1, 1, 16, 20) > 0.5
        found = FrameByFrame().figures(image, reference, masks={"some": mask})
        square = ((image - reference) ** 2).mean(1, keepdim=True)[mask].mean()
        assert found["psnr_some"] == pytest.approx(-10 * math.log10(float(square)), rel=1e-5)
        flip = flip_ldr(image, reference)
        assert found["flip_some"] == pytest.approx(float(flip[mask].mean()), rel=1e-5)
        empty = FrameByFrame().figures(image, reference, masks={"no": mask & False})
        assert math.isnan(empty["ssim_no"])

    @pytest.mark.parametrize(
        ("value", "rising", "text"),
        [
            (0.2, False, "2.0"),
            (0.15, False, "2.8"),
            (0.31, False, "< 1"),
            (0.02, False, "> 4"),
            (-0.2, True, "2.0"),
            (-0.31, True, "< 1"),
            (-0.02, True, "> 4"),
            (None, True, ""),
        ],
    )
    def test_worth_is_read_off_the_curve(self, value, rising, text):
        sign = -1 if rising else 1
        curve = [(1, sign * 0.3), (2, sign * 0.2), (4, sign * 0.1)]
        assert worth_of(value, curve, rising=rising) == text

    def test_agreement(self):
        mask = torch.tensor([True, True, True, False]).view(1, 1, 2, 2)
        truth = torch.tensor([True, False, False, True]).view(1, 1, 2, 2)
        assert agreement(mask, truth) == {
            "recall": 0.5,
            "precision": pytest.approx(1 / 3),
            "mask_share": 0.75,
            "hidden_share": 0.5,
        }


class TestHidden:
    def moment(self, seen=None):
        """A block of 8 px at depth 1 moves 4 px to the right before a still wall at depth 2."""
        block = torch.zeros(1, 1, 6, 24, dtype=torch.bool)
        block[..., 8:16] = True
        sharp = Frame(
            color=torch.rand(1, 3, 6, 24),
            velocity=torch.cat((block * 4.0, block * 0.0), 1),
            depth=torch.where(block, 1.0, 2.0),
            object_id=torch.where(block, 7, 1),
        )
        return Moment(
            index=0,
            sharp=sharp,
            samples=(),
            raw={},
            estimated=frozenset(),
            references={},
            variances={},
            revealed=None,
            seen=seen,
            shutter=Shutter(1.0),
            first_of_shot=True,
        )

    def test_estimate_is_the_inner_half_of_the_blur(self):
        # The block is at 8 + s .. 16 + s for s in [-2, 2]: 2 px at either end are left at times.
        (line,) = hidden_mask(self.moment())[0, 0].unique(dim=0)
        assert line.nonzero().flatten().tolist() == [8, 9, 14, 15]

    def test_count_over_rays_asks_for_what_is_behind(self):
        ids = self.moment().sharp.object_id.repeat(20, 1, 1, 1)
        depths = self.moment().sharp.depth.repeat(20, 1, 1, 1)
        ids[:2, ..., 9] = 1  # 10 % of the time
        ids[:2, ..., 10] = 1
        depths[:2, ..., 9] = 2.0
        depths[:2, ..., 10] = 0.5  # before the block
        ids[:1, ..., 11], depths[:1, ..., 11] = 1, 2.0  # 5 %: not more than that
        ids[:9, ..., 3], depths[:9, ..., 3] = 7, 3.0  # the wall does not move
        (line,) = hidden_mask(self.moment((ids, depths)))[0, 0].unique(dim=0)
        assert line.nonzero().flatten().tolist() == [9]


class TestRays:
    @pytest.fixture
    def rays(self, study):
        """The ball before the wall, with what it hides, through two filters."""
        text = study.read_text()
        text = text.replace("stream_spp: 4,", "revealed: true, revealed_spp: 2,")
        text = text.replace("count: 3", "count: 2")
        head, _, _ = text.partition("\nvariants:")
        study.write_text(
            head
            + """
variants:
  - {name: plain, filter: tan2022}
  - {name: all, filter: guertin2014, revealed: all, params: {background: revealed}}
  - {name: mask, filter: guertin2014, revealed: mask, params: {background: revealed}}
masks: [ray_mask, hidden]
mask_params: {tile_size: 20}
"""
        )
        return study

    @pytest.mark.filterwarnings("ignore:tan2022. no layer `revealed`")
    def test_layer_behind_is_given_as_asked(self, rays):
        config = load_study_config(rays)
        rows = run_study(config, rays.parent / "out")
        (moment, _) = moments(config.data[0])
        shutter = {"shutter": 1.0, "shutter_position": "centered"}
        asked = get_filter("tan2022")(tile_size=20).layers(moment.sharp, **shutter)["ray_mask"] > 0
        layer = moment.revealed
        assert asked.any()
        assert (layer.valid.bool() & ~asked).any()
        masked = dataclasses.replace(layer, valid=layer.valid.bool() & asked)
        guertin = get_filter("guertin2014")(background="revealed")
        for name, blur, revealed in (
            ("plain", get_filter("tan2022")(), None),
            ("all", guertin, layer),
            ("mask", guertin, masked),
        ):
            frame = dataclasses.replace(moment.sharp, revealed=revealed)
            with torch.no_grad():
                image = blur(frame, **shutter)
            reference, figures = moment.references["center"], row_of(rows, name).figures
            found = figures["psnr"][0], figures["psnr_ray_mask"][0]
            want = float(psnr(image, reference)), float(psnr(image, reference, mask=asked))
            assert found == pytest.approx(want, rel=1e-5), name

    @pytest.mark.filterwarnings("ignore:tan2022. no layer `revealed`")
    def test_facts_of_the_mask(self, rays):
        config = load_study_config(rays)
        rows = run_study(config, rays.parent / "out")
        (facts,) = (row for row in rows if row.variant == FACTS)
        moment = next(iter(moments(config.data[0])))
        mask, truth = ray_mask_of(moment, {"tile_size": 20}), hidden_mask(moment)
        for name, value in agreement(mask, truth).items():
            assert facts.figures[name][0] == value
        assert facts.figures["recall_1px"][0] >= facts.figures["recall"][0] > 0
        found = render_revealed(
            load_scene(rays.parent / "ball.yaml"), (32, 48), frame=-1.0, mask=mask
        )
        assert facts.figures["rays"][0] == found.rays
        assert facts.figures["rays_per_px"][0] == found.rays / (32 * 48)
        for name in ("mask", "trace", "tiles"):
            assert facts.mean(f"seconds_{name}") > 0
        write_study(rays.parent / "out", config, rows)
        assert "Ray mask: recall 0." in (rays.parent / "out" / "tables.md").read_text()
        data = json.loads((rays.parent / "out" / "study.json").read_text())
        assert data["facts"]["ball"]["rays"] == facts.mean("rays")
        assert len(data["rows"]) == 3 * 2

    def test_hidden_pixels_are_those_the_ball_leaves(self, rays):
        """The ball moves by 1.2 diameters over 2: behind it the wall shows at its sides."""
        moment = next(iter(moments(load_study_config(rays).data[0])))
        truth, ball = hidden_mask(moment), moment.sharp.object_id == 2
        assert (truth & ~ball).sum() == 0
        share = moment.seen[0] != 2
        left = share.float().mean(0, keepdim=True)[ball]
        assert truth[ball].float().mean() > 0.3
        assert left[truth[ball]].min() > 0.05

    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("revealed: true,", "revealed: false,", r"'ball' has no layer.*`revealed: true`"),
            ("masks: [ray_mask, ", "masks: [", r"needs `ray_mask`.*variants\.1\.revealed"),
        ],
    )
    def test_what_is_missing_is_named(self, rays, old, new, message):
        with pytest.raises(ConfigError, match=message):
            load_study_config(edited(rays, old, new))


class TestCommand:
    def run(self, *args, code=0):
        result = CliRunner().invoke(app, ["study", *map(str, args)])
        assert result.exit_code == code, result.output
        return result

    def test_writes_everything(self, study):
        folder = study.parent / "out"
        output = self.run(study, "-o", folder).stdout
        assert "ball, center" in output
        data = json.loads((folder / "study.json").read_text())
        row = next(r for r in data["rows"] if r["variant"] == "line" and r["reference"] == "box")
        assert len(row["per_frame"]["flip"]) == 3
        assert row["means"]["flip"] == pytest.approx(sum(row["per_frame"]["flip"]) / 3)
        assert set(row["worth"]) == {"flip", "psnr", "flip_moving", "psnr_moving"}
        tables = (folder / "tables.md").read_text()
        assert f"| line | {row['means']['flip']:.4f} |" in tables
        lines = [line for line in tables.splitlines() if line.startswith("| ")]
        assert len({line.count("|") for line in lines}) == 1
        assert len((folder / "tables.csv").read_text().splitlines()) == 1 + 5 * 2
        plots = sorted(path.name for path in (folder / "plots").iterdir())
        assert plots == [
            f"ball.{reference}.{name}.png"
            for reference in ("box", "center")
            for name in ("time", "worth-flip", "worth-psnr")
        ]
        assert (folder / "pictures" / "ball.png").stat().st_size > 1000

    def test_replaces_nothing_unasked(self, study):
        folder = study.parent / "out"
        folder.mkdir()
        (folder / "study.json").write_text("precious")
        assert "study.json exists" in self.run(study, "-o", folder, code=2).stderr
        assert (folder / "study.json").read_text() == "precious"
        self.run(study, "-o", folder, "--overwrite")
        assert json.loads((folder / "study.json").read_text())["title"] == "Tiny study"

    def test_worth_in_the_tables_is_that_of_the_curve(self, study):
        config = load_study_config(study)
        rows = run_study(config, study.parent / "out")
        curve = curve_of(config, rows, "ball", "center", "psnr")
        assert [n for n, _ in curve] == [1, 4]
        want = worth_of(row_of(rows, "filtered").mean("psnr"), curve, rising=True)
        assert worth_table(config, rows)["ball", "center", "filtered psnr"] == want
        write_study(study.parent / "out", config, rows)
        assert f" {want} |" in (study.parent / "out" / "tables.md").read_text()


class TestRefused:
    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("path: ball.yaml", "path: bal.yaml", r"no scene `bal\.yaml`.*data\.0\.path"),
            ("filter: line", "filter: lime", r"`lime`.*`line`.*variants\.4\.filter"),
            ("num_samples: 15", "num_sample: 15", r"`num_sample` \(did.*variants\.4\.params"),
            ("num_samples: 15", "shutter: 1", r"`shutter` belongs to the data.*variants\.4"),
            ("samples: 4}", "samples: 8}", r"'4 spp' takes 8.*'ball' has 4.*variants\.1"),
            ("samples: 4}", "samples: 3}", r"1, 2, 4, 8 … samples, got 3.*variants\.1"),
            ("name: 4 spp", "name: 1 spp", r"two of them.*'1 spp'.*variants\.1\.name"),
            ("worth: [filtered", "worth: [filterd", r"'filterd' \(did you mean `filtered`.*worth"),
            ("variants: [1 spp", "variants: [1 sp", r"'1 sp' \(did.*plots\.0\.variants"),
            ("filtered, input: stream", "filtered", r"oberberger2022 needs samples.*variants\.2"),
            ("filter: line,", "filter: line, only: [bal],", r"'bal' \(did.*variants\.4\.only"),
            (", filter: line, params", ", params", r"need a `filter`.*variants\.4"),
            ("size: 48x32", "size: big", r"`size`.*'big'.*data\.0\.size"),
            (
                "filter: line, params",
                "input: stream, samples: 2, filter: line, params",
                r"one sample",
            ),
        ],
    )
    def test_bad_study(self, study, old, new, message):
        load_study_config(study)
        with pytest.raises(ConfigError, match=message):
            load_study_config(edited(study, old, new))


def test_studies_in_configs_load(repository, tmp_path):
    for file in sorted((repository / "configs" / "studies").glob("*.yaml")):
        kinds = [item["kind"] for item in load_yaml(file)["data"]]
        overrides = [f"data.{i}.path={tmp_path}" for i, kind in enumerate(kinds) if kind == "exr"]
        assert load_study_config(file, overrides).title
