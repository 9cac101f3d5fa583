"""Parameters that change nothing on the frames of a fit are found before it."""

import dataclasses

import pytest
import torch
from planted import FIXED, planted_case

from torchblur.filters import get_filter
from torchblur.frame import Frame
from tuning.config.data import Crops
from tuning.config.fit import FilterSpec
from tuning.config.objective import ObjectiveSpec
from tuning.objective.effect import without_effect
from tuning.objective.problem import Problem
from tuning.objective.space import make_space
from tuning.objective.windows import make_samples


def problem_of(cases, free, **params):
    spec = FilterSpec(kind="guertin2014", params=FIXED | params, free=free)
    space, blur = make_space(spec), get_filter("guertin2014")(**FIXED, **params)
    blur.requires_grad_(False)
    samples = make_samples(cases, Crops(), tile_size=12, seed=1, blur=blur)
    return Problem(blur, samples, ObjectiveSpec(terms={"mse": 1.0}), space.names), space


def still(case):
    frame = case.frame
    zero = Frame(color=frame.color, depth=frame.depth, velocity=torch.zeros_like(frame.velocity))
    return dataclasses.replace(case, frame=zero)


FREE = ["kappa", "third_gain", "soft_depth_extent", "num_samples", "directions"]


def test_what_waits_for_a_switch_is_named():
    problem, space = problem_of([planted_case(1)], FREE)
    assert without_effect(problem, space) == ("soft_depth_extent",)


def test_where_nothing_moves_all_are_named_and_one_moving_frame_is_enough():
    frames = [still(planted_case(1))]
    problem, space = problem_of(frames, FREE)
    assert without_effect(problem, space) == tuple(FREE)
    problem, space = problem_of([*frames, planted_case(2)], FREE)
    assert without_effect(problem, space) == ("soft_depth_extent",)


@pytest.mark.parametrize("choices", [[True], [True, False]])
def test_choices_are_those_of_the_configuration(choices):
    problem, space = problem_of([planted_case(1)], {"center_weight": {"choices": choices}})
    assert without_effect(problem, space) == (("center_weight",) if choices == [True] else ())
