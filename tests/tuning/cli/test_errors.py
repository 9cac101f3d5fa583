"""Bad input: one clear message on the standard error, an exit code, and nothing half-written."""

import os

import pytest
import torch
from tiny_shots import (
    box_blur,
    moving_square,
    truncate,
    with_nan_velocity,
    write_channels,
    write_shot,
)
from typer.testing import CliRunner

from torchblur.io import save_yaml, write_frame, write_image
from tuning.cli.app import app


@pytest.fixture(autouse=True)
def _wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")


@pytest.fixture
def shot(tmp_path):
    return write_shot(tmp_path / "shot", 2)


def refused(*args, code=2):
    """Run a command that must fail; return its message, a single line."""
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    assert result.exit_code == code, f"{result.output}\n{result.exception!r}"
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert lines[0].startswith("error: "), result.stderr
    assert len(lines) == 1, result.stderr
    return lines[0].removeprefix("error: ")


def nothing_left(folder, *allowed):
    names = {path.name for path in folder.iterdir()} - set(allowed)
    assert not names, names


class TestFilter:
    @pytest.fixture
    def blur(self, shot, tmp_path):
        def call(*more, name="guertin2014", source=shot[0], output=tmp_path / "out.exr"):
            message = refused("filter", name, source, "-o", output, *more)
            assert not (tmp_path / "out.exr").exists()
            return message

        return call

    def test_unknown_filter(self, blur):
        message = blur(name="guertin2015")
        assert "unknown filter `guertin2015` (did you mean `guertin2014`?)" in message

    def test_no_such_preset(self, blur):
        assert "none.yaml does not exist" in blur(name="none.yaml")

    def test_unknown_key(self, blur):
        message = blur("--set", "num_sample=3")
        assert "unknown key `num_sample` (did you mean `num_samples`?)" in message

    def test_bad_setting(self, blur):
        assert "`on_invalid`" in blur("--set", "on_invalid=maks")
        message = blur("--set", "overrides.velocity_scal=2")
        assert "did you mean `velocity_scale`?" in message
        assert "--set" in message

    def test_out_of_range(self, blur):
        message = blur("--set", "kappa=-1.5")
        assert "`kappa` must lie in [1, 1000], got -1.5" in message

    def test_wrong_kind(self, blur):
        message = blur("--set", "num_samples=many")
        assert "`num_samples`" in message
        assert "'many'" in message

    @pytest.mark.parametrize(("text", "said"), [("kappa", "KEY"), ("kappa=[1", "not YAML")])
    def test_malformed_set(self, blur, text, said):
        message = blur("--set", text)
        assert said in message
        assert text in message

    def test_no_such_input(self, blur, tmp_path):
        assert "nothing.exr" in blur(source=tmp_path / "nothing.exr")

    def test_pattern_that_fits_nothing(self, blur, tmp_path):
        message = blur(source=tmp_path / "shot/beauty.####.exr")
        assert "beauty.####.exr" in message
        assert "sharp.0001.exr" in message

    def test_missing_channel_lists_those_there(self, blur, tmp_path):
        path = write_channels(tmp_path / "bad.exr", velocity_X=None)
        message = blur(source=path)
        assert "no velocity channels" in message
        assert "Present: B, G, R, Z, velocity.Y" in message
        assert "blender: " in message

    def test_missing_depth(self, blur, tmp_path):
        message = blur(source=write_channels(tmp_path / "bad.exr", Z=None))
        assert "`depth` is needed and is missing" in message
        assert "bad.exr" in message

    def test_truncated(self, blur, shot):
        message = blur(source=truncate(shot[0]))
        assert f"{shot[0]} is truncated" in message

    def test_not_an_exr(self, blur, tmp_path):
        (tmp_path / "text.exr").write_text("hello")
        assert "text.exr is not an OpenEXR file" in blur(source=tmp_path / "text.exr")

    def test_nan_velocity(self, blur, tmp_path):
        message = blur(source=with_nan_velocity(tmp_path / "nan.exr"))
        assert "`velocity.X` of" in message
        assert "nan.exr" in message
        assert "1 values" in message
        assert "x=5, y=3" in message

    def test_mismatched_gbuffer(self, blur, tmp_path):
        write_frame(tmp_path / "g.exr", moving_square(size=(40, 60)))
        message = blur("--gbuffer", tmp_path / "g.exr")
        assert "64x48" in message
        assert "60x40" in message

    def test_mismatched_reference(self, blur, tmp_path):
        write_image(tmp_path / "r.exr", box_blur(moving_square(size=(40, 60))))
        message = blur("--reference", tmp_path / "r.exr")
        assert f"{tmp_path / 'r.exr'} is 60x40" in message
        assert "is 64x48" in message

    def test_unknown_convention(self, blur):
        assert "did you mean `blender`?" in blur("--convention", "blendr")

    def test_convention_that_does_not_fit(self, blur):
        message = blur("--convention", "nuke")
        assert "forward.u/forward.v" in message
        assert "velocity.X" in message

    def test_existing_output_is_kept(self, shot, tmp_path):
        (tmp_path / "out.exr").write_bytes(b"precious")
        args = ("filter", "line", shot[0], "-o", tmp_path / "out.exr")
        message = refused(*args)
        assert f"{tmp_path / 'out.exr'} exists" in message
        assert "--overwrite" in message
        assert (tmp_path / "out.exr").read_bytes() == b"precious"
        assert CliRunner().invoke(app, [*map(str, args), "--overwrite"]).exit_code == 0
        assert (tmp_path / "out.exr").read_bytes() != b"precious"

    def test_existing_output_is_seen_before_any_work(self, shot, tmp_path):
        out = tmp_path / "out"
        out.mkdir()
        (out / "sharp.0002.exr").write_bytes(b"precious")
        assert "sharp.0002.exr exists" in refused("filter", "line", *shot, "-o", out)
        nothing_left(out, "sharp.0002.exr")

    def test_unwritable_folder(self, blur, tmp_path):
        (tmp_path / "file").write_text("not a folder")
        assert "cannot make the folder" in blur(output=tmp_path / "file/out.exr")

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
    def test_folder_without_permission(self, blur, tmp_path):
        (tmp_path / "locked").mkdir(mode=0o500)
        assert "cannot write into" in blur(output=tmp_path / "locked/out.exr")

    def test_unknown_ending(self, blur, tmp_path):
        assert "must end in .exr or .png" in blur(output=tmp_path / "out.jpg")

    def test_two_inputs_for_one_output(self, shot, tmp_path):
        message = refused("filter", "line", *shot, "-o", tmp_path / "out.exr")
        assert "would both be written" in message
        assert "####" in message

    def test_output_in_place_of_an_input(self, shot):
        before = shot[0].read_bytes()
        message = refused("filter", "line", shot[0], "-o", shot[0], "--overwrite")
        assert "would replace an input" in message
        assert shot[0].read_bytes() == before

    def test_unknown_placeholder(self, blur, tmp_path):
        message = blur(output=str(tmp_path / "{nam}.exr"))
        assert "unknown placeholder `{nam}`" in message
        assert "`name`" in message

    def test_number_where_there_is_none(self, tmp_path):
        write_frame(tmp_path / "one.exr", moving_square())
        message = refused("filter", "line", tmp_path / "one.exr", "-o", tmp_path / "o.####.exr")
        assert "one.exr has none" in message

    def test_one_reference_for_several_inputs(self, shot):
        reference = shot[0].parent / "reference.0001.exr"
        message = refused("filter", "line", *shot, "--reference", reference)
        assert "####" in message
        assert "2 inputs" in message

    def test_neither_output_nor_reference(self, shot):
        message = refused("filter", "line", shot[0])
        assert "-o OUT" in message
        assert "--reference" in message


