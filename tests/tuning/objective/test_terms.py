"""The objective: its terms against the metrics, its weights, and what a fit asks of it."""

import dataclasses
import itertools

import pytest
import torch
from planted import FIXED, PLANTED, planted_case, tiny_frame

from torchblur.filters import get_filter
from torchblur.metrics import flip_hdr, flip_ldr, ssim
from tuning.config.data import Crops
from tuning.config.objective import ObjectiveSpec
from tuning.data.blurring import blurred
from tuning.objective.problem import Problem
from tuning.objective.terms import PreparedObjective
from tuning.objective.windows import make_samples


@pytest.fixture
def pair():
    image, reference = torch.rand(2, 3, 24, 32), torch.rand(2, 3, 24, 32)
    band = torch.zeros(2, 1, 24, 32, dtype=torch.bool)
    band[0, :, :, :10] = True
    return image * 1.5, reference, band


def single(metric, space="linear", **options):
    return ObjectiveSpec(terms={metric: 1.0}, color_space=space, **options)


@pytest.mark.parametrize(
    ("metric", "space", "expected"),
    [
        ("flip", "linear", flip_ldr),
        ("flip_hdr", "linear", flip_hdr),
        ("ssim", "linear", lambda a, b: 1 - ssim(a, b)),
        ("l1", "linear", lambda a, b: (a - b).abs()),
        ("mse", "linear", lambda a, b: (a - b) ** 2),
        ("l1", "log", lambda a, b: (torch.log(1 + a) - torch.log(1 + b)).abs()),
        ("relative_l2", "linear", lambda a, b: (a - b) ** 2 / (b**2 + 0.01)),
    ],
)
def test_terms_are_the_metrics(pair, metric, space, expected):
    image, reference, band = pair
    got = PreparedObjective(single(metric, space), reference, band)(image)
    assert torch.allclose(got, expected(image, reference).mean(dim=(1, 2, 3)), atol=1e-6)


def test_srgb_is_what_a_display_gets(pair):
    _, _, band = pair
    image, reference = torch.full((2, 3, 24, 32), 2.0), torch.full((2, 3, 24, 32), 0.5)
    got = PreparedObjective(single("l1", "srgb"), reference, band)(image)
    assert got.tolist() == pytest.approx([1 - 0.735357] * 2, abs=1e-5)


def test_weights_add_up(pair):
    image, reference, band = pair
    both = ObjectiveSpec(terms={"l1": 2.0, "flip": 0.5}, color_space="linear")
    parts = [PreparedObjective(single(m), reference, band)(image) for m in ("l1", "flip")]
    got = PreparedObjective(both, reference, band)(image)
    assert torch.allclose(got, 2.0 * parts[0] + 0.5 * parts[1])


def test_band_gets_its_share(pair):
    image, reference, band = pair
    error = (image - reference).abs().mean(dim=1, keepdim=True)
    got = PreparedObjective(single("l1", band_weight=0.25), reference, band)(image)
    whole, inside = error.mean(dim=(1, 2, 3)), error[0][band[0]].mean()
    assert float(got[0]) == pytest.approx(float(0.75 * whole[0] + 0.25 * inside), rel=1e-5)
    assert float(got[1]) == pytest.approx(float(whole[1]), rel=1e-5)  # no band: all is image


def test_terms_of_the_band_stand_beside_those_of_the_image(pair):
    image, reference, band = pair
    spec = ObjectiveSpec(terms={"l1": 2.0}, band={"l1": 0.5, "mse": 3.0}, color_space="linear")
    got = PreparedObjective(spec, reference, band)(image)
    error = (image - reference).abs().mean(dim=1, keepdim=True)
    squares = ((image - reference) ** 2).mean(dim=1, keepdim=True)
    inside = [0.5 * float(e[0][band[0]].mean()) for e in (error, 2 * 3.0 * squares)]
    assert float(got[0]) == pytest.approx(2.0 * float(error[0].mean()) + sum(inside), rel=1e-5)
    # Without a band its terms are those of the whole image.
    whole = 2.5 * float(error[1].mean()) + 3.0 * float(squares[1].mean())
    assert float(got[1]) == pytest.approx(whole, rel=1e-5)


def test_a_share_of_the_band_is_terms_of_both(pair):
    image, reference, band = pair
    share = ObjectiveSpec(terms={"flip": 1.0}, band_weight=0.25)
    terms = ObjectiveSpec(terms={"flip": 0.75}, band={"flip": 0.25})
    losses = [PreparedObjective(spec, reference, band)(image) for spec in (share, terms)]
    assert torch.allclose(*losses, rtol=1e-5)


