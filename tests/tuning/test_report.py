"""The report: its figures, and that the page works in a browser without asking for anything."""

import base64
import html
import io
import re
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from planted import write_planted

from torchblur.metrics import flip_ldr
from torchblur.params import build
from tuning.config import TuneConfig
from tuning.fit import run_fit
from tuning.page import Column, Row, Table, error_map, image_uri, make_view, map_limit, render_page
from tuning.report import figures_table, verdict_of


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    root = tmp_path_factory.mktemp("report")
    data = write_planted(root / "frames")
    data["filter"]["free"] = {"kappa": {}, "third_gain": {"high": 2.5}, "tile_size": {"high": 16}}
    data["methods"] = [
        {"kind": "blackbox", "trials": 12},
        {
            "kind": "gradient", "steps": 5, "starts": 2, "free": ["kappa", "third_gain"],
            "continue_from_best": True, "learning_rate": 0.2,
        },
    ]  # fmt: skip
    data["filter"]["params"] |= {"direction_exponent": 2.5}
    result = run_fit(build(TuneConfig, data), root / "run")
    return result, root / "run" / "report.html"


def pixels(uri):
    kind, _, data = uri.partition(",")
    assert kind == "data:image/webp;base64"
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))


class TestPieces:
    def test_image_is_lossless_srgb(self):
        color = torch.rand(1, 3, 9, 14) * 1.2
        clipped = color[0].clamp(0, 1).permute(1, 2, 0).double().numpy()
        encoded = np.where(
            clipped <= 0.0031308, clipped * 12.92, 1.055 * clipped ** (1 / 2.4) - 0.055
        )
        got = pixels(image_uri(color)).astype(float)
        assert np.abs(got - encoded * 255).max() <= 0.51
        brighter = pixels(image_uri(color, exposure=1.0))
        assert np.array_equal(brighter, pixels(image_uri(color * 2)))

    def test_large_images_are_averaged_down(self):
        color = torch.zeros(1, 3, 4, 2000)
        color[..., ::2] = 1.0
        got = pixels(image_uri(color))
        assert got.shape == (2, 1000, 3)
        assert set(got.flatten()) == {188}  # linear 0.5, not encoded 0.5

    def test_error_map_has_the_colors_of_the_error(self):
        reference = torch.rand(1, 3, 16, 16)
        image = reference.clone()
        image[..., :8] = 1 - image[..., :8]
        error = flip_ldr(image, reference)[0, 0]
        got = pixels(error_map(image, reference, limit=0.5)).astype(int).sum(axis=2)
        order = np.argsort(error.numpy().flatten())
        assert np.array_equal(got.flatten()[order], np.sort(got.flatten()))
        assert pixels(error_map(reference, reference)).max() <= 4

    @pytest.mark.parametrize(("error", "limit"), [(0.0, 0.05), (0.07, 0.1), (0.9, 1.0)])
    def test_limit_is_round(self, error, limit):
        assert map_limit([torch.full((1, 1, 8, 8), error)]) == limit

    def test_best_of_a_column(self):
        rows = [
            Row(name="a", values=[0.10004, 30.0]),
            Row(name="b", values=[0.10001, None]),
            Row(name="bound", values=[0.0, 90.0], ranked=False),
        ]
        columns = [Column(name="FLIP", better="low"), Column(name="PSNR", digits=2, better="high")]
        table = Table(title="", columns=columns, rows=rows)
        assert [table.is_best(row, 0) for row in rows] == [True, True, False]
        assert [table.is_best(row, 1) for row in rows] == [True, False, False]
        assert [table.text(row, 1) for row in rows] == ["30.00", "–", "90.00"]
        assert (
            Table(
                title="",
                columns=[Column(name="d", signed=True)],
                rows=[Row(name="r", values=[-0.5])],
            ).text(Row(name="r", values=[-0.5]), 0)
            == "−0.5000"
        )

    def test_view_of_any_images(self):
        reference = torch.rand(1, 3, 12, 16)
        images = {"one": reference * 0.9, "two": reference}
        view = make_view("v", "Title", images, reference)
        assert (view.left, view.right) == ("one", "reference")
        assert [p.name for p in view.pictures] == ["one", "two", "reference"]
        assert view.pictures[1].caption == "FLIP 0.0000"
        assert len(view.maps) == 2

    def test_names_are_escaped(self, run):
        from tuning.page import _environment

        template = _environment().from_string("{% import 'parts.html' as p %}{{ p.slider(view) }}")
        reference = torch.rand(1, 3, 12, 16)
        view = make_view("v", "<script>x</script>", {'a"><b>': reference}, reference)
        page = template.render(view=view)
        assert "<script>" not in page
        assert 'a"><b>' not in page


class TestFigures:
    def test_table_has_the_means(self, run):
        result, _ = run
        table = figures_table(result, "holdout")
        rows = {row.name: row for row in table.rows}
        assert list(rows) == list(result.variants())
        assert rows["tuned"].values[0] == result.mean("tuned", "holdout", "flip")
        assert rows["tuned"].strong
        assert figures_table(result.model_copy(update={"scores": ()}), "holdout") is None

    def test_verdict(self, run):
        result, _ = run
        verdict = verdict_of(result)
        assert verdict.good
        assert "On the hold-out frames, which the fit never saw" in verdict.text
        swapped = [
            s.model_copy(
                update={
                    "variant": {"tuned": "default", "default": "tuned"}.get(s.variant, s.variant)
                }
            )
            for s in result.scores
        ]
        assert not verdict_of(result.model_copy(update={"scores": tuple(swapped)})).good
        unchanged = result.model_copy(update={"chosen": "start"})
        assert "better than the start values" in verdict_of(unchanged).text