class TestOthers:
    def test_tune_without_a_file(self, tmp_path):
        assert "none.yaml does not exist" in refused("tune", tmp_path / "none.yaml")

    def test_tune_with_bad_yaml(self, tmp_path):
        (tmp_path / "bad.yaml").write_text("filter: [1\n")
        assert "bad.yaml:" in refused("tune", tmp_path / "bad.yaml")

    def test_tune_with_several_mistakes_lists_all(self, tmp_path):
        save_yaml(tmp_path / "bad.yaml", {"filtr": 1, "seed": -1})
        result = CliRunner().invoke(app, ["tune", str(tmp_path / "bad.yaml")])
        assert result.exit_code == 2
        for said in ("`filtr` (did you mean `filter`?)", "`data` is required", "`seed`"):
            assert said in result.stderr

    def test_render_without_such_a_scene(self, tmp_path):
        assert "no scene `nowhere_at_all`" in refused("render", "nowhere_at_all", "-o", tmp_path)

    def test_render_of_what_is_no_scene(self, tmp_path):
        save_yaml(tmp_path / "s.yaml", {"camra": 1})
        result = CliRunner().invoke(app, ["render", str(tmp_path / "s.yaml"), "-o", str(tmp_path)])
        assert result.exit_code == 2
        assert "did you mean `camera`?" in result.stderr

    @pytest.mark.parametrize(
        ("option", "value"), [("--spp", 1), ("--frames", 0), ("--shutter", 9), ("--seed", -1)]
    )
    def test_render_out_of_range(self, option, value, tmp_path, repository):
        scene = sorted((repository / "configs/scenes").glob("*.yaml"))[0]
        message = refused("render", scene, "-o", tmp_path / "r", option, value)
        assert f"`{option[2:]}`" in message
        assert str(value) in message
        assert not (tmp_path / "r").exists()

    def test_compare_sizes(self, shot, tmp_path):
        write_image(tmp_path / "small.exr", torch.rand(1, 3, 40, 60))
        message = refused("compare", tmp_path / "small.exr", "--reference", shot[0])
        assert f"{tmp_path / 'small.exr'} is 60x40" in message
        assert f"{shot[0]} is 64x48" in message

    def test_compare_missing_file(self, shot, tmp_path):
        assert "none.png" in refused("compare", tmp_path / "none.png", "--reference", shot[0])

    def test_compare_keeps_an_existing_page(self, shot, tmp_path):
        (tmp_path / "page.html").write_text("precious")
        result = CliRunner().invoke(
            app,
            [
                "compare",
                str(shot[0]),
                "--reference",
                str(shot[1]),
                "-o",
                str(tmp_path / "page.html"),
            ],
        )
        assert result.exit_code == 2
        assert "page.html exists" in result.stderr
        assert (tmp_path / "page.html").read_text() == "precious"

    def test_inspect_unreadable(self, shot):
        assert "is truncated" in refused("inspect", truncate(shot[0]))

    def test_params_of_no_filter(self):
        assert "did you mean `line`?" in refused("params", "lin")

    def test_unknown_option_is_typers_own_message(self):
        result = CliRunner().invoke(app, ["filter", "--sett", "a=1"])
        assert result.exit_code == 2
        assert "No such option" in result.stderr


