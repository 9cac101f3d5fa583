"""The benchmark as a command: selections, processes, tables, JSON. No figure is judged."""

import itertools
import json
import os
import subprocess
import sys
import time

import pytest
import torch
from typer.testing import CliRunner

from torchblur.errors import ConfigError, OutputError
from tuning.bench.cases import Case, Report, Row
from tuning.bench.child import MARK, BenchJob, run_job
from tuning.bench.measure import Times
from tuning.bench.plan import TABLES, BenchOptions, plan_tables, unique_cases
from tuning.bench.run import Limits, check_output, measure_cases, run_bench
from tuning.cli.app import app

TINY = Case(filter="line", width=24, height=16, num_samples=3)


@pytest.fixture(autouse=True)
def _wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")


def run(*args, code=0):
    result = CliRunner().invoke(app, ["bench", *(str(arg) for arg in args)])
    assert result.exit_code == code, f"{result.output}\n{result.exception!r}"
    assert "Traceback" not in result.output
    return result


class TestPlans:
    def test_default_has_all_tables_and_filters(self):
        plans = {plan.name: plan for plan in plan_tables(BenchOptions())}
        assert tuple(plans) == TABLES
        named = {case.filter for case in plans["filters"].cases}
        asked = "line mcguire2012 guertin2014 sousa2013 jimenez2014 notes2025 oberberger2022"
        assert set(asked.split()) < named
        taps = {c.num_samples for c in plans["taps"].cases if c.filter == "guertin2014"}
        assert taps == {19, 27, 35, 47}
        assert {c.moving for c in plans["moving"].cases} == {0, 10, 50, 100}
        assert {(c.sets, c.batch) for c in plans["batch"].cases} == {(1, 4), (32, 1)}
        step = plans["step"].cases[0]
        assert (step.batch, step.width, step.height, step.num_samples) == (8, 256, 256, 15)

    def test_each_filter_has_a_copy_to_compare_with(self):
        for name in ("filters", "sizes"):
            (plan,) = plan_tables(BenchOptions(only=(name,)))
            sizes = {(c.width, c.height) for c in plan.cases if c.kind == "blur"}
            assert sizes == {(c.width, c.height) for c in plan.cases if c.kind == "copy"}

    def test_full_goes_up_to_4k_with_both_engines(self):
        (plan,) = plan_tables(BenchOptions(only=("sizes",), full=True))
        assert {c.engine for c in plan.cases if c.kind == "blur"} == {"eager", "compiled"}
        assert max(c.width for c in plan.cases) == 3840

    def test_selections(self):
        options = BenchOptions(
            filters=("line",),
            sizes=("24x16",),
            num_samples=(3, 5),
            what=("parameters",),
            engines=("eager",),
            only=("filters",),
        )
        (plan,) = plan_tables(options)
        found = {(c.filter, c.width, c.height, c.num_samples, c.what, c.engine) for c in plan.cases}
        assert found - {("", 24, 16, None, "forward", "eager")} == {
            ("line", 24, 16, n, "parameters", "eager") for n in (3, 5)
        }

    def test_a_case_of_two_tables_is_measured_once(self):
        plans = plan_tables(BenchOptions(quick=True))
        cases = unique_cases(plans)
        assert len({case.key for case in cases}) == len(cases)
        assert len(cases) < sum(len(plan.cases) for plan in plans)
        runs = [name for name, _ in itertools.groupby(case.process for case in cases)]
        assert len(set(runs)) == len(runs)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"only": ("size",)}, r"unknown table `size` \(did you mean `sizes`\?\)"),
            ({"filters": ("lime",)}, r"unknown filter `lime`"),
            ({"sizes": ("12by8",)}, r"`size` must be WIDTHxHEIGHT in px.*got '12by8'"),
            ({"sizes": ("0x8",)}, r"got '0x8'"),
            ({"params": {"num_samples": 3}}, r"--num-samples"),
            ({"params": {"kappa": 3.0}}, r"--filter"),
            ({"filters": ("line",), "params": {"kappa": 3.0}}, r"unknown .*`kappa`.*line"),
        ],
    )
    def test_refuse_bad_selections(self, options, message):
        with pytest.raises(ConfigError, match=message):
            plan_tables(BenchOptions(**options))


