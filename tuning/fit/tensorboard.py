"""A fit in TensorBoard: scalars as the log grows, figures and images at the end.

All of it is read from the run's own log and result, and nothing is given back to the run. What an
earlier process wrote is replaced, so that a run that was stopped and goes on has each step once.
TensorBoard is imported where it is used alone: it comes with the extra `track`.
"""

from __future__ import annotations

import importlib
import json
import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from torch import Tensor

from torchblur.errors import ConfigError, OutputError
from torchblur.filters import get_filter
from torchblur.metrics import display_encode, flip_ldr
from torchblur.params import choices
from tuning.config.fit import TuneConfig, resolve
from tuning.data.cases import AnyCase
from tuning.data.loading import load_cases
from tuning.data.variants import Variant, shown_image, shown_reference
from tuning.methods.run import method_name
from tuning.objective.prepare import fit_device
from tuning.progress import Progress, ProgressEvent
from tuning.results.fit import FitResult

__all__ = ["Tracker", "tracking"]

_SUFFIX = ".torchblur"
_COLORS = "magma"
_MAX_CASES = 8


class Tracker:
    """Copies a run into an event file for TensorBoard.

    It is a `Progress` that hands each event on. Nothing is written before the first event, so
    that a run that is refused leaves the events of an earlier one as they are.

    Args:
        directory: Log folder of TensorBoard; the run gets a folder of its name in it.
        run: The run folder.
        config: The configuration.
        progress: Who is told of each event, too.

    Raises:
        ConfigError: TensorBoard is not installed.
    """

    def __init__(
        self, directory: Path, run: Path, config: TuneConfig, progress: Progress | None = None
    ) -> None:
        self._writer_class = _load_writer()
        self.folder = directory / run.absolute().name
        self._log = run / "log.jsonl"
        self._config = resolve(config)
        self._progress = progress
        self._writer: Any = None
        self._offset, self._last = 0, b""  # of what is read of the log, and its last line
        self._seen: set[tuple[int, int]] = set()
        self._best: dict[int, float] = {}

    def __call__(self, event: ProgressEvent) -> None:
        """Write what is new in the log; called after each step."""
        if self._progress is not None:
            self._progress(event)
        self._follow()

    def finish(self, result: FitResult) -> None:
        """Write the figures of a result, and images of its frames.

        Args:
            result: What the run found.

        Raises:
            TorchblurError: the data cannot be read any more.
        """
        self._follow()
        self._write_figures(result)
        cases = load_cases(self._config.data, device=fit_device(self._config.device))
        # Hold-out first: these are the frames that say something.
        ordered = sorted(cases, key=lambda case: case.split != "holdout")
        for case in ordered[:_MAX_CASES]:
            for name, image in _images(case, self._config, result).items():
                self._open().add_image(f"{case.split} {case.name}/{name}", image, 0)

    def close(self) -> None:
        """Write what is still in memory."""
        if self._writer is not None:
            self._writer.close()

    def _open(self) -> Any:
        """Return the writer; the first call removes the events of an earlier process."""
        if self._writer is None:
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                for path in self.folder.glob(f"events.out.tfevents.*{_SUFFIX}"):
                    path.unlink()
            except OSError as error:
                raise OutputError(f"cannot write into {self.folder}: {error.strerror}") from error
            self._writer = self._writer_class(str(self.folder), filename_suffix=_SUFFIX)
        return self._writer

    # -- the log -------------------------------------------------------------------------------

    def _follow(self) -> None:
        for record in self._new_records():
            key = (record.get("method", -1), record.get("step", -1))
            # A method that goes on does the steps after its checkpoint again, with one result.
            if min(key) >= 0 and key not in self._seen:
                self._seen.add(key)
                self._write_step(*key, record)
        self._open().flush()

    def _new_records(self) -> Iterator[dict[str, Any]]:
        """Yield the lines that were not read yet; all of them if the log was written anew."""
        if not self._log.is_file():
            return
        with self._log.open("rb") as file:
            file.seek(self._offset - len(self._last))
            if file.read(len(self._last)) != self._last:
                self._offset = file.seek(0)
            content = file.read()
        lines = content[: content.rfind(b"\n") + 1].splitlines(keepends=True)
        self._offset += sum(map(len, lines))
        self._last = lines[-1] if lines else self._last
        yield from map(json.loads, lines)

    def _write_step(self, method: int, step: int, record: Mapping[str, Any]) -> None:
        name = method_name(self._config, method)
        losses = [math.nan if loss is None else loss for loss in record.get("loss", ())]
        finite = [loss for loss in losses if math.isfinite(loss)]
        scalars = {"cost": record.get("cost"), "pruned": record.get("pruned")}
        if finite:
            self._best[method] = min([*finite, self._best.get(method, math.inf)])
            scalars |= {"loss": min(finite), "best": self._best[method]}
        for start, loss in enumerate(losses if len(losses) > 1 else ()):
            scalars[f"loss of start {start + 1}"] = loss
        for key, values in record.get("params", {}).items():
            for start, value in enumerate(values):
                of = f" of start {start + 1}" if len(values) > 1 else ""
                scalars[f"{key}{of}"] = self._number(key, value)
        for key, value in scalars.items():
            if value is not None and math.isfinite(value):
                self._open().add_scalar(_tag(f"{name}/{key}"), value, step)

    def _number(self, name: str, value: Any) -> float:
        """Return a value as a number: of a choice its position."""
        if isinstance(value, str):
            return choices(get_filter(self._config.filter.kind).config_class, name).index(value)
        return float(value)

    # -- the result ----------------------------------------------------------------------------

    def _write_figures(self, result: FitResult) -> None:
        figures: dict[str, float] = {"objective": result.objective}
        for split in ("holdout", "train"):
            metrics = {m for s in result.scores if s.split == split for m in s.scores}
            for metric in sorted(metrics):
                for variant in result.variants():
                    value = result.mean(variant, split, metric)
                    if value is not None and math.isfinite(value):
                        figures[_tag(f"{split} {metric}/{variant}")] = value
        tuned = {p.name: p.tuned for p in result.parameters}
        about = {"filter": result.filter, "chosen": result.chosen, "seed": result.seed}
        hparams = importlib.import_module("torch.utils.tensorboard.summary").hparams
        writer = self._open()
        for summary in hparams(about | tuned, figures):
            writer.file_writer.add_summary(summary)
        for tag, value in figures.items():
            writer.add_scalar(tag, value, 0)


