"""What a fit is told of its methods: gradient steps, searches, and searches with more to them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import Field

from torchblur.errors import ConfigError, nearest_name
from torchblur.params import Config, Param
from tuning.config.data import DataItem, FamilyData, FamilyStreamData

__all__ = [
    "BlackBoxMethod",
    "GradientMethod",
    "Method",
    "ParetoMethod",
    "PolishSpec",
    "PolishSteps",
    "PruningSpec",
    "RefreshSpec",
    "check_method",
    "check_refresh",
    "polished_names",
    "smooth_by_default",
]


_LEAST_GENERATION = 4


class _MethodBase(Config):
    free: tuple[str, ...] | None = Field(
        None, min_length=1, description="the free parameters that this method fits; all if left out"
    )
    continue_from_best: bool = Field(
        False, description="begin at the best of the methods before it, beside the start values"
    )


class _Windows(Config):
    batch: int | None = Field(
        None, ge=1, description="frames or windows of a step, drawn anew; all if left out"
    )
    unroll: int | None = Field(
        None,
        ge=1,
        description="frames of a sequence that gradients go back through at most (truncated "
        "backpropagation: memory for so many); all if left out",
    )


class RefreshSpec(Config):
    """Scenes of a family that are replaced by new ones while a gradient method goes on."""

    every: int = Field(10, ge=1, description="after so many steps …")
    scenes: int = Field(
        1,
        ge=1,
        description="… so many scenes of the families in `data.train` are replaced, in turn, by "
        "scenes with seeds of their own, none of which is in the data",
    )
    spp: int = Field(
        32,
        ge=2,
        description="samples per pixel of the new references; their noise averages out over "
        "steps: it adds no bias to the gradient of squared errors, a small one to that of the "
        "others (absolute and relative errors, FLIP, SSIM)",
    )


class GradientMethod(_MethodBase, _Windows):
    """Adam in the unit cube from several starts at once, or L-BFGS; for smooth parameters."""

    kind: Literal["gradient"]
    optimizer: Literal["adam", "lbfgs"] = Field(
        "adam",
        description="adam; lbfgs: a quasi-Newton method with a line search, over all windows, "
        "start by start",
    )
    steps: int = Field(
        100,
        ge=1,
        description="steps of the optimizer; one of lbfgs takes as many evaluations as its line "
        "search needs, mostly one or two",
    )
    starts: int = Field(4, ge=1, description="the first at the start values, the others random")
    learning_rate: float = Field(
        0.03,
        gt=0,
        le=1,
        description="first step, as a fraction of each range; adam's falls by a cosine, lbfgs "
        "finds the length of the others by itself",
    )
    refresh: RefreshSpec | None = Field(
        None,
        description="replace scenes of families as the steps go on; left out: all steps see the "
        "same scenes",
    )

    @property
    def is_sampled(self) -> bool:
        """Whether steps see other windows, so that their losses cannot be compared."""
        return self.batch is not None or self.refresh is not None


class PolishSteps(_Windows):
    """Gradient steps from a setting that a search found."""

    steps: int = Field(15, ge=1, description="steps of Adam from one setting")
    learning_rate: float = Field(
        0.03, gt=0, le=1, description="first step, as a fraction of each range; falls by a cosine"
    )


class PolishSpec(PolishSteps):
    """Gradient steps from the promising trials of a search; what they find joins the study."""

    quantile: float = Field(
        0.25, gt=0, le=1, description="a trial is polished if it is in this best share so far"
    )
    free: tuple[str, ...] | None = Field(
        None, min_length=1, description="what is polished; the method's smooth ones if left out"
    )


class PruningSpec(Config):
    """Trials begin on a few windows, and only the promising ones see more."""

    pruner: Literal["sha", "hyperband", "median"] = Field(
        "sha",
        description="successive halving, several of them that begin later and later, or: stop "
        "what is worse than the median",
    )
    first: float = Field(0.25, gt=0, lt=1, description="share of the windows that all trials see")
    factor: int = Field(
        2,
        ge=2,
        description="each rung has so many times the windows of the one before; with sha and "
        "hyperband one trial in so many goes on",
    )
    crop: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="rungs before the last see a part of each window alone, where the most moves; "
        "its edges are so much of the window's, and it costs the square of that; left out: whole "
        "windows",
    )
    startup: int = Field(5, ge=1, description="so many trials at the beginning see all windows")


class BlackBoxMethod(_MethodBase):
    """An Optuna sampler; for parameters of every class."""

    kind: Literal["blackbox"]
    sampler: Literal["tpe", "cmaes", "gp", "random"] = Field("tpe", description="Optuna's sampler")
    trials: int = Field(100, ge=1, description="candidates; the first at the start values")
    population: int = Field(
        1,
        ge=1,
        description="candidates drawn together, before any of them is known: what the workers of "
        "a cluster share; of cmaes the generation",
    )
    together: int | None = Field(
        None,
        ge=1,
        description="candidates of a population that are filtered in one call if their discrete "
        "values agree; left out: one on the CPU, as many as fit on a GPU",
    )
    polish: PolishSpec | None = Field(None, description="gradient steps from promising trials")
    pruning: PruningSpec | None = Field(None, description="few windows first")


def _standard_budgets() -> dict[str, float]:
    return {"low": 0.25, "medium": 0.5, "high": 1.0, "ultra": 2.0}


class ParetoMethod(_MethodBase):
    """A search for the settings that no other one beats in both quality and cost."""

    kind: Literal["pareto"]
    sampler: Literal["nsga2", "tpe"] = Field("nsga2", description="Optuna's sampler")
    trials: int = Field(200, ge=1, description="settings that are tried, the given ones included")
    population: int | None = Field(
        None,
        ge=2,
        description="settings drawn together, before any of them is known: what the workers of a "
        "cluster share; of nsga2 the generation; left out: 20 with nsga2, 1 with tpe",
    )
    sweep: int = Field(
        5,
        ge=0,
        description="the search begins at the start values (or the best so far) with so many "
        "other values of what costs the most, the number of taps say",
    )
    budgets: dict[
        Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")], Annotated[float, Field(gt=0)]
    ] = Field(
        default_factory=_standard_budgets,
        min_length=1,
        description="presets by name, and what each may cost, relative to Guertin 2014 with 35 "
        "taps",
    )
    polish: PolishSteps | None = Field(
        None, description="gradient steps from each preset's setting, with its smooth parameters"
    )


AnyMethod = GradientMethod | BlackBoxMethod | ParetoMethod
Method = Annotated[AnyMethod, Field(discriminator="kind")]


def polished_names(
    method: BlackBoxMethod, names: Collection[str], specs: Mapping[str, Param]
) -> tuple[str, ...]:
    """Return what a search polishes by gradient, in the order of the free parameters.

    Args:
        method: The search.
        names: What it fits.
        specs: Declarations of the filter's parameters.
    """
    if method.polish is None:
        return ()
    if method.polish.free is not None:
        return tuple(name for name in names if name in method.polish.free)
    return tuple(name for name in names if specs[name].grad == "smooth")


def smooth_by_default(
    methods: Sequence[AnyMethod], free: Collection[str], specs: Mapping[str, Param]
) -> list[dict[str, Any]]:
    """Return methods as plain data, in which a gradient without `free` takes what is smooth.

    Args:
        methods: The methods.
        free: Names of the free parameters.
        specs: Declarations of the filter's parameters.
    """
    smooth = tuple(name for name in free if specs[name].grad == "smooth") or None
    found = [method.model_dump() for method in methods]
    for method in found:
        if method["kind"] == "gradient" and method["free"] is None:
            method["free"] = smooth
    return found


def check_method(
    method: AnyMethod, names: Collection[str], specs: Mapping[str, Param], place: str
) -> None:
    """Refuse a method that cannot fit what it is given.

    Args:
        method: The method.
        names: What it fits.
        specs: Declarations of the filter's parameters.
        place: Key path of the method, with the file, for messages.

    Raises:
        ConfigError: a parameter without a usable gradient; nothing to polish; a sampler that
            cannot learn from what is polished; too small a generation; an optimizer that needs
            the same windows in all steps.
    """
    if isinstance(method, GradientMethod):
        _check_optimizer(method, place)
        for name in names:
            _check_gradient(name, specs[name], bool(method.free), place)
    elif isinstance(method, BlackBoxMethod):
        _check_generation(method, place)
        if method.polish is not None:
            _check_polish(method, names, specs, place)


def check_refresh(method: AnyMethod, train: Sequence[DataItem], place: str) -> None:
    """Refuse new scenes where there is no family to draw them from.

    Args:
        method: The method.
        train: The training data.
        place: Key path of the method, with the file, for messages.

    Raises:
        ConfigError: no item of a family.
    """
    if not isinstance(method, GradientMethod) or method.refresh is None:
        return
    if not any(isinstance(item, FamilyData | FamilyStreamData) for item in train):
        kinds = ", ".join(dict.fromkeys(item.kind for item in train))
        raise ConfigError(
            "`refresh` replaces scenes of families, and data.train has no item of kind family or "
            f"family_stream, only {kinds} ({place}.refresh)"
        )


def _check_generation(method: BlackBoxMethod, place: str) -> None:
    if method.sampler == "cmaes" and 1 < method.population < _LEAST_GENERATION:
        raise ConfigError(
            f"a generation of cmaes needs at least {_LEAST_GENERATION} candidates, got "
            f"`population: {method.population}`; 1 leaves its size to the sampler "
            f"({place}.population)"
        )


def _check_optimizer(method: GradientMethod, place: str) -> None:
    if method.optimizer == "lbfgs" and method.is_sampled:
        key = "refresh" if method.batch is None else "batch"
        raise ConfigError(
            "lbfgs compares losses along a line, so all steps must see the same windows: leave "
            f"`{key}` out, or take adam ({place}.{key})"
        )


def _check_gradient(name: str, spec: Param, is_named: bool, place: str) -> None:
    if spec.grad == "discrete" or (spec.grad == "weak" and not is_named):
        raise ConfigError(
            f"`{name}` is {spec.grad} and has no usable gradient; fit it with a `blackbox` method, "
            f"and name this method's own parameters in its `free` ({place}.free)"
        )


def _check_polish(
    method: BlackBoxMethod, names: Collection[str], specs: Mapping[str, Param], place: str
) -> None:
    assert method.polish is not None
    if method.sampler == "cmaes":
        raise ConfigError(
            "`polish` needs a sampler that learns from points which it did not draw: tpe, gp or "
            f"random, got cmaes ({place}.polish)"
        )
    for name in method.polish.free or ():
        if name not in names:
            raise ConfigError(
                f"`{name}` is not among the parameters of the search{nearest_name(name, names)} "
                f"({place}.polish.free)"
            )
        if specs[name].grad == "discrete":
            raise ConfigError(
                f"`{name}` is discrete and cannot be polished by its gradient ({place}.polish.free)"
            )
    if not polished_names(method, names, specs):
        raise ConfigError(
            f"`polish` needs a smooth parameter, and the search has {', '.join(names)} "
            f"({place}.polish)"
        )
