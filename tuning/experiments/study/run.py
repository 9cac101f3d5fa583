"""Studies: what filters make of frames and sequences, frame by frame, beside raw input.

A study is data times variants. Each variant runs through each sequence in its order, with a
memory of its own if its filter has one, and is compared with every reference. What is measured
is kept per data and variant, so that a stopped study goes on where it was.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchblur.errors import ConfigError, nearest_name
from torchblur.filters import BlurFilter, History, TemporalBlur
from torchblur.frame import Frame
from torchblur.io.paths import output_file
from torchblur.metrics import FlipReference, border_band, prepare_flip_ldr
from tuning.experiments.kept import figures_hash, slug
from tuning.experiments.study.config import (
    StudyConfig,
    StudyExr,
    StudyScene,
    StudyVariant,
    make_filter,
)
from tuning.experiments.study.frames import Moment, identity_of, moments
from tuning.experiments.study.ray_mask import ray_facts, ray_mask_of, shutter_values, with_revealed
from tuning.experiments.study.scores import hidden_mask, moving_mask
from tuning.files.images import write_color
from tuning.progress import Progress, Stage
from tuning.results.fit import finite_or_none
from tuning.scoring.sequences import FrameByFrame

FACTS = "ray mask"
"""Name of the variant that stands for figures of the data themselves."""

__all__ = ["FACTS", "Row", "mean_of", "part_file", "picture_file", "run_study"]


@dataclass(frozen=True, kw_only=True)
class Row:
    """What one variant scored on some data against one of its references.

    Args:
        data: Name of the data.
        variant: Name of the variant.
        reference: Name of the reference.
        figures: Lists with one figure per frame, by name; None where a mask was empty.
        cpu_seconds: Median over the frames, of the filter alone; None for raw input.
        estimated: Whether the input stands in for samples that are not there.
    """

    data: str
    variant: str
    reference: str
    figures: Mapping[str, Sequence[float | None]]
    cpu_seconds: float | None = None
    estimated: bool = False

    def mean(self, name: str) -> float | None:
        """Return the mean of a figure over the frames that have it."""
        return mean_of(self.figures.get(name, ()))


def mean_of(values: Sequence[float | None]) -> float | None:
    """Return the mean of the values that are there, or None."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def run_study(config: StudyConfig, folder: Path, progress: Progress | None = None) -> list[Row]:
    """Measure all variants on all data; what `folder` has already is not measured again.

    Args:
        config: What `load_study_config` returned.
        folder: Gets `parts/` with one file per data and variant, and `pictures/`.
        progress: Told after each frame.

    Returns:
        A row for each data, variant and reference, and if there is a ray mask one for each data
        with a revealed layer: variant `FACTS`, without reference, with what `ray_facts` returns.

    Raises:
        TorchblurError: files that cannot be read, data without what a filter needs.
    """
    (folder / "parts").mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for item in config.data:
        wanted = config.variants_of(item)
        if item.revealed and "ray_mask" in config.masks:
            wanted = [*wanted, StudyVariant(name=FACTS)]
        missing = [v for v in wanted if not part_file(folder, config, item, v).is_file()]
        if missing:
            _measure(config, item, missing, folder, progress)
        for variant in wanted:
            text = part_file(folder, config, item, variant).read_text(encoding="utf-8")
            rows += [Row(**record) for record in json.loads(text)["rows"]]
    return rows


def part_file(
    folder: Path, config: StudyConfig, item: StudyScene | StudyExr, variant: StudyVariant
) -> Path:
    """Return where the figures of a variant on some data are kept.

    Its name is made of all that they depend on: settings, files, and the source of filters,
    operations and metrics.
    """
    parts = (
        item.model_dump_json(exclude={"picture"}),
        variant.model_dump_json(exclude={"only"}),
        json.dumps([config.masks, config.mask_params], sort_keys=True),
        identity_of(item),
        figures_hash(),
    )
    digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
    return folder / "parts" / f"{slug(item.name)}.{slug(variant.name)}.{digest}.json"


def picture_file(folder: Path, item: StudyScene | StudyExr, name: str) -> Path:
    """Return where the picture of a variant or of a reference ("reference NAME") is kept."""
    return folder / "pictures" / slug(item.name) / f"{slug(name)}.png"


# -- one set of data -------------------------------------------------------------------------------