class TestDebug:
    @pytest.mark.parametrize("place", ["first", "last"])
    def test_shows_where(self, place):
        args = ["params", "nonsense"]
        args = ["--debug", *args] if place == "first" else [*args, "--debug"]
        result = CliRunner().invoke(app, args)
        assert type(result.exception).__name__ == "ConfigError"

    def test_defects_are_one_message_too(self, shot, tmp_path, monkeypatch):
        import tuning.batch.single

        def broken(*args, **kwargs):
            raise RuntimeError("the tensors disagree")

        monkeypatch.setattr(tuning.batch.single, "filter_files", broken)
        result = CliRunner().invoke(
            app, ["filter", "line", str(shot[0]), "-o", str(tmp_path / "o")]
        )
        assert result.exit_code == 1
        assert "unexpected RuntimeError: the tensors disagree" in result.stderr
        assert "--debug" in result.stderr

    def test_warnings_are_one_line(self, shot, tmp_path, monkeypatch):
        import warnings

        import tuning.batch.single

        def warning(*args, **kwargs):
            warnings.simplefilter("always")
            warnings.warn("something is odd", stacklevel=1)

        monkeypatch.setattr(tuning.batch.single, "filter_files", warning)
        result = CliRunner().invoke(
            app, ["filter", "line", str(shot[0]), "-o", str(tmp_path / "o")]
        )
        assert result.exit_code == 0
        assert result.stderr == "warning: something is odd\n"

    def test_what_is_cut_is_told_once_for_each_filter(self, shot, tmp_path, monkeypatch):
        import warnings

        import tuning.batch.single
        from torchblur.errors import ReachWarning

        def cutting(*args, **kwargs):
            warnings.simplefilter("always")
            for text in ("tan2022: 5%", "tan2022: 6%", "sousa2013: 5%"):
                warnings.warn(text, ReachWarning, stacklevel=1)

        monkeypatch.setattr(tuning.batch.single, "filter_files", cutting)
        result = CliRunner().invoke(
            app, ["filter", "line", str(shot[0]), "-o", str(tmp_path / "o")]
        )
        assert result.stderr == "warning: tan2022: 5%\nwarning: sousa2013: 5%\n"
