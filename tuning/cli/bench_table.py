"""How the benchmark's results look in a terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rich.text import Text

from tuning.bench.cases import LinearFit, Report, Row, Table, TargetRow, cost_of
from tuning.bench.fit_step import METRIC_PARTS, RENDER_SCENE, STEP_PARTS
from tuning.bench.targets import KNOWN
from tuning.cli.console import plain_table, print_error, print_warning, results

__all__ = ["print_report"]

_MARK = "*"
_WIDE = 120
_WHAT = {"forward": "forward", "backward": "+ backward", "parameters": "+ parameters"}
_NOTES_US = {("full", "two"): 490, ("full", "one"): 355, ("half", "two"): 225, ("half", "one"): 195}
"""Microseconds of the 2025 notes' own table (1080p, GTX 1660 Ti, 6 taps per direction)."""

_CONDITIONS = ("engine", "size", "N", "what")
"""Columns that are left to the title where all rows agree."""

Column = tuple[str, Callable[[Row], str]]


def print_report(report: Report) -> None:
    """Print everything that a benchmark found; problems last."""
    width = results.width
    if not results.is_terminal:
        results.width = max(width, _WIDE)  # a file has no edge
    try:
        _print_report(report)
    finally:
        results.width = width


def _print_report(report: Report) -> None:
    _print_machine(report)
    for table in report.tables:
        if table.name == "step":
            _print_steps(table)
        elif table.name != "targets":
            _print_table(table)
    if report.targets:
        _print_targets(report)
    _print_problems(report)


def _print_problems(report: Report) -> None:
    rows = [row for table in report.tables for row in table.rows]
    if any(row.disturbed for row in rows):
        results.print(f"{_MARK} something else used the machine: inflated", style="yellow")
    for row in {row.case.key: row for row in rows}.values():
        if row.error:
            print_error(f"{row.case.label}: {row.error}")
        for name, text in row.checks.items():
            if name not in ("sync", "graph"):
                print_warning(f"{row.case.label}: {name}: {text}")
    for warning in report.warnings:
        print_warning(warning)


def _print_machine(report: Report) -> None:
    machine = report.machine
    gpu = machine.get("gpu")
    where = f"{gpu['name']}, CUDA {gpu['cuda']}" if gpu else machine["processor"]
    text = (
        f"{where}; {machine['threads']} threads on {machine['cores']} cores; torch "
        f"{machine['torch']}; commit {machine['commit'] or 'unknown'}"
    )
    runs = {row.runs for table in report.tables for row in table.rows if row.runs > 1}
    if runs:
        text += f"; medians of {min(runs)} to {max(runs)} runs"
    results.print(Text(text, style="dim"), soft_wrap=True)


# -- tables of rows --------------------------------------------------------------------------------


def _print_table(table: Table) -> None:
    rows = [row for row in table.rows if row.error is None]
    if not rows:
        return
    columns, common = _varied(_columns(table), rows)
    _print_title(", ".join([table.title, *common]))
    shown = plain_table("", [name for name, _ in columns], right=_right(columns))
    for column in shown.columns:
        column.no_wrap = True
    for row in rows:
        shown.add_row(*(Text(value(row)) for _, value in columns))
    results.print(shown)
    if table.fits:
        _print_fits(table.fits)


def _varied(columns: Sequence[Column], rows: Sequence[Row]) -> tuple[list[Column], list[str]]:
    """Return the columns without those that say the same of all rows, and what they say."""
    kept, common = [], []
    for name, value in columns:
        said = {value(row) for row in rows} - {""}
        if name in _CONDITIONS and len(said) <= 1:
            common += [f"N = {text}" if name == "N" else text for text in said]
        elif said:
            kept.append((name, value))
    return kept, common


def _print_title(title: str) -> None:
    results.print()
    results.print(Text(title, style="bold"), soft_wrap=True)


def _right(columns: Sequence[Column]) -> list[str]:
    return [name for name, _ in columns if name not in ("filter", "engine", "what", "calls")]


def _columns(table: Table) -> list[Column]:
    rows = table.rows
    on_gpu = any(row.device_ms is not None for row in rows)
    columns: list[Column] = [("filter", _who), ("engine", _engine), ("size", _size)]
    columns += [("N", lambda row: str(row.case.num_samples or ""))]
    if table.name != "notes":
        columns += [("what", lambda row: _WHAT[row.case.what] if row.case.kind == "blur" else "")]
    columns += _own_columns(table)
    if on_gpu:
        columns += [("device\nms", lambda row: _number(row.device_ms))]
        columns += [("graph\nms", lambda row: _number(row.graph_ms))]
    else:
        columns += [("CPU\nms", lambda row: _ms(row.cpu_s))]
    columns += [("wall\nms", lambda row: _ms(row.wall_s)), ("peak\nMiB", _peak)]
    columns += _ratio_columns(table.name)
    if on_gpu:
        columns += [("waits", lambda row: row.checks.get("sync", ""))]
    return columns


def _own_columns(table: Table) -> list[Column]:
    if table.name == "moving":
        return [("moves", lambda row: f"{row.case.moving} %")]
    if table.name == "notes":
        return [("variant", lambda row: "{resolution}, {directions}".format(**row.case.params))]
    if table.name == "batch":
        return [("batch", _batch), ("calls", lambda row: "one by one" if row.case.apart else "one")]
    return []


