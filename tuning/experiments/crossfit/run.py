"""Crossfit: filters fitted to all scenes but one, and scored on the one that was left out.

Each fit is a run folder of its own, and each image's figures are a file, so that what was stopped
goes on within the fit in flight; several processes may share the fits and find the same.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.io.paths import output_file
from torchblur.params import build
from tuning.config.data import DataItem, DataSpec
from tuning.config.fit import TuneConfig
from tuning.data.cases import AnyCase, check_needs
from tuning.data.loading import load_cases
from tuning.data.variants import Variant, cut_of
from tuning.experiments.crossfit.bootstrap import Sums, tile_sums
from tuning.experiments.crossfit.config import CrossfitConfig
from tuning.experiments.kept import digest_of, figures_hash, slug
from tuning.files.outputs import make_folders
from tuning.files.run_folder import open_run
from tuning.methods.run import run_methods
from tuning.objective.prepare import fit_device, prepare
from tuning.parallel.processes import worker_pool
from tuning.progress import Progress, Stage

__all__ = ["Crossfit", "Fold", "Scored", "run_crossfit"]

_FOUND = "fold.json"


@dataclass(frozen=True, kw_only=True)
class Fold:
    """What a fit found without one case.

    Args:
        filter: Name of the filter's entry.
        case: What was left out.
        start: Free parameters where the fit began.
        tuned: The best on the training frames.
        chosen: Name of the method that found them; "start" if none was better.
        start_objective: On the training frames, at the start.
        objective: The same of the best.
        passes: Evaluations of all training windows.
        cpu_seconds: Of the methods.
    """

    filter: str
    case: str
    start: Mapping[str, Any]
    tuned: Mapping[str, Any]
    chosen: str
    start_objective: float
    objective: float
    passes: float
    cpu_seconds: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Scored:
    """An image's figures.

    Args:
        case: Name of the case.
        filter: Name of the filter's entry; "sharp" and "line" for what all are compared with.
        variant: "default"; "given" with the entry's own values and not fitted; "tuned" on the
            other cases; "" of the sharp frame.
        heights: Sums over tiles by the height of the camera's image, px.
        cuts: Of each frame or sequence the share of the pixels that move farther than the filter
            blurs, and the longest half spread, px; of a filter without such a limit nothing.
    """

    case: str
    filter: str
    variant: str
    heights: Mapping[int, Sums]
    cuts: tuple[tuple[float, float], ...] = ()

    @property
    def sums(self) -> Sums:
        """Over tiles of all frames."""
        return Sums.joined(list(self.heights.values()))


@dataclass(frozen=True, eq=False)
class Crossfit:
    """All that was found: of each fit, and of each image."""

    folds: tuple[Fold, ...]
    scored: tuple[Scored, ...]


@dataclass(frozen=True)
class _Shown:
    """What is scored: a filter with values, or the sharp frame."""

    filter: str
    variant: str
    kind: str | None
    params: Mapping[str, Any]
    free: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Job:
    """A fit and the score of what it found; without a filter the scores of what is not fitted."""

    case: str
    filter: str | None = None

    @property
    def label(self) -> str:
        return f"{self.case}: unfitted" if self.filter is None else f"{self.filter}: {self.case}"


def run_crossfit(
    config: CrossfitConfig, folder: Path, progress: Progress | None = None, *, workers: int = 1
) -> Crossfit:
    """Fit each filter to all cases but one, for each case, and score it there.

    Args:
        config: What `load_crossfit_config` returned.
        folder: Gets `folds/`, a run folder for each fit, and `scores/`; what it has is kept.
        progress: Told after each fit.
        workers: Processes that share the fits; the figures do not depend on their number.

    Raises:
        TorchblurError: data that cannot be read; a method that finds nothing.
    """
    jobs = [*(_Job(case) for case in config.data.cases)]
    jobs += [_Job(case, name) for name, case in config.folds]
    missing = [job for job in jobs if not _is_done(config, folder, job)]
    stage = Stage("fits", len(jobs), progress, done=len(jobs) - len(missing))
    stage.step(len(jobs) - len(missing))
    if any(job.filter is not None for job in missing):
        _load(config, config.data.always, "always")  # rendered once, not by each worker
    done = len(jobs) - len(missing)
    for job in _worked_off(config, folder, missing, workers):
        done += 1
        stage.step(done, message=job.label)
    return _collected(config, folder)


def _worked_off(
    config: CrossfitConfig, folder: Path, jobs: Sequence[_Job], workers: int
) -> Iterator[_Job]:
    """Yield jobs when they are done."""
    workers = min(workers, len(jobs))
    if workers < 2:
        for job in jobs:
            _work(config, folder, job)
            yield job
        return
    with worker_pool(workers) as pool:
        waiting = {pool.submit(_work, config, folder, job): job for job in jobs}
        try:
            for future in as_completed(waiting):
                future.result()
                yield waiting[future]
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _work(config: CrossfitConfig, folder: Path, job: _Job) -> None:
    cases: list[AnyCase] = []
    if job.filter is not None:
        shown: list[_Shown] = [_tuned(config, _fitted(config, folder, job.filter, job.case))]
    else:
        shown = _unfitted(config)
    for one in shown:
        path = _score_path(config, folder, one, job.case)
        if path.is_file():
            continue
        cases = cases or _load(config, config.scored(job.case), f"cases.{job.case}")
        found = _score(cases, _variant(config, one, cases), config.bootstrap.tile)
        make_folders([path])
        with output_file(path, overwrite=True) as temporary:
            temporary.write_text(json.dumps(found), encoding="utf-8")


# -- fits ------------------------------------------------------------------------------------------


def _fitted(config: CrossfitConfig, folder: Path, name: str, case: str) -> Fold:
    """Return what a fit found, after running it if need be."""
    fit = config.fold(name, case)
    path = _fold_path(folder, name, case, fit)
    if not (path / _FOUND).is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        with open_run(path, fit, resume=True) as run:
            ready = prepare(fit)
            methods = run_methods(fit, ready.problem, ready.space, run)
            start = ready.space.start()
            start_objective = float(ready.problem.mean(start))
            best = min(methods, key=lambda method: method.objective)
            improved = best.objective < start_objective
            fold = Fold(
                filter=name,
                case=case,
                start=start,
                tuned=best.params if improved else start,
                chosen=best.name if improved else "start",
                start_objective=start_objective,
                objective=best.objective if improved else start_objective,
                passes=sum(method.passes for method in methods),
                cpu_seconds=sum(method.cpu_seconds for method in methods),
            )
            run.write(_FOUND, json.dumps(dataclasses.asdict(fold), indent=1))
    return _read_fold(path)


def _read_fold(path: Path) -> Fold:
    return Fold(**json.loads((path / _FOUND).read_text(encoding="utf-8")))


def _fold_path(folder: Path, name: str, case: str, fit: TuneConfig) -> Path:
    digest = digest_of(fit.model_dump(mode="json"), version("torchblur"))
    return folder / "folds" / f"{slug(name)}.without-{slug(case)}.{digest}"


# -- scores ----------------------------------------------------------------------------------------


def _unfitted(config: CrossfitConfig) -> list[_Shown]:
    """Return what is scored without a fit: the sharp frame, line, each filter's own values."""
    shown = [_Shown("sharp", "", None, {}), _Shown("line", "default", "line", {})]
    for name, entry in config.filters.items():
        kind, params = entry.filter.kind, entry.filter.params
        if kind != "line":
            shown.append(_Shown(name, "default", kind, {}))
        default = get_filter(kind).config_class()
        if any(getattr(default, key) != value for key, value in params.items()):
            shown.append(_Shown(name, "given", kind, params, tuple(entry.filter.free)))
    return shown


