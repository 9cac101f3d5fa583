"""A pool of scenes that is renewed while a gradient method goes on.

A fit to a fixed set of scenes suits these; a fit to scenes that are new at every step would suit
the whole family, but a reference costs as much as many gradient steps. So the scenes of families
are kept for a while: every so many steps some of them are replaced, in turn, by new ones, with
references of fewer samples. The noise of such a reference changes with each scene and averages out
over steps: with squared errors it adds nothing to the gradient but its own noise, which has no
bias. The gradients of absolute and relative errors, FLIP and SSIM are not linear in the reference,
and have a small bias. What the fit is judged by at its end are the windows of the data, with all
samples.

Which scenes a step sees depends on the seed and the step's number alone, and rendered scenes are
cached, so that a run that was killed goes on with the same ones.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from torchblur.errors import ConfigError
from tuning.config.data import DataSpec, FamilyData, FamilyStreamData
from tuning.config.methods import RefreshSpec
from tuning.data.cases import AnyCase
from tuning.data.loading import draw_cases
from tuning.methods.gradient_state import seed_of
from tuning.objective.problem import Problem
from tuning.objective.windows import AnySample, make_samples
from tuning.parallel.sharded_problem import ShardedProblem

__all__ = ["Pool"]

_FIRST_SEED = 1_000_000_000  # of new scenes: far from those that one writes
_SCENES, _PLACES = 1 << 44, 1 << 45


@dataclass(frozen=True)
class _Slot:
    """A place in the pool, for the windows of one scene: what is drawn for it, and their weight."""

    key: str
    item: FamilyData | FamilyStreamData
    weight: float


class Pool:
    """The windows of each step.

    Args:
        problem: The objective over the windows of the data.
        data: What these were made from; there is a family among it.
        spec: How many scenes are replaced, and when.
        seed: Of the new scenes.

    Raises:
        ConfigError: windows that are split between processes.
    """

    def __init__(self, problem: Problem, data: DataSpec, spec: RefreshSpec, seed: int) -> None:
        if isinstance(problem, ShardedProblem):
            raise ConfigError(
                "`refresh` draws scenes in one process, and torchrun started several: leave "
                "`refresh` out, or torchrun"
            )
        self._problem, self._data, self._spec, self._seed = problem, data, spec, seed
        self._slots, self._windows = _slots_of(problem, data)
        self._drawn: dict[int, list[AnySample]] = {}
        self._numbers: tuple[int | None, ...] = (None,) * len(self._slots)
        self._current = problem

    def at(self, step: int) -> Problem:
        """Return the objective over the windows of a step.

        Args:
            step: Its number, from 0.
        """
        numbers = self.numbers(step)
        if numbers != self._numbers:
            self._problem.meter.enter("render")
            self._drawn = {
                number: self._drawn.get(number) or self._draw(number)
                for number in numbers
                if number is not None
            }
            samples = [
                sample
                for place, windows in enumerate(self._windows)
                for sample in self._of(numbers, place, windows)
            ]
            self._problem.meter.enter("other")
            self._current = self._current.with_samples(samples)
            self._numbers = numbers
        return self._current

    def numbers(self, step: int) -> tuple[int | None, ...]:
        """Return which of the new scenes each slot has at a step; None for that of the data."""
        count = len(self._slots)
        done = step // self._spec.every * self._spec.scenes
        latest = [done - 1 - (done - 1 - slot) % count for slot in range(count)]
        return tuple(number if number >= 0 else None for number in latest)

    def scene_seed(self, number: int) -> int:
        """Return the seed of a new scene; it is none of the data's."""
        seed = _FIRST_SEED + seed_of(self._seed, _SCENES, number) % _FIRST_SEED
        while any(seed in item.seeds for item in self._families()):
            seed += 1
        return seed

    def _families(self) -> list[FamilyData | FamilyStreamData]:
        items = (*self._data.train, *self._data.holdout)
        return [item for item in items if isinstance(item, FamilyData | FamilyStreamData)]

    def _of(
        self, numbers: tuple[int | None, ...], place: int, windows: list[AnySample]
    ) -> list[AnySample]:
        """Return the windows of a slot, or, after all slots, those that stay."""
        number = numbers[place] if place < len(numbers) else None
        return windows if number is None else self._drawn[number]

    def _draw(self, number: int) -> list[AnySample]:
        slot = self._slots[number % len(self._slots)]
        update = {"seed": self.scene_seed(number), "scenes": 1, "spp": self._spec.spp}
        item = slot.item.model_copy(update=update | {"weight": None})
        device = self._problem.samples[0].device
        cases: list[AnyCase] = [
            case.to(device) for case in draw_cases(self._data.root, slot.key, item)
        ]
        samples = make_samples(
            cases,
            self._data.crops,
            tile_size=int(getattr(self._problem.blur.config, "tile_size", 16)),
            seed=seed_of(self._seed, _PLACES, number),
            blur=self._problem.blur,
        )
        scale = slot.weight / sum(sample.weight for sample in samples)
        return [dataclasses.replace(s, weight=s.weight * scale) for s in samples]


def _slots_of(problem: Problem, data: DataSpec) -> tuple[list[_Slot], list[list[AnySample]]]:
    """Return the slots, and the windows of each; after them the windows of all other data."""
    families = {
        f"data.train.{index}": item
        for index, item in enumerate(data.train)
        if isinstance(item, FamilyData | FamilyStreamData)
    }
    by_scene: dict[tuple[str, str], list[AnySample]] = {}
    others: list[AnySample] = []
    for sample in problem.samples:
        if sample.item in families:
            by_scene.setdefault((sample.item, sample.origin), []).append(sample)
        else:
            others.append(sample)
    slots = [
        _Slot(key, families[key], sum(sample.weight for sample in windows))
        for (key, _), windows in by_scene.items()
    ]
    return slots, [*by_scene.values(), others]
