"""What a study is told: data, variants, masks and plots; one YAML file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from torchblur.errors import ConfigError, nearest_name
from torchblur.filters import BlurFilter, TemporalBlur, get_filter
from torchblur.frame import Shutter, ShutterPosition
from torchblur.io import load_yaml
from torchblur.params import Config, build
from tuning.config.overrides import apply_overrides
from tuning.config.presets import SHUTTER_KEYS, named_filter
from tuning.render.scene import find_scene

__all__ = [
    "KEPT_SAMPLES",
    "Mask",
    "StudyConfig",
    "StudyExr",
    "StudyItem",
    "StudyPlot",
    "StudyScene",
    "StudyVariant",
    "load_study_config",
    "make_filter",
]

KEPT_SAMPLES = 4
"""Samples per pixel of a stream that filters can have; of more only the mean colors are kept."""

Mask = Literal["band", "moving", "ray_mask", "hidden"]
"""Where figures are taken beside the whole image.

band: at moving borders. moving: where something moves in the sharp frame or in a sample. ray_mask:
where Tan 2022 asks for rays. hidden: where the reference shows background behind a moving object.
"""


class _Item(Config):
    name: str = Field(min_length=1, description="short label, unique")
    shutter: float = Field(0.5, ge=0, description="open time in frames")
    shutter_position: ShutterPosition = Field(
        "centered", description="open around the frame's time, after it, or before it"
    )
    count: int = Field(1, ge=1, description="number of consecutive frames")
    cuts: tuple[int, ...] = Field((), description="positions of frames that begin a new shot")
    revealed: bool = Field(False, description="whether there is a layer of what lies behind")
    picture: int | None = Field(
        None, ge=0, description="position of the frame that is shown; the middle one if left out"
    )

    @property
    def exposure(self) -> Shutter:
        """The shutter of the references, and of the stream's times."""
        return Shutter(self.shutter, self.shutter_position)

    @property
    def shown(self) -> int:
        """Position of the frame that is shown."""
        return self.count // 2 if self.picture is None else min(self.picture, self.count - 1)


class StudyScene(_Item):
    """Frames of a scene, rendered by torchblur and cached."""

    kind: Literal["scene"]
    path: str = Field(description="scene file, or a name in configs/scenes")
    size: str = Field("240x136", pattern=r"^[1-9]\d*x[1-9]\d*$", description="WIDTHxHEIGHT in px")
    first: float = Field(0.0, description="time of the first frame, in frames")
    spp: int = Field(256, ge=2, description="samples per pixel of the references")
    color_spp: int = Field(16, ge=1, description="samples per pixel of the sharp color")
    stream_spp: int = Field(0, ge=0, description="samples per pixel of the stream; 0: no stream")
    references: tuple[Literal["center", "box"], ...] = Field(
        ("box",),
        min_length=1,
        description="mean over the time at the pixel's center, to which a stream converges, or "
        "over the pixel's area too",
    )
    revealed_spp: int = Field(16, ge=1, description="samples per pixel of the revealed color")
    seed: int = Field(0, ge=0, description="seed of the renderer")
    camera: dict[str, Any] = Field(
        default_factory=dict, description="values over those of the scene's camera: its velocity …"
    )

    @property
    def height_width(self) -> tuple[int, int]:
        """Height and width in px."""
        width, height = (int(part) for part in self.size.split("x"))
        return height, width


class StudyExr(_Item):
    """Frames of another renderer, as EXR files in one folder."""

    kind: Literal["exr"]
    path: str = Field(".", description="folder")
    first: int = Field(1, ge=0, description="number that #### stands for in the first frame")
    sharp: str = Field("sharp.exr", description="sharp render; #### stands for the frame number")
    gbuffer: str | None = Field(
        None, description="file with depth, velocity … if they are not in the sharp render's"
    )
    stream: tuple[str, ...] = Field((), description="samples with their times, one file for each")
    references: dict[str, str] = Field(
        default_factory=lambda: {"reference": "reference.exr"},
        min_length=1,
        description="renders with motion blur, by name",
    )
    converged: str | None = Field(
        None, description="name of the reference that the stream converges to, if there is one"
    )
    revealed_color: str | None = Field(None, description="file of what lies behind")
    revealed_gbuffer: str | None = Field(None, description="its layers, if they are in another")
    convention: str = Field("auto", description="whose channel names and signs")

    @field_validator("stream", mode="before")
    @classmethod
    def _one_or_several(cls, value: object) -> object:
        return (value,) if isinstance(value, str) else value


