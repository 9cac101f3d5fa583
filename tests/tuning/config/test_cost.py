"""The cost model: by hand, monotone in what is counted, and as part of the objective."""

import pytest
import torch
from planted import FIXED, PLANTED, planted_case

from torchblur.errors import ConfigError
from torchblur.filters import BlurFilter, get_filter, list_filters
from torchblur.filters.parts.base import FilterConfig
from torchblur.params import declared
from tuning.config.cost import Cost, cost_at, cost_of
from tuning.config.objective import ObjectiveSpec
from tuning.objective.problem import Problem
from tuning.objective.windows import make_samples

TAPS = {
    "line": ("num_samples",),
    "mcguire2012": ("num_samples",),
    "guertin2014": ("num_samples",),
    "jimenez2014": ("num_samples",),
    "sousa2013": ("num_samples", "passes"),
    "notes2025": ("num_samples", "post_samples"),
    "tan2022": ("num_samples", "mask_samples"),
    "oberberger2022": (
        "variance_window",
        "prefilter_samples",
        "second_stage_iterations",
        "reprojection_iterations",
    ),
    "composed": ("num_samples",),
    "torchblur": ("num_samples", "refinements"),
    "warp": ("num_samples", "supersampling"),
}


def _counted():
    return [(n, p) for n, names in TAPS.items() if n in list_filters() for p in names]


def test_guertin_as_published_is_the_unit():
    cost = cost_of("guertin2014")
    assert cost.relative == 1
    # 35 taps of two lookups and weights worth two; tile maxima (40 px tiles); two passes.
    tiles = 1 / 40**2
    assert cost.taps == 35
    assert cost.lookups == pytest.approx(70 + 1 + 9 * tiles)
    assert cost.total == pytest.approx(cost.lookups + 70 + 6 * (2 + tiles))


@pytest.mark.parametrize(("name", "parameter"), _counted())
@pytest.mark.parametrize("other", [{}, {"resolution": "half"}])
def test_rises_with_each_number_of_taps(name, parameter, other):
    model = get_filter(name).config_class
    if not set(other) <= set(model.model_fields):
        other = {}
    low, high = declared(model)[parameter].bounds
    numbers = [n for n in (1, 2, 4, 7, 16, 33, 60) if low <= n <= high]
    costs = [cost_of(name, other | {parameter: n}) for n in numbers]
    assert len(costs) >= 3
    assert [c.total for c in costs] == sorted(c.total for c in costs)
    assert costs[-1].total > costs[0].total
    assert costs[-1].lookups > costs[0].lookups


@pytest.mark.parametrize(
    ("name", "cheap", "dear"),
    [
        ("guertin2014", {}, {"color_lookup": "bilinear"}),
        ("guertin2014", {}, {"background": "revealed"}),
        ("guertin2014", {"tile_size": 40}, {"tile_size": 4}),
        ("jimenez2014", {"num_samples": 13}, {"num_samples": 15}),  # pairs: 14 and 16
        ("notes2025", {"resolution": "half"}, {}),
        ("notes2025", {"post_filter": False}, {}),
        ("notes2025", {"directions": "one"}, {}),
        ("notes2025", {"double_samples": False}, {}),
        ("tan2022", {}, {"shutter_position": "centered"}),
        ("torchblur", {"second_direction": False}, {}),
        ("composed", {"sampling": "alternate"}, {"sampling": "pairs"}),
        ("torchblur", {"color_lookup": "bilinear"}, {"color_lookup": "cubic"}),
        ("torchblur", {"edge_motion": "own"}, {}),
        ("composed", {"sampling": "pairs"}, {"sampling": "pairs", "double_samples": True}),
        ("composed", {}, {"post_filter": True}),
        ("oberberger2022", {"variance_stride": 4}, {}),
        ("oberberger2022", {"prefilter": False}, {}),
        ("oberberger2022", {"first_stage": False}, {}),
        ("oberberger2022", {"temporal": False}, {}),
        ("oberberger2022", {}, {"blend_source": "filtered"}),
    ],
)
def test_counts_what_makes_a_filter_dear(name, cheap, dear):
    assert cost_of(name, cheap).total < cost_of(name, dear).total


def test_smooth_parameters_cost_nothing():
    for name, kind in list_filters().items():
        if name not in TAPS:
            continue
        smooth = {
            n: s.bounds[1] for n, s in declared(kind.config_class).items() if s.grad != "discrete"
        }
        assert cost_of(name, smooth) == cost_of(name), name


def test_every_filter_has_a_cost():
    for name in list_filters():
        assert cost_of(name).total > 0


def test_a_filter_may_state_its_own(monkeypatch):
    kind = get_filter("line")
    monkeypatch.setattr(
        kind, "cost", classmethod(lambda cls, config: Cost(lookups=config.num_samples * 3.0)),
        raising=False,
    )  # fmt: skip
    assert cost_of("line", {"num_samples": 5}).total == 15


def test_an_unknown_cost_says_so(monkeypatch):
    monkeypatch.setattr("torchblur.filters.parts.registry._REGISTRY", {})

    class Odd(BlurFilter):
        name = "odd"
        config_class = FilterConfig

    with pytest.raises(ConfigError, match="the cost of `odd` is not known"):
        cost_of("odd")


class TestObjective:
    def problem(self, **options):
        blur = get_filter("guertin2014")(**FIXED).requires_grad_(False)
        samples = make_samples([planted_case(1), planted_case(2)], None, tile_size=12, seed=0)
        spec = ObjectiveSpec(terms={"l1": 1.0}, **options)
        return Problem(blur, samples, spec, (*PLANTED, "num_samples"))

    @pytest.mark.parametrize("reduction", ["mean", "worst"])
    def test_cost_is_a_term(self, reduction):
        plain = self.problem(reduction=reduction)
        priced = self.problem(reduction=reduction, cost=0.5)
        for number in (5, 24):
            values = PLANTED | {"num_samples": number}
            extra = 0.5 * cost_of("guertin2014", FIXED | values).relative
            assert float(priced.mean(values)) == pytest.approx(float(plain.mean(values)) + extra)
            assert torch.allclose(priced.each(values), plain.each(values) + extra)

    @pytest.mark.parametrize("reduction", ["mean", "worst"])
    def test_cost_leaves_gradients_as_they_are(self, reduction):
        grads, totals = [], []
        for cost in (0.0, 0.5):
            kappa = torch.tensor([5.0, 20.0], requires_grad=True)
            total = sum(self.problem(reduction=reduction, cost=cost).losses({"kappa": kappa}, 2))
            total.sum().backward()
            grads.append(kappa.grad)
            totals.append(total.detach())
        assert torch.equal(*grads)
        extra = 0.5 * cost_of("guertin2014", FIXED).relative
        assert torch.allclose(totals[1].double(), totals[0].double() + extra)

    def test_tensors_are_no_choices(self):
        blur = get_filter("guertin2014")()
        assert cost_at(blur, {"kappa": torch.rand(3), "num_samples": 35}).relative == 1