class TestErrors:
    @pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
    @pytest.mark.parametrize("more", [[], ["--targets", "--json", "gpu.json"]])
    def test_no_gpu_is_one_clear_error(self, more, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        result = run("--device", "cuda", *more, code=2)
        assert "`device` 'cuda' cannot be used here" in result.output
        assert result.output.count("error:") == 1
        assert list(tmp_path.iterdir()) == []

    def test_targets_are_not_to_be_changed(self):
        result = run("--targets", "--size", "64x36", code=2)
        assert "`targets` are measured as they are defined, without `sizes`" in result.output

    def test_quick_or_full(self):
        assert "contradict" in run("--quick", "--full", code=2).output

    def test_bad_choices(self):
        assert "'sideways'" in run("--what", "sideways", code=2).output
        assert "'turbo'" in run("--engine", "turbo", code=2).output

    def test_files_are_not_replaced(self, tmp_path):
        file = tmp_path / "a.json"
        file.write_text("mine")
        with pytest.raises(OutputError, match=r"a\.json exists.*--overwrite"):
            check_output(file, overwrite=False)
        check_output(file, overwrite=True)
        with pytest.raises(OutputError, match="cannot write"):
            check_output(tmp_path / "missing" / "a.json", overwrite=False)
        assert "exists" in run("--json", file, "--only", "notes", "--quick", code=2).output
        assert file.read_text() == "mine"


class TestJobs:
    @pytest.fixture(autouse=True)
    def _threads(self):
        threads = torch.get_num_threads()
        yield
        torch.set_num_threads(threads)

    def test_each_case_gets_its_times(self):
        told = []
        cases = [TINY, TINY.but(num_samples=5), Case(kind="copy", width=24, height=16)]
        run_job(
            BenchJob(cases=cases, runs=2, memory=False),
            lambda index, found: told.append((index, found)),
        )
        assert [index for index, _ in told] == [0, 1, 2]
        for case, (_, found) in zip(cases, told, strict=True):
            row = Row(case=case, **found)
            assert row.runs == 2
            assert row.wall_s > 0
            assert row.cpu_s > 0
            assert row.first_s > 0
            assert row.compile_s is None
            assert row.device_ms is None

    def test_a_case_that_fails_does_not_end_the_others(self):
        told = {}
        bad = TINY.but(params={"kappa": 3.0})
        run_job(BenchJob(cases=[bad, TINY], runs=1, memory=False), told.__setitem__)
        assert told[0]["error"].startswith("ConfigError: unknown key `kappa`")
        assert told[1]["wall_s"] > 0

    def test_missing_compiler_is_told(self, monkeypatch):
        monkeypatch.setattr("tuning.bench.child.compiler_works", lambda: False)
        monkeypatch.setattr("tuning.bench.child.make_call", lambda case: lambda: None)
        told = {}
        job = BenchJob(cases=[TINY.but(engine="compiled")], runs=1, memory=False)
        run_job(job, told.__setitem__)
        assert told[0]["checks"] == {"compiled": "no: there is no compiler"}


class TestJobsOnAGpu:
    """The order of things, with stand-ins for what needs a GPU."""

    @pytest.fixture
    def told(self, monkeypatch):
        def no_graph(call, runs):
            raise RuntimeError("not permitted while a stream is capturing\nmore")

        times = Times(runs=3, wall=0.1, cpu=0.1, device=0.5, spread=0.0, others=None, waited=False)
        child = "tuning.bench.child"
        monkeypatch.setattr(f"{child}.make_call", lambda case: lambda: None)
        monkeypatch.setattr(f"{child}.repeat", lambda *args: times)
        monkeypatch.setattr(f"{child}.peak_mib", lambda call, device: 3.0)
        monkeypatch.setattr(f"{child}.find_sync", lambda call: "line.py:3 f")
        monkeypatch.setattr(f"{child}.graph_ms", no_graph)
        monkeypatch.setattr(f"{child}.exact_allocation", lambda: pytest.fail("of the CPU"))
        monkeypatch.setattr(torch.cuda, "synchronize", lambda device=None: None)
        monkeypatch.setattr(torch, "set_num_threads", lambda count: None)
        cases = [TINY.but(device="cuda", what=what) for what in ("forward", "backward")]
        found = []
        run_job(BenchJob(cases=cases), lambda index, part: found.append((index, part)))
        return found

    def test_checks_come_last(self, told):
        assert [index for index, _ in told] == [0, 1] * 3
        assert ["wall_s" in part for _, part in told] == [True, True] + [False] * 4
        assert told[0][1]["device_ms"] == 0.5
        assert told[2][1] == {"peak_mib": 3.0}

    def test_a_graph_that_cannot_be_had_is_a_remark(self, told):
        forward, backward = (part for _, part in told[-2:])
        assert forward["checks"] == {
            "sync": "line.py:3 f",
            "graph": "not permitted while a stream is capturing",
        }
        assert backward["checks"] == {"sync": "line.py:3 f"}


class TestProcesses:
    def test_what_a_process_told_before_it_died_is_kept(self, monkeypatch):
        line = MARK + json.dumps({"index": 0, "found": {"runs": 1, "cpu_s": 2.0}})
        more = MARK + json.dumps({"index": 0, "found": {"peak_mib": 5.0}})
        code = (
            "import os, sys; sys.stdin.read(); print('noise')\n"
            f"print({line!r}); print({more!r}, flush=True)\n"
            "sys.stderr.write('a\\nthe stack broke\\n'); sys.stderr.flush(); os._exit(3)"
        )
        monkeypatch.setattr("tuning.bench.run._COMMAND", (sys.executable, "-c", code))
        (rows,) = measure_cases([TINY, TINY.but(num_samples=5)], Limits())
        first, second = rows.values()
        assert (first.cpu_s, first.peak_mib, first.error) == (2.0, 5.0, None)
        assert second.error == "the process ended with code 3: the stack broke"

    def test_checks_add_up(self, monkeypatch):
        lines = [
            MARK + json.dumps({"index": 0, "found": {"checks": checks}})
            for checks in ({"memory": "no room"}, {"sync": "no"})
        ]
        code = f"import sys; sys.stdin.read(); print({lines[0]!r}); print({lines[1]!r})"
        monkeypatch.setattr("tuning.bench.run._COMMAND", (sys.executable, "-c", code))
        (rows,) = measure_cases([TINY], Limits())
        assert rows[TINY.key].checks == {"memory": "no room", "sync": "no"}

    def test_each_filter_and_engine_has_its_own(self, monkeypatch):
        code = (
            f"import json, sys; n = len(json.load(sys.stdin)['cases'])\n"
            f"for i in range(n): print({MARK!r} + json.dumps("
            "{'index': i, 'found': {'runs': n}}))"
        )
        monkeypatch.setattr("tuning.bench.run._COMMAND", (sys.executable, "-c", code))
        cases = [TINY, TINY.but(num_samples=5), TINY.but(engine="compiled")]
        parts = list(measure_cases(cases, Limits()))
        assert [[row.runs for row in rows.values()] for rows in parts] == [[2, 2], [1]]


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    file = tmp_path_factory.mktemp("bench") / "figures.json"
    args = ["--filter", "guertin2014", "--size", "48x27", "--quick", "--runs", "1"]
    args += ["--num-samples", "3", "--num-samples", "5", "--num-samples", "9"]
    for table in ("filters", "taps", "moving"):
        args += ["--only", table]
    result = run(*args, "--json", file)
    return result, Report.model_validate_json(file.read_text())


class TestWhole:
    def test_json_has_rows_ratios_and_fits(self, ran):
        _, report = ran
        tables = {table.name: table for table in report.tables}
        assert list(tables) == ["filters", "taps", "moving"]
        assert report.complete
        assert report.settings["filters"] == ["guertin2014"]
        assert report.machine["threads"] >= 1
        blurs = [row for row in tables["filters"].rows if row.case.kind == "blur"]
        assert [(r.case.num_samples, r.case.what) for r in blurs] == [
            (n, what) for n in (3, 5, 9) for what in ("forward", "backward")
        ]
        forward, backward = blurs[:2]
        assert forward.ratios["of_eager"] == 1
        assert backward.ratios["of_forward"] == backward.cpu_s / forward.cpu_s
        copy = tables["filters"].rows[0]
        assert forward.ratios["of_copy"] == forward.cpu_s / copy.cpu_s
        assert [row.case.moving for row in tables["moving"].rows] == [0, 10, 50, 100]
        assert tables["moving"].rows[-1].ratios["of_whole"] == 1
        (fit,) = tables["taps"].fits
        assert (fit.x, fit.points) == ("N", 3)
        assert all(row.error is None for table in report.tables for row in table.rows)

    def test_memory_was_measured(self, ran):
        _, report = ran
        if sys.platform == "linux":
            assert all(row.peak_mib is not None for row in report.tables[0].rows)

    def test_tables_are_printed(self, ran):
        output = ran[0].output
        assert "filters, everything moves, eager, 48x27" in output
        assert "cost by the number of taps N, eager, 48x27, forward" in output
        assert "ms / N" not in output  # the header has the ms
        assert " / N " in output
        assert "bench 1/" in output
        assert "figures.json" in output

    def test_no_file_is_left_beside(self, tmp_path):
        file = tmp_path / "a.json"
        options = BenchOptions(quick=True, sizes=("16x9",), filters=("line",), only=("taps",))
        told = []
        run_bench(options, output=file, progress=told.append)
        assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
        assert told[-1].done == told[-1].total == 4


def test_a_busy_machine_is_warned_of_at_once(monkeypatch, tmp_path):
    monkeypatch.setattr("tuning.bench.run.watch", lambda: 1.3)
    monkeypatch.setattr("tuning.bench.run.measure_cases", lambda cases, limits, stage: iter(()))
    warned = []
    report = run_bench(BenchOptions(quick=True, only=("notes",)), warn=warned.append)
    assert warned == report.warnings
    assert "other programs use 1.3 of" in warned[0]
    monkeypatch.setattr("tuning.bench.run.watch", lambda: 0.05)
    assert run_bench(BenchOptions(quick=True, only=("notes",))).warnings == []


def test_what_was_measured_is_kept_when_stopped(monkeypatch, tmp_path):
    def stopped(cases, limits, stage):
        yield {cases[0].key: Row(case=cases[0], cpu_s=1.0)}
        raise KeyboardInterrupt

    monkeypatch.setattr("tuning.bench.run.measure_cases", stopped)
    file = tmp_path / "a.json"
    result = run("--only", "notes", "--quick", "--json", file, code=130)
    assert "what was measured is in" in result.output
    report = Report.model_validate_json(file.read_text())
    assert not report.complete
    assert len(report.tables[0].rows) == 1


def test_a_time_limit_ends_the_process_that_measures(tmp_path):
    child = tmp_path / "child.pid"
    code = f"import os, time; open({str(child)!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    main = (
        "import sys, tuning.bench.run\n"
        f"tuning.bench.run._COMMAND = (sys.executable, '-c', {code!r})\n"
        "from tuning.cli import main; main()"
    )
    args = [sys.executable, "-c", main, "bench", "--quick", "--only", "notes"]
    with subprocess.Popen(args, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None and not (child.exists() and child.read_text()):
            time.sleep(0.05)
        process.terminate()
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "error: stopped" in errors
    with pytest.raises(ProcessLookupError):
        os.kill(int(child.read_text()), 0)


def test_schema_is_printed():
    schema = json.loads(run("--json-schema").output)
    assert "targets" in schema["properties"]
    fields = schema["$defs"]["Row"]["properties"]
    assert all("description" in fields[name] for name in fields if name != "case")
