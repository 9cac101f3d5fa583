"""What the benchmark prints, from planted rows."""

import pytest

from tuning.bench.cases import Case, LinearFit, Report, Row, Table, TargetRow
from tuning.cli.bench_table import print_report

TINY = Case(filter="line", width=24, height=16, num_samples=3)


@pytest.fixture(autouse=True)
def _wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")


class TestPrinting:
    def report(self, **changes):
        machine = {"processor": "P", "cores": 2, "threads": 2, "torch": "9", "commit": None}
        return Report(started="now", machine=machine, settings={}, **changes)

    def test_rows_are_marked_and_errors_told(self, capsys):
        rows = [
            Row(case=TINY, runs=3, cpu_s=0.5, wall_s=0.25, others=1.0),
            Row(case=TINY.but(filter="sousa2013"), runs=5, cpu_s=0.125, wall_s=0.1, others=0.1),
            Row(case=TINY.but(filter="tan2022"), error="MemoryError: no room"),
        ]
        fit = LinearFit(name="f", x="N", points=3, intercept=1, slope=2, r2=0.5, residual=0.25)
        print_report(self.report(tables=[Table(name="taps", title="taps", rows=rows, fits=[fit])]))
        captured = capsys.readouterr()
        assert " line* " in captured.out
        assert "P; 2 threads on 2 cores; torch 9; commit unknown; medians of 3 to 5" in captured.out
        assert " sousa2013 " in captured.out
        assert "500" in captured.out
        assert "tan2022" not in captured.out
        assert "0.5000" in captured.out
        assert "25.0%" in captured.out
        assert "* something else used the machine" in captured.out
        assert "MemoryError: no room" in captured.err

    def test_quiet_figures_are_not_marked(self, capsys):
        rows = [Row(case=TINY, cpu_s=0.5, wall_s=0.25, others=0.1)]
        print_report(self.report(tables=[Table(name="taps", title="taps", rows=rows)]))
        assert "*" not in capsys.readouterr().out

    def test_device_time_has_its_columns(self, capsys):
        rows = [
            Row(
                case=TINY.but(device="cuda"),
                device_ms=0.456,
                graph_ms=0.123,
                wall_s=0.1,
                cpu_s=0.1,
                checks={"sync": "line.py:7 f", "graph": "captured"},
            )
        ]
        print_report(self.report(tables=[Table(name="sizes", title="sizes", rows=rows)]))
        output = capsys.readouterr().out
        for text in ("0.456", "0.123", "line.py:7 f", "device"):
            assert text in output
        assert "CPU" not in output

    def test_steps_have_shares(self, capsys):
        parts = {
            "filter forward": 0.1,
            "loss forward": 0.2,
            "loss backward": 0.2,
            "filter backward": 0.4,
            "optimizer": 0.1,
        }
        step = Row(case=TINY.but(kind="step", batch=4), wall_s=1.0, cpu_s=1.0, parts=parts)
        crop = Row(case=Case(kind="render"), wall_s=0.75, parts={"sharp": 0.25, "reference": 0.5})
        print_report(self.report(tables=[Table(name="step", title="one step", rows=[step, crop])]))
        output = capsys.readouterr().out
        assert "the metric's share" in output
        assert "40.0%" in output  # of the metric
        assert "costs as much as 0.8 steps" in output
        assert "the renderer takes 75.0%" in output

    def test_targets_have_verdicts(self, capsys):
        targets = [
            TargetRow(name="a", unit="ms", value=0.4, limit=0.5, met=True, source="x"),
            TargetRow(name="b", unit="", value=2.0, limit=3, at_least=True, met=False, source="x"),
            TargetRow(name="c", unit="", value=None, limit=3, met=None, source="x", note="why"),
        ]
        print_report(self.report(targets=targets))
        lines = capsys.readouterr().out.splitlines()
        assert any("met" in x and "0.4 ms" in x and "≤ 0.5 ms" in x for x in lines)
        assert any("not met" in x and "≥ 3" in x for x in lines)
        assert any("not measured" in x for x in lines)
        assert "c: why" in lines