class TestPsnr:
    def test_counts_ten_decibels_as_one(self):
        reference = torch.full((1, 3, 8, 8), 0.5)
        prepared = PreparedObjective(single("psnr"), reference, torch.ones(1, 1, 8, 8) > 0)
        losses = [float(prepared(reference + 10 ** (-db / 20))) for db in (20, 30, 40)]
        assert losses[0] - losses[1] == pytest.approx(1.0, abs=1e-3)
        assert losses == pytest.approx([(60 - db) / 10 for db in (20, 30, 40)], abs=5e-3)
        assert float(prepared(reference)) == 0

    def test_has_a_gradient_down_to_equality(self):
        reference = torch.full((1, 3, 8, 8), 0.5, dtype=torch.float64)
        prepared = PreparedObjective(single("psnr"), reference, torch.ones(1, 1, 8, 8) > 0)
        for error in (0.3, 0.01, 1e-5, 0.0):
            image = torch.full_like(reference, 0.5 + error).requires_grad_(True)
            assert torch.autograd.gradcheck(lambda i: prepared(i).double(), image, atol=1e-4)


def problem_of(cases, objective, crops=None, free=tuple(PLANTED)):
    blur = get_filter("guertin2014")(**FIXED).requires_grad_(False)
    return Problem(blur, make_samples(cases, crops, tile_size=12, seed=0), objective, free)


def test_zero_at_the_planted_values(planted_problem):
    assert float(planted_problem.mean(PLANTED)) < 1e-12
    assert float(planted_problem.mean(PLANTED | {"kappa": 30.0})) > 1e-6


def test_many_sets_at_once_are_single_sets():
    """Also over windows, and over cases of different shutters and sizes."""
    small = dataclasses.replace(planted_case(3), frame=tiny_frame(3), name="other shutter")
    cases = [planted_case(1), dataclasses.replace(small, shutter=planted_case(1).shutter)]
    for crops in (None, Crops(size=16, per_frame=3, context=12)):
        problem = problem_of(cases, ObjectiveSpec(terms={"flip": 1.0, "l1": 1.0}), crops)
        values = {
            "kappa": torch.tensor([5.0, 40.0, 90.0]),
            "third_gain": torch.tensor([1.0, 2.0, 9.0]),
            "direction_exponent": torch.tensor([1.0, 2.0, 3.0]),
        }
        together = problem.mean(values, 3)
        alone = [problem.mean({n: float(v[k]) for n, v in values.items()}) for k in range(3)]
        assert torch.allclose(together, torch.cat(alone), rtol=1e-4)


def test_shutter_comes_from_the_data_unless_it_is_free():
    case = planted_case(1)
    other = dataclasses.replace(case, shutter=dataclasses.replace(case.shutter, open=0.25))
    objective = ObjectiveSpec(terms={"l1": 1.0})
    fixed = problem_of([case], objective).mean({"kappa": 40.0})
    assert float(problem_of([other], objective).mean({"kappa": 40.0})) != float(fixed)
    free = [
        float(problem_of([c], objective, free=("shutter",)).mean({"shutter": 0.7}))
        for c in (case, other)
    ]
    assert free[0] == free[1] != float(fixed)


def test_a_free_shutter_without_a_value_is_the_filters_own():
    case = planted_case(1)
    objective = ObjectiveSpec(terms={"l1": 1.0})
    own = problem_of([case], objective, free=("shutter",))
    assert float(own.blur.shutter) == 0.5 != case.shutter.open
    assert float(own.mean({})) == float(own.mean({"shutter": 0.5}))


def test_windows_are_scored_where_they_are_not_context():
    crops = Crops(size=16, per_frame=5, context=12)
    problem = problem_of([planted_case(1)], ObjectiveSpec(terms={"l1": 1.0}), crops)
    errors = []
    for sample in problem.samples:
        top, left, height, width = sample.inner
        image = problem.blur(sample.frame, shutter=sample.shutter.open)
        inner = image[..., top : top + height, left : left + width]
        prepared = PreparedObjective(problem.objective, sample.reference, sample.band)
        errors.append(float(prepared(inner)))
    assert any(sample.inner[:2] != (0, 0) for sample in problem.samples)
    assert float(problem.mean({})) == pytest.approx(sum(errors) / len(errors), rel=1e-5)


def test_a_set_without_a_finite_image_is_alone_with_it(monkeypatch):
    problem = problem_of([planted_case(1)], ObjectiveSpec(terms={"flip": 1.0, "ssim": 1.0}))

    def broken(blur, frame, shutter, position, values, free):
        image = blurred(blur, frame, shutter, position, values, free)
        return torch.where(torch.tensor([False, True]).view(-1, 1, 1, 1), torch.nan, image)

    monkeypatch.setattr("tuning.objective.batches.blurred", broken)
    values = {"kappa": torch.tensor([10.0, 10.0], dtype=torch.float64, requires_grad=True)}
    losses = sum(problem.losses(values, 2))
    losses[0].backward()
    assert torch.isfinite(losses).tolist() == [True, False]
    assert torch.isfinite(values["kappa"].grad).all()


def test_parts_add_up_to_the_mean(planted_problem):
    values = {"kappa": torch.tensor([8.0, 9.0])}
    parts = list(planted_problem.losses(values, 2))
    assert len(parts) == len(planted_problem.samples)
    assert torch.allclose(sum(parts).double(), planted_problem.mean(values, 2), rtol=1e-5)
    for chosen in itertools.combinations(range(2), 1):
        (part,) = planted_problem.losses(values, 2, chosen)
        assert torch.allclose(part, parts[chosen[0]] * 2, rtol=1e-5)
