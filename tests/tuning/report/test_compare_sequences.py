"""Sequences against their references: means, the error of change, the frame shown, the page."""

from pathlib import Path

import pytest
import torch
from tiny_shots import write_shot
from typer.testing import CliRunner

from torchblur.errors import ConfigError, FrameError
from torchblur.frame import Shutter
from torchblur.io import read_frame, read_image, write_image
from torchblur.metrics import border_band, evaluate, flip_ldr, temporal_errors
from torchblur.metrics.pooling import weighted_median
from tuning.cli.app import app
from tuning.report.compare_sequences import compare_sequences, is_sequence

NUMBERS = (1, 2, 3, 4)


@pytest.fixture
def shot(tmp_path):
    """Frames and references, and two sequences near them: one steady, one that flickers."""
    write_shot(tmp_path, 4)
    for number in NUMBERS:
        reference = read_image(tmp_path / f"reference.{number:04d}.exr")
        flicker = 1.3 if number == 3 else 1.0
        write_image(tmp_path / f"steady.{number:04d}.exr", reference * 1.1, half=False)
        write_image(tmp_path / f"flicker.{number:04d}.exr", reference * flicker, half=False)
    return tmp_path


def images(shot, name):
    return [read_image(shot / f"{name}.{number:04d}.exr") for number in NUMBERS]


def compared(shot, *names, **options):
    paths = [shot / f"{name}.####.exr" for name in names]
    return compare_sequences(paths, shot / "reference.####.exr", **options)


class TestFigures:
    def test_means_over_the_frames(self, shot):
        found = compared(shot, "steady", "flicker")
        truth = images(shot, "reference")
        assert list(found.scores) == ["steady.####.exr", "flicker.####.exr"]
        for name in ("steady", "flicker"):
            pairs = list(zip(images(shot, name), truth, strict=True))
            scores = found.scores[f"{name}.####.exr"]
            flips = [float(evaluate(i, r)["flip"]) for i, r in pairs]
            assert scores["flip"] == pytest.approx(sum(flips) / 4, rel=1e-4)
            medians = [float(weighted_median(flip_ldr(i, r))) for i, r in pairs]
            assert scores["flip_median"] == pytest.approx(sum(medians) / 4, rel=1e-4)
            changes = temporal_errors([i for i, _ in pairs], truth)[1:].mean()
            assert scores["temporal"] == pytest.approx(float(changes), rel=1e-4)
        flicker, steady = (found.scores[f"{n}.####.exr"] for n in ("flicker", "steady"))
        assert flicker["flip"] < steady["flip"]
        assert flicker["temporal"] > 3 * steady["temporal"]

    def test_a_missing_number_is_no_change(self, shot):
        for path in shot.glob("*.0003.exr"):
            path.unlink()
        with pytest.warns(
            UserWarning, match=r"flicker\.####\.exr lacks 1 of 4 frames: 3; .* other 3"
        ):
            found = compared(shot, "flicker")
        assert found.frames == "3 frames"
        assert found.scores["flicker.####.exr"]["temporal"] == 0

    @pytest.mark.parametrize("number", [1, 4])
    def test_frames_that_only_the_reference_has_are_named(self, shot, number):
        (shot / f"flicker.{number:04d}.exr").unlink()
        text = f"lacks 1 of 4 frames: {number}; the figures are those of the other 3"
        with pytest.warns(UserWarning, match=text):
            compared(shot, "flicker")

    def test_the_worst_frame_is_shown(self, shot):
        found = compared(shot, "flicker", "steady")
        assert found.shown == "Frame 3, the worst of flicker.####.exr"
        assert torch.equal(found.reference, images(shot, "reference")[2])
        assert torch.equal(found.images["steady.####.exr"], images(shot, "steady")[2])

    def test_sharp_frames_add_the_band(self, shot):
        found = compared(shot, "steady", frame=shot / "sharp.####.exr", shutter=Shutter(0.5))
        assert list(found.scores) == ["sharp", "steady.####.exr"]
        want = []
        for number, image, truth in zip(
            NUMBERS, images(shot, "steady"), images(shot, "reference"), strict=True
        ):
            sharp = read_frame(shot / f"sharp.{number:04d}.exr")
            masks = {"band": border_band(sharp, Shutter(0.5))}
            want.append(float(evaluate(image, truth, masks=masks)["psnr_band"]))
        got = found.scores["steady.####.exr"]["psnr_band"]
        assert got == pytest.approx(sum(want) / 4, rel=1e-4)


class TestRefusals:
    def test_a_sequence_with_a_single_image(self):
        with pytest.raises(ConfigError, match=r"r\.exr has no #### for the frame number"):
            is_sequence([Path("a/s.####.exr"), Path("r.exr")])
        assert not is_sequence([Path("a.exr"), Path("b.exr")])

    def test_no_file(self, shot):
        with pytest.raises(ConfigError, match=r"is called none\.####\.exr \(IMAGE\)"):
            compared(shot, "none")

    def test_sizes_that_differ(self, shot):
        write_image(shot / "steady.0002.exr", torch.rand(1, 3, 8, 9), overwrite=True)
        with pytest.raises(FrameError, match=r"steady\.0002\.exr is 9x8, .*reference\.0002\.exr"):
            compared(shot, "steady")


class TestCommand:
    def run(self, *args, code=0):
        result = CliRunner().invoke(app, ["compare", *map(str, args)])
        assert result.exit_code == code, f"{result.output}\n{result.exception!r}"
        return result

    def test_table_and_page(self, shot):
        sequences = [shot / f"{name}.####.exr" for name in ("steady", "flicker")]
        result = self.run(
            *sequences, "--reference", shot / "reference.####.exr", "-o", shot / "page.html"
        )
        output = " ".join(result.stdout.split())
        assert "mean of 4 frames" in output
        assert "in time" in output
        page = (shot / "page.html").read_text()
        for said in ("Over the frames", "<svg", "worst of steady", "change in time", "4 frames"):
            assert said in page

    def test_missing_reference(self, shot):
        (shot / "reference.0002.exr").unlink()
        result = self.run(
            shot / "steady.####.exr", "--reference", shot / "reference.####.exr", code=2
        )
        assert "reference.0002.exr does not exist" in result.stderr
