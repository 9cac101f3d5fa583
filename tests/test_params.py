from typing import Annotated, Literal

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from torchblur.errors import ConfigError, nearest_name
from torchblur.params import Config, Param, build, choices, declared


class Inner(Config):
    gamma: Annotated[
        float,
        Param(unit="px", low=0.05, high=20, scale="log", grad="smooth", source="s", meaning="m"),
    ] = 1.5
    count: Annotated[int, Param(low=1, high=9, grad="discrete", source="s", meaning="m")] = 3
    mode: Annotated[Literal["a", "b"], Param(grad="discrete", source="s", meaning="m")] = "a"
    switch: Annotated[bool, Param(grad="discrete", source="s", meaning="m")] = True


class Left(Config):
    kind: Literal["left"]
    steps: int = 1


class Right(Config):
    kind: Literal["right"]
    trials: int = 1


class Outer(Config):
    inner: Inner = Inner()
    methods: list[Annotated[Left | Right, Field(discriminator="kind")]] = Field(
        default_factory=list
    )
    needed: str
    terms: dict[Literal["flip", "ssim"], float] = Field(default_factory=dict)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"inner": {"gamma": -1.5}}, r"`gamma` must lie in \[0.05, 20\] px, got -1.5 \(f: inner.g"),
        ({"inner": {"gamma": float("nan")}}, r"`gamma`.*nan \(f: inner.gamma\)"),
        ({"inner": {"gamma": "1.5"}}, r"`gamma`: .*valid number, got '1.5' \(f: inner.gamma\)"),
        ({"inner": {"gamma": True}}, r"`gamma`: .*number, got True"),
        ({"inner": {"count": 2.5}}, r"`count`: .*integer, got 2.5"),
        ({"inner": {"count": 10}}, r"`count` must lie in \[1, 9\], got 10"),
        ({"inner": {"mode": "c"}}, r"`mode`: .*'a' or 'b', got 'c'"),
        ({"inner": {"switch": 1}}, r"`switch`: .*boolean, got 1"),
        (
            {"inner": {"gama": 1}},
            r"unknown key `gama` \(did you mean `gamma`\?\) \(f: inner.gama\)",
        ),
        (
            {"methods": [{"kind": "left", "step": 2}]},
            r"`step` \(did you mean `steps`.*methods.0.st",
        ),
        ({"methods": [{"kind": "rigth"}]}, r"'left', 'right'.*methods.0"),
        ({"needed": None}, r"`needed`: .*string, got None"),
        ({"terms": {"flop": 1.0}}, r"`flop`: .*'flip' or 'ssim', got 'flop' \(f: terms.flop\)"),
        ({}, r"`needed` is required and is missing \(f: needed\)"),
    ],
)
def test_one_clear_error(data, message):
    given_data = data if "needed" in data or not data else {"needed": "x"} | data
    with pytest.raises(ConfigError, match=message):
        build(Outer, given_data, "f")


def test_all_mistakes_are_listed():
    with pytest.raises(ConfigError) as caught:
        build(Outer, {"inner": {"gamma": 99, "count": 0, "zzz": 1}})
    assert len(str(caught.value).splitlines()) == 4


def test_declarations():
    assert list(declared(Inner)) == ["gamma", "count", "mode", "switch"]
    assert choices(Inner, "mode") == ("a", "b")
    assert choices(Inner, "switch") == (False, True)
    schema = Inner.model_json_schema()["properties"]["gamma"]
    assert (schema["minimum"], schema["maximum"]) == (0.05, 20)
    assert "px" in schema["description"]
    with pytest.raises(TypeError, match="a choice and has no range"):
        _ = declared(Inner)["mode"].bounds


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"low": 1}, "both `low` and `high`"),
        ({"low": 2, "high": 1}, "`low < high` must hold, got 2 and 1"),
        ({"low": 0, "high": 1, "scale": "log"}, "a log scale needs `low > 0`, got 0"),
    ],
)
def test_declarations_are_checked(bad, message):
    with pytest.raises(TypeError, match=message):
        Param(grad="smooth", source="s", meaning="m", **bad)


@given(st.floats(0, 1), st.sampled_from(["linear", "log"]))
def test_unit_cube_round_trip(unit, scale):
    spec = Param(low=0.05, high=20, scale=scale, grad="smooth", source="s", meaning="m")
    value = spec.from_unit(torch.tensor(unit, dtype=torch.float64))
    assert 0.05 <= float(value) <= 20
    assert float(spec.to_unit(value)) == pytest.approx(unit, abs=1e-9)


def test_log_scale_has_its_middle_at_the_geometric_mean():
    spec = Param(low=1, high=100, scale="log", grad="smooth", source="s", meaning="m")
    assert float(spec.from_unit(torch.tensor(0.5))) == pytest.approx(10)


def test_tensors_of_values_are_checked():
    spec = declared(Inner)["gamma"]
    spec.check("gamma", torch.tensor([0.05, 20.0]))
    for bad in (0.01, 21.0, torch.nan):
        with pytest.raises(ConfigError, match=r"`gamma` must lie in \[0.05, 20\] px, got"):
            spec.check("gamma", torch.tensor([1.0, bad]))


def test_nearest_name():
    assert nearest_name("kapa", ["kappa", "gamma"]) == " (did you mean `kappa`?)"
    assert nearest_name("zzz", ["kappa"]) == ""


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_a_fit_can_leave_the_ends_of_a_range(scale):
    """Rounding may put the end of a range outside: cutting that off must keep the gradient."""
    ends = [(0.01, 3.0), (0.01, 40.0), (0.05, 20.0), (1.0, 1000.0)]
    for low, high in ends:
        spec = Param(meaning="", grad="smooth", source="", low=low, high=high, scale=scale)
        unit = torch.tensor([0.0, 1.0], dtype=torch.float64, requires_grad=True)
        values = spec.from_unit(unit)
        assert low <= float(values[0]) <= float(values[1]) <= high
        values.sum().backward()
        slopes = (low, high) if scale == "log" else (1.0, 1.0)
        span = torch.tensor(high / low).log().item() if scale == "log" else high - low
        assert unit.grad.tolist() == pytest.approx([slope * span for slope in slopes], rel=1e-6)
