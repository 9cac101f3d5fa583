"""Parts of windows: what they show, where they lie, what they cost, and trials that see them."""

import dataclasses

import pytest
import torch
from planted import FIXED, planted_case
from planted_sequences import sequence_case

from torchblur.filters import get_filter
from torchblur.params import build
from tuning.config.data import Crops
from tuning.config.fit import TuneConfig, resolve
from tuning.config.methods import PruningSpec
from tuning.config.objective import ObjectiveSpec
from tuning.methods.pruning import Ladder, rung_sizes
from tuning.objective.batches import FrameGroup
from tuning.objective.cropping import pixels_of, smaller
from tuning.objective.prepare import prepare
from tuning.objective.problem import Problem
from tuning.objective.windows import make_samples
from tuning.parallel.cluster_problem import ClusterProblem
from tuning.parallel.sharded_problem import Shard, ShardedProblem


def windows(crops=None, seeds=(1, 2, 3, 4)):
    return make_samples([planted_case(seed) for seed in seeds], crops, tile_size=12, seed=0)


def problem_of(samples):
    blur = get_filter("guertin2014")(**FIXED).requires_grad_(False)
    objective = ObjectiveSpec(terms={"mse": 1.0}, color_space="linear")
    return Problem(blur, samples, objective, ("kappa",))


@pytest.mark.parametrize("share", [0.3, 0.5, 0.77])
@pytest.mark.parametrize(
    "crops", [None, Crops(size=24, per_frame=3, context=8), Crops(size=40, per_frame=1, context=0)]
)
def test_a_part_is_a_part(crops, share):
    """All layers show one place, and the scored part lies within the window's own."""
    for sample in windows(crops):
        # Layers that tell where they are.
        place = torch.arange(48 * 64, dtype=torch.float32).view(1, 1, 48, 64)
        height, width = sample.size
        y, x, h, w = sample.inner
        here = place[..., :height, :width].expand(1, 3, -1, -1)
        scored = here[..., y : y + h, x : x + w]
        told = dataclasses.replace(
            sample,
            frame=sample.frame.replaced(color=here),
            reference=scored,
            band=scored[:, :1] > 0,
        )
        part = smaller(told, share, 12)
        top, left, rows, columns = part.inner
        assert part.reference.shape[-2:] == (rows, columns) == part.band.shape[-2:]
        assert torch.equal(
            part.frame.color[..., top : top + rows, left : left + columns], part.reference
        )
        assert part.size == tuple(-int(-share * edge // 1) for edge in sample.size)
        assert pixels_of(part) / pixels_of(sample) == pytest.approx(share**2, rel=0.2)


def test_it_is_where_the_most_moves():
    sample = windows(seeds=(1,))[0]
    velocity = torch.zeros(1, 2, 48, 64)
    velocity[..., 30:40, 40:55] = 6.0
    still = dataclasses.replace(sample, frame=sample.frame.replaced(velocity=velocity * 0))
    moving = dataclasses.replace(sample, frame=sample.frame.replaced(velocity=velocity))
    part = smaller(moving, 0.5, 12)
    assert (part.frame.velocity[:, 0] > 0).sum() == 10 * 15
    assert torch.equal(part.frame.color, sample.frame.color[..., 24:48, 24:56])  # tiles lie alike
    central = smaller(still, 0.5, 12)
    assert torch.equal(central.frame.color, sample.frame.color[..., 12:36, 12:44])


def test_a_sequence_keeps_its_place_over_time():
    (sample,) = make_samples([sequence_case(4)], None, tile_size=1, seed=0)
    part = smaller(sample, 0.5, 1)
    for step, reference in zip(part.steps, part.references, strict=True):
        assert step[0].size == (24, 32)
        assert reference.shape == (1, 3, 24, 32)
    lefts = [
        next(
            (top, left)
            for top in range(25)
            for left in range(33)
            if torch.equal(whole[..., top : top + 24, left : left + 32], scored)
        )
        for whole, scored in zip(sample.references, part.references, strict=True)
    ]
    assert len(set(lefts)) == 1
    assert pixels_of(sample) == 4 * 48 * 64 == 4 * pixels_of(part)


@pytest.mark.parametrize(
    ("total", "first", "sizes"), [(16, 0.25, (4, 8, 16)), (1, 0.5, (1, 1)), (3, 0.5, (2, 3))]
)
def test_rungs(total, first, sizes):
    assert rung_sizes(total, PruningSpec(first=first, crop=0.5)) == sizes


def test_the_last_rung_is_the_whole_objective(monkeypatch):
    """One trial climbs all rungs: what it is told at each, and what is filtered for it."""
    problem = problem_of(windows())
    ladder = Ladder(problem, PruningSpec(crop=0.5), 7)
    values = {"kappa": 4.0}
    filtered, told = [], []
    parts = FrameGroup.parts

    def counted(group, *args):
        filtered.append(group.frame.color[:, 0].numel())
        yield from parts(group, *args)

    monkeypatch.setattr(FrameGroup, "parts", counted)

    class Trial:
        number = 0

        def report(self, loss, resource):
            told.append((resource, loss))

        def should_prune(self):
            return False

    (climb,) = ladder.climb([Trial()], _Space(), {}, [values])
    assert sum(filtered) / (4 * 48 * 64) == climb.passes == 0.25 * 0.5 + 1
    monkeypatch.setattr(FrameGroup, "parts", parts)
    cut = problem_of([smaller(problem.samples[place], 0.5, 12) for place in ladder.order])
    each = cut.each(values)[:, 0]
    assert [resource for resource, _ in told] == [1, 2]
    assert [loss for _, loss in told] == pytest.approx([float(each[:k].mean()) for k in (1, 2)])
    assert climb.loss == pytest.approx(float(problem.mean(values)), rel=1e-6)


class _Space:
    parameters = ()

    def continuous(self):
        return self

    names = ()


def test_parts_split_between_ranks():
    whole = problem_of(windows())

    class Together:
        shards = [Shard(whole, rank, 3) for rank in range(3)]

        def ask(self, request):
            return sum(shard.answer(request) for shard in self.shards)

    sharded = ShardedProblem(whole, Together()).subset([3, 1, 0], 0.5)
    plain = whole.subset([3, 1, 0], 0.5)
    for values, count in (({"kappa": 3.0}, 1), ({"kappa": torch.tensor([2.0, 9.0])}, 2)):
        want = plain.each(values, count)
        torch.testing.assert_close(sharded.each(values, count), want, rtol=1e-6, atol=0)
        want = plain.mean(values, count)
        torch.testing.assert_close(sharded.mean(values, count), want, rtol=1e-6, atol=0)
    assert [sample.size for sample in sharded.samples] == [(24, 32)] * 3


def _each(problem, values):
    return problem.each(values)


def test_parts_on_the_workers_of_a_cluster(planted_folders, monkeypatch):
    """A worker cuts the same parts out of the windows that it has loaded itself."""
    monkeypatch.setattr("tuning.parallel.cluster_problem.share_cores", lambda: None)
    config = resolve(build(TuneConfig, planted_folders))
    problem = prepare(config).problem
    here = type("Here", (), {"map": lambda self, work, items: [work(item) for item in items]})()
    values = {"kappa": 3.0, "third_gain": 2.0, "direction_exponent": 1.0}
    whole = ClusterProblem(here, config, problem)
    for crop in (0.5, None):
        (found,) = whole.subset([0], crop).map(_each, [values])
        assert torch.equal(found, problem.subset([0], crop).each(values))
    assert not torch.equal(found, whole.subset([0], 0.5).map(_each, [values])[0])
