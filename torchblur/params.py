"""A parameter is declared once.

The declaration is a pydantic field whose annotation carries a `Param`::

    class MyConfig(Config):
        kappa: Annotated[float, Param(symbol="κ", unit="1", low=1, high=1000, scale="log",
                                      grad="smooth", source="Guertin 2014, section 4.3",
                                      meaning="bias of the center weight")] = 40.0

From it follow the validation and its message, the YAML keys, the JSON Schema, the `nn.Parameter`
of the filter, the search space of the black-box fit, the unit cube of the gradient fit, and the
table that `torchblur params` prints. Nothing about a parameter is written anywhere else.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, get_args

import torch
from pydantic import (
    BaseModel,
    ConfigDict,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
)
from pydantic_core import CoreSchema, PydanticCustomError, core_schema
from torch import Tensor

from torchblur.errors import ConfigError, nearest_name

__all__ = ["Config", "GradClass", "Param", "build", "choices", "declared", "idle"]

GradClass = Literal["smooth", "weak", "discrete"]

_CLAUSE = re.compile(r"(\w+) (==|!=|>) ([\w.]+)")
_COMPARE = {"==": operator.eq, "!=": operator.ne, ">": operator.gt}
ModelT = TypeVar("ModelT", bound=BaseModel)


@dataclass(frozen=True, kw_only=True)
class Param:
    """What is known of one parameter, beside its name, type and default.

    Args:
        meaning: One line: what it does, and in which direction.
        grad: "smooth": autograd's gradient is right and it becomes an `nn.Parameter`. "weak": a
            float that acts through sample positions or thresholds, so that with nearest lookups
            its gradient is zero or biased. "discrete": an integer, a switch or a choice.
        source: Paper and section, or who else uses it.
        symbol: The letter in the paper, if it has one.
        unit: "px", "frame", "1", "scene units", "taps" …
        low: Least valid value, included. Needed for numbers.
        high: Greatest valid value, included. Needed for numbers.
        scale: "log" if fits should work on its logarithm (then `low` must be positive).
        active_when: What others must be for it to act: "reach == frame", "tap_spacing > 0",
            "sampling == pairs and noise != none"; left out: always.
    """

    meaning: str
    grad: GradClass
    source: str
    symbol: str = ""
    unit: str = "1"
    low: float | None = None
    high: float | None = None
    scale: Literal["linear", "log"] = "linear"
    active_when: str = ""

    def __post_init__(self) -> None:
        clauses = self.active_when.split(" and ") if self.active_when else []
        if not all(_CLAUSE.fullmatch(clause) for clause in clauses):
            raise TypeError(f"Param: no condition: {self.active_when!r}")
        if (self.low is None) != (self.high is None):
            raise TypeError("Param: give both `low` and `high`, or neither")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise TypeError(f"Param: `low < high` must hold, got {self.low} and {self.high}")
        if self.scale == "log" and not (self.low or 0) > 0:
            raise TypeError(f"Param: a log scale needs `low > 0`, got {self.low}")

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and greatest valid value, both included.

        Raises:
            TypeError: if the parameter is a switch or a choice, which has no range.
        """
        if self.low is None or self.high is None:
            raise TypeError("this parameter is a choice and has no range")
        return self.low, self.high

    @property
    def conditions(self) -> tuple[tuple[str, str, Any], ...]:
        """What `active_when` says: name, comparison and value of each part."""
        found = _CLAUSE.findall(self.active_when)
        return tuple((name, compare, _literal(text)) for name, compare, text in found)

    @property
    def range_text(self) -> str:
        """The range with its unit, as it stands in messages: "[0.05, 20] px"."""
        low, high = self.bounds
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"[{low:g}, {high:g}]{unit}"

    def check(self, name: str, value: float | Tensor) -> None:
        """Refuse a value, or any element of a tensor of values, outside the range.

        Args:
            name: Name for the message.
            value: A number or a tensor of any shape.

        Raises:
            ConfigError: if the value is not finite or lies outside [low, high].
        """
        low, high = self.bounds
        if isinstance(value, Tensor):
            bad = ~((value >= low) & (value <= high))
            if not bool(bad.any()):
                return
            value = float(value[bad].flatten()[0])
        elif low <= value <= high:
            return
        raise ConfigError(f"`{name}` must lie in {self.range_text}, got {value:g}")

    def to_unit(self, value: Tensor) -> Tensor:
        """Map [low, high] to [0, 1], through the logarithm where the scale says so.

        Differentiable: yes, inside and outside the range.
        """
        low, high = self.bounds
        if self.scale == "log":
            return (value.log() - math.log(low)) / (math.log(high) - math.log(low))
        return (value - low) / (high - low)

    def from_unit(self, unit: Tensor) -> Tensor:
        """Map [0, 1] to [low, high]: the inverse of `to_unit`, never outside the range.

        Differentiable: yes, at the ends of the range too, where rounding may leave it: a fit that
        begins there must be able to go back.
        """
        low, high = self.bounds
        if self.scale == "log":
            value = torch.exp(unit * (math.log(high) - math.log(low)) + math.log(low))
        else:
            value = unit * (high - low) + low
        return value.detach().clamp(low, high) + (value - value.detach())

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        if self.low is None:
            return core_schema.bool_schema(strict=True) if source is bool else handler(source)
        number = core_schema.int_schema if source is int else core_schema.float_schema
        return core_schema.with_info_after_validator_function(self._validate, number(strict=True))

    def _validate(self, value: float, info: core_schema.ValidationInfo) -> float:
        try:
            self.check(info.field_name or "value", value)
        except ConfigError as error:
            raise PydanticCustomError("range", "{text}", {"text": str(error)}) from error
        return value

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        result = handler(schema)
        when = f"; acts when {self.active_when}" if self.active_when else ""
        result["description"] = f"{self.meaning} [{self.unit}] ({self.source}){when}"
        if self.low is not None:
            result |= {"minimum": self.low, "maximum": self.high}
        return result