def _tuned(config: CrossfitConfig, fold: Fold) -> _Shown:
    spec = config.filters[fold.filter].filter
    return _Shown(fold.filter, "tuned", spec.kind, {**spec.params, **fold.tuned}, tuple(spec.free))


def _variant(config: CrossfitConfig, shown: _Shown, cases: Sequence[AnyCase]) -> Variant:
    if shown.kind is None:
        return Variant(name=shown.filter)
    blur = get_filter(shown.kind)(engine=config.engine, **shown.params)
    check_needs(blur, cases)
    return Variant(name=shown.filter, blur=blur.to(fit_device(config.device)), free=shown.free)


def _score(cases: Sequence[AnyCase], variant: Variant, tile: int) -> dict[str, Any]:
    """Return what a score's file holds."""
    by_height: dict[int, list[AnyCase]] = {}
    for case in cases:
        by_height.setdefault(case.lines, []).append(case)
    sums = {lines: tile_sums(some, variant, tile) for lines, some in by_height.items()}
    cuts = [
        (cut.share, cut.longest) for case in cases if (cut := cut_of(variant, case)) is not None
    ]
    return {"heights": {lines: s.plain() for lines, s in sums.items() if len(s)}, "cuts": cuts}


def _read_score(path: Path, **of: str) -> Scored:
    data = json.loads(path.read_text(encoding="utf-8"))
    return Scored(
        heights={int(lines): Sums(sums) for lines, sums in data["heights"].items()},
        cuts=tuple((share, longest) for share, longest in data["cuts"]),
        **of,
    )


def _score_path(config: CrossfitConfig, folder: Path, shown: _Shown, case: str) -> Path:
    """Return a score's file; its name depends on all that its figures do, the source included."""
    parts = [shown.kind, dict(shown.params), list(shown.free), config.data.root]
    items = [item.model_dump(mode="json") for item in config.scored(case)]
    digest = digest_of(*parts, items, config.bootstrap.tile, figures_hash())
    name = ".".join(slug(text) for text in (case, shown.filter, shown.variant) if text)
    return folder / "scores" / f"{name}.{digest}.json"


def _load(config: CrossfitConfig, items: Sequence[DataItem], key: str) -> list[AnyCase]:
    """Load frames that are not fitted; messages name their place in the crossfit's file."""
    if not items:
        return []
    data = {"root": config.data.root, "train": [item.model_dump() for item in items]}
    try:
        return load_cases(build(DataSpec, data, key), device=fit_device(config.device))
    except ConfigError as error:
        raise ConfigError(str(error).replace("data.train.", f"data.{key}.")) from error


# -- results ---------------------------------------------------------------------------------------


def _is_done(config: CrossfitConfig, folder: Path, job: _Job) -> bool:
    shown = _unfitted(config)
    if job.filter is not None:
        path = _fold_path(folder, job.filter, job.case, config.fold(job.filter, job.case))
        if not (path / _FOUND).is_file():
            return False
        shown = [_tuned(config, _read_fold(path))]
    return all(_score_path(config, folder, one, job.case).is_file() for one in shown)


def _collected(config: CrossfitConfig, folder: Path) -> Crossfit:
    folds = {key: _fitted(config, folder, *key) for key in config.folds}
    scored = []
    for case in config.data.cases:
        shown = _unfitted(config)
        shown += [_tuned(config, fold) for (_, left_out), fold in folds.items() if left_out == case]
        order = ["sharp", "line", *config.filters]
        shown.sort(key=lambda one: order.index(one.filter))
        for one in shown:
            path = _score_path(config, folder, one, case)
            found = _read_score(path, case=case, filter=one.filter, variant=one.variant)
            if found.heights:
                scored.append(found)
    return Crossfit(tuple(folds.values()), tuple(scored))
