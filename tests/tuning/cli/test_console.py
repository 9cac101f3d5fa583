"""Tables and progress as they are printed."""

import pytest
from rich.console import Console

from tuning.cli import console
from tuning.cli.console import metrics_table, number_text
from tuning.progress import ProgressEvent


def bold_cells(table):
    """Return the texts that are printed bold in the rows of a table."""
    cells = [cell for column in table.columns for cell in column.cells]
    return {cell.plain for cell in cells if "bold" in str(cell.style)}


class TestMetricsTable:
    ROWS = {
        "sharp": {"flip": 0.3, "psnr": 20.0},
        "tuned": {"flip": 0.1, "psnr": 30.0},
        "noise": {"flip": 0.01, "psnr": 50.0},
    }

    def test_best_is_least_flip_and_most_psnr(self):
        rows = {name: self.ROWS[name] for name in ("sharp", "tuned")}
        assert bold_cells(metrics_table("", rows)) == {"0.1000", "30.00"}

    def test_bounds_are_never_the_best(self):
        table = metrics_table("", self.ROWS, unranked=("noise",))
        assert bold_cells(table) == {"0.1000", "30.00"}

    def test_missing_figures(self):
        rows = {"a": {"flip_band": float("nan")}, "b": {"flip_band": 0.2}}
        assert bold_cells(metrics_table("", rows)) == {"0.2000"}
        assert number_text("psnr_band", float("nan")) == "–"
        assert number_text("psnr", float("inf")) == "inf"


class TestLines:
    @pytest.fixture
    def printed(self, monkeypatch, capsys):
        monkeypatch.setattr(console, "status", Console(stderr=True, highlight=False))
        return lambda: [line.split(" ", 1)[1] for line in capsys.readouterr().err.splitlines()]

    def test_first_and_last_step_are_told_and_those_between_now_and_then(self, printed):
        with console.show_progress() as progress:
            for done in range(1001):
                progress(ProgressEvent(stage="batch", done=done, total=1000, eta=3661.0))
        assert printed() == ["batch 0/1000, 1:01:01 left", "batch 1000/1000"]

    def test_a_message_without_a_step_is_told(self, printed):
        with console.show_progress() as progress:
            for message in ("a.exr", "b.exr"):
                progress(ProgressEvent(stage="batch", done=len(message), total=9, message=message))
        assert printed() == ["batch 5/9, a.exr", "batch 5/9, b.exr"]

    def test_on_a_terminal_it_is_a_bar(self, monkeypatch, capsys):
        terminal = Console(stderr=True, force_terminal=True, width=100)
        monkeypatch.setattr(console, "status", terminal)
        with console.show_progress() as progress:
            for done in (0, 3):
                progress(ProgressEvent(stage="tpe 2", done=done, total=8, eta=75.0, best=0.0277))
        text = capsys.readouterr().err
        for part in ("tpe 2", "3/8", "0:01:15 left", "best 0.0277"):
            assert part in text
