"""Windows split between ranks: the sums are those of one process, whatever the number of ranks."""

import pytest
import torch
from planted import FIXED, planted_case
from planted_sequences import sequence_case

from torchblur.filters import get_filter
from tuning.config.objective import ObjectiveSpec
from tuning.objective.problem import Problem
from tuning.objective.windows import make_samples
from tuning.parallel.sharded_problem import Shard, ShardedProblem

NAMES = ("kappa", "third_gain")


class Together:
    """Stands for the ranks: each does its share here, one after the other."""

    def __init__(self, problem, count):
        self.shards = [Shard(problem, rank, count) for rank in range(count)]
        self.asked = []

    def ask(self, request):
        self.asked.append(request)
        return sum(shard.answer(request) for shard in self.shards)


@pytest.fixture(scope="module")
def samples():
    cases = [planted_case(1), planted_case(2), planted_case(3)]
    return make_samples(cases, None, tile_size=12, seed=0)


def problem_of(samples, **objective):
    blur = get_filter("guertin2014")(**FIXED).requires_grad_(False)
    return Problem(blur, samples, ObjectiveSpec(**objective), NAMES)


def sets(count):
    values = {"kappa": torch.linspace(2, 30, count), "third_gain": torch.linspace(1, 9, count)}
    return {name: v.double().requires_grad_(True) for name, v in values.items()}


def losses_and_slopes(problem, count, **options):
    values = sets(count)
    total = torch.zeros(count, dtype=torch.float64)
    for part in problem.losses(values, count, **options):
        total += part.detach().double()
        if part.requires_grad:
            part.sum().backward()
    return torch.stack([total, *(value.grad for value in values.values())])


OBJECTIVES = [
    {"terms": {"mse": 1.0}, "color_space": "linear"},
    {"terms": {"l1": 1.0}, "reduction": "cvar", "tail": 0.4},
    {"terms": {"l1": 1.0}, "reduction": "worst"},
    {"terms": {"l1": 1.0}, "cost": 0.01},
]


@pytest.mark.parametrize("ranks", [1, 2, 4])  # three windows: uneven, and a rank without any
@pytest.mark.parametrize("objective", OBJECTIVES, ids=["mean", "cvar", "worst", "cost"])
def test_losses_and_gradients_are_those_of_one_process(samples, objective, ranks):
    whole = problem_of(samples, **objective)
    sharded = ShardedProblem(whole, Together(whole, ranks))
    for count, options in ((1, {}), (3, {}), (3, {"chosen": [2, 0]}), (1, {"chosen": [1]})):
        want = losses_and_slopes(whole, count, **options)
        found = losses_and_slopes(sharded, count, **options)
        assert want[1:].abs().max() > 0
        torch.testing.assert_close(found, want, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("objective", OBJECTIVES[:2], ids=["mean", "cvar"])
def test_means_and_single_windows(samples, objective):
    whole = problem_of(samples, **objective)
    crew = Together(whole, 2)
    sharded = ShardedProblem(whole, crew)
    values = {name: v.detach() for name, v in sets(3).items()}
    torch.testing.assert_close(sharded.mean(values, 3), whole.mean(values, 3), rtol=1e-6, atol=0)
    torch.testing.assert_close(sharded.each(values, 3), whole.each(values, 3), rtol=1e-6, atol=0)
    assert {request.slopes for request in crew.asked} == {()}


def test_a_subset_keeps_its_ranks(samples):
    whole = problem_of(samples, terms={"l1": 1.0})
    sharded = ShardedProblem(whole, Together(whole, 2)).subset([2, 1]).subset([0])
    values = {name: float(v.detach()) for name, v in sets(1).items()}
    assert len(sharded.samples) == 1
    want = whole.subset([2]).mean(values)
    torch.testing.assert_close(sharded.mean(values), want, rtol=1e-6, atol=0)


def test_gradients_through_few_frames_of_a_sequence(recall):
    cases = [sequence_case(4, seed) for seed in (0, 1, 2)]
    blur = recall().requires_grad_(False)
    samples = make_samples(cases, None, tile_size=1, seed=0, blur=blur)
    objective = ObjectiveSpec(terms={"l1": 1.0}, color_space="linear", temporal=0.5)
    whole = Problem(blur, samples, objective, ("gain",))
    found = []
    for problem in (whole, ShardedProblem(whole, Together(whole, 2))):
        gain = torch.tensor([0.3, 0.8], dtype=torch.float64, requires_grad=True)
        for part in problem.losses({"gain": gain}, 2, unroll=2):
            part.sum().backward()
        found.append(gain.grad)
    assert found[0].abs().min() > 0
    torch.testing.assert_close(found[1], found[0], rtol=1e-6, atol=0)
