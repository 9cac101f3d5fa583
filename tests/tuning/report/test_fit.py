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
from planted import planted_case, write_planted

from torchblur.metrics import flip_ldr
from torchblur.params import build
from tuning.cli.printing import print_fit
from tuning.config.fit import TuneConfig
from tuning.config.objective import ObjectiveSpec
from tuning.fit.run import run_fit
from tuning.report.evidence import evidence_of
from tuning.report.fit import figures_table, figures_tables, verdict_of
from tuning.report.page import (
    Column,
    Row,
    Table,
    error_map,
    image_uri,
    make_view,
    map_limit,
    render_page,
)
from tuning.results.fit import CaseScore


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
        from tuning.report.page import _environment

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


class TestHeights:
    """Figures of the hold-out at each height; those of "tall" are 0.3, of "small" 0.1 and 0.2."""

    @pytest.fixture
    def result(self, run):
        given = {"tall": (0.3, 0.2, 1080), "small": (0.1, 0.2, 136), "other": (0.2, 0.1, 136)}
        scores = [
            CaseScore(
                case=case,
                split=split,
                variant=variant,
                scores={"flip": flip, "psnr": 30.0},
                lines=lines,
            )
            for split in ("train", "holdout")
            for case, (tuned, line, lines) in given.items()
            for variant, flip in (("tuned", tuned), ("line", line), ("default", 0.5))
        ]
        return run[0].model_copy(update={"scores": tuple(scores)})

    def test_means(self, result):
        assert result.heights("holdout") == (1080, 136)
        assert result.height_groups() == (1080, 136, None)
        means = [result.mean("tuned", "holdout", "flip", lines) for lines in (1080, 136, None)]
        assert means == pytest.approx([0.3, 0.15, 0.2])

    def test_tables(self, result):
        tables = figures_tables(result)
        assert [table.title for table in tables] == [
            "Hold-out, 1080 lines: 1 frame",
            "Hold-out, 136 lines: 2 frames",
            "Hold-out, all heights: 3 frames",
            "Training: 3 frames",
        ]
        rows = [{row.name: row.values[0] for row in table.rows} for table in tables]
        assert [row["tuned"] for row in rows] == pytest.approx([0.3, 0.15, 0.2, 0.2])

    def test_verdict_names_where_the_line_blur_is_better(self, result):
        text = verdict_of(result).text
        assert text.endswith("Worse than a line blur at 1080 lines (0.3000 against 0.2000).")

    def test_printed(self, result, tmp_path, capsys):
        print_fit(result, tmp_path)
        titles = [
            line.rstrip()
            for line in capsys.readouterr().out.splitlines()
            if line.startswith(("hold", "train"))
        ]
        assert titles == [
            "training frames", "hold-out, 1080 lines", "hold-out, 136 lines",
            "hold-out, all heights",
        ]  # fmt: skip

    def test_evidence(self, result):
        cases = [planted_case(1), planted_case(2, "holdout")]
        evidence = evidence_of(result, ObjectiveSpec(), cases, ("default", "tuned"))
        figures = {key: one["tuned"]["flip"] for key, one in evidence["figures"].items()}
        assert figures == pytest.approx(
            {"train": 0.2, "holdout, 1080 lines": 0.3, "holdout, 136 lines": 0.15, "holdout": 0.2}
        )

    def test_one_height_or_none_known_is_one_table(self, run, result):
        low = tuple(score for score in result.scores if score.lines == 136)
        unknown = tuple(s.model_copy(update={"lines": None}) for s in result.scores)
        for scores in (low, unknown):
            one = result.model_copy(update={"scores": scores})
            assert one.height_groups() == (None,)
            titles = [table.title.partition(":")[0] for table in figures_tables(one)]
            assert titles == ["Hold-out", "Training"]

    def test_a_fit_writes_them(self, run):
        assert {score.lines for score in run[0].scores} == {48}


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