@dataclass
class _Runner:
    """One variant on its way through a sequence."""

    variant: StudyVariant
    blur: BlurFilter | None
    history: History | None = None
    judges: dict[str, FrameByFrame] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)
    figures: dict[str, dict[str, list[float | None]]] = field(default_factory=dict)
    estimated: bool = False

    @torch.no_grad()
    def image(
        self, moment: Moment, ray_mask: Tensor | None = None
    ) -> tuple[Tensor, dict[str, float | None]]:
        """Return the image of a frame, and figures that the filter tells of itself."""
        variant = self.variant
        if self.blur is None:
            if variant.input == "sharp":
                return moment.sharp.color, {}
            self.estimated |= variant.samples in moment.estimated
            return moment.raw[variant.samples], {}
        frames = _frames(variant, moment, ray_mask)
        began = time.process_time()
        layers = self._layers(frames, moment)
        self.seconds.append(time.process_time() - began)
        if variant.layer not in layers:
            raise ConfigError(
                f"{self.blur.name} has no layer `{variant.layer}`"
                f"{nearest_name(variant.layer, layers)} (variant {variant.name!r})"
            )
        return layers[variant.layer], _told(layers)

    def _layers(self, frames: tuple[Frame, ...], moment: Moment) -> dict[str, Tensor]:
        shutter = shutter_values(moment.shutter)
        if not isinstance(self.blur, TemporalBlur):
            assert self.blur is not None
            return self.blur.layers(frames[0], **shutter)
        history = None if moment.first_of_shot else self.history
        layers, self.history = self.blur.step(frames, history, **shutter)
        return layers

    def compare(
        self,
        moment: Moment,
        image: Tensor,
        told: Mapping[str, float | None],
        prepared: Mapping[str, FlipReference],
        masks: Mapping[str, Tensor],
    ) -> None:
        """Keep the figures of an image against all references."""
        for name, reference in moment.references.items():
            found = self.judges.setdefault(name, FrameByFrame()).figures(
                image,
                reference,
                masks=masks,
                prepared=prepared[name],
                begins_shot=moment.first_of_shot,
            )
            figures = {key: finite_or_none(value) for key, value in found.items()}
            first = {key: figures.pop(key) for key in ("flip", "flip_median")}
            self.keep(name, {**first, **figures, **told})

    def keep(self, reference: str, figures: Mapping[str, float | None]) -> None:
        lists = self.figures.setdefault(reference, {})
        for key, value in figures.items():
            lists.setdefault(key, []).append(value)

    def rows(self, item: StudyScene | StudyExr) -> list[Row]:
        return [
            Row(
                data=item.name,
                variant=self.variant.name,
                reference=reference,
                figures=lists,
                cpu_seconds=statistics.median(self.seconds) if self.seconds else None,
                estimated=self.estimated,
            )
            for reference, lists in self.figures.items()
        ]


def _measure(
    config: StudyConfig,
    item: StudyScene | StudyExr,
    variants: Sequence[StudyVariant],
    folder: Path,
    progress: Progress | None,
) -> None:
    runners = [_Runner(v, make_filter(v)) for v in variants if v.name != FACTS]
    facts = _Runner(StudyVariant(name=FACTS), None)
    asked = len(runners) < len(variants)
    raw = tuple(v.samples for v in variants if v.filter is None and v.input == "stream")
    stage = Stage(item.name, item.count, progress)
    stage.step(0)
    for moment in moments(item, raw):
        masks = _masks(config, item, moment)
        prepared = {name: prepare_flip_ldr(image) for name, image in moment.references.items()}
        shown = {f"reference {name}": image for name, image in moment.references.items()}
        for runner in runners:
            image, told = runner.image(moment, masks.get("ray_mask"))
            runner.compare(moment, image, told, prepared, masks)
            shown[runner.variant.name] = image
        if asked:
            facts.keep("", ray_facts(item, moment, config.mask_params))
        if moment.index == item.shown:
            shown |= {f"mask {name}": mask.float() for name, mask in masks.items()}
            for name, image in shown.items():
                _show(picture_file(folder, item, name), image.expand(1, 3, -1, -1))
        stage.step(moment.index + 1)
    for runner in [*runners, facts] if asked else runners:
        data = {"rows": [dataclasses.asdict(row) for row in runner.rows(item)]}
        path = part_file(folder, config, item, runner.variant)
        with output_file(path, overwrite=True) as temporary:
            temporary.write_text(json.dumps(data), encoding="utf-8")


def _masks(config: StudyConfig, item: StudyScene | StudyExr, moment: Moment) -> dict[str, Tensor]:
    """Return the masks by name; those of rays only where there is something behind."""
    makers: dict[str, Callable[[], Tensor]] = {
        "band": lambda: border_band(moment.sharp, moment.shutter),
        "moving": lambda: moving_mask(moment),
        "hidden": lambda: hidden_mask(moment),
        "ray_mask": lambda: ray_mask_of(moment, config.mask_params),
    }
    return {name: makers[name]() for name in config.masks if name != "ray_mask" or item.revealed}


def _frames(variant: StudyVariant, moment: Moment, ray_mask: Tensor | None) -> tuple[Frame, ...]:
    """Return what a filter is given."""
    if variant.input == "stream":
        return moment.samples[: variant.samples]
    if variant.revealed == "none":
        return (moment.sharp,)
    return (with_revealed(moment, ray_mask if variant.revealed == "mask" else None),)


def _told(layers: Mapping[str, Tensor]) -> dict[str, float | None]:
    """Return figures that a filter tells of itself: the share of failed reprojections."""
    if "reprojection" not in layers:
        return {}
    tried = int((layers["reprojection"] != 0).sum())
    return {"failed": int((layers["reprojection"] < 0).sum()) / tried if tried else None}


def _show(path: Path, image: Tensor) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_color(path, image, overwrite=True)
