"""Constants for other languages: what is written is what the filter computes with."""

import json
import re

import numpy as np
import pytest

from torchblur.errors import ConfigError, OutputError
from torchblur.export import constants_of, constants_text, write_constants
from torchblur.filters import get_filter, list_filters
from torchblur.params import choices, declared
from torchblur.presets import Preset, create_filter, load_preset

FILTERS = sorted(list_filters())
CONST = {"hlsl": r"static const", "glsl": r"const"}


def parsed(text, language, prefix="blur_"):
    """Return values by name, as a compiler reads them: no comment, each name once."""
    values, defined = {}, {}
    for line in text.splitlines():
        code = line.split("//")[0].strip()
        if not code or code.startswith(("#ifndef", "#endif")):
            continue
        if match := re.fullmatch(r"#define ([A-Za-z]\w*) (\d+)", code):
            assert match[1] not in defined, line
            defined[match[1]] = int(match[2])
        elif not re.fullmatch(r"#define [A-Z0-9_]+_CONSTANTS", code):
            pattern = rf"{CONST[language]} (float|int|bool) {prefix}([a-z]\w*) = (\S+);"
            match = re.fullmatch(pattern, code)
            assert match is not None, line
            assert match[2] not in values, line
            values[match[2]] = {"float": as_float, "int": int, "bool": as_bool}[match[1]](match[3])
    return values, defined


def as_float(text):
    assert re.fullmatch(r"-?\d+\.\d+|-?\d+(\.\d+)?e[+-]\d+", text), text
    return np.float32(text)


def as_bool(text):
    return {"true": True, "false": False}[text]


def off_default(name):
    """Return a preset of a filter with no parameter at its default."""
    model = get_filter(name).config_class
    params = {}
    for index, (key, spec) in enumerate(declared(model).items()):
        default = getattr(model(), key)
        if isinstance(default, bool):
            params[key] = not default
        elif isinstance(default, str):
            params[key] = next(c for c in choices(model, key) if c != default)
        elif isinstance(default, int):
            params[key] = default + 1
        else:
            low, high = spec.bounds
            params[key] = low + (high - low) / (3 + 0.1 * index)
    return Preset(filter=name, params=params)


class TestShaders:
    @pytest.mark.parametrize("language", ["hlsl", "glsl"])
    @pytest.mark.parametrize("name", FILTERS)
    def test_every_parameter_of_every_filter_comes_back(self, name, language):
        preset = off_default(name)
        text = constants_text(preset, language)
        values, defined = parsed(text, language)
        model = get_filter(name).config_class
        for key in declared(model):
            want = preset.params[key]
            if isinstance(want, str):
                options = choices(model, key)
                assert defined.pop(f"blur_{key}") == options.index(want)
                for number, option in enumerate(options):
                    assert defined.pop(f"blur_{key}_{option}") == number
            else:
                want = np.float32(want) if isinstance(want, float) else want
                assert values.pop(key) == want
        assert not values
        assert not defined

    def test_floats_are_those_of_the_filter(self, repository):
        path = repository / "configs" / "filters" / "guertin2014-tuned.yaml"
        values, _ = parsed(constants_text(load_preset(path), "hlsl"), "hlsl")
        blur = create_filter(path)
        numbers = {name: p.item() for name, p in [*blur.named_parameters(), *blur.named_buffers()]}
        assert len(numbers) > 10
        for name, number in numbers.items():
            assert float(values[name]) == number

    def test_head_of_a_quality_level(self):
        figures = {"holdout": {"default": {"flip": 0.05}, "low": {"flip": 0.04}}}
        preset = Preset(filter="line", evidence={"figures": figures})
        head = constants_text(preset, "glsl").split("\n\n")[0]
        assert "hold-out frames, published -> tuned: flip 0.05 -> 0.04." in head

    def test_head_and_comments(self, repository):
        path = repository / "configs" / "filters" / "guertin2014-tuned.yaml"
        preset = load_preset(path)
        text = constants_text(preset, "glsl", name=path.name)
        head = text.split("\n\n")[0]
        figures = preset.evidence["figures"]["holdout"]
        before, after = (f"{figures[name]['flip']:.4g}" for name in ("default", "tuned"))
        assert "guertin2014, guertin2014-tuned.yaml; written by torchblur 0.1.0" in head
        assert f"hold-out frames, published -> tuned: flip {before} -> {after}" in head
        assert "Made by: torchblur tune configs/tune/guertin2014.yaml" in head
        assert f"const float blur_kappa = {preset.params['kappa']};  // published: 40.0\n" in text
        assert "[kappa; 1 to 1000]" in text
        assert (
            "#define blur_noise 2  // none of 0 halton, 1 gradient, 2 none; published: halton"
            in (text)
        )
        assert "const float blur_eta = 0.95;\n" in text  # not tuned
        assert text.isascii()
        assert text.count("#ifndef") == text.count("#endif") == 1

    def test_no_text_breaks_out_of_its_comment(self):
        evidence = {"command": "tune a\nstatic const int x = 1;\\", "figures": {"holdout": "none"}}
        text = constants_text(Preset(filter="line", evidence=evidence), "hlsl", name="κ\\\n.yaml")
        head = text.split("\n\n")[0]
        assert all(line.startswith("//") for line in head.splitlines())
        assert not any(line.endswith("\\") for line in text.splitlines())

    @pytest.mark.parametrize("prefix", ["9x", "a-b", "a__b", "gl_", "", "blur__"])
    def test_refuses_names_that_are_none(self, prefix):
        preset = Preset(filter="guertin2014")
        with pytest.raises(ConfigError, match=rf"`?prefix`?.* got '{prefix}'"):
            constants_text(preset, "glsl", prefix=prefix)

    def test_prefix_keeps_two_filters_apart(self):
        near, far = (
            constants_text(Preset(filter="line"), "hlsl", prefix=prefix) for prefix in ("a_", "b_")
        )
        names = [set(re.findall(r"\b[ab]_\w+|\b[AB]_\w+", text)) for text in (near, far)]
        assert names[0]
        assert not names[0] & names[1]