class Config(BaseModel):
    """Base of every configuration: keyword-only, immutable, unknown keys refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def declared(model: type[BaseModel]) -> dict[str, Param]:
    """Return the declared parameters of a configuration class by name, in order.

    Args:
        model: A configuration class; fields without a `Param` are left out.
    """
    specs: dict[str, Param] = {}
    for name, field in model.model_fields.items():
        for item in field.metadata:
            if isinstance(item, Param):
                specs[name] = item
    return specs


def idle(
    model: type[BaseModel], values: Mapping[str, Any], free: Collection[str] = ()
) -> dict[str, str]:
    """Return the parameters that change nothing with these values, and what they wait for.

    What waits for a parameter that itself cannot act waits, too.

    Args:
        model: A configuration class.
        values: Of its parameters; the defaults of those that are left out.
        free: Names of parameters that may take any value: nothing waits for these.
    """
    specs = declared(model)
    given = {name: values.get(name, field.default) for name, field in model.model_fields.items()}

    def waits(name: str) -> str:
        spec = specs[name]
        for other, how, value in spec.conditions:
            if other not in free and not _COMPARE[how](given[other], value):
                return next(c for c in spec.active_when.split(" and ") if c.startswith(f"{other} "))
            if reason := waits(other):
                return reason
        return ""

    return {name: reason for name in specs if (reason := waits(name))}


def _literal(text: str) -> Any:
    """Return what a word of a condition stands for: a switch, a number or a choice."""
    if text in ("true", "false"):
        return text == "true"
    try:
        return float(text)
    except ValueError:
        return text


def choices(model: type[BaseModel], name: str) -> tuple[Any, ...]:
    """Return the valid values of a switch or a choice, or an empty tuple for a number.

    Args:
        model: A configuration class.
        name: One of its fields.
    """
    annotation = model.model_fields[name].annotation
    if annotation is bool:
        return (False, True)
    return get_args(annotation)


def build(model: type[ModelT], data: object, place: str = "") -> ModelT:
    """Make a configuration from plain data, with one clear error if that cannot be done.

    Args:
        model: The configuration class.
        data: Nested dicts, lists and scalars, as a YAML file gives them.
        place: Where the data came from, for the message ("configs/tune/x.yaml", "--set").

    Returns:
        The validated configuration.

    Raises:
        ConfigError: the rule, the value, the place (file and key path), and a hint. All mistakes
            of the data are listed, one a line.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        items = [dict(item) for item in error.errors()]
        lines = [_explain(item, model, data, place) for item in items if not _follows(item, items)]
        raise ConfigError("\n".join(lines)) from error


def _follows(error: dict[str, Any], others: list[dict[str, Any]]) -> bool:
    """Return whether a list is too short only because items of it are wrong."""
    loc = error["loc"]
    below = any(len(o["loc"]) > len(loc) and o["loc"][: len(loc)] == loc for o in others)
    return error["type"] == "too_short" and below


def _explain(error: dict[str, Any], model: type[BaseModel], data: object, place: str) -> str:
    path = _keys_of(error["loc"], data)
    key = path[-1] if path else ""
    where = ": ".join(part for part in (place, ".".join(path)) if part)
    where = f" ({where})" if where else ""
    kind = error["type"]
    if kind == "extra_forbidden":
        valid = _valid_keys(model, error["loc"][:-1])
        hint = nearest_name(key, valid) or (f"; valid keys: {', '.join(valid)}" if valid else "")
        return f"unknown key `{key}`{hint}{where}"
    if kind == "missing":
        return f"`{key}` is required and is missing{where}"
    if kind in ("range", "nested"):
        return f"{error['msg']}{where}"
    message = error["msg"].removeprefix("Value error, ")
    return f"`{key}`: {message}, got {error.get('input')!r}{where}"


def _keys_of(loc: tuple[int | str, ...], data: object) -> list[str]:
    """Return the key path as the file has it: without pydantic's tags of unions."""
    keys: list[str] = []
    current = data
    loc = tuple(part for part in loc if part != "[key]")  # pydantic's mark of a mapping's key
    for position, part in enumerate(loc):
        if isinstance(current, dict) and part in current:
            current = current[part]
        elif isinstance(current, list) and isinstance(part, int) and part < len(current):
            current = current[part]
        elif position < len(loc) - 1:
            continue
        keys.append(str(part))
    return keys


def _valid_keys(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys that are valid at a place, as far as the models tell."""
    candidates: list[Any] = [model]
    for part in loc:
        inside = [
            _models_in(c.model_fields[part].annotation)
            for c in candidates
            if part in c.model_fields
        ]
        if inside:
            candidates = [m for models in inside for m in models]
        elif isinstance(part, str):  # the tag of a union: keep the member that it names
            candidates = [
                c
                for c in candidates
                if any(part in get_args(f.annotation) for f in c.model_fields.values())
            ]
    return [key for c in candidates for key in c.model_fields]


def _models_in(annotation: Any) -> list[Any]:
    if hasattr(annotation, "model_fields"):
        return [annotation]
    return [model for arg in get_args(annotation) for model in _models_in(arg)]