def _ratio_columns(table: str) -> list[Column]:
    def ratio(name: str) -> Callable[[Row], str]:
        return lambda row: f"{row.ratios[name]:.3g}" if name in row.ratios else ""

    if table == "filters":
        return [
            ("compile\ns", lambda row: "" if row.compile_s is None else f"{row.compile_s:.1f}"),
            ("of\neager", ratio("of_eager")),
            ("of\nforward", ratio("of_forward")),
            ("of its\nmemory", ratio("memory_of_forward")),
            ("of a\ncopy", ratio("of_copy")),
        ]
    if table == "notes":
        return [("of\nfull, two", ratio("of_full_two")), ("in the\ntext", _in_text)]
    names = {"moving": "of_whole", "batch": "of_apart", "sizes": "of_copy"}
    titles = {"moving": "of\n100 %", "batch": "of one\nby one", "sizes": "of a\ncopy"}
    return [(titles[table], ratio(names[table]))] if table in names else []


def _who(row: Row) -> str:
    mark = _MARK if row.disturbed else ""
    return (row.case.filter or row.case.kind) + mark


def _engine(row: Row) -> str:
    return row.case.engine if row.case.kind == "blur" else ""


def _size(row: Row) -> str:
    return f"{row.case.width}x{row.case.height}"


def _batch(row: Row) -> str:
    return f"{row.case.sets} sets" if row.case.sets > 1 else f"{row.case.batch} frames"


def _peak(row: Row) -> str:
    return "" if row.peak_mib is None else f"{row.peak_mib:.0f}"


def _in_text(row: Row) -> str:
    params = row.case.params
    text = _NOTES_US.get((params["resolution"], params["directions"]))
    return "" if text is None else f"{text / _NOTES_US['full', 'two']:.2f}"


def _ms(seconds: float | None) -> str:
    return _number(None if seconds is None else 1000 * seconds)


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _print_fits(fits: Sequence[LinearFit]) -> None:
    columns = ["least-squares line", "at 0, ms", "ms per", "R²", "residual"]
    shown = plain_table("", columns, right=columns[1:])
    for fit in fits:
        shown.add_row(
            Text(fit.name),
            _number(fit.intercept),
            f"{_number(fit.slope)} / {fit.x}",
            "" if fit.r2 is None else f"{fit.r2:.4f}",
            "two points" if fit.residual is None else f"{fit.residual:.1%}",
        )
    results.print(shown)


# -- steps -----------------------------------------------------------------------------------------


def _print_steps(table: Table) -> None:
    steps = [row for row in table.rows if row.case.kind == "step" and not row.error]
    for row in steps:
        case = row.case
        title = (
            f"{table.title}: {case.filter}, {case.engine}, {case.batch} crops of {_size(row)}, "
            f"{case.moving} % moving"
        )
        if case.num_samples is not None:
            title += f", N = {case.num_samples}"
        _print_title(title + (_MARK if row.disturbed else ""))
        total = sum(row.parts.values())
        shown = plain_table("", ["part", "ms", "share"], right=["ms", "share"])
        for name in STEP_PARTS:
            shown.add_row(name, _ms(row.parts[name]), f"{row.parts[name] / total:.1%}")
        metrics = sum(row.parts[name] for name in METRIC_PARTS)
        shown.add_row("all parts", _ms(total), "100.0%", style="bold")
        shown.add_row("the metric's share", _ms(metrics), f"{metrics / total:.1%}")
        shown.add_row("the step in one piece", _ms(row.wall_s), f"{(row.wall_s or 0) / total:.1%}")
        results.print(shown)
        facts = f"CPU {_ms(row.cpu_s)} ms"
        if row.peak_mib is not None:
            facts += f", peak memory {row.peak_mib:.0f} MiB"
        results.print(facts)
    for row in table.rows:
        if row.case.kind == "render" and not row.error:
            _print_render(row, steps)


def _print_render(row: Row, steps: Sequence[Row]) -> None:
    _print_title(f"a new crop of {_size(row)}, rendered ({RENDER_SCENE})")
    shown = plain_table("", ["part", "ms"], right=["ms"])
    for name, seconds in row.parts.items():
        shown.add_row(name, _ms(seconds))
    results.print(shown)
    for step in steps:
        if step.wall_s and row.wall_s:
            whole = step.wall_s + step.case.batch * row.wall_s
            results.print(
                f"{step.case.filter}, {step.case.engine}: a new crop costs as much as "
                f"{row.wall_s / step.wall_s:.1f} steps; with {step.case.batch} new crops a step "
                f"the renderer takes {1 - step.wall_s / whole:.1%}",
                soft_wrap=True,
            )


# -- targets ---------------------------------------------------------------------------------------


def _print_targets(report: Report) -> None:
    columns = ["", "value", "limit", "target"]
    _print_title("targets")
    shown = plain_table("", columns, right=["value", "limit"])
    for row in report.targets:
        sign = "≥" if row.at_least else "≤"
        shown.add_row(
            _verdict(row),
            _with_unit(row.value, row.unit),
            f"{sign} {row.limit:g} {row.unit}".rstrip(),
            Text(row.name + (_MARK if row.disturbed else "")),
        )
    results.print(shown)
    for row in report.targets:
        if row.note:
            results.print(Text(f"{row.name}: {row.note}", style="dim"), soft_wrap=True)
    _print_known(report)


def _with_unit(value: float | None, unit: str) -> str:
    return "–" if value is None else f"{value:.3g} {unit}".rstrip()


def _verdict(row: TargetRow) -> Text:
    if row.met is None:
        return Text("not measured" if row.value is None else "not judged", style="dim")
    return Text("met", style="green") if row.met else Text("not met", style="red")


def _print_known(report: Report) -> None:
    rows = [row for table in report.tables for row in table.rows]
    if any(cost_of(row) is not None and row.case.device == "cpu" for row in rows):
        _print_title("other programs like Guertin's filter, N = 35, two quiet cores")
        shown = plain_table("", ["", "CPU-s"], right=["CPU-s"])
        for name, seconds in KNOWN:
            shown.add_row(name, f"{seconds:g}")
        results.print(shown)
