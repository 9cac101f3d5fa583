"""What filters cut short: how much of each case, and how results, reports and cards say it."""

import dataclasses
import json

import pytest
import torch
from planted import planted_case, write_planted
from planted_sequences import sequence_case
from tiny_shots import moving_square

from torchblur.filters import get_filter
from torchblur.frame import Shutter
from torchblur.params import build
from torchblur.presets import load_preset
from tuning.cards.text import Card, card_text
from tuning.cli.printing import print_fit
from tuning.config.fit import TuneConfig, load_tune_config
from tuning.data.variants import Variant, cut_of
from tuning.fit.run import run_fit
from tuning.results.cuts import Cuts, cuts_over
from tuning.results.fit import CaseScore, FitResult, cut_text
from tuning.scoring.cases import score_variant

SQUARE = 12 * 12 / (48 * 64)  # share of the pixels that move


def square_case(shutter=None, **changes):
    frame = moving_square(speed=40.0)
    return dataclasses.replace(
        planted_case(1), frame=frame, reference=frame.color, shutter=shutter or Shutter(0.5),
        band=torch.ones(1, 1, 48, 64, dtype=torch.bool), **changes,
    )  # fmt: skip


def variant(name="guertin2014", *, values=None, free=(), **params):
    return Variant(name="tuned", blur=get_filter(name)(**params), values=values, free=free)


class TestOfACase:
    @pytest.mark.parametrize(
        ("shutter", "tile_size", "share", "longest"),
        [
            (Shutter(0.5), 9, SQUARE, 10.0),
            (Shutter(0.5), 10, 0.0, 10.0),
            (Shutter(1.0), 10, SQUARE, 20.0),
            (Shutter(0.5, "trailing"), 16, SQUARE, 10.0),
        ],
    )
    def test_by_hand(self, shutter, tile_size, share, longest):
        found = cut_of(variant(tile_size=tile_size), square_case(shutter))
        assert found.share == pytest.approx(share)
        assert found.longest == pytest.approx(longest)

    def test_values_of_a_fit_count(self):
        case = square_case()
        assert cut_of(variant(tile_size=4, values={"tile_size": 40}), case).share == 0
        assert cut_of(variant(tile_size=40, values={"tile_size": 4}), case).share > 0
        free = variant(tile_size=10, values={"shutter": 1.0}, free=("shutter",))
        assert cut_of(free, case).longest == pytest.approx(20.0)

    def test_of_a_sequence_the_mean_share_and_the_longest(self):
        case = sequence_case()
        blur = variant(tile_size=1)
        frames = [frame for step in case.steps(blur.blur) for frame in step]
        given = {"shutter": case.shutter.open}
        each = [blur.blur.cut(frame, **given) for frame in frames]
        found = cut_of(blur, case)
        assert found.share == pytest.approx(sum(cut.share for cut in each) / len(each))
        assert found.longest == pytest.approx(max(cut.longest for cut in each))
        assert found.share > 0

    def test_a_filter_without_a_limit(self):
        assert cut_of(variant("line"), square_case()) is None
        assert cut_of(Variant(name="sharp"), square_case()) is None

    def test_score_keeps_it(self):
        score = score_variant(square_case(), variant(tile_size=9, num_samples=5))
        assert (score.cut, score.longest) == pytest.approx((SQUARE, 10.0))
        again = CaseScore.model_validate_json(score.model_dump_json())
        assert again == score
        line = score_variant(square_case(), variant("line"))
        assert (line.cut, line.longest) == (None, None)


class TestWords:
    def test_over_frames(self):
        found = cuts_over([(0.1, 50.0), (0.0, 90.0), (0.25, 40.0)])
        assert found == Cuts(2, 3, 0.25, 50.0)
        assert found.text("frames") == (
            "on 2 of 3 frames it cuts short up to 25 % of the pixels, whose blur goes up to "
            "50 px to each side"
        )
        assert "short less than 0.1 % of" in Cuts(1, 3, 0.0004, 50.0).text("frames")
        assert cuts_over([(0.0, 90.0)]) is None
        assert cuts_over([]) is None


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A fit with a tile that is too small: 4.5 px to each side, 2 px are blurred."""
    root = tmp_path_factory.mktemp("cuts")
    data = write_planted(root / "frames")
    data["filter"]["params"]["tile_size"] = 2
    data["methods"] = [{"kind": "gradient", "steps": 2, "starts": 1}]
    return root / "run", run_fit(build(TuneConfig, data), root / "run")


@pytest.mark.filterwarnings("error")
class TestOfAFit:
    def test_result(self, run):
        folder, result = run
        cuts = result.cuts("tuned", "holdout")
        assert (cuts.frames, cuts.of) == (1, 1)
        assert cuts.share > 0.5
        assert cuts.longest == pytest.approx(4.5, abs=0.01)
        assert result.cuts("default", "holdout") is None
        assert FitResult.load(folder / "result.json") == result

    def test_preset(self, run):
        evidence = load_preset(run[0] / "preset.yaml").evidence
        assert evidence["cut"] == {"tuned": run[1].cuts("tuned", "holdout")._asdict()}

    def test_report(self, run):
        page = (run[0] / "report.html").read_text()
        assert "Tuned: on 1 of 1 hold-out frames it cuts short up to " in page
        assert "cut, % after" in page

    def test_printed(self, run, capsys):
        print_fit(run[1], run[0])
        assert f"note: Tuned: {cut_text(run[1], 'tuned')}" in capsys.readouterr().err

    def test_card(self, run):
        card = Card(
            name="guertin2014-tuned",
            preset=load_preset(run[0] / "preset.yaml"),
            config=load_tune_config(run[0] / "config.yaml"),
            result=run[1],
            variant="tuned",
        )
        head = card_text(card, "p", "i", "").split("```")[0]
        assert f"48 lines. Mind its reach: {cut_text(run[1], 'tuned')}\n" in head

    def test_an_old_result_says_nothing(self, run, tmp_path):
        data = json.loads((run[0] / "result.json").read_text())
        for score in data["scores"]:
            for key in ("cut", "longest", "lines"):
                score.pop(key)
        (tmp_path / "result.json").write_text(json.dumps(data))
        old = FitResult.load(tmp_path / "result.json")
        assert cut_text(old, "tuned") == ""
        assert old.heights("holdout") == ()
