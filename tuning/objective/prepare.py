"""What a configuration stands for: its frames, its filter, its free parameters, its objective."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch

from torchblur.errors import ConfigError
from torchblur.filters import BlurFilter, get_filter
from tuning.config.fit import TuneConfig
from tuning.data.cases import AnyCase, check_needs
from tuning.data.loading import load_cases
from tuning.objective.engine import fit_engine
from tuning.objective.problem import Problem
from tuning.objective.space import Space, make_space
from tuning.objective.windows import AnySample, Sample, make_samples

__all__ = ["Prepared", "fingerprint", "fit_device", "is_same_data", "prepare"]

_SAME = 1e-4


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """What a fit works on.

    Args:
        space: The free parameters.
        blur: The filter, on its device; its parameters need no gradient.
        cases: Frames and sequences of both splits.
        problem: The objective on the training frames.
        notes: What the user should know of the data.
    """

    space: Space
    blur: BlurFilter
    cases: list[AnyCase]
    problem: Problem
    notes: tuple[str, ...]


def prepare(config: TuneConfig, report: Callable[[int, int, str], None] | None = None) -> Prepared:
    """Load the data of a resolved configuration and make its filter and its objective.

    The same configuration and data give the same windows in every process.

    Args:
        config: What `resolve` or `load_tune_config` returned.
        report: Called with (done, total, name of the next case).

    Raises:
        ConfigError: no such device; data that the filter cannot use.
        TorchblurError: data that is missing or cannot be read.
    """
    device = fit_device(config.device)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cases = load_cases(config.data, device=device, report=report)
    notes = tuple(dict.fromkeys(str(warning.message) for warning in caught))
    if not config.data.holdout:
        notes += ("There is no hold-out: these figures are of the frames that were fitted.",)
    space = make_space(config.filter)
    blur = get_filter(config.filter.kind)(engine=config.engine, **config.filter.params).to(device)
    check_needs(blur, cases)
    train = [case for case in cases if case.split == "train"]
    tile_size = int(getattr(blur.config, "tile_size", 16))
    samples = make_samples(
        train, config.data.crops, tile_size=tile_size, seed=config.seed, blur=blur
    )
    for parameter in blur.parameters():
        parameter.requires_grad_(False)
    problem = Problem(blur, samples, config.objective, space.names)
    blur.engine = fit_engine(config, problem, space)
    return Prepared(space=space, blur=blur, cases=cases, problem=problem, notes=notes)


def fingerprint(problem: Problem) -> tuple[tuple[int, int, float], ...]:
    """Return height, width and mean reference of each window, to compare two processes' data."""
    return tuple((*sample.size, _mean_reference(sample)) for sample in problem.samples)


def is_same_data(
    one: tuple[tuple[int, int, float], ...], other: tuple[tuple[int, int, float], ...]
) -> bool:
    """Return whether two fingerprints are of the same windows.

    Two machines that render the same scene agree but for the last bits.
    """
    return len(one) == len(other) and all(
        a[:2] == b[:2] and math.isclose(a[2], b[2], rel_tol=_SAME, abs_tol=1e-12)
        for a, b in zip(one, other, strict=True)
    )


def fit_device(name: str) -> torch.device:
    """Return a device by its name; "auto" is a GPU if there is one.

    Raises:
        ConfigError: no such device here.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"`device` {name!r} cannot be used: {reason}") from error
    return device


def _mean_reference(sample: AnySample) -> float:
    if isinstance(sample, Sample):
        return float(sample.reference.double().mean())
    return sum(float(reference.double().mean()) for reference in sample.references)