class TestPage:
    def test_content(self, run):
        result, path = run
        page = path.read_text(encoding="utf-8")
        assert html.escape(verdict_of(result).text) in page
        for parameter in result.parameters:
            assert parameter.name in page
        assert result.parameters[1].tuned == 2.5
        assert "at the end of its range" in page
        assert "importance (Optuna)" in page
        assert page.count("<svg") == 3
        assert "num_samples: 11" in page

    def test_nothing_is_fetched(self, run):
        page = run[1].read_text(encoding="utf-8")
        sources = re.findall(r"""(?:src|href|url)\s*[=(]\s*["']?([^"')\s>]+)""", page)
        assert sources
        assert all(source.startswith(("data:", "#")) for source in sources)

    def test_ids_are_unique(self, run):
        ids = re.findall(r'\bid="([^"]+)"', run[1].read_text(encoding="utf-8"))
        assert len(ids) == len(set(ids))

    def test_unknown_names_in_a_template_are_errors(self):
        from jinja2 import UndefinedError

        with pytest.raises(UndefinedError, match="result"):
            render_page("fit.html")


@pytest.fixture(scope="module")
def chromium():
    """A headless browser; without one these tests are skipped."""
    executable = shutil.which("chromium") or shutil.which("google-chrome")
    api = pytest.importorskip("playwright.sync_api")
    if executable is None:
        pytest.skip("no Chromium here")
    quiet = ["background-networking", "component-update", "sync", "gpu"]
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=executable,
            args=["--no-sandbox", *(f"--disable-{name}" for name in quiet)],
        )
        yield browser
        browser.close()


class TestBrowser:
    @pytest.fixture
    def page(self, run, chromium):
        page = chromium.new_page(viewport={"width": 1000, "height": 800})
        self.said, self.asked = [], []
        page.on("console", lambda message: self.said.append(message.text))
        page.on("pageerror", lambda error: self.said.append(str(error)))
        page.on("request", lambda request: self.asked.append(request.url))
        page.goto(run[1].as_uri())
        yield page
        page.close()

    def test_quiet_and_alone(self, page, run):
        assert self.said == []
        assert [url for url in self.asked if not url.startswith("data:")] == [run[1].as_uri()]

    def test_images_are_there(self, page):
        sizes = page.eval_on_selector_all("img", "all => all.map(i => [i.naturalWidth, i.width])")
        assert len(sizes) == 2 * (5 + 3)
        assert all(natural == 64 and shown > 0 for natural, shown in sizes if shown)

    def test_slider_moves_by_keys_and_by_mouse(self, page):
        view = page.locator(".view").first
        over, slider = view.locator("img.over"), view.locator("input[type=range]")

        def clip():
            return over.evaluate("image => getComputedStyle(image).clipPath")

        assert view.locator("img.under").get_attribute("data-name") == "default"
        assert over.get_attribute("data-name") == "tuned"
        assert clip() == "inset(0px 0px 0px 50%)"
        slider.focus()
        page.keyboard.press("ArrowRight")
        assert clip() == "inset(0px 0px 0px 50.5%)"
        page.keyboard.press("Home")
        assert clip() == "inset(0px 0px 0px 0%)"
        view.scroll_into_view_if_needed()
        box = slider.bounding_box()
        page.mouse.click(box["x"] + box["width"] * 0.75, box["y"] + box["height"] / 2)
        percent = float(re.search(r"([\d.]+)%", clip())[1])
        assert percent == pytest.approx(75, abs=3)
        assert self.said == []

    def test_images_can_be_chosen(self, page):
        view = page.locator(".view").first
        view.locator("select").nth(0).select_option("tuned")
        view.locator("select").nth(1).select_option("line")
        assert view.locator("img.under").get_attribute("data-name") == "tuned"
        assert view.locator("img.over").get_attribute("data-name") == "line"
        assert view.locator(".label.l").inner_text().startswith("tuned · FLIP")
        view.locator("select").nth(2).select_option("4")
        assert view.locator(".stack").evaluate("stack => stack.offsetWidth") == 256

    def test_views_do_not_share_their_slider(self, page):
        first, second = (page.locator(".view").nth(i) for i in range(2))
        first.locator("input").focus()
        page.keyboard.press("End")
        clip = "image => getComputedStyle(image).clipPath"
        assert first.locator("img.over").evaluate(clip) == "inset(0px 0px 0px 100%)"
        assert second.locator("img.over").evaluate(clip) == "inset(0px 0px 0px 50%)"

    @pytest.mark.parametrize("width", [380, 1400])
    def test_no_sideways_scroll(self, page, width):
        page.set_viewport_size({"width": width, "height": 800})
        wide = page.evaluate("document.documentElement.scrollWidth")
        assert wide <= width
