"""Configurations: what is accepted, and that each mistake is one clear message."""

import copy
from pathlib import Path

import pytest

from torchblur.errors import ConfigError, FileFormatError
from torchblur.io import save_yaml
from torchblur.params import build
from torchblur.presets import Preset, save_preset
from tuning.config.fit import TuneConfig, load_tune_config, resolve
from tuning.config.overrides import apply_overrides
from tuning.objective.space import make_space

BASE = {
    "filter": {"kind": "guertin2014", "params": {"num_samples": 15}, "free": ["kappa"]},
    "data": {"train": [{"kind": "scene", "path": "a.yaml"}]},
}


def changed(**sections):
    data = copy.deepcopy(BASE)
    for key, value in sections.items():
        data[key] = data[key] | value if isinstance(value, dict) and key in data else value
    return data


def load(tmp_path, data, overrides=()):
    save_yaml(tmp_path / "x.yaml", data, overwrite=True)
    return load_tune_config(tmp_path / "x.yaml", overrides)


def test_every_shipped_configuration_loads(repository):
    files = sorted((repository / "configs" / "tune").glob("*.yaml"))
    assert len(files) >= 3
    for file in files:
        config = load_tune_config(file)
        for item in (*config.data.train, *config.data.holdout):
            if not item.kind.startswith("exr"):
                assert (Path(config.data.root) / item.path).is_file(), f"{file}: {item.path}"


def test_the_demo_has_what_it_promises(repository):
    config = load_tune_config(repository / "configs" / "tune" / "demo.yaml")
    continuous = make_space(config.filter).continuous().names
    assert len(continuous) >= 6
    assert len(config.data.train) >= 4
    assert len(config.data.holdout) >= 2
    assert {method.kind for method in config.methods} == {"gradient", "blackbox"}


def test_the_demo_is_checked_at_1080_lines(repository):
    data = load_tune_config(repository / "configs" / "tune" / "demo.yaml").data
    assert [item.lines for item in data.train] == [None] * 4
    assert [item.lines for item in data.holdout] == [None] * 4 + [1080]


def test_resolved_configuration_is_read_back_equal(tmp_path):
    config = load(tmp_path, changed(data={"root": "frames"}))
    assert config.data.root == str(tmp_path / "frames")
    save_yaml(tmp_path / "again.yaml", config.model_dump(mode="json"))
    assert load_tune_config(tmp_path / "again.yaml") == config
    assert resolve(config) == config


def test_overrides_replace_single_values(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path.parent)
    overrides = ["seed=7", "data.root=frames", "data.train.0.spp=8", "filter.params.gamma=2.5"]
    config = load(tmp_path, BASE, overrides)
    assert (config.seed, config.data.train[0].spp) == (7, 8)
    assert config.data.root == str(tmp_path.parent / "frames")
    assert config.filter.params["gamma"] == 2.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed", "must be KEY.PATH=VALUE, got 'seed'"),
        ("data.train.3.spp=1", r"`3` leads into a list of 1"),
        ("seed.x=1", "`x` leads into the value 3"),
        ("seed=[1", "not YAML"),
    ],
)
def test_bad_overrides(text, message):
    data = BASE | {"seed": 3}
    before = copy.deepcopy(data)
    if text == "seed.x=1":
        text = "seed.x.y=1"
    with pytest.raises(ConfigError, match=message):
        apply_overrides(data, [text])
    assert data == before


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (changed(filtre={}), r"unknown key `filtre` \(did you mean `filter`\?\) \(x\.yaml: filtre"),
        (
            changed(filter={"params": {"gama": 1.0}}),
            r"unknown key `gama` \(did you mean `gamma`\?\) \(x\.yaml: filter\.params\.gama\)",
        ),
        (
            changed(filter={"params": {"gamma": -1.5}}),
            r"`gamma` must lie in \[0\.05, 20\] px, got -1\.5 \(x\.yaml: filter\.params\.gamma\)",
        ),
        (
            changed(filter={"free": ["kapa"]}),
            r"unknown parameter `kapa` of guertin2014 \(did you mean `kappa`\?\) "
            r"\(x\.yaml: filter\.free\.kapa\)",
        ),
        (
            changed(filter={"free": {"kappa": {"low": 0.5}}}),
            r"range of `kappa` must lie within \[1, 1000\], got \[0\.5, 1000\]",
        ),
        (
            changed(filter={"free": {"kappa": {"low": 9, "high": 9}}}),
            r"`low < high` must hold for `kappa`, got 9 and 9",
        ),
        (
            changed(filter={"params": {"kappa": 5.0}, "free": {"kappa": {"low": 9}}}),
            r"`kappa` starts at 5, outside its range \[9, 1000\]",
        ),
        (
            changed(filter={"free": {"kappa": {"choices": [10.0]}}}),
            "`kappa` is continuous: give `low` and `high`",
        ),
        (
            changed(filter={"free": {"directions": {"low": 1}}}),
            "`directions` is given as choices and has no `low`",
        ),
        (
            changed(filter={"free": ["num_samples"]}),
            r"`num_samples` is discrete and has no usable gradient; fit it with a `blackbox`",
        ),
        (
            changed(filter={"free": ["kappa"], "params": {"center_weight": False}}),
            r"`kappa` of guertin2014 acts only with `center_weight == true`: .*filter\.free\.kappa",
        ),
        (changed(filter={"free": ["gamma"]}), r"`gamma` is weak and has no usable gradient"),
        (
            changed(methods=[{"kind": "gradient", "free": ["kapa"]}]),
            r"`kapa` is not among the free parameters \(did you mean `kappa`\?\)",
        ),
        (changed(methods=[{"kind": "gradient", "steps": 0}]), "`steps`: .*1, got 0"),
        (changed(methods=[{"kind": "magic"}]), "magic"),
        (changed(filter={"params": {"shutter": 1.0}}), "`shutter` belongs to the items under data"),
        (changed(filter={"kind": "guertin2041"}), r"did you mean `guertin2014`.*filter\.kind"),
        (changed(filter={"free": []}), "free"),
        (
            changed(data={"train": [{"kind": "scene", "path": "a.yaml", "size": "320"}]}),
            r"`size` must be WIDTHxHEIGHT in px, got '320' \(x\.yaml: data\.train\.0\.size\)",
        ),
        (changed(objective={"terms": {"flipp": 1.0}}), "flipp"),
        (changed(objective={"terms": {"flip": -1.0}}), "-1"),
        (changed(objective={"terms": {}}), r"`terms` or `band` must name a metric.*x\.yaml: obj"),
        (
            changed(objective={"band": {"flip": 1.0}, "band_weight": 0.3}),
            r"give weights of the `band`, or its share `band_weight`, not both.*x\.yaml: objective",
        ),
        (changed(objective={"band": {"psnrr": 1.0}}), r"psnrr.*x\.yaml: objective\.band\.psnrr"),
        (changed(objective={"tail": 1.5}), r"`tail`: .*1, got 1\.5 \(x\.yaml: objective\.tail"),
        (changed(objective={"reduction": "median"}), r"'mean', 'cvar' or 'worst', got 'median'"),
    ],
)
def test_mistakes_name_rule_value_and_place(tmp_path, monkeypatch, data, message):
    monkeypatch.chdir(tmp_path)
    save_yaml("x.yaml", data)
    with pytest.raises(ConfigError, match=message):
        load_tune_config("x.yaml")


