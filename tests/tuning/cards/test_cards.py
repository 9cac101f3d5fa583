"""Cards of presets: figures of the run and nothing else, honest about what is worse."""

import io
import re
from dataclasses import replace

import pytest
import torch
from PIL import Image
from planted import write_planted
from typer.testing import CliRunner

from torchblur.errors import ConfigError, OutputError
from torchblur.metrics import display_encode
from torchblur.params import build
from torchblur.presets import load_preset
from tuning.cards.picture import card_picture
from tuning.cards.text import Card, card_text
from tuning.cards.write import write_cards
from tuning.cli.app import app
from tuning.config.fit import TuneConfig, load_tune_config
from tuning.data.loading import load_cases
from tuning.fit.run import run_fit
from tuning.results.fit import CaseScore

FIGURES = {"flip": 0.02, "psnr": 30.0, "ssim": 0.9}
LEVELS = {
    "kind": "pareto", "sampler": "nsga2", "trials": 4, "population": 2, "sweep": 2,
    "budgets": {"low": 0.3, "sky": 9.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished fit: its folder and its result."""
    root = tmp_path_factory.mktemp("card")
    data = write_planted(root / "frames")
    data["methods"] = [{"kind": "gradient", "steps": 3, "starts": 1}]
    return root / "run", run_fit(build(TuneConfig, data), root / "run")


@pytest.fixture(scope="module")
def levels(tmp_path_factory):
    """The same with quality levels."""
    root = tmp_path_factory.mktemp("levels")
    data = write_planted(root / "frames") | {"methods": [LEVELS]}
    data["filter"]["free"] = {"num_samples": {"low": 2, "high": 24}, "kappa": {}}
    return root / "run", run_fit(build(TuneConfig, data), root / "run")


def card_of(run, **changes):
    folder, result = run
    return Card(
        name="guertin2014-tuned",
        preset=load_preset(folder / "preset.yaml"),
        config=load_tune_config(folder / "config.yaml"),
        result=result.model_copy(update=changes),
        variant="tuned",
    )


def test_defaults_that_no_paper_has_are_not_called_published(run):
    published, own = card_of(run), card_of(run, filter="warp", parameters=())
    own = replace(own, preset=own.preset.model_copy(update={"filter": "warp", "params": {}}))
    for card, label in ((published, "as published"), (own, "with its defaults")):
        text = card_text(card, "used", "picture", "")
        assert card.rival == label
        assert f"| {label} |" in section(text, "Before and after")
        assert ("published" in text) == (card is published)


def section(text, title):
    return text.split(f"## {title}\n")[1].split("\n## ")[0]


def scored(case, split="holdout", lines=None, **by_variant):
    """Return scores of a case: figures of a variant differ from FIGURES as given."""
    return [
        CaseScore(case=case, split=split, variant=name, scores=FIGURES | changes, lines=lines)
        for name, changes in by_variant.items()
    ]


def test_the_card_has_the_figures_of_the_run(run, tmp_path):
    folder, result = run
    (path,) = write_cards(folder, tmp_path / "cards", presets_dir=tmp_path / "presets")
    assert path == tmp_path / "cards" / "guertin2014-tuned.md"
    text = path.read_text()
    assert text.startswith("# guertin2014-tuned\n")
    assert f"\n{result.command}\n" in text
    assert f"torchblur filter {tmp_path}/presets/guertin2014-tuned.yaml INPUT.exr" in text
    assert f"Seed 5. python {result.versions['python']}, torchblur" in text
    before_after = section(text, "Before and after")
    for split in ("holdout", "train"):
        for variant, name in (("tuned", "`guertin2014-tuned`"), ("default", "as published")):
            flip = f"{result.mean(variant, split, 'flip'):.4f}"
            psnr = f"{result.mean(variant, split, 'psnr'):.2f}"
            row = f"| {name} | {flip} | {psnr} |"
            assert row in before_after.replace("**", "")
    tuned = {parameter.name: parameter.tuned for parameter in result.parameters}
    rows = section(text, "Parameters")
    assert f"| `kappa` | 40 | {tuned['kappa']:.5g} |  | 1 to 1000 |" in rows
    assert "| `tile_size` | 40 | 12 | px | fixed |" in rows
    assert "gamma" not in rows
    made = section(text, "How it was made")
    assert "| hold-out | exr | `second` | all |  |  | 1, centered |  |" in made
    assert "Objective: terms {mse: 1}, color_space linear." in made
    assert f"{result.start_objective:.5f} → {result.objective:.5f}" in made


class TestHeights:
    def lines(self, run, *scores):
        """Return the first paragraphs and the titles of the tables."""
        text = card_text(card_of(run, scores=scores), "p", "i", "")
        head = text.split("```")[0].split("\n\n")[1:-1]
        return head, re.findall(r"^(.*); means\.", section(text, "Before and after"), re.MULTILINE)

    def test_worse_than_a_line_blur_is_said_first(self, run):
        better = scored("a", lines=1080, default={}, line={}, tuned={"flip": 0.01})
        worse = scored("b", lines=136, default={}, line={}, tuned={"flip": 0.03})
        train = scored("c", "train", lines=136, default={}, line={}, tuned={})
        (first, summary), titles = self.lines(run, *better, *worse, *train)
        assert first == "**Worse than a line blur at 136 lines (0.0300 against 0.0200).**"
        assert summary.endswith("references of 136 lines and held out at 1080 and 136 lines.")
        assert titles == [
            "Hold-out, 1080 lines: 1 frame",
            "Hold-out, 136 lines: 1 frame",
            "Hold-out, all heights: 2 frames",
            "Training: 1 frame",
        ]

    def test_nothing_where_it_is_not(self, run):
        (summary,), titles = self.lines(
            run, *scored("a", lines=136, default={}, line={}, tuned={"flip": 0.020049})
        )
        assert summary.endswith("references and held out at 136 lines.")
        assert titles == ["Hold-out: 1 frame"]

    def test_results_that_do_not_say_their_height(self, run):
        (first, summary), _ = self.lines(
            run, *scored("a", default={}, line={}, tuned={"flip": 0.03})
        )
        assert first == "**Worse than a line blur on the hold-out (0.0300 against 0.0200).**"
        assert summary.endswith("fitted to references.")


def test_the_preset_is_that_of_the_run(run, tmp_path):
    write_cards(run[0], tmp_path, presets_dir=tmp_path)
    shipped, own = load_preset(tmp_path / "guertin2014-tuned.yaml"), run[0] / "preset.yaml"
    assert shipped == load_preset(own)
    head = (tmp_path / "guertin2014-tuned.yaml").read_text()
    assert f"{tmp_path}/guertin2014-tuned.md shows it, and where it is worse" in head


class TestWhereItIsWorse:
    def text(self, run, *scores):
        return section(card_text(card_of(run, scores=scores), "p", "i", ""), "Where it is worse")

    def test_nowhere_only_if_so(self, run):
        better = scored("a", default={}, line={}, tuned={"flip": 0.01, "psnr": 31.0})
        assert self.text(run, *better).strip() == (
            "Nowhere: on no frame is it worse than the filter as published or the line blur, by "
            "any figure shown."
        )

    def test_each_figure_that_is_worse(self, run):
        text = self.text(
            run,
            *scored("a", default={}, line={}, tuned={"psnr": 29.5}),
            *scored("b", default={}, line={"flip": 0.005}, tuned={"flip": 0.01}),
            *scored("c", default={}, line={}, tuned={}),
            *scored("d", "train", default={"ssim": 0.95}, line={"ssim": 0.94}, tuned={}),
        )
        assert "On 2 of 3 hold-out frames and 1 of 1 training frames it is worse" in text
        rows = [line for line in text.splitlines() if line.startswith("|")]
        assert rows == [
            "| frame |  | FLIP | PSNR | SSIM |",
            "| --- | --- | --- | --- | --- |",
            "| a | hold-out |  | 29.50 (as published 30.00, line blur 30.00) |  |",
            "| b | hold-out | 0.0100 (line blur 0.0050) |  |  |",
            "| d | training |  |  | 0.9000 (as published 0.9500, line blur 0.9400) |",
        ]

    def test_digits_that_are_not_shown_do_not_count(self, run):
        text = self.text(run, *scored("a", default={"flip": 0.01999}, line={}, tuned={}))
        assert "Nowhere" in text

    def test_a_figure_that_is_missing(self, run):
        band = scored("a", default={"flip_band": None}, line={}, tuned={"flip_band": None})
        assert "Nowhere" in self.text(run, *band)


class TestPicture:
    def cases(self, run):
        return load_cases(load_tune_config(run[0] / "config.yaml").data)

    def test_shows_what_the_caption_says(self, run):
        picture = card_picture(card_of(run), self.cases(run))
        assert len(picture.content) <= 60_000
        image = Image.open(io.BytesIO(picture.content))
        assert image.format == "WEBP"
        flips = [run[1].mean(v, "holdout", "flip") for v in ("line", "default", "tuned")]
        assert (
            f"second, where it helps most: FLIP line blur {flips[0]:.4f}, as published "
            f"{flips[1]:.4f}, tuned {flips[2]:.4f}."
        ) in picture.caption
        # One row of five: the last is the reference, 64x48 px shown four times as large.
        width = (image.width + 4) // 5
        assert (width - 4, image.height) == (4 * 64, 20 + 4 * 48)
        tile = image.crop((4 * width, 20, 4 * width + 256, 20 + 192)).resize((64, 48))
        shown = torch.frombuffer(bytearray(tile.tobytes()), dtype=torch.uint8).view(48, 64, 3)
        (case,) = (c for c in self.cases(run) if c.split == "holdout")
        wanted = display_encode(case.reference)[0].permute(1, 2, 0)
        assert float((shown / 255 - wanted).abs().mean()) < 0.03

    def test_best_and_worst_frame(self, run):
        """Judged against what is better, the line blur or the filter as published."""
        scores = (
            *scored("first", "holdout", default={"flip": 0.04}, line={}, tuned={"flip": 0.019}),
            *scored("second", "holdout", default={}, line={"flip": 0.04}, tuned={"flip": 0.01}),
        )
        cases = [c for c in self.cases(run)]
        for case in cases:
            object.__setattr__(case, "split", "holdout")
        caption = card_picture(card_of(run, scores=scores), cases).caption
        assert "second, where it helps most" in caption
        assert "first, where it helps least" in caption
        assert "frames that the fit never saw" in caption


def test_a_card_for_each_level(levels, tmp_path):
    folder, result = levels
    files = write_cards(folder, tmp_path, presets_dir=tmp_path)
    assert [file.name for file in files] == ["guertin2014-low.md", "guertin2014-sky.md"]
    found = result.methods[0].pareto
    for file, name in zip(files, ("low", "sky"), strict=True):
        text = file.read_text()
        assert f"`guertin2014-{name}` | {result.mean(name, 'holdout', 'flip'):.4f}" in (
            text.replace("**", "")
        )
        preset = load_preset(file.with_suffix(".yaml"))
        assert preset == load_preset(folder / "presets" / f"{name}.yaml")
        picked = found.picked()[name]
        assert f"| {picked.params['num_samples']} | taps |" in text
        among = section(text, "Among the levels")
        assert (
            f"| **{name}** | {'0.30' if name == 'low' else '9.00'} | {picked.cost:.3f} |" in among
        )
        published = found.landmarks[0]
        cheap = [p.cost for p in found.points if p.objective <= published.objective]
        assert f"As published the filter costs {published.cost:.3g}; " in among
        assert (f"is as good costs {min(cheap):.3g}." in among) if cheap else "no setting" in among
        assert "guertin2014-levels.webp" in among
    with Image.open(tmp_path / "guertin2014-levels.webp") as plot:
        assert plot.format == "WEBP"


def test_what_is_there_is_kept(run, tmp_path):
    (tmp_path / "guertin2014-tuned.webp").write_text("mine")
    with pytest.raises(OutputError, match=r"guertin2014-tuned\.webp exists.*--overwrite"):
        write_cards(run[0], tmp_path)
    assert not (tmp_path / "guertin2014-tuned.md").exists()
    write_cards(run[0], tmp_path, overwrite=True)
    assert (tmp_path / "guertin2014-tuned.webp").read_bytes()[:4] == b"RIFF"


def test_a_run_that_is_not_finished(tmp_path):
    with pytest.raises(ConfigError, match=r"has no result\.json: a folder of a finished fit"):
        write_cards(tmp_path, tmp_path / "cards")
    assert not (tmp_path / "cards").exists()


def test_command(run, tmp_path):
    done = CliRunner().invoke(app, ["card", str(run[0]), "-o", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "guertin2014-tuned.md" in done.output.replace("\n", "")
    again = CliRunner().invoke(app, ["card", str(run[0]), "-o", str(tmp_path)])
    assert again.exit_code == 2
