"""A run: data, methods, evaluation, preset and report, in one folder that survives a kill."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import platform
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from torchblur.filters import BlurFilter, get_filter
from torchblur.params import declared
from torchblur.presets import Preset, save_preset
from tuning.config.fit import TuneConfig, resolve
from tuning.config.methods import GradientMethod
from tuning.data.cases import SequenceCase
from tuning.data.variants import Variant
from tuning.files.run_folder import RunFolder, open_run
from tuning.fit.ceiling import ceiling
from tuning.fit.front_scores import budget_notes, judged
from tuning.methods.run import run_methods
from tuning.objective.effect import without_effect
from tuning.objective.prepare import Prepared, fit_device, prepare
from tuning.objective.problem import Problem
from tuning.objective.sensitivity import measure_sensitivity
from tuning.objective.space import Space
from tuning.parallel.cluster import Cluster, ClusterError
from tuning.parallel.cluster_problem import ClusterProblem
from tuning.parallel.ranks import is_restarted, join_ranks
from tuning.progress import Progress, ProgressEvent, Stage
from tuning.report.evidence import evidence_of
from tuning.report.fit import write_report
from tuning.report.front_files import write_pareto
from tuning.results.fit import (
    CaseScore,
    FitResult,
    MethodResult,
    ParameterResult,
    SensitivityResult,
)
from tuning.scoring.cases import score_cases, score_variant

__all__ = ["run_fit"]

_EDGE = 0.005  # of a range
_NO_EFFECT = "`{}` changes nothing on the frames of the fit, whatever its value."


@dataclass(frozen=True, kw_only=True, eq=False)
class _Setting(Prepared):
    """What all stages of a run share."""

    config: TuneConfig
    folder: RunFolder
    progress: Progress | None


def run_fit(
    config: TuneConfig,
    output_dir: str | Path,
    resume: bool = False,
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
    cluster: Cluster | None = None,
) -> FitResult:
    """Fit a filter's free parameters to references and write a run folder.

    The folder gets `config.yaml` (resolved), `log.jsonl` (a line per step and trial), checkpoints
    and Optuna journals, `preset.yaml` (what `torchblur filter` takes), `result.json` and
    `report.html`. The best method is chosen on the training frames; the hold-out is only scored.

    In processes that torchrun started the windows are split between them; the first one writes.

    Args:
        config: The configuration.
        output_dir: The run folder; it must not hold a run unless `resume` or `overwrite` is on.
        resume: Go on with a run that was stopped, with the same configuration. It ends as it
            would have ended: bit-equal on one machine with the CPU.
        progress: Called after each step.
        overwrite: Remove a run that is there.
        cluster: Workers for what a search draws together (`population`); they build the objective
            from the configuration, and find the same as one process.

    Returns:
        All figures; `FitResult.load` reads the same from `result.json`.

    Raises:
        ConfigError: a mistake in the configuration.
        FitError: no parameter set gives a finite loss.
        OutputError: the folder exists, or cannot be written to.
        ClusterError: workers or other processes that are not there, or lack the data.
        TorchblurError: data that is missing or cannot be read.
    """
    config, path = resolve(config), Path(output_dir)
    with join_ranks(config.device) as ranks:
        if ranks is None:
            workers = None if cluster is None else partial(ClusterProblem, cluster)
            with open_run(path, config, resume=resume, overwrite=overwrite) as folder:
                return _fit(config, folder, progress, workers)
        if cluster is not None:
            raise ClusterError("a fit goes to torchrun's processes or to a Dask cluster, not both")
        if ranks.rank > 0:
            return ranks.follow()
        again = is_restarted()
        fresh = overwrite and not again
        with open_run(path, config, resume=resume or again, overwrite=fresh) as folder:
            result = _fit(config, folder, progress, ranks.share)
        ranks.dismiss(result)
        return result


def _fit(
    config: TuneConfig,
    folder: RunFolder,
    progress: Progress | None,
    spread: Callable[[TuneConfig, Problem], Problem] | None,
) -> FitResult:
    began = time.monotonic()
    finished = folder.path / "result.json"
    if finished.is_file():
        return _finished(config, folder, progress, FitResult.load(finished))
    setting = _told(_prepare(config, folder, progress))
    if spread is not None:
        problem = spread(config, setting.problem)
        setting = dataclasses.replace(setting, problem=problem)
    methods = run_methods(config, setting.problem, setting.space, folder, progress)
    result, variants = _evaluate(setting, methods, began)
    _write_preset(setting, result)
    folder.write("result.json", result.model_dump_json(indent=2))
    _report(setting, result, variants)
    return result


def _finished(
    config: TuneConfig, folder: RunFolder, progress: Progress | None, result: FitResult
) -> FitResult:
    """Write what a run that has its result lacks beside it."""
    missing = {name for name in ("preset.yaml", "report.html") if not (folder.path / name).exists()}
    if missing:
        setting = _prepare(config, folder, progress)
        if "preset.yaml" in missing:
            _write_preset(setting, result)
        tuned = {parameter.name: parameter.tuned for parameter in result.parameters}
        _report(setting, result, _variants(setting, result.methods, tuned))
    return result


def _report(setting: _Setting, result: FitResult, variants: Sequence[Variant]) -> None:
    stage = Stage("report", 1, setting.progress)
    stage.step(0, message="pictures of the frames")
    write_report(setting.folder, setting.config, result, setting.cases, variants)
    stage.step(1)


# -- stages ----------------------------------------------------------------------------------------


def _prepare(config: TuneConfig, folder: RunFolder, progress: Progress | None) -> _Setting:
    ready = prepare(config, _data_reporter(progress))
    return _Setting(**vars(ready), config=config, folder=folder, progress=progress)


def _told(setting: _Setting) -> _Setting:
    """Tell what the user should know before the first trial."""
    idle = without_effect(setting.problem, setting.space, setting.progress)
    notes = (*setting.notes, *map(_NO_EFFECT.format, idle))
    total = len(setting.cases)
    for note in notes:
        setting.folder.log(note=note)
        if setting.progress is not None:
            setting.progress(ProgressEvent(stage="data", done=total, total=total, message=note))
    return dataclasses.replace(setting, notes=notes)


def _evaluate(
    setting: _Setting, methods: Sequence[MethodResult], began: float
) -> tuple[FitResult, list[Variant]]:
    start = setting.space.start()
    start_objective = float(setting.problem.mean(start))
    best = min(methods, key=lambda method: method.objective)
    improved = best.objective < start_objective
    tuned = best.params if improved else start
    methods = [judged(m, setting.problem, start, setting.cases, setting.progress) for m in methods]
    variants = _variants(setting, methods, tuned)
    stage = Stage("evaluation", len(setting.cases), setting.progress)
    scores = score_cases(setting.cases, variants, stage) + _ceiling_scores(setting, tuned)
    slopes = measure_sensitivity(
        setting.problem, setting.space, start, tuned, _unroll(setting.config), setting.progress
    )
    params = setting.config.filter.params | tuned | _common_shutter(setting)
    result = FitResult(
        filter=setting.config.filter.kind,
        params=_not_default(setting.blur, params),
        chosen=best.name if improved else "start",
        start_objective=start_objective,
        objective=best.objective if improved else start_objective,
        parameters=_parameters(setting.space, tuned, slopes),
        methods=tuple(methods),
        scores=tuple(scores),
        notes=setting.notes + budget_notes(methods) + _edge_notes(setting, tuned),
        seed=setting.config.seed,
        command=_command(),
        versions=_versions(),
        seconds=time.monotonic() - began,
    )
    return result, variants


def _variants(
    setting: _Setting, methods: Sequence[MethodResult], tuned: dict[str, Any]
) -> list[Variant]:
    """Return what is scored: frames, line, the filter as published, before and after the fit."""
    blur, free = setting.blur, setting.space.names
    device = fit_device(setting.config.device)
    variants = [Variant(name="sharp")]
    if any(isinstance(case, SequenceCase) for case in setting.cases):
        variants.append(Variant(name="input", stream=True))
    if blur.name != "line":
        line = get_filter("line")().to(device)
        variants.append(Variant(name="line", blur=line))
    published = get_filter(blur.name)().to(device)
    variants.append(Variant(name="default", blur=published))
    start = setting.space.start()
    if _not_default(blur, setting.config.filter.params | start):
        variants.append(Variant(name="start", blur=blur, values=start, free=free))
    if len(methods) > 1:
        variants += [Variant(name=m.name, blur=blur, values=m.params, free=free) for m in methods]
    for found in [method.pareto for method in methods if method.pareto is not None]:
        variants += [
            Variant(name=name, blur=blur, values=point.params, free=free)
            for name, point in found.picked().items()
        ]
    return [*variants, Variant(name="tuned", blur=blur, values=tuned, free=free)]


def _ceiling_scores(setting: _Setting, tuned: dict[str, Any]) -> list[CaseScore]:
    steps = setting.config.ceiling_steps
    if steps == 0:
        return []
    stage = Stage("ceiling", len(setting.cases), setting.progress)
    scores: list[CaseScore] = []
    for done, case in enumerate(setting.cases):
        args = (setting.space, tuned, setting.config.objective, steps)
        values = ceiling(case, setting.blur, *args)
        variant = Variant(
            name="ceiling", blur=setting.blur, values=values, free=setting.space.names
        )
        scores.append(score_variant(case, variant))
        stage.step(done + 1, message=case.name)
    return scores


# -- results ---------------------------------------------------------------------------------------


def _parameters(
    space: Space, tuned: dict[str, Any], slopes: dict[str, SensitivityResult]
) -> tuple[ParameterResult, ...]:
    rows = []
    for parameter in space.parameters:
        spec, slope = parameter.spec, slopes.get(parameter.name)
        low, high = (None, None) if parameter.choices else spec.bounds
        rows.append(
            ParameterResult(
                name=parameter.name,
                symbol=spec.symbol,
                unit=spec.unit,
                meaning=spec.meaning,
                source=spec.source,
                default=parameter.default,
                start=parameter.start,
                tuned=tuned[parameter.name],
                low=low,
                high=high,
                choices=parameter.choices,
                scale=spec.scale,
                sensitivity=None if slope is None else slope.rise,
                slopes=slope,
            )
        )
    return tuple(rows)


def _edge_notes(setting: _Setting, tuned: dict[str, Any]) -> tuple[str, ...]:
    """Return what ended at the edge of its range, where a better value may lie beyond."""
    notes, specs = [], declared(setting.blur.config_class)
    for p in setting.space.parameters:
        value = tuned[p.name]
        if p.choices or value == p.start:
            continue
        (place,) = setting.space.subset((p.name,)).to_unit(tuned).tolist()
        end = round(place)
        if abs(place - end) <= _EDGE:
            limit = p.spec.bounds[end]
            beyond = (
                "the filter takes no more" if limit == specs[p.name].bounds[end] else "widen it"
            )
            notes.append(
                f"`{p.name}` ended at the edge of its range, {value:g} of {limit:g}; {beyond}."
            )
    return tuple(notes)


def _unroll(config: TuneConfig) -> int | None:
    """Return through how many frames the methods let gradients go back, or all."""
    return next((m.unroll for m in config.methods if isinstance(m, GradientMethod)), None)


def _common_shutter(setting: _Setting) -> dict[str, Any]:
    """Return the shutter of the training frames for the preset, if they have one in common."""
    shutters = {case.shutter for case in setting.cases if case.split == "train"}
    if len(shutters) > 1:
        return {}
    shutter = shutters.pop()
    given = {"shutter": shutter.open, "shutter_position": shutter.position}
    return {key: value for key, value in given.items() if key not in setting.space.names}


def _not_default(blur: BlurFilter, params: dict[str, Any]) -> dict[str, Any]:
    default = blur.config_class()
    return {key: value for key, value in params.items() if value != getattr(default, key)}


def _write_preset(setting: _Setting, result: FitResult) -> None:
    config = setting.config
    evidence = evidence_of(
        result,
        config.objective,
        setting.cases,
        ("default", "tuned"),
        objective_before=result.start_objective,
        objective_after=result.objective,
        method=result.chosen,
    )
    comment = (
        f"{result.filter}, tuned by torchblur; report.html beside this file has the evidence.\n"
        "Use it: torchblur filter preset.yaml INPUT.exr -o OUTPUT.exr"
    )
    preset = Preset(filter=result.filter, params=result.params, evidence=evidence)
    save_preset(setting.folder.path / "preset.yaml", preset, comment=comment, overwrite=True)
    write_pareto(setting.folder, config, result, setting.cases, _common_shutter(setting))


def _versions() -> dict[str, str]:
    names = ("torchblur", "torch", "optuna")
    return {"python": platform.python_version()} | {
        name: importlib.metadata.version(name) for name in names
    }


def _command() -> str:
    """Return the command of this process, without what only says how it begins."""
    program = Path(sys.argv[0]).name
    words = ["python", "-m", "tuning"] if program == "__main__.py" else [program]
    return shlex.join([*words, *(w for w in sys.argv[1:] if w not in ("--resume", "--overwrite"))])


def _data_reporter(progress: Progress | None) -> Any:
    stage: list[Stage] = []

    def report(done: int, total: int, name: str) -> None:
        if not stage:
            stage.append(Stage("data", total, progress))
        stage[0].step(done, message=name)

    return report
