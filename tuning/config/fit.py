"""What a fit is told: filter, data, objective, methods; one YAML file.

Every mistake is one `ConfigError` with the file and the key path. Paths under `data` are relative
to `data.root`, which is relative to the file itself; `filter.kind` may be a preset's path, relative
to the file too. `data` may be the path of a file that holds this section, for several fits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field, create_model, field_validator

from torchblur.errors import ConfigError, FileFormatError, nearest_name
from torchblur.filters import get_filter
from torchblur.io import load_yaml
from torchblur.ops.compiling import EngineChoice
from torchblur.params import Config, build, choices, declared, idle
from tuning.config.cost_limits import check_costs
from tuning.config.data import DataSpec
from tuning.config.methods import GradientMethod, Method, check_method, check_refresh
from tuning.config.objective import ObjectiveSpec
from tuning.config.overrides import apply_overrides
from tuning.config.presets import SHUTTER_KEYS, named_filter

__all__ = [
    "FilterSpec",
    "FreeRange",
    "TuneConfig",
    "free_names",
    "load_tune_config",
    "resolve",
    "resolve_filter",
]


class FreeRange(Config):
    """Where a free parameter may lie; the declared range if nothing is given."""

    low: float | None = Field(None, description="least value, included")
    high: float | None = Field(None, description="greatest value, included")
    choices: tuple[bool | int | float | str, ...] | None = Field(
        None, min_length=1, description="values to choose from; for integers, switches, choices"
    )


class FilterSpec(Config):
    """The filter, what is fixed, and what is free."""

    kind: str = Field(description="registered name of a filter, or the path of a preset")
    params: dict[str, Any] = Field(
        default_factory=dict, description="fixed values; of free ones, where the fit starts"
    )
    free: dict[str, FreeRange] = Field(
        min_length=1, description="names of the free parameters, or a mapping name: {low, high}"
    )

    @field_validator("free", mode="before")
    @classmethod
    def _names_to_mapping(cls, value: Any) -> Any:
        if isinstance(value, (list, tuple)):
            return {str(name): {} for name in value}
        if isinstance(value, dict):
            return {name: {} if item is None else item for name, item in value.items()}
        return value


class TuneConfig(Config):
    """One fit: `torchblur tune CONFIG`; in the file `data` may be the path of another one."""

    filter: FilterSpec
    data: DataSpec
    objective: ObjectiveSpec = Field(default_factory=ObjectiveSpec)
    methods: tuple[Method, ...] = Field(
        default_factory=lambda: (GradientMethod(kind="gradient"),),
        min_length=1,
        description="run in this order; the best on the training frames becomes the preset",
    )
    ceiling_steps: int = Field(
        0,
        ge=0,
        description="gradient steps for the best parameters of each single frame; 0: leave it out",
    )
    seed: int = Field(0, ge=0, description="of starts, windows, batches and samplers")
    device: str = Field("auto", description="auto, cpu, cuda, cuda:1 …")
    engine: EngineChoice = Field(
        "auto", description="eager, compiled, or auto: compiled if there is so much to do"
    )


def load_tune_config(path: str | Path, overrides: Sequence[str] = ()) -> TuneConfig:
    """Read a configuration and check all of it.

    Args:
        path: A YAML file.
        overrides: "key.path=value", value in YAML: ``seed=3``, ``data.root=/frames``,
            ``methods.0.steps=50``. A `data.root` given here is relative to the working folder.

    Returns:
        The configuration with absolute paths and without reference to a preset.

    Raises:
        ConfigError: each mistake in a line, with file and key path.
        FileFormatError: no such file.
    """
    path = Path(path)
    content = _with_shared_data(load_yaml(path), path, overrides)
    config = build(TuneConfig, content, str(path))
    own_root = any(text.startswith("data.root=") for text in overrides)
    return resolve(config, str(path), path.parent, Path.cwd() if own_root else None)


def _with_shared_data(
    content: Mapping[str, Any], path: Path, overrides: Sequence[str] = ()
) -> dict[str, Any]:
    """Return a configuration's content with overrides, and with `data` read from its file if any.

    The file holds what would stand under `data`; its `root` is relative to itself. Overrides of
    single values (``data.train.0.spp=8``) count for what was read; ``data=other.yaml`` takes
    another file, relative to the working folder.

    Args:
        content: As the YAML file gives it; left as it is.
        path: The configuration's file.
        overrides: "key.path=value", value in YAML.

    Raises:
        ConfigError: no such file, or a mistake in it; with its name and the key.
    """
    whole = [text for text in overrides if text.startswith("data=")]
    content = apply_overrides(content, whole)
    if isinstance(content.get("data"), str):
        folder = Path.cwd() if whole else path.parent
        content = content | {"data": _read_data(folder / content["data"], f"{path}: data")}
    return apply_overrides(content, [text for text in overrides if text not in whole])


def resolve(
    config: TuneConfig, place: str = "", folder: Path | None = None, root_folder: Path | None = None
) -> TuneConfig:
    """Check what spans several keys, make paths absolute, and replace a preset by its content.

    Args:
        config: A configuration; an already resolved one comes back equal.
        place: Name for messages.
        folder: What relative paths are relative to; the working folder if left out.
        root_folder: The same for `data.root` alone, if it differs.

    Raises:
        ConfigError: unknown filter or parameter, value out of range, a gradient fit of a
            parameter without a gradient, new scenes without a family.
    """
    folder = Path.cwd() if folder is None else folder
    filter_spec = resolve_filter(config.filter, place, folder)
    if config.objective.reduction != "mean" and config.data.is_weighted:
        raise ConfigError(
            "weights of the data (`weight`, crops.unbiased) belong to a mean, got "
            f"{config.objective.reduction!r} ({_join(place, 'objective.reduction')})"
        )
    root = str(((root_folder or folder) / config.data.root).resolve())
    config = config.model_copy(
        update={"filter": filter_spec, "data": config.data.model_copy(update={"root": root})}
    )
    names = [free_names(config, index, place) for index in range(len(config.methods))]
    check_costs(config, names, place)
    for index, method in enumerate(config.methods):
        check_refresh(method, config.data.train, _join(place, f"methods.{index}"))
    return config


def resolve_filter(spec: FilterSpec, place: str, folder: Path) -> FilterSpec:
    """Check a filter's parameters and ranges, and replace a preset by its content.

    Args:
        spec: The filter.
        place: Name for messages.
        folder: What a preset's path is relative to.

    Raises:
        ConfigError: unknown filter or parameter, value out of range.
    """
    spec = _checked_params(_without_preset(spec, place, folder), place)
    for name, limits in spec.free.items():
        _check_range(spec, name, limits, f"{place}: " if place else "")
    _check_acts(spec, place)
    return spec


def free_names(config: TuneConfig, index: int, place: str = "") -> tuple[str, ...]:
    """Return the parameters that a method fits, or refuse those that it cannot.

    A gradient method takes smooth parameters. It refuses discrete ones always; weak ones, whose
    gradient is zero or biased, unless the method itself names them in its `free`.

    Args:
        config: The configuration.
        index: Position in `methods`.
        place: Name for messages.

    Raises:
        ConfigError: unknown name, or one without a usable gradient.
    """
    method = config.methods[index]
    where = _join(place, f"methods.{index}")
    names = tuple(config.filter.free) if method.free is None else method.free
    specs = declared(get_filter(config.filter.kind).config_class)
    for name in names:
        if name not in config.filter.free:
            hint = nearest_name(name, config.filter.free)
            raise ConfigError(f"`{name}` is not among the free parameters{hint} ({where}.free)")
    check_method(method, names, specs, where)
    return names


# -- checks ----------------------------------------------------------------------------------------


def _read_data(path: Path, where: str) -> dict[str, Any]:
    try:
        data = load_yaml(path)
    except FileFormatError as error:
        raise ConfigError(
            f"`data` must be a mapping, or the path of a YAML file with one: {error} ({where})"
        ) from error
    spec = build(DataSpec, data, str(path))
    return data | {"root": str((path.parent / spec.root).resolve())}


def _without_preset(spec: FilterSpec, place: str, folder: Path) -> FilterSpec:
    kind, params = named_filter(spec.kind, folder, _join(place, "filter.kind"))
    return spec.model_copy(update={"kind": kind, "params": params | spec.params})


def _checked_params(spec: FilterSpec, place: str) -> FilterSpec:
    """Build the filter's own config where it stands in the file, so that errors name the place."""
    for key in SHUTTER_KEYS:
        if key in spec.params and key not in spec.free:
            raise ConfigError(
                f"`{key}` belongs to the items under data, which know how their references were "
                f"made; or name it under filter.free ({_join(place, f'filter.params.{key}')})"
            )
    inner: Any = get_filter(spec.kind).config_class
    data: Any = spec.params
    for key in ("params", "filter"):
        fields: Any = {key: (inner, ...)}
        inner, data = create_model(key, __base__=Config, **fields), {key: data}
    build(inner, data, place)
    return spec


