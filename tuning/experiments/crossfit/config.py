"""What a crossfit is told: cases, the filters that are fitted to all of them but one, and targets.

One YAML file. Every mistake is one `ConfigError` with the file and the key path.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.io import load_yaml
from torchblur.ops.compiling import EngineChoice
from torchblur.params import Config, build, declared
from tuning.config.data import (
    Crops,
    DataItem,
    FamilyData,
    FamilyStreamData,
    SceneData,
    SceneStreamData,
)
from tuning.config.fit import FilterSpec, FreeRange, TuneConfig, resolve, resolve_filter
from tuning.config.methods import Method, smooth_by_default
from tuning.config.objective import ObjectiveSpec
from tuning.config.overrides import apply_overrides
from tuning.render.scene import find_scene

__all__ = [
    "Bootstrap",
    "CrossfitConfig",
    "CrossfitData",
    "CrossfitEntry",
    "Target",
    "load_crossfit_config",
]

Target = Literal["flip_ratio", "flip_band_ratio", "psnr_gain", "psnr_band_gain"]


class CrossfitData(Config):
    """Scenes, each of which is left out once."""

    root: str = Field(".", description="folder that the paths below are relative to")
    cases: dict[str, Annotated[tuple[DataItem, ...], Field(min_length=1)]] = Field(
        min_length=2, description="by name: the frames of one scene, which are left out together"
    )
    always: tuple[DataItem, ...] = Field(
        (),
        description="fitted every time, never scored; a scene or family of `configs/` by its name",
    )
    crops: Crops | None = Field(None, description="fit on windows; on full frames if left out")


class _ScoredFilter(FilterSpec):
    """A filter that may have nothing to be fitted."""

    free: dict[str, FreeRange] = Field(
        default_factory=dict, description="as in a fit; without any the filter is only scored"
    )


class CrossfitEntry(Config):
    """One filter; what is left out is as for all."""

    filter: _ScoredFilter
    methods: tuple[Method, ...] | None = Field(None, min_length=1, description="as in a fit")
    crops: Crops | None = Field(None, description="windows to fit on")

    @property
    def is_fitted(self) -> bool:
        """Whether it has free parameters."""
        return bool(self.filter.free)


class Bootstrap(Config):
    """Intervals: how far the figures would go with other parts of the same images."""

    tile: int = Field(64, ge=8, description="edge of the parts that are drawn again, px")
    draws: int = Field(2000, ge=10, description="number of draws")
    level: float = Field(0.95, gt=0, lt=1, description="share of the draws within an interval")
    seed: int = Field(0, ge=0, description="of the draws")


class CrossfitConfig(Config):
    """One evaluation: `torchblur crossfit CONFIG`."""

    title: str = Field("One case left out", description="heading")
    data: CrossfitData
    filters: dict[str, CrossfitEntry] = Field(min_length=1, description="by name, unique")
    methods: tuple[Method, ...] | None = Field(
        None, min_length=1, description="of the filters that name none"
    )
    objective: ObjectiveSpec = Field(default_factory=ObjectiveSpec)
    bootstrap: Bootstrap = Field(default_factory=Bootstrap)
    targets: dict[Target, float] = Field(
        default_factory=dict,
        description="against `line`: greatest ratios of FLIP, least gains of PSNR in dB",
    )
    seed: int = Field(0, ge=0, description="of each fit")
    device: str = Field("auto", description="auto, cpu, cuda, cuda:1 …")
    engine: EngineChoice = Field("auto", description="as in a fit")

    @property
    def folds(self) -> tuple[tuple[str, str], ...]:
        """Names of filter and left-out case of each fit, in order."""
        fitted = [name for name, entry in self.filters.items() if entry.is_fitted]
        return tuple((name, case) for name in fitted for case in self.data.cases)

    def scored(self, case: str) -> tuple[DataItem, ...]:
        """Return the items of a case as they are scored: weights belong to a fit."""
        items = self.data.cases[case]
        return tuple(item.model_copy(update={"weight": None}) for item in items)

    def fold(self, name: str, case: str, place: str = "") -> TuneConfig:
        """Return the resolved configuration of one fit.

        Args:
            name: A filter that is fitted.
            case: What is left out; it is the fit's hold-out.
            place: Name for messages.

        Raises:
            ConfigError: a method that does not suit the filter; families with common seeds.
        """
        entry = self.filters[name]
        others = [item for c, items in self.data.cases.items() if c != case for item in items]
        crops = self.data.crops if entry.crops is None else entry.crops
        data = {
            "filter": entry.filter.model_dump(),
            "data": {
                "root": self.data.root,
                "train": [item.model_dump() for item in (*others, *self.data.always)],
                "holdout": [item.model_dump() for item in self.scored(case)],
                "crops": None if crops is None else crops.model_dump(),
            },
            "objective": self.objective.model_dump(),
            "methods": smooth_by_default(
                entry.methods or self.methods or (),
                entry.filter.free,
                declared(get_filter(entry.filter.kind).config_class),
            ),
            "seed": self.seed,
            "device": self.device,
            "engine": self.engine,
        }
        return resolve(build(TuneConfig, data, place), place)


def load_crossfit_config(path: str | Path, overrides: Sequence[str] = ()) -> CrossfitConfig:
    """Read a configuration and check all of it.

    Args:
        path: A YAML file; paths in it are relative to it.
        overrides: "key.path=value", value in YAML: ``seed=3``, ``data.root=/frames``. A `data.root`
            given here is relative to the working folder.

    Returns:
        The configuration with absolute paths and without reference to a preset.

    Raises:
        ConfigError: each mistake, with file and key path.
        FileFormatError: no such file.
    """
    path = Path(path)
    config = build(CrossfitConfig, apply_overrides(load_yaml(path), overrides), str(path))
    own_root = any(text.startswith("data.root=") for text in overrides)
    root = (Path.cwd() if own_root else path.parent) / config.data.root
    config = config.model_copy(
        update={
            "data": config.data.model_copy(
                update={
                    "root": str(root.resolve()),
                    "always": tuple(_found(item, root) for item in config.data.always),
                }
            ),
            "filters": {
                name: _resolved(config, name, str(path), path.parent) for name in config.filters
            },
        }
    )
    if "mean" in config.data.cases:
        raise ConfigError(
            f"'mean' is what tables call the mean over the cases; give the case another name "
            f"({path}: data.cases.mean)"
        )
    for name, case in config.folds:
        config.fold(name, case, f"{path}: filters.{name}, without {case!r}")
    return config


def _found(item: DataItem, root: Path) -> DataItem:
    """Return an item whose scene or family is a file."""
    if not isinstance(item, (SceneData, FamilyData, SceneStreamData, FamilyStreamData)):
        return item
    return item.model_copy(update={"path": str(find_scene(item.path, root).resolve())})


def _resolved(config: CrossfitConfig, name: str, place: str, folder: Path) -> CrossfitEntry:
    entry = config.filters[name]
    if name == "sharp" or (name == "line" and entry.filter.kind != "line"):
        raise ConfigError(
            f"{name!r} is what all filters are compared with; give the entry another name "
            f"({place}: filters.{name})"
        )
    if entry.is_fitted and entry.methods is None and config.methods is None:
        raise ConfigError(
            f"{name!r} has free parameters, and neither it nor the file has `methods` "
            f"({place}: filters.{name})"
        )
    if not entry.is_fitted and entry.methods is not None:
        raise ConfigError(
            f"{name!r} has `methods` and no free parameters ({place}: filters.{name}.filter.free)"
        )
    spec = resolve_filter(entry.filter, f"{place}: filters.{name}", folder)
    return entry.model_copy(update={"filter": spec})