StudyItem = Annotated[StudyScene | StudyExr, Field(discriminator="kind")]


class StudyVariant(Config):
    """An image that is measured: raw input, or a filter on it."""

    name: str = Field(min_length=1, description="short label, unique")
    input: Literal["sharp", "stream"] = Field(
        "sharp", description="the frame at the middle of the shutter, or samples with their times"
    )
    samples: int = Field(1, ge=1, description="samples per pixel of the stream")
    filter: str | None = Field(
        None, description="registered name or path of a preset; the input itself if left out"
    )
    params: dict[str, Any] = Field(default_factory=dict, description="values over its own")
    revealed: Literal["none", "all", "mask"] = Field(
        "none",
        description="what lies behind: not given, given, or given where Tan 2022 asks for it",
    )
    layer: str = Field(
        "color", description="which layer of the filter is the image: the result, or a stage's"
    )
    only: tuple[str, ...] = Field((), description="names of the data; all if left out")


class StudyPlot(Config):
    """Curves over the frames of a sequence."""

    name: str = Field(pattern=r"^[\w-]+$", description="part of the file's name")
    title: str = Field("", description="heading")
    variants: tuple[str, ...] = Field(min_length=1, description="names, one color each")


class StudyConfig(Config):
    """One study: `torchblur study CONFIG`."""

    title: str = Field(min_length=1, description="heading of the report")
    data: tuple[StudyItem, ...] = Field(min_length=1, description="frames and sequences")
    variants: tuple[StudyVariant, ...] = Field(min_length=1, description="what is measured")
    masks: tuple[Mask, ...] = Field((), description="where to measure beside the whole image")
    plots: tuple[StudyPlot, ...] = Field((), description="curves over the frames")
    pictures: tuple[str, ...] = Field((), description="variants in the pictures; all if left out")
    mask_params: dict[str, Any] = Field(
        default_factory=dict, description="parameters of tan2022 that ray masks are made with"
    )
    worth: tuple[str, ...] = Field(
        (), description="variants whose worth in raw samples per pixel is asked for"
    )

    def variants_of(self, item: StudyScene | StudyExr) -> list[StudyVariant]:
        """Return the variants that are measured on some data."""
        return [v for v in self.variants if not v.only or item.name in v.only]


def load_study_config(path: str | Path, overrides: Sequence[str] = ()) -> StudyConfig:
    """Read a study's configuration and check all of it, filters and scenes as well.

    Args:
        path: A YAML file; paths in it are relative to it.
        overrides: "key.path=value", value in YAML: ``data.0.count=8``.

    Returns:
        The configuration with absolute paths, and presets replaced by what is in them.

    Raises:
        ConfigError: unknown filter, parameter, scene or name, a value out of range; with file
            and key.
        FileFormatError: no such file.
    """
    path = Path(path)
    place = f"{path} and --set" if overrides else str(path)
    config = build(StudyConfig, apply_overrides(load_yaml(path), overrides), place)
    data = tuple(
        _with_path(item, path.parent, f"{place}: data.{index}.path")
        for index, item in enumerate(config.data)
    )
    variants = tuple(
        _with_preset(variant, path.parent, f"{place}: variants.{index}")
        for index, variant in enumerate(config.variants)
    )
    config = config.model_copy(update={"data": data, "variants": variants})
    _check_names(config, place)
    for index, variant in enumerate(config.variants):
        _check_variant(config, variant, f"{place}: variants.{index}")
    return config


def make_filter(variant: StudyVariant) -> BlurFilter | None:
    """Return a variant's filter, or None for raw input."""
    return None if variant.filter is None else get_filter(variant.filter)(**variant.params)


# -- checks ----------------------------------------------------------------------------------------


def _with_path(item: StudyScene | StudyExr, folder: Path, place: str) -> StudyScene | StudyExr:
    if isinstance(item, StudyExr):
        found = (folder / item.path).resolve()
        if not found.is_dir():
            raise ConfigError(f"the folder {found} does not exist ({place})")
    else:
        found = find_scene(item.path, folder, place).resolve()
    return item.model_copy(update={"path": str(found)})


