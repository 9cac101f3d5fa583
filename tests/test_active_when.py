"""What a parameter's `active_when` says is true: where it does not hold nothing changes."""

import pytest
import torch

from torchblur.filters import get_filter, list_filters
from torchblur.params import Param, choices, declared, idle
from torchblur.testing.frames import as_stream, moving_square

WAITING = [
    (name, parameter)
    for name, kind in list_filters().items()
    for parameter, spec in declared(kind.config_class).items()
    if spec.active_when
]


def layers(name, params, frame):
    kind = get_filter(name)
    given = as_stream(frame) if "time" in kind.needs else frame
    return {k: v.detach() for k, v in kind(**params).layers(given).items()}


def another(model, parameter, value):
    """A value that differs from one, as far from it as may be."""
    spec = declared(model)[parameter]
    if spec.low is None:
        return next(choice for choice in choices(model, parameter) if choice != value)
    low, high = spec.bounds
    whole = model.model_fields[parameter].annotation is int
    far = min(high, 8.0) if value < 3 else max(low, 0.5 * value)
    return round(far) if whole else float(far)


def breaking(model, condition):
    """Settings under which one part of a condition does not hold."""
    name, how, value = condition
    if how == "==":
        return {name: next(c for c in choices(model, name) if c != value)}
    if how == "!=":
        return {name: value}
    whole = model.model_fields[name].annotation is int
    return {name: int(value) if whole else value}


@pytest.mark.filterwarnings("ignore:tan2022. no layer:UserWarning")
@pytest.mark.parametrize(("name", "parameter"), WAITING)
def test_what_waits_changes_nothing(name, parameter):
    model = get_filter(name).config_class
    frame = moving_square(20, 26)
    for condition in declared(model)[parameter].conditions:
        settings = {"tile_size": 6} if "tile_size" in model.model_fields else {}
        settings |= breaking(model, condition)
        assert parameter in idle(model, settings)
        value = model.model_fields[parameter].default
        before = layers(name, settings, frame)
        after = layers(name, settings | {parameter: another(model, parameter, value)}, frame)
        for key, plane in before.items():
            assert torch.equal(plane, after[key]), (condition, key)


@pytest.mark.parametrize(("name", "parameter"), WAITING)
def test_conditions_name_parameters_and_their_values(name, parameter):
    model = get_filter(name).config_class
    specs = declared(model)
    for other, how, value in specs[parameter].conditions:
        assert other in specs
        assert other != parameter
        valid = choices(model, other)
        assert value in valid if valid else how == ">"


def test_what_waits_for_what_waits_waits_too():
    model = get_filter("notes2025").config_class
    found = idle(model, {"resolution": "full", "alpha_fade": True})
    assert found["alpha_fade"] == found["fade_start"] == "resolution == half"
    assert "fade_start" not in idle(model, {"resolution": "half"})
    assert "fade_start" not in idle(model, {}, free={"resolution"})


def test_a_condition_that_is_none_is_refused():
    with pytest.raises(TypeError, match="no condition: 'reach is frame'"):
        Param(meaning="", grad="discrete", source="", active_when="reach is frame")


def test_of_the_default_filter_little_waits():
    model = get_filter("torchblur").config_class
    assert len(idle(model, {})) <= 7
