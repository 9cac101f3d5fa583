"""How the sensitivities of parameters stand in a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from tuning.results.fit import FitResult, SensitivityResult

__all__ = ["SlopeRow", "slope_rows"]

_DISAGREE = 0.5  # of the larger slope
_FLAT = 0.1  # slopes below this, in % per % of the range, mislead nobody


@dataclass(frozen=True, kw_only=True)
class SlopeRow:
    """One parameter.

    Args:
        name: Its name.
        cells: Slopes and rise as text.
        misled: Whether gradient and trial disagree at the start values.
    """

    name: str
    cells: tuple[str, ...]
    misled: bool

    def importance(self, importances: Mapping[str, float]) -> str:
        """Return its importance by Optuna as text."""
        return f"{100 * importances[self.name]:.1f} %" if self.name in importances else "–"


def slope_rows(result: FitResult) -> list[SlopeRow]:
    """Return a row for each parameter that has slopes.

    Args:
        result: A fit's result.
    """
    return [
        SlopeRow(name=p.name, cells=_cells(p.slopes), misled=_is_misled(p.slopes))
        for p in result.parameters
        if p.slopes is not None
    ]


def _cells(one: SensitivityResult) -> tuple[str, ...]:
    slopes = (one.start_gradient, one.start_difference, one.gradient, one.difference)
    texts = [_percent(value) for value in slopes]
    return (*texts, _percent(None if one.rise is None else 100 * one.rise))


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:+.2f} %".replace("-", "−")


def _is_misled(one: SensitivityResult) -> bool:
    given, tried = one.start_gradient, one.start_difference
    if given is None or tried is None:
        return False
    largest = max(abs(given), abs(tried))
    return largest > _FLAT and abs(given - tried) > _DISAGREE * largest
