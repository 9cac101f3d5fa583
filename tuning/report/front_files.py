"""Files of a front in the run folder: presets, a table of all trials, and a plot."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from torchblur.filters import get_filter
from torchblur.presets import Preset, save_preset
from tuning.config.fit import TuneConfig
from tuning.data.cases import AnyCase
from tuning.files.run_folder import RunFolder
from tuning.report.evidence import evidence_of
from tuning.report.front_plots import front_png
from tuning.results.fit import FitResult, MethodResult
from tuning.results.front import ParetoPick, ParetoPoint, ParetoResult

__all__ = ["front_method", "write_pareto"]


def front_method(result: FitResult) -> MethodResult | None:
    """Return the method of a run that searched for a front."""
    return next((method for method in result.methods if method.pareto is not None), None)


def write_pareto(
    folder: RunFolder,
    config: TuneConfig,
    result: FitResult,
    cases: Sequence[AnyCase],
    shutter: Mapping[str, Any],
) -> None:
    """Write `presets/NAME.yaml`, `pareto.csv` and `pareto.png`, if the run has a front.

    Args:
        folder: The run.
        config: The resolved configuration.
        result: The run's result.
        cases: Frames and sequences of both splits.
        shutter: Parameters of the shutter that the training frames have in common.
    """
    method = front_method(result)
    if method is None or method.pareto is None:
        return
    found = method.pareto
    (folder.path / "presets").mkdir(exist_ok=True)
    for pick in found.picks:
        if pick.number is None:
            continue
        point = found.point(pick.number)
        params = config.filter.params | point.params | dict(shutter)
        default = get_filter(result.filter).config_class()
        preset = Preset(
            filter=result.filter,
            params={key: v for key, v in params.items() if v != getattr(default, key)},
            evidence=evidence_of(
                result, config.objective, cases, ("default", pick.name),
                **_about(pick, point, method, found),
            ),
        )  # fmt: skip
        comment = (
            f"{result.filter}, {pick.name}: the best of {len(found.points)} settings that cost at "
            f"most {pick.budget:g} of\nGuertin 2014 with 35 taps. ../report.html has the evidence."
            f"\nUse it: torchblur filter presets/{pick.name}.yaml INPUT.exr -o OUTPUT.exr"
        )
        path = folder.path / "presets" / f"{pick.name}.yaml"
        save_preset(path, preset, comment=comment, overwrite=True)
    folder.write("pareto.csv", _table(found))
    folder.write("pareto.png", front_png(found))


def _about(
    pick: ParetoPick, point: ParetoPoint, method: MethodResult, found: ParetoResult
) -> dict[str, Any]:
    """Return what evidence says of one preset alone."""
    published = found.landmarks[0]
    return {
        "method": method.name,
        "trials": method.evaluations,
        "budget": pick.budget,
        "cost": round(point.cost, 4),
        "taps": round(point.taps, 2),
        "lookups": round(point.lookups, 2),
        "passes": round(point.passes, 2),
        "cost_as_published": round(published.cost, 4),
        "objective_as_published": published.objective,
        "objective_after": point.objective,
        "holdout_as_published": published.holdout,
        "holdout_after": point.holdout,
    }


def _table(found: ParetoResult) -> str:
    """Return all settings as CSV, landmarks first."""
    presets: dict[int, list[str]] = {}
    for pick in found.picks:
        if pick.number is not None:
            presets.setdefault(pick.number, []).append(pick.name)
    names = list(found.points[0].params)
    head = ["number", "origin", "cost", "taps", "lookups", "passes", "objective", "holdout"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*head, "front", "presets", *names])
    for point in (*found.landmarks, *found.points):
        number = point.number if point.number >= 0 else ""
        figures = [getattr(point, name) for name in head[2:]]
        values = [point.params.get(name, "") for name in names]
        on_front = int(point.number in found.front)
        mine = " ".join(presets.get(point.number, []))
        writer.writerow([number, point.origin, *figures, on_front, mine, *values])
    return text.getvalue()