class TestJson:
    @pytest.mark.parametrize("name", FILTERS)
    def test_holds_everything(self, name):
        preset = off_default(name)
        document = json.loads(constants_text(preset, "json", name="x.yaml"))
        assert (document["filter"], document["preset"]) == (name, "x.yaml")
        entries = {entry["name"]: entry for entry in document["parameters"]}
        specs = declared(get_filter(name).config_class)
        assert list(entries) == list(specs)
        for key, spec in specs.items():
            entry, want = entries[key], preset.params[key]
            assert entry["tuned"]
            assert (entry["symbol"], entry["unit"]) == (spec.symbol, spec.unit)
            assert (entry["source"], entry["meaning"]) == (spec.source, spec.meaning)
            assert type(entry["value"]) is type(want)
            if isinstance(want, float):
                assert np.float32(entry["value"]) == np.float32(want)
                assert entry["range"] == list(spec.bounds)
            else:
                assert entry["value"] == want
            if isinstance(want, str):
                assert want in entry["choices"]

    def test_can_be_read_back_as_a_preset(self, repository):
        path = repository / "configs" / "filters" / "guertin2014-tuned.yaml"
        preset = load_preset(path)
        document = json.loads(constants_text(preset, "json"))
        tuned = {e["name"]: e["value"] for e in document["parameters"] if e["tuned"]}
        assert tuned == preset.params
        assert document["evidence"] == preset.evidence

    def test_evidence_of_any_form(self):
        evidence = {"worst": float("nan"), "at": {1: (2, 3)}}
        text = constants_text(Preset(filter="line", evidence=evidence), "json")
        assert json.loads(text)["evidence"] == {"worst": None, "at": {"1": [2, 3]}}


class TestFiles:
    def test_written_whole_and_not_over_another(self, tmp_path):
        path, preset = tmp_path / "line.hlsl", Preset(filter="line")
        write_constants(path, preset, "hlsl")
        assert path.read_text() == constants_text(preset, "hlsl")
        with pytest.raises(OutputError, match=r"line\.hlsl exists"):
            write_constants(path, preset, "glsl")
        write_constants(path, preset, "glsl", overwrite=True)
        assert path.read_text() == constants_text(preset, "glsl")
        assert [entry.name for entry in tmp_path.iterdir()] == ["line.hlsl"]

    def test_a_refused_preset_leaves_nothing(self, tmp_path):
        with pytest.raises(ConfigError, match=r"kappa.*-3"):
            write_constants(
                tmp_path / "x.json", Preset(filter="guertin2014", params={"kappa": -3.0}), "json"
            )
        assert not list(tmp_path.iterdir())

    def test_unknown_format(self):
        with pytest.raises(ConfigError, match=r"unknown format `hsl`.*did you mean `hlsl`"):
            constants_text(Preset(filter="line"), "hsl")


def test_constants_know_what_is_tuned():
    found = {c.name: c for c in constants_of(Preset(filter="line", params={"num_samples": 7}))}
    assert found["num_samples"].tuned
    assert (found["num_samples"].value, found["num_samples"].kind) == (7, "int")
    assert not found["shutter"].tuned
