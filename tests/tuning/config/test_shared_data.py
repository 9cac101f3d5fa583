"""`data` of a configuration as the path of a file."""

from pathlib import Path

import pytest
from planted import write_planted

from torchblur.errors import ConfigError
from torchblur.io import load_yaml, save_yaml
from tuning.config.fit import load_tune_config
from tuning.fit.run import run_fit

DATA = {"root": "../frames", "train": [{"kind": "scene", "path": "a.yaml", "spp": 32}]}
CONFIG = {"filter": {"kind": "guertin2014", "free": ["kappa"]}, "data": "shared/d.yaml"}


def save(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    save_yaml(path, data, overwrite=True)
    return path


@pytest.fixture
def config_file(tmp_path):
    save(tmp_path / "configs" / "shared" / "d.yaml", DATA)
    return save(tmp_path / "configs" / "x.yaml", CONFIG)


def test_it_is_as_if_it_stood_there(config_file, tmp_path):
    inline = save(tmp_path / "configs" / "y.yaml", CONFIG | {"data": DATA | {"root": "frames"}})
    shared = load_tune_config(config_file)
    assert shared == load_tune_config(inline)
    assert shared.data.root == str(tmp_path / "configs" / "frames")  # from shared/, one up


def test_without_a_root_paths_are_relative_to_the_file_of_the_data(config_file, tmp_path):
    save(tmp_path / "configs" / "shared" / "d.yaml", {"train": DATA["train"]})
    assert load_tune_config(config_file).data.root == str(tmp_path / "configs" / "shared")


def test_overrides_count_for_what_was_read(config_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = load_tune_config(config_file, ["data.train.0.spp=8", "data.root=mine"])
    assert config.data.train[0].spp == 8
    assert config.data.root == str(tmp_path / "mine")
    assert load_yaml(tmp_path / "configs" / "shared" / "d.yaml") == DATA


def test_another_file_by_an_override(config_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(tmp_path / "other.yaml", DATA | {"root": "there"})
    config = load_tune_config(config_file, ["data.train.0.spp=8", "data=other.yaml"])
    assert config.data.root == str(tmp_path / "there")
    assert config.data.train[0].spp == 8


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"`data` must be a mapping, or the path of.*d\.yaml does not exist.*\(x\.yaml: dat"),
        ({"train": []}, r"`train`.*d\.yaml: train"),
        ({"data": DATA}, r"unknown key `data`.*d\.yaml: data"),
        (
            DATA | {"train": [{"kind": "scene", "path": "a.yaml", "size": "9"}]},
            r"must be WIDTHxHEIGHT in px, got '9' \(shared/d\.yaml: train\.0\.size\)",
        ),
    ],
)
def test_mistakes_name_the_file_they_are_in(config_file, monkeypatch, content, message):
    monkeypatch.chdir(config_file.parent)
    path = Path("shared/d.yaml")
    path.unlink()
    if content is not None:
        save(path, content)
    with pytest.raises(ConfigError, match=message):
        load_tune_config("x.yaml")


def test_an_override_of_the_wrong_kind_names_the_configuration(config_file, monkeypatch):
    monkeypatch.chdir(config_file.parent)
    with pytest.raises(ConfigError, match=r"`spp`: .*2, got 1 \(x\.yaml: data\.train\.0\.spp\)"):
        load_tune_config("x.yaml", ["data.train.0.spp=1"])


def test_a_run_folder_holds_all_of_it(tmp_path):
    content = write_planted(tmp_path / "frames")
    save(tmp_path / "shared" / "d.yaml", content["data"] | {"root": "../frames"})
    methods = [{"kind": "gradient", "steps": 1, "starts": 1}]
    path = save(tmp_path / "x.yaml", content | {"data": "shared/d.yaml", "methods": methods})
    run_fit(load_tune_config(path), tmp_path / "run")
    (tmp_path / "shared" / "d.yaml").unlink()
    written = load_yaml(tmp_path / "run" / "config.yaml")["data"]
    assert written["root"] == str(tmp_path / "frames")
    assert [item["path"] for item in written["train"]] == ["first"]
    assert load_tune_config(tmp_path / "run" / "config.yaml").data.holdout[0].path == "second"