def _check_range(spec: FilterSpec, name: str, limits: FreeRange, place: str) -> None:
    model = get_filter(spec.kind).config_class
    specs = declared(model)
    where = f"({place}filter.free.{name})"
    if name not in specs:
        raise ConfigError(
            f"unknown parameter `{name}` of {spec.kind}{nearest_name(name, specs)} {where}"
        )
    numeric = specs[name].low is not None
    narrowed = limits.low is not None or limits.high is not None
    if narrowed and (not numeric or limits.choices):
        raise ConfigError(f"`{name}` is given as choices and has no `low` and `high` {where}")
    if limits.choices is not None:
        if specs[name].grad != "discrete":
            raise ConfigError(f"`{name}` is continuous: give `low` and `high`, not choices {where}")
        for value in limits.choices:
            build(model, {name: value}, f"{place}filter.free.{name}.choices")
        return
    if not numeric:
        if not choices(model, name):
            raise ConfigError(f"`{name}` needs `choices` {where}")
        return
    _check_narrowed(spec, name, limits, where)


def _check_acts(spec: FilterSpec, place: str) -> None:
    """Refuse to fit what cannot change anything."""
    waiting = idle(get_filter(spec.kind).config_class, spec.params, {*spec.free, *SHUTTER_KEYS})
    for name in spec.free:
        if name in waiting:
            raise ConfigError(
                f"`{name}` of {spec.kind} acts only with `{waiting[name]}`: set that under "
                f"filter.params, or do not fit it ({_join(place, f'filter.free.{name}')})"
            )


def _check_narrowed(spec: FilterSpec, name: str, limits: FreeRange, where: str) -> None:
    declared_range = declared(get_filter(spec.kind).config_class)[name]
    low, high = declared_range.bounds
    new_low = low if limits.low is None else limits.low
    new_high = high if limits.high is None else limits.high
    if new_low < low or new_high > high:
        raise ConfigError(
            f"the range of `{name}` must lie within {declared_range.range_text}, "
            f"got [{new_low:g}, {new_high:g}] {where}"
        )
    if not new_low < new_high:
        raise ConfigError(
            f"`low < high` must hold for `{name}`, got {new_low:g} and {new_high:g} {where}"
        )
    start = spec.params.get(name)
    if start is not None and not new_low <= start <= new_high:
        raise ConfigError(
            f"`{name}` starts at {start:g}, outside its range [{new_low:g}, {new_high:g}] {where}"
        )


def _join(place: str, keys: str) -> str:
    return f"{place}: {keys}" if place else keys