def _with_preset(variant: StudyVariant, folder: Path, place: str) -> StudyVariant:
    if variant.filter is None:
        return variant
    name, params = named_filter(variant.filter, folder, f"{place}.filter")
    return variant.model_copy(update={"filter": name, "params": params | variant.params})


def _check_names(config: StudyConfig, place: str) -> None:
    for key in ("data", "variants", "plots"):
        names = [entry.name for entry in getattr(config, key)]
        for index, name in enumerate(names):
            if name in names[:index]:
                raise ConfigError(f"two of them are called {name!r} ({place}: {key}.{index}.name)")
    known = [variant.name for variant in config.variants]
    for index, plot in enumerate(config.plots):
        _check_known(plot.variants, known, f"{place}: plots.{index}.variants")
    _check_known(config.pictures, known, f"{place}: pictures")
    _check_known(config.worth, known, f"{place}: worth")


def _check_known(names: Sequence[str], known: Sequence[str], where: str) -> None:
    for name in names:
        if name not in known:
            raise ConfigError(f"no variant is called {name!r}{nearest_name(name, known)} ({where})")


def _check_variant(config: StudyConfig, variant: StudyVariant, where: str) -> None:
    _check_known_data(config, variant, where)
    for item in config.data:
        if variant.revealed != "none" and (not variant.only or item.name in variant.only):
            _check_revealed(config, item, where)
    if variant.filter is None:
        if variant.params or variant.revealed != "none" or variant.layer != "color":
            raise ConfigError(f"`params`, `revealed` and `layer` need a `filter` ({where})")
    else:
        _check_filter(variant, where)
    if variant.input == "stream":
        for item in config.data:
            if not variant.only or item.name in variant.only:
                _check_samples(variant, item, where)


def _check_known_data(config: StudyConfig, variant: StudyVariant, where: str) -> None:
    names = [item.name for item in config.data]
    for name in variant.only:
        if name not in names:
            raise ConfigError(
                f"no data is called {name!r}{nearest_name(name, names)} ({where}.only)"
            )


def _check_revealed(config: StudyConfig, item: StudyScene | StudyExr, where: str) -> None:
    if not item.revealed or (isinstance(item, StudyExr) and item.revealed_color is None):
        hint = "`revealed: true`" + (" and `revealed_color`" if isinstance(item, StudyExr) else "")
        raise ConfigError(
            f"{item.name!r} has no layer of what lies behind: it needs {hint} ({where}.revealed)"
        )
    if "ray_mask" not in config.masks:
        raise ConfigError(f"`revealed` needs `ray_mask` among the masks ({where}.revealed)")


def _check_filter(variant: StudyVariant, where: str) -> None:
    assert variant.filter is not None
    kind = get_filter(variant.filter)
    for key in SHUTTER_KEYS:
        if key in variant.params:
            raise ConfigError(f"`{key}` belongs to the data ({where}.params.{key})")
    build(kind.config_class, variant.params, f"{where}.params")
    if variant.input == "sharp" and "time" in kind.needs:
        raise ConfigError(
            f"{variant.filter} needs samples with their times: `input: stream` ({where}.input)"
        )
    if variant.samples > 1 and not issubclass(kind, TemporalBlur):
        raise ConfigError(f"{variant.filter} takes one sample per pixel ({where}.samples)")
    if variant.samples > KEPT_SAMPLES:
        raise ConfigError(
            f"a filter can have {KEPT_SAMPLES} samples, got {variant.samples} ({where}.samples)"
        )


def _check_samples(variant: StudyVariant, item: StudyScene | StudyExr, where: str) -> None:
    if isinstance(item, StudyExr):
        have, raw = len(item.stream), item.converged is not None and variant.filter is None
        if have and raw:
            return  # what more samples would give is estimated
    else:
        have = item.stream_spp
    if variant.samples > have:
        raise ConfigError(
            f"{variant.name!r} takes {variant.samples} samples per pixel and {item.name!r} has "
            f"{have} ({where}.samples; `only` names the data of a variant)"
        )
    if variant.filter is None and variant.samples & (variant.samples - 1):
        raise ConfigError(
            f"raw input has 1, 2, 4, 8 … samples, got {variant.samples} ({where}.samples)"
        )