def test_what_a_free_switch_may_turn_on_can_be_fitted(tmp_path):
    free = {"kappa": None, "center_weight": None}
    data = changed(
        filter={"free": free, "params": {"center_weight": False}},
        methods=[{"kind": "blackbox", "trials": 2}],
    )
    config = resolve(build(TuneConfig, data), folder=tmp_path)
    assert tuple(config.filter.free) == ("kappa", "center_weight")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileFormatError, match=r"none\.yaml does not exist"):
        load_tune_config(tmp_path / "none.yaml")


def test_weak_parameters_are_fitted_when_a_method_names_them(tmp_path):
    methods = [{"kind": "gradient", "free": ["gamma"]}]
    data = changed(filter={"free": ["gamma", "kappa"]}, methods=methods)
    assert load(tmp_path, data).methods[0].free == ("gamma",)


def test_preset_as_filter(tmp_path):
    preset = Preset(filter="mcguire2012", params={"num_samples": 7, "shutter": 1.0, "jitter": 0.5})
    save_preset(tmp_path / "mine.yaml", preset)
    data = changed(
        filter={"kind": "mine.yaml", "params": {"jitter": 0.25}, "free": ["center_gain"]}
    )
    spec = load(tmp_path, data).filter
    assert spec.kind == "mcguire2012"
    assert spec.params == {"num_samples": 7, "jitter": 0.25}


def test_space_starts_within_a_range_that_excludes_the_default(tmp_path):
    data = changed(filter={"free": {"kappa": {"low": 100, "high": 200}}})
    parameter = make_space(load(tmp_path, data).filter).parameters[0]
    assert (parameter.start, parameter.default) == (100, 40)
    assert parameter.spec.bounds == (100, 200)
    assert parameter.rounded(199.9999999) == 200
    assert parameter.rounded(123.4567891) == 123.457


def test_unit_cube_and_back(tmp_path):
    data = changed(filter={"free": ["kappa", "third_gain"]})
    space = make_space(load(tmp_path, data).filter)
    values = {"kappa": 12.5, "third_gain": 3.0}
    back = space.from_unit(space.to_unit(values)[None])
    assert {name: float(v) for name, v in back.items()} == pytest.approx(values)


def test_json_schema_for_editors():
    schema = TuneConfig.model_json_schema()
    assert set(schema["properties"]) >= {"filter", "data", "objective", "methods", "seed"}
    with pytest.raises(ConfigError, match="`data` is required"):
        build(TuneConfig, {"filter": BASE["filter"]}, "x")
