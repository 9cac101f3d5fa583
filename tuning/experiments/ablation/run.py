"""Tables of claims: a filter with a feature off and on, against the reference of one scene.

Each row of a configuration names what somebody claims, the scene that should show it, and the
parameters without and with the feature. A run measures all rows and says which claims show.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field
from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.filters import BlurFilter, get_filter
from torchblur.frame import LONGEST_SHUTTER, ShutterPosition
from torchblur.io import load_yaml
from torchblur.params import Config, build
from tuning.config.data import DataItem, DataSpec, ExrData, SceneData
from tuning.config.overrides import apply_overrides
from tuning.config.presets import SHUTTER_KEYS
from tuning.data.cases import Case
from tuning.data.loading import load_cases
from tuning.data.variants import Variant, render
from tuning.progress import Progress, Stage
from tuning.render.scene import find_scene
from tuning.scoring.cases import noise_scores, score_image

__all__ = [
    "AblationConfig",
    "AblationRow",
    "ExrCase",
    "Measured",
    "Outcome",
    "load_ablation_config",
    "run_ablation",
    "verdict_of",
]

Outcome = Literal["shows", "does not show", "mixed"]
Scores = Mapping[str, float | None]

_RENDER_KEYS = ("size", "spp", "color_spp", "shutter", "shutter_position", "seed")
_BETTER = {"flip": 0.01, "psnr": 0.05}  # least gain that counts: relative, dB
_COMPARABLE = {"flip": 0.05, "psnr": 0.25}  # largest loss that does not count: relative, dB


class ExrCase(ExrData):
    """One frame of another renderer, as EXR files in one folder."""

    kind: Literal["exr"] = "exr"


class AblationRow(Config):
    """A claim, the scene that should show it, and the parameters without and with the feature."""

    name: str = Field(min_length=1, description="short label, unique")
    claim: str = Field(min_length=1, description="what is claimed, with the section of the paper")
    scene: str | None = Field(None, description="name in configs/scenes, or a path")
    exr: ExrCase | None = Field(None, description="EXR files instead of a scene")
    filter: str = Field(description="registered name of a filter")
    params: dict[str, Any] = Field(default_factory=dict, description="values that both share")
    off: dict[str, Any] = Field(default_factory=dict, description="values without the feature")
    on: dict[str, Any] = Field(default_factory=dict, description="values with the feature")
    expect: Literal["better", "comparable"] = Field(
        "better", description="whether the feature improves the image, or only must not spoil it"
    )
    frame: float = Field(0.0, description="time of the scene, in frames")
    size: str | None = Field(None, description="WIDTHxHEIGHT in px; the table's if left out")
    spp: int | None = Field(None, description="samples per pixel of the reference; the table's")
    color_spp: int | None = Field(None, description="of the sharp color; the table's")
    shutter: float | None = Field(None, description="open time in frames; the table's")
    shutter_position: ShutterPosition | None = Field(None, description="the table's if left out")
    seed: int | None = Field(None, description="seed of the renderer; the table's if left out")

    def values(self, which: Literal["off", "on"]) -> dict[str, Any]:
        """Return all parameters of one side."""
        return self.params | (self.on if which == "on" else self.off)


class AblationConfig(Config):
    """One table: `torchblur ablate CONFIG`."""

    title: str = Field("Claims", description="heading of the table")
    size: str = Field("240x136", description="WIDTHxHEIGHT in px")
    spp: int = Field(64, ge=2, description="samples per pixel of the references")
    color_spp: int = Field(16, ge=1, description="samples per pixel of the sharp colors")
    shutter: Annotated[float, Field(ge=0, le=LONGEST_SHUTTER)] = Field(
        0.5, description="open time in frames"
    )
    shutter_position: ShutterPosition = "centered"
    seed: int = Field(0, ge=0, description="seed of the renderer")
    time_runs: int = Field(
        3, ge=0, le=100, description="timed calls of each side, the median counts; 0: no times"
    )
    rows: tuple[AblationRow, ...] = Field(min_length=1, description="the claims")


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """A row of the table.

    Args:
        row: What was measured.
        case: The frame and its reference.
        images: "off" and "on", scene-linear, (1, 3, H, W).
        scores: What `evaluate` returns by image: "off", "on", "sharp", and for rendered scenes
            "noise": what a perfect image would score, as the reference is noisy.
        seconds: CPU-seconds of a call, "off" and "on"; empty if it was not timed.
        verdict: Whether the claim shows.
    """

    row: AblationRow
    case: Case
    images: Mapping[str, Tensor]
    scores: Mapping[str, Scores]
    seconds: Mapping[str, float]
    verdict: Outcome

    @property
    def time_ratio(self) -> float | None:
        """CPU-seconds with the feature over those without it."""
        return self.seconds["on"] / self.seconds["off"] if self.seconds else None

    def gain(self, key: str) -> float | None:
        """Return how much better a figure is with the feature.

        Args:
            key: "flip_band", "psnr" ... FLIP as a share of the figure without the feature.
        """
        return _gain(key, self.scores["off"].get(key), self.scores["on"].get(key))


def load_ablation_config(path: str | Path, overrides: Sequence[str] = ()) -> AblationConfig:
    """Read a table's configuration and check all of it, parameters and scenes as well.

    Args:
        path: A YAML file; paths in it are relative to it.
        overrides: "key.path=value", value in YAML: ``size=640x360``, ``rows.0.on.num_samples=9``.

    Returns:
        The configuration with absolute paths of scenes.

    Raises:
        ConfigError: unknown filter, parameter or scene, a value out of range; with file and key.
        FileFormatError: no such file.
    """
    path = Path(path)
    place = f"{path} and --set" if overrides else str(path)
    config = build(AblationConfig, apply_overrides(load_yaml(path), overrides), place)
    rows = tuple(
        _resolved(row, path.parent, f"{place}: rows.{index}")
        for index, row in enumerate(config.rows)
    )
    config = config.model_copy(update={"rows": rows})
    _check_rows(config, place)
    return config


def run_ablation(config: AblationConfig, progress: Progress | None = None) -> list[Measured]:
    """Measure all rows; a scene that several of them share is rendered once.

    Args:
        config: What `load_ablation_config` returned, or one made in Python.
        progress: Told after each row.

    Raises:
        ConfigError: unknown filter, parameter or scene, a value out of range.
        TorchblurError: files that cannot be read.
    """
    _check_rows(config)
    cases: dict[str, Case] = {}
    stage = Stage("claims", len(config.rows), progress)
    stage.step(0)
    measured = []
    for index, row in enumerate(config.rows):
        item = _item(config, row, f"rows.{index}")
        key = item.model_dump_json()
        if key not in cases:
            cases[key] = _load(item, f"rows.{index}")
        measured.append(_measure(row, cases[key], config.time_runs))
        stage.step(index + 1, message=row.name)
    return measured


def verdict_of(off: Scores, on: Scores, expect: str = "better") -> Outcome:
    """Return whether a feature does what is claimed.

    FLIP and PSNR in the band at moving borders are asked, over the image if nothing moves. Each
    says yes if it is better by at least 1 % (FLIP) or 0.05 dB (PSNR); where the claim is that the
    result is comparable, if it is not worse by more than 5 % or 0.25 dB.

    Args:
        off: Figures without the feature.
        on: Figures with it.
        expect: "better" or "comparable".

    Returns:
        "shows" if both say yes, "does not show" if both say no, "mixed" if they disagree.
    """
    mask = "_band" if off.get("flip_band") is not None else ""
    votes = set()
    for metric in ("flip", "psnr"):
        gain = _gain(metric, off.get(f"{metric}{mask}"), on.get(f"{metric}{mask}")) or 0.0
        votes.add(gain >= (_BETTER[metric] if expect == "better" else -_COMPARABLE[metric]))
    if len(votes) == 2:
        return "mixed"
    return "shows" if votes.pop() else "does not show"


def _gain(key: str, off: float | None, on: float | None) -> float | None:
    if off is None or on is None:
        return None
    if not key.startswith("flip"):
        return on - off
    return (off - on) / off if off else -on


# -- one row ---------------------------------------------------------------------------------------


def _measure(row: AblationRow, case: Case, time_runs: int) -> Measured:
    blur = get_filter(row.filter)()
    sides = {side: _variant(blur, row, side) for side in ("off", "on")}
    images = {side: render(variant, case) for side, variant in sides.items()}
    found = {side: score_image(case, side, image) for side, image in images.items()}
    found["sharp"] = score_image(case, "sharp", case.frame.color)
    if case.variance is not None:
        found["noise"] = noise_scores(case)
    scores = {name: score.scores for name, score in found.items()}
    return Measured(
        row=row,
        case=case,
        images=images,
        scores=scores,
        seconds=_seconds(sides, case, time_runs),
        verdict=verdict_of(scores["off"], scores["on"], row.expect),
    )


def _variant(blur: BlurFilter, row: AblationRow, side: Literal["off", "on"]) -> Variant:
    return Variant(name=side, blur=type(blur)(**row.values(side)))


def _seconds(sides: Mapping[str, Variant], case: Case, runs: int) -> dict[str, float]:
    """Return medians of CPU-seconds; the sides take turns, so that drift of the machine cancels."""
    taken: dict[str, list[float]] = {side: [] for side in sides} if runs else {}
    for _ in range(runs):
        for side, variant in sides.items():
            began = time.process_time()
            render(variant, case)
            taken[side].append(time.process_time() - began)
    return {side: statistics.median(times) for side, times in taken.items()}


def _load(item: DataItem, place: str) -> Case:
    cases = [case for case in load_cases(DataSpec(train=(item,))) if isinstance(case, Case)]
    if len(cases) != 1:
        raise ConfigError(
            f"a row takes one frame, got {len(cases)}; give `frames: [N]` ({place}.exr)"
        )
    return cases[0]


# -- checks ----------------------------------------------------------------------------------------


def _resolved(row: AblationRow, folder: Path, place: str) -> AblationRow:
    """Return the row with the absolute path of its scene or of its files."""
    if row.exr is not None:
        path = str((folder / row.exr.path).resolve())
        return row.model_copy(update={"exr": row.exr.model_copy(update={"path": path})})
    if row.scene is None:
        return row
    return row.model_copy(
        update={"scene": str(find_scene(row.scene, folder, f"{place}.scene").resolve())}
    )


def _check_rows(config: AblationConfig, place: str = "") -> None:
    place = f"{place}: " if place else ""
    names = [row.name for row in config.rows]
    for index, row in enumerate(config.rows):
        where = f"{place}rows.{index}"
        if row.name in names[:index]:
            raise ConfigError(f"two rows are called {row.name!r} ({where}.name)")
        _check_params(row, where)
        _item(config, row, where)


def _check_params(row: AblationRow, where: str) -> None:
    try:
        model = get_filter(row.filter).config_class
    except ConfigError as error:
        raise ConfigError(f"{error} ({where}.filter)") from error
    for side in ("params", "off", "on"):
        values: dict[str, Any] = getattr(row, side)
        for key in SHUTTER_KEYS:
            if key in values:
                raise ConfigError(
                    f"`{key}` belongs to the row, as the reference needs it too "
                    f"({where}.{side}.{key})"
                )
        build(model, values, f"{where}.{side}")
    if row.values("off") == row.values("on"):
        raise ConfigError(f"`off` and `on` are the same parameters: {row.off} ({where}.on)")


def _item(config: AblationConfig, row: AblationRow, where: str) -> DataItem:
    """Return what the row's case is loaded from."""
    if (row.scene is None) == (row.exr is None):
        raise ConfigError(f"a row needs `scene` or `exr`, and not both ({where})")
    own = {key: getattr(row, key) for key in _RENDER_KEYS if getattr(row, key) is not None}
    if row.exr is not None:
        if own:
            key = next(iter(own))
            raise ConfigError(f"`{key}` is for scenes; `exr` has its own shutter ({where}.{key})")
        return row.exr
    assert row.scene is not None
    shared = {key: getattr(config, key) for key in _RENDER_KEYS}
    path = str(find_scene(row.scene, place=f"{where}.scene").resolve())
    data = {"kind": "scene", "path": path, "frames": [row.frame]} | shared | own
    return build(SceneData, data, where)