@contextmanager
def tracking(
    directory: Path | None, run: Path, config: TuneConfig, progress: Progress
) -> Iterator[Tracker | None]:
    """Give the tracker of a run, or None if there is no folder for it; close it at the end.

    Args:
        directory: Log folder of TensorBoard.
        run: The run folder.
        config: The configuration.
        progress: Who is told of each event, too.
    """
    if directory is None:
        yield None
        return
    tracker = Tracker(directory, run, config, progress)
    try:
        yield tracker
    finally:
        tracker.close()


def _load_writer() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what it imports itself
        try:
            return importlib.import_module("torch.utils.tensorboard").SummaryWriter
        except ImportError as error:
            raise ConfigError(
                "--track needs TensorBoard, which is not installed; pip install 'torchblur[track]'"
            ) from error


def _tag(text: str) -> str:
    return text.replace(" ", "_")


# -- images ----------------------------------------------------------------------------------------


def _images(case: AnyCase, config: TuneConfig, result: FitResult) -> dict[str, Tensor]:
    """Return images to show, (3, H, W) in [0, 1]; of a sequence the middle scored frame."""
    kind, device = get_filter(config.filter.kind), fit_device(config.device)
    tuned = {p.name: p.tuned for p in result.parameters}
    blur = kind(engine="eager", **config.filter.params).to(device)
    variants = [
        Variant(name="sharp"),
        Variant(name="default", blur=kind(engine="eager").to(device)),
        Variant(name="tuned", blur=blur, values=tuned, free=tuple(tuned)),
    ]
    shown = [variant for variant in variants if variant.fits(case)]
    images, reference = {v.name: shown_image(v, case) for v in shown}, shown_reference(case)
    errors = {
        f"error of {name}": _colored(flip_ldr(image, reference))
        for name, image in images.items()
        if name != "sharp"
    }
    plain = {name: _displayed(image) for name, image in images.items()}
    return {_tag(n): i for n, i in (plain | {"reference": _displayed(reference)} | errors).items()}


def _displayed(image: Tensor) -> Tensor:
    shown: Tensor = display_encode(image)[0].clamp(0, 1).cpu()
    return shown


def _colored(error: Tensor) -> Tensor:
    """Return FLIP, (1, 1, H, W) in [0, 1], in the colors that it is shown in everywhere."""
    colors = colormaps[_COLORS](error[0, 0].clamp(0, 1).cpu().numpy())[..., :3]
    return torch.from_numpy(np.ascontiguousarray(colors, np.float32)).permute(2, 0, 1)
