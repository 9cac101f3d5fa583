"""Images against a reference: the figures, the names, and the page."""

import math
import re

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_shots import box_blur, moving_square, write_shot
from typer.testing import CliRunner

from torchblur.errors import FrameError, OutputError
from torchblur.frame import Shutter
from torchblur.io import read_image, write_frame, write_image
from torchblur.metrics import border_band, evaluate
from tuning.cli.app import app
from tuning.files.images import read_color, read_metadata, write_color
from tuning.report.compare import compare_images, short_names, write_page


@pytest.fixture
def files(tmp_path):
    frame = moving_square()
    write_frame(tmp_path / "sharp.exr", frame)
    write_image(tmp_path / "reference.exr", box_blur(frame))
    write_image(tmp_path / "near.exr", box_blur(frame) * 1.02)
    return tmp_path


class TestCompareImages:
    def test_scores_are_those_of_evaluate(self, files):
        found = compare_images([files / "near.exr"], files / "reference.exr")
        image, reference = read_image(files / "near.exr"), read_image(files / "reference.exr")
        want = {key: float(value) for key, value in evaluate(image, reference).items()}
        assert found.scores == {"near.exr": want}
        assert found.scores["near.exr"]["psnr"] > 30

    def test_frame_adds_the_band_and_the_sharp_image(self, files):
        found = compare_images(
            [files / "near.exr"],
            files / "reference.exr",
            frame=files / "sharp.exr",
            shutter=Shutter(0.5),
        )
        frame = moving_square()
        band = {"band": border_band(frame, Shutter(0.5))}
        want = evaluate(frame.color, read_image(files / "reference.exr"), masks=band)
        assert list(found.scores) == ["sharp", "near.exr"]
        assert found.scores["sharp"]["flip_band"] == pytest.approx(float(want["flip_band"]))
        assert found.scores["sharp"]["psnr_band"] < found.scores["near.exr"]["psnr_band"]

    def test_shutter_decides_the_band(self, files):
        common = ([files / "near.exr"], files / "reference.exr")
        narrow, wide = (
            compare_images(*common, frame=files / "sharp.exr", shutter=Shutter(open_))
            for open_ in (0.25, 1.0)
        )
        assert narrow.scores["sharp"]["psnr_band"] != wide.scores["sharp"]["psnr_band"]

    def test_png_is_decoded(self, files):
        write_color(files / "near.png", read_image(files / "near.exr"))
        found = compare_images([files / "near.png"], files / "reference.exr")
        clipped = read_image(files / "near.exr").clamp(0, 1)
        want = float(evaluate(clipped, read_image(files / "reference.exr"))["flip"])
        assert found.scores["near.png"]["flip"] == pytest.approx(want, abs=3e-3)

    def test_equal_images(self, files):
        scores = compare_images([files / "reference.exr"], files / "reference.exr").scores
        assert scores["reference.exr"]["flip"] == 0
        assert math.isinf(scores["reference.exr"]["psnr"])

    def test_sizes_that_differ(self, files):
        write_image(files / "small.exr", torch.rand(1, 3, 40, 60))
        with pytest.raises(FrameError, match=r"small\.exr is 60x40.*reference\.exr is 64x48"):
            compare_images([files / "small.exr"], files / "reference.exr")


class TestShortNames:
    @pytest.mark.parametrize(
        ("paths", "names"),
        [
            (["a/x.exr", "a/y.exr"], ["x.exr", "y.exr"]),
            (["a/x.exr", "b/x.exr"], ["a/x.exr", "b/x.exr"]),
            (["x.exr", "x.png"], ["x.exr", "x.png"]),
            (["x.exr", "x.exr"], ["1 x.exr", "2 x.exr"]),
        ],
    )
    def test_are_as_short_as_they_can_be(self, paths, names, tmp_path):
        from pathlib import Path

        assert short_names([Path(path) for path in paths]) == names


class TestPage:
    def test_holds_the_table_and_asks_the_network_for_nothing(self, files):
        found = compare_images(
            [files / "near.exr"], files / "reference.exr", frame=files / "sharp.exr"
        )
        write_page(files / "page.html", found, title="A <b>title</b>")
        page = (files / "page.html").read_text(encoding="utf-8")
        assert f"{found.scores['near.exr']['flip']:.4f}" in page
        assert "FLIP, borders" in page
        assert "A &lt;b&gt;title&lt;/b&gt;" in page
        assert page.count("data:image/webp;base64,") >= 5  # three images, two error maps
        assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//", page)

    def test_is_not_overwritten(self, files):
        found = compare_images([files / "near.exr"], files / "reference.exr")
        (files / "page.html").write_text("precious")
        with pytest.raises(OutputError, match=r"page\.html exists"):
            write_page(files / "page.html", found, title="x")
        write_page(files / "page.html", found, title="x", overwrite=True)

    def test_from_the_command_line(self, files, monkeypatch):
        monkeypatch.setenv("COLUMNS", "120")
        result = CliRunner().invoke(
            app,
            [
                "compare",
                *(str(files / n) for n in ("near.exr", "sharp.exr")),
                "--reference",
                str(files / "reference.exr"),
                "--frame",
                str(files / "sharp.exr"),
                "-o",
                str(files / "page.html"),
            ],
        )
        assert result.exit_code == 0, result.output
        assert "borders" in result.stdout
        assert re.search(r"near\.exr +0\.\d{4} +\d\d\.\d\d", result.stdout)
        assert (files / "page.html").is_file()


class TestImages:
    def test_png_is_8_bit_srgb_and_keeps_metadata(self, tmp_path):
        color = torch.tensor([-0.5, 0.0, 0.2158605, 1.0, 7.0]).expand(1, 3, 6, 5)
        write_color(tmp_path / "a.png", color, metadata={"κ": 40.0})
        values = np.asarray(Image.open(tmp_path / "a.png"))
        assert values[0, :, 0].tolist() == [0, 0, 128, 255, 255]
        assert read_metadata(tmp_path / "a.png") == {"κ": 40.0}
        got = read_color(tmp_path / "a.png")
        torch.testing.assert_close(got, color.clamp(0, 1), atol=2e-3, rtol=0)

    def test_png_holds_no_layers(self, tmp_path):
        with pytest.raises(OutputError, match=r"a\.png.*not depth"):
            write_color(tmp_path / "a.png", torch.ones(1, 3, 6, 6), layers={"depth": torch.ones(1)})
        assert not list(tmp_path.iterdir())

    def test_exr_metadata(self, tmp_path):
        path = write_shot(tmp_path, 1)[0]
        assert read_metadata(path) == {}
