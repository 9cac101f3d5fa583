"""Targets: what they are made of, and verdicts on planted figures."""

import pytest

from tuning.bench.cases import Case, Row
from tuning.bench.targets import judge_targets, targets_for

GUERTIN = Case(
    filter="guertin2014", engine="compiled", width=1920, height=1080, num_samples=35, device="cpu"
)


def rows_for(device="cpu", **figures):
    """Return rows of all cases of the targets with the same figures."""
    cases = {case.key: case for target in targets_for(device) for case in target.cases}
    return {key: Row(case=case, **figures) for key, case in cases.items()}


def with_figures(rows, case, **figures):
    return rows | {case.key: rows[case.key].model_copy(update=figures)}


def by_name(found):
    return {row.name: row for row in found}


class TestOnTheCpu:
    def test_names_the_promised_figures(self):
        limits = {target.name: target.limit for target in targets_for("cpu")}
        assert limits["guertin2014, 1920x1080, N = 35, everything moves"] == 2.2
        assert limits["10 % of the area moves, over all of it"] == 0.2
        assert limits["nothing moves, over all of it"] == 0.03
        assert limits["forward and backward of a fit (all parameters), over forward"] == 4
        assert limits["the same, with the gradient of the color"] == 4
        assert limits["forward and backward, over forward: peak memory"] == 3
        assert limits["32 parameter sets of one 128x128 frame, all weights: 32 calls over one"] == 3

    def test_judges_planted_figures(self):
        rows = rows_for(cpu_s=2.0, peak_mib=100.0, compile_s=9.0)
        rows = with_figures(rows, GUERTIN.but(moving=10), cpu_s=0.3)
        rows = with_figures(rows, GUERTIN.but(moving=0), cpu_s=0.1)
        rows = with_figures(rows, GUERTIN.but(storage="half"), cpu_s=1.8)
        rows = with_figures(rows, GUERTIN.but(what="backward"), cpu_s=9.0, peak_mib=250.0)
        rows = with_figures(rows, GUERTIN.but(what="parameters"), cpu_s=7.0)
        sets = GUERTIN.but(width=128, height=128, sets=32)
        rows = with_figures(rows, sets, cpu_s=1.0)
        rows = with_figures(rows, sets.but(shared=("min_length",)), cpu_s=0.5)
        found = by_name(judge_targets(targets_for("cpu"), rows))
        verdicts = {name: (row.value, row.met) for name, row in found.items()}
        assert verdicts == {
            "guertin2014, 1920x1080, N = 35, everything moves": (2.0, True),
            "the same, compiling, once": (9.0, False),
            "guertin2014, 1280x720, N = 35, compiled": (2.0, False),
            "guertin2014, 1280x720, N = 35, eager": (2.0, True),
            "10 % of the area moves, over all of it": (0.15, True),
            "nothing moves, over all of it": (0.05, False),
            "half-precision storage, over full": (0.9, True),
            "forward and backward of a fit (all parameters), over forward": (3.5, True),
            "the same, with the gradient of the color": (4.5, False),
            "forward and backward, over forward: peak memory": (2.5, True),
            "backward, 1280x720, N = 35 over N = 5: peak memory": (1.0, True),
            "32 parameter sets of one 128x128 frame, all weights: 32 calls over one": (4.0, True),
            "the same, min_length too, which moves the taps": (2.0, False),
        }

    def test_larger_is_better_where_it_says_so(self):
        rows = rows_for(cpu_s=2.0)
        found = by_name(judge_targets(targets_for("cpu"), rows))
        sets = found["32 parameter sets of one 128x128 frame, all weights: 32 calls over one"]
        assert (sets.value, sets.met, sets.at_least) == (1.0, False, True)

    def test_does_not_judge_what_failed(self):
        rows = rows_for(cpu_s=1.0)
        rows = with_figures(rows, GUERTIN, cpu_s=None, error="MemoryError: no room")
        found = by_name(judge_targets(targets_for("cpu"), rows))
        whole = found["guertin2014, 1920x1080, N = 35, everything moves"]
        assert (whole.value, whole.met) == (None, None)
        assert whole.note.startswith("MemoryError: no room")
        assert found["nothing moves, over all of it"].met is None
        assert found["guertin2014, 1280x720, N = 35, compiled"].met is True

    def test_does_not_judge_a_quick_look(self):
        quick = targets_for("cpu", quick=True)
        rows = {case.key: Row(case=case, cpu_s=1.0) for t in quick for case in t.cases}
        assert max(row.case.width for row in rows.values()) == 240
        found = judge_targets(quick, rows, judged=False)
        assert all(row.met is None for row in found)
        assert found[0].value == 1.0

    def test_marks_figures_of_a_busy_machine(self):
        rows = with_figures(rows_for(cpu_s=1.0), GUERTIN.but(moving=0), others=1.0)
        found = by_name(judge_targets(targets_for("cpu"), rows))
        assert found["nothing moves, over all of it"].disturbed
        assert not found["guertin2014, 1920x1080, N = 35, everything moves"].disturbed


class TestOnAGpu:
    """Planned and judged without one."""

    def test_names_the_promised_figures(self):
        limits = {t.name: (t.limit, t.unit) for t in targets_for("cuda") if t.unit == "ms"}
        assert limits["guertin2014, 1920x1080, N = 35, everything moves"] == (0.5, "ms")
        assert limits["oberberger2022, 1920x1080, all stages, everything moves"] == (1.5, "ms")
        assert limits["notes2025, 1920x1080, full resolution, two directions"] == (0.3, "ms")

    def test_judges_device_time_graphs_and_waits(self):
        rows = rows_for("cuda", cpu_s=9.0, device_ms=0.4, graph_ms=0.2, checks={"sync": "no"})
        guertin = GUERTIN.but(device="cuda")
        rows = with_figures(
            rows, guertin, graph_ms=None, checks={"sync": "line.py:3 f", "graph": "it waits"}
        )
        direct, graph, waits, *_ = judge_targets(targets_for("cuda"), rows)
        assert (direct.value, direct.met) == (0.4, True)
        assert (graph.value, graph.met) == (None, None)
        assert "graph: it waits" in graph.note
        assert (waits.value, waits.met) == (1.0, False)
        assert "sync: line.py:3 f" in waits.note

    @pytest.mark.parametrize("device", ["cuda", "cuda:1"])
    def test_all_cases_are_on_the_device(self, device):
        assert {c.device for t in targets_for(device) for c in t.cases} == {device}
