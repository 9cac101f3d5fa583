"""The command line: what each command does on good input, and how it looks."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_shots import HEIGHT, WIDTH, moving_square, write_channels, write_shot
from typer.testing import CliRunner

from torchblur.filters import get_filter, list_filters
from torchblur.frame import Shutter
from torchblur.io import (
    read_channels,
    read_exr,
    read_frame,
    read_image,
    save_yaml,
    write_frame,
    write_image,
)
from torchblur.metrics import border_band, display_encode, evaluate
from torchblur.params import declared
from torchblur.presets import Preset, create_filter, save_preset
from torchblur.render import load_scene, render_frame, render_reference
from tuning.cli.app import app

COMMANDS = (
    "tune",
    "filter",
    "batch",
    "render",
    "compare",
    "export",
    "card",
    "ablate",
    "study",
    "race",
    "crossfit",
    "bench",
    "params",
    "inspect",
)


@pytest.fixture(autouse=True)
def _wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")


@pytest.fixture
def shot(tmp_path):
    return write_shot(tmp_path / "shot", 3)


def run(*args, code=0):
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    assert result.exit_code == code, f"{result.output}\n{result.exception!r}"
    assert "Traceback" not in result.output
    return result


def row(output, name):
    """Return the numbers of the table row with a name."""
    line = next(x for x in output.splitlines() if re.match(rf"[ >]*{re.escape(name)} ", x))
    return [float(word) for word in line.split(name, 1)[1].split()]


class TestHelp:
    def test_names_all_commands(self):
        output = run("--help").output
        listed = output.split(" Commands ")[1]
        assert tuple(re.findall(r"(?m)^│ (\w+) ", listed)) == COMMANDS

    @pytest.mark.parametrize("name", COMMANDS)
    def test_of_each_command_describes_each_option(self, name):
        output = run(name, "--help").output
        for line in re.findall(r"│ .*--\w.*", output):
            assert len(line.split("  ")) > 2, line

    @pytest.mark.parametrize("name", COMMANDS)
    def test_no_parameter_has_a_flag_of_its_own(self, name):
        flags = set(re.findall(r"--([a-z-]+)", run(name, "--help").output))
        parameters = {n for f in list_filters().values() for n in declared(f.config_class)}
        # Those of the reference, which no filter makes, and an axis of the grid that is timed.
        others = {"render": {"shutter", "seed"}, "compare": {"shutter"}, "bench": {"num-samples"}}
        assert flags & {n.replace("_", "-") for n in parameters} == others.get(name, set())

    def test_needs_no_torch(self):
        code = "import sys, tuning.cli.app; sys.exit('torch' in sys.modules)"
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

    def test_version(self):
        from importlib.metadata import version

        assert run("--version").output == f"torchblur {version('torchblur')}\n"

    def test_missing_extra_is_one_sentence(self):
        hide = "import sys; sys.modules['typer'] = None; from tuning.cli import main; main()"
        done = subprocess.run([sys.executable, "-c", hide], capture_output=True, text=True)
        assert done.returncode == 1
        assert "pip install 'torchblur[tune]'" in done.stderr
        assert "Traceback" not in done.stderr

    def test_console_script(self):
        code = "from tuning.cli import main; main()"
        args = [sys.executable, "-c", code, "params", "nonsense"]
        done = subprocess.run(args, capture_output=True, text=True)
        assert done.returncode == 2
        assert done.stderr.startswith("error: unknown filter `nonsense`")
        assert done.stdout == ""


class TestFilter:
    def test_writes_what_the_module_returns(self, shot, tmp_path):
        out = tmp_path / "out.exr"
        run(
            "filter",
            "mcguire2012",
            shot[0],
            "-o",
            out,
            "--set",
            "shutter=0.8",
            "--set",
            "num_samples=7",
        )
        blur = create_filter("mcguire2012", shutter=0.8, num_samples=7)
        with torch.no_grad():
            expected = blur(read_frame(shot[0]))
        torch.testing.assert_close(read_image(out), expected.half().float())
        assert not torch.allclose(read_image(out), read_image(shot[0]), atol=0.01)

    def test_result_says_what_it_was_made_with(self, shot, tmp_path):
        run("filter", "line", shot[0], "-o", tmp_path / "out.exr", "--set", "num_samples=9")
        found = read_exr(tmp_path / "out.exr").metadata
        assert found["source"] == "sharp.0001.exr"
        assert found["recipe"]["filter"] == "line"
        assert found["recipe"]["params"]["num_samples"] == 9

    def test_takes_a_preset(self, shot, tmp_path):
        preset = Preset(filter="line", params={"num_samples": 5})
        save_preset(tmp_path / "mine.yaml", preset)
        run("filter", tmp_path / "mine.yaml", shot[0], "-o", tmp_path / "a.exr")
        run("filter", "line", shot[0], "-o", tmp_path / "b.exr", "--set", "num_samples=5")
        assert torch.equal(read_image(tmp_path / "a.exr"), read_image(tmp_path / "b.exr"))

    def test_set_reaches_how_files_are_read_and_written(self, shot, tmp_path):
        run(
            "filter",
            "guertin2014",
            shot[0],
            "-o",
            tmp_path / "out.exr",
            "--set",
            "overrides.velocity_scale=0.5",
            "--set",
            "layers=[luma]",
            "--set",
            "num_samples=5",
        )
        with torch.no_grad():
            blur = create_filter("guertin2014", num_samples=5)
            want = blur.layers(read_frame(shot[0], velocity_scale=0.5))
        torch.testing.assert_close(read_image(tmp_path / "out.exr"), want["color"].half().float())
        torch.testing.assert_close(read_channels(tmp_path / "out.exr", "luma"), want["luma"])

    def test_channels_can_be_named(self, shot, tmp_path):
        write_channels(
            tmp_path / "odd.exr",
            velocity_X=None,
            velocity_Y=None,
            mv_a=torch.zeros(48, 64),
            mv_b=torch.zeros(48, 64),
        )
        args = ("filter", "line", tmp_path / "odd.exr", "-o", tmp_path / "out.exr")
        run(*args, code=2)
        run(*args, "--set", "overrides.velocity=[mv.a, mv.b]")
        sharp = read_image(tmp_path / "odd.exr").half().float()
        torch.testing.assert_close(read_image(tmp_path / "out.exr"), sharp)

    def test_png_is_srgb(self, shot, tmp_path):
        run("filter", "line", shot[0], "-o", tmp_path / "out.png")
        run("filter", "line", shot[0], "-o", tmp_path / "out.exr")
        got = np.asarray(Image.open(tmp_path / "out.png"), dtype=np.float32)
        want = display_encode(read_image(tmp_path / "out.exr"))[0].permute(1, 2, 0) * 255
        assert got.shape == (HEIGHT, WIDTH, 3)
        assert np.abs(got - want.numpy()).max() < 0.7

    def test_folder_gives_one_output_per_frame(self, shot, tmp_path):
        output = run("filter", "line", shot[0].parent, "-o", tmp_path / "out").output
        names = sorted(path.name for path in (tmp_path / "out").iterdir())
        assert names == ["sharp.0001.exr", "sharp.0002.exr", "sharp.0003.exr"]
        assert "3 files" in output

    def test_pattern_in_the_output(self, shot, tmp_path):
        run("filter", "line", *shot[1:], "-o", tmp_path / "{name}_blurred.###.png")
        names = sorted(path.name for path in tmp_path.glob("*.png"))
        assert names == ["sharp_blurred.002.png", "sharp_blurred.003.png"]

    def test_table_holds_what_evaluate_gives(self, shot, tmp_path):
        reference = shot[0].parent / "reference.0001.exr"
        output = run(
            "filter",
            "guertin2014",
            shot[0],
            "-o",
            tmp_path / "o.exr",
            "--reference",
            reference,
            "--set",
            "num_samples=9",
            "--set",
            "shutter=0.5",
        ).output
        frame = read_frame(shot[0])
        masks = {"band": border_band(frame, Shutter(0.5))}
        images = {
            "sharp": frame.color,
            "line": create_filter("line", shutter=0.5)(frame),
            "guertin2014": create_filter("guertin2014", shutter=0.5)(frame),
            "guertin2014 (asked)": create_filter("guertin2014", shutter=0.5, num_samples=9)(frame),
        }
        for name, image in images.items():
            scores = evaluate(image.detach(), read_image(reference), masks=masks)
            keys = ("flip", "psnr", "ssim", "flip_band", "psnr_band", "ssim_band")
            want = [round(float(scores[key]), 2 if "psnr" in key else 4) for key in keys]
            assert row(output, name) == pytest.approx(want, abs=1.01e-4), name
        assert "> guertin2014 (asked)" in output
        assert "mcguire2012" in output

    def test_baselines_get_the_shutter_of_the_asked_filter(self, shot):
        reference = shot[0].parent / "reference.0001.exr"
        common = ("filter", "mcguire2012", shot[0], "--reference", reference)
        half = row(run(*common, "--set", "shutter=0.5").output, "line")
        full = row(run(*common, "--set", "shutter=1.0").output, "line")
        assert half[1] > full[1] + 1

    def test_default_of_a_baseline_stands_in_the_table_once(self, shot):
        reference = shot[0].parent / "reference.0001.exr"
        output = run("filter", "line", shot[0], "--reference", reference).output
        assert output.count("  line ") + output.count("> line ") == 1
        assert "> line" in output

    def test_baselines_that_need_more_layers_are_left_out(self, shot, tmp_path):
        write_channels(tmp_path / "flat.exr", Z=None)
        reference = shot[0].parent / "reference.0001.exr"
        command = [
            sys.executable,
            "-c",
            "from tuning.cli import main; main()",
            "filter",
            "line",
            tmp_path / "flat.exr",
            "--reference",
            reference,
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert "warning: mcguire2012 is left out" in done.stderr
        assert "guertin2014" not in done.stdout
        assert len(row(done.stdout, "line")) == 6

    @pytest.mark.filterwarnings("always")
    def test_what_a_filter_cuts_is_one_line_for_all_frames(self, tmp_path):
        for number, speed in enumerate((200.0, 220.0, 240.0), start=1):
            frame = moving_square(speed=speed)
            write_frame(tmp_path / f"sharp.{number:04d}.exr", frame)
            write_image(tmp_path / f"reference.{number:04d}.exr", frame.color)
        given = ("--reference", tmp_path / "reference.####.exr", "--set", "num_samples=5")
        result = run("filter", "jimenez2014", tmp_path / "sharp.####.exr", *given)
        told = [line for line in result.stderr.splitlines() if line.startswith("warning")]
        # One line for the filter, and one for each of those that it is compared with.
        assert [line.split(":")[1].strip() for line in told] == [
            "jimenez2014",
            "mcguire2012",
            "guertin2014",
        ]
        assert all("and are cut there" in line for line in told)

    def test_mean_over_a_sequence(self, shot):
        folder = shot[0].parent
        common = ("filter", "line", "--reference", folder / "reference.####.exr")
        each = [row(run(*common, path).output, "line")[1] for path in shot]
        output = run(*common, folder).output
        assert row(output, "line")[1] == pytest.approx(sum(each) / 3, abs=0.011)
        assert "mean of 3 frames" in output

    def test_gbuffer_is_used_only_if_named(self, shot, tmp_path):
        folder = tmp_path / "pair"
        folder.mkdir()
        sharp = folder / "sharp.exr"
        shot[0].rename(sharp)
        shot[1].rename(folder / "gbuffer.exr")
        run("filter", "line", sharp, "-o", tmp_path / "plain.exr")
        run("filter", "line", folder, "-o", tmp_path / "folder")
        run(
            "filter",
            "line",
            sharp,
            "-o",
            tmp_path / "used.exr",
            "--gbuffer",
            folder / "gbuffer.exr",
        )
        with torch.no_grad():
            plain = create_filter("line")(read_frame(sharp)).half().float()
            used = create_filter("line")(read_frame(sharp, gbuffer=folder / "gbuffer.exr"))
        torch.testing.assert_close(read_image(tmp_path / "plain.exr"), plain)
        torch.testing.assert_close(read_image(tmp_path / "folder/sharp.exr"), plain)
        torch.testing.assert_close(read_image(tmp_path / "used.exr"), used.half().float())
        assert not torch.equal(plain, used.half().float())

    @pytest.mark.shared
    def test_works_on_a_file_as_blender_wrote_it(self, shared_data, tmp_path):
        case = shared_data / "vase"
        output = run(
            "filter",
            "line",
            case / "sharp.exr",
            "-o",
            tmp_path / "out.exr",
            "--set",
            "num_samples=15",
            "--reference",
            case / "reference.exr",
        ).output
        assert row(output, "sharp")[1] == pytest.approx(28.42, abs=0.01)
        assert row(output, "line (asked)")[1] > 37
        assert read_image(tmp_path / "out.exr").shape == (1, 3, 360, 640)


class TestRender:
    @pytest.fixture
    def scene(self, repository):
        return sorted((repository / "configs/scenes").glob("*.yaml"))[0]

    def render(self, scene, out, *more):
        return run("render", scene, "-o", out, "--size", "64x48", "--spp", "4", *more)

    def test_writes_what_the_renderer_returns(self, scene, tmp_path):
        self.render(scene, tmp_path, "--frames", "2", "--shutter", "0.8", "--seed", "3")
        names = sorted(path.name for path in tmp_path.iterdir())
        stem = scene.stem
        assert names == sorted(
            [f"{stem}.0000.exr", f"{stem}.0001.exr", "reference.0000.exr", "reference.0001.exr"]
        )
        loaded = load_scene(scene)
        frame = render_frame(loaded, (48, 64), frame=1, seed=4)
        read = read_frame(tmp_path / f"{stem}.0001.exr")
        for name, layer in frame.layers().items():
            torch.testing.assert_close(read.layers()[name], layer, msg=name)
        want = render_reference(loaded, (48, 64), spp=4, shutter=Shutter(0.8), frame=1, seed=4)
        file = tmp_path / "reference.0001.exr"
        torch.testing.assert_close(read_image(file), want.mean)
        variance = read_channels(file, "variance.R", "variance.G", "variance.B")
        torch.testing.assert_close(variance, want.variance)

    def test_scene_by_name_and_a_new_folder(self, scene, tmp_path):
        self.render(scene.stem, tmp_path / "deep/new")
        assert (tmp_path / f"deep/new/{scene.stem}.0000.exr").exists()

    def test_ctrl_c_keeps_what_is_done(self, scene, tmp_path, monkeypatch):
        import tuning.render.scene

        def interrupted(*args, **kwargs):
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(tuning.render.scene.Renderer, "reference", interrupted)
            result = run("render", scene, "-o", tmp_path, "--size", "64x48", code=130)
        assert "the same command goes on" in result.stderr
        assert [path.name for path in tmp_path.iterdir()] == [f"{scene.stem}.0000.exr"]

    def test_goes_on_where_it_stopped(self, scene, tmp_path):
        self.render(scene, tmp_path)
        kept, lost = tmp_path / "reference.0000.exr", tmp_path / f"{scene.stem}.0000.exr"
        before = kept.stat().st_mtime_ns
        lost.unlink()
        self.render(scene, tmp_path, "--frames", "2")
        assert lost.exists()
        assert kept.stat().st_mtime_ns == before

    def test_refuses_other_settings(self, scene, tmp_path):
        self.render(scene, tmp_path)
        args = ("render", scene, "-o", tmp_path, "--size", "64x48", "--spp", "5")
        assert "made with other settings" in run(*args, code=2).output
        run(*args, "--overwrite")

    def test_unknown_scene_names_the_nearest(self, scene, tmp_path):
        output = run("render", scene.stem + "x", "-o", tmp_path, code=2).output
        assert f"did you mean `{scene.stem}`?" in output

    @pytest.mark.parametrize("size", ["64", "0x48", "64x48x2", "ax48"])
    def test_bad_size(self, scene, tmp_path, size):
        output = run("render", scene, "-o", tmp_path, "--size", size, code=2).output
        assert "`size`" in output or "`width`" in output
        assert size.split("x")[0] in output


class TestParams:
    @pytest.mark.parametrize("width", ["80", "200"])
    @pytest.mark.parametrize("name", sorted(list_filters()))
    def test_lists_each_declaration(self, name, width, monkeypatch):
        monkeypatch.setenv("COLUMNS", width)
        output = " ".join(run("params", name).output.split())
        for key, spec in declared(get_filter(name).config_class).items():
            assert key in output
            assert spec.grad in output
            if spec.low is not None:
                assert f"[{spec.low:g}, {spec.high:g}]" in output

    def test_without_a_filter_lists_all(self):
        output = run("params").output
        for name in list_filters():
            assert name in output

    def test_json_schema(self):
        schema = json.loads(run("params", "line", "--json-schema").output)
        assert schema == get_filter("line").config_class.model_json_schema()
        assert set(json.loads(run("params", "--json-schema").output)) == set(list_filters())


class TestInspect:
    def test_shows_channels_convention_and_speeds(self, shot):
        output = run("inspect", shot[0]).output
        assert "velocity.X" in output
        assert "torchblur (known from: verified)" in output
        assert "12.0 px/frame" in output

    def test_warnings_are_visible_and_no_error(self, tmp_path):
        write_image(tmp_path / "plain.exr", moving_square().color)
        result = run("inspect", tmp_path / "plain.exr")
        assert "warning: " in result.stderr
        assert "no velocity channels" in result.stderr

    @pytest.mark.parametrize(
        ("columns", "speed", "text"),
        [
            (
                16, 347.0,
                "longest blur 87 px to each side (99 % of the pixels: 87 px); the default follows "
                "it; filters of papers need reach=frame or a tile_size of 87 (guertin2014 has 40: "
                "25 % of the pixels would be cut)",
            ),
            (
                16, 100.0,
                "longest blur 25 px to each side (99 % of the pixels: 25 px); the default follows "
                "it; filters of papers need reach=frame or a tile_size of 25 (jimenez2014 has 20: "
                "25 % of the pixels would be cut)",
            ),
            (16, 60.0, "longest blur 15 px to each side (99 % of the pixels: 15 px); all filters"),
            (
                16, 3000.0,
                "the default follows it up to 512 px; all of it needs reach=frame and a max_reach "
                "of 750",
            ),
        ],
    )  # fmt: skip
    def test_says_which_reach_it_needs(self, tmp_path, columns, speed, text):
        velocity = np.zeros((HEIGHT, WIDTH))
        velocity[:, :columns] = speed
        write_channels(tmp_path / "a.exr", velocity_X=velocity, velocity_Y=np.zeros_like(velocity))
        output = run("inspect", tmp_path / "a.exr").stdout
        (line,) = [line for line in output.splitlines() if line.startswith("at shutter 0.5")]
        assert text in line

    def test_few_fast_pixels_are_less_than_a_percent(self, tmp_path):
        velocity = np.zeros((HEIGHT, WIDTH))
        velocity[0, 0] = 347.0
        write_channels(tmp_path / "a.exr", velocity_X=velocity)
        output = run("inspect", tmp_path / "a.exr").stdout
        assert "(99 % of the pixels: 0 px)" in output
        assert "guertin2014 has 40: less than 1 % of the pixels" in output

    def test_a_still_frame_needs_no_reach(self, tmp_path):
        write_channels(tmp_path / "a.exr", velocity_X=np.zeros((HEIGHT, WIDTH)))
        assert "at shutter" not in run("inspect", tmp_path / "a.exr").stdout

    def test_signs_are_tried_with_a_reference(self, shot):
        output = run(
            "inspect", shot[0], "--reference", shot[0].parent / "reference.0001.exr"
        ).output
        assert "as read" in output


class TestTune:
    @pytest.fixture
    def config(self, shot, tmp_path):
        item = {
            "kind": "exr",
            "path": "shot",
            "sharp": "sharp.####.exr",
            "reference": "reference.####.exr",
        }
        save_yaml(
            tmp_path / "fit.yaml",
            {
                "filter": {"kind": "guertin2014", "params": {"num_samples": 5}, "free": ["kappa"]},
                "data": {"train": [item | {"frames": [1, 2]}], "holdout": [item | {"frames": [3]}]},
                "methods": [{"kind": "gradient", "steps": 3, "starts": 1}],
            },
        )
        return tmp_path / "fit.yaml"

    def test_fits_and_says_where_the_preset_is(self, config, shot, tmp_path):
        output = run("tune", config, "-o", tmp_path / "run", "--set", "methods.0.steps=2").output
        assert "training frames" in output
        assert "hold-out" in output
        assert "> tuned" in output
        assert str(tmp_path / "run/preset.yaml") in output
        assert (tmp_path / "run/report.html").is_file()
        run("filter", tmp_path / "run/preset.yaml", shot[0], "-o", tmp_path / "out.exr")

    @pytest.mark.filterwarnings("always")
    def test_what_is_cut_is_no_warning(self, config, tmp_path):
        result = run("tune", config, "-o", tmp_path / "run", "--set", "filter.params.tile_size=2")
        assert "warning" not in result.stderr
        assert "are cut" not in result.output

    def test_existing_run_is_kept(self, config, tmp_path):
        run("tune", config, "-o", tmp_path / "run")
        assert "--resume" in run("tune", config, "-o", tmp_path / "run", code=2).stderr
        run("tune", config, "-o", tmp_path / "run", "--resume")
        run("tune", config, "-o", tmp_path / "run", "--overwrite")

    def test_misspelled_key(self, config, tmp_path):
        result = run(
            "tune", config, "-o", tmp_path / "run", "--set", "objective.band_wieght=1", code=2
        )
        assert "did you mean `band_weight`?" in result.stderr
        assert not (tmp_path / "run").exists()

    def test_ctrl_c_says_how_to_go_on(self, config, tmp_path, monkeypatch):
        import tuning.fit.run

        def interrupted(*args, **kwargs):
            raise KeyboardInterrupt

        monkeypatch.setattr(tuning.fit.run, "run_fit", interrupted)
        result = run("tune", config, "-o", tmp_path / "r", "--set", "seed=3", code=130)
        assert f"torchblur tune {config} -o {tmp_path / 'r'} --set seed=3 --resume" in result.stderr
