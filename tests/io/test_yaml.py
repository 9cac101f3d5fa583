"""YAML 1.2: what it means, what is refused, and where the mistake stands."""

import math

import numpy as np
import pytest

from torchblur.errors import ConfigError, FileFormatError, OutputError
from torchblur.io.yaml import line_of, load_yaml, save_yaml


@pytest.fixture
def file(tmp_path):
    def make(text):
        path = tmp_path / "c.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return make


def test_numbers_and_words_follow_yaml_1_2(file):
    data = load_yaml(file("a: 1e-3\nb: 3e1\nc: on\nd: 1:30\ne: .inf\nf: [1, 2.5, true, null]\n"))
    assert data == {
        "a": 1e-3,
        "b": 30.0,
        "c": "on",
        "d": "1:30",
        "e": math.inf,
        "f": [1, 2.5, True, None],
    }
    assert type(data) is dict
    assert type(data["f"]) is list


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb:\n  x: 1\n  x: 2\n", r'c\.yaml:4:3: found duplicate key "x"'),
        ("a: [1,\nb: 2", r"c\.yaml:2:5: not YAML: .*expected ',' or '\]'"),
        ("a: b: c", r"c\.yaml:1:5: not YAML: mapping values are not allowed"),
        ("a: !!python/object/apply:os.system [ls]", r"c\.yaml:1:4: not YAML: .*tag"),
        ("- 1\n", r"c\.yaml: must hold a mapping .*, got a list"),
        ("# only a comment\n", r"c\.yaml: must hold a mapping .*, got nothing"),
        ("word", r"c\.yaml: must hold a mapping .*, got a str"),
    ],
)
def test_mistakes_are_named_with_their_place(file, text, message):
    with pytest.raises(ConfigError, match=message):
        load_yaml(file(text))


def test_what_is_no_text_file_is_refused(tmp_path):
    (tmp_path / "c.yaml").write_bytes(b"a: \xff\xfe")
    with pytest.raises(FileFormatError, match=r"not a text file in UTF-8 \(byte 3\)"):
        load_yaml(tmp_path / "c.yaml")
    with pytest.raises(FileFormatError, match=r"none\.yaml does not exist"):
        load_yaml(tmp_path / "none.yaml")


def test_round_trip_in_order_with_a_comment(tmp_path):
    data = {
        "z": 1e-3,
        "a": [1, 2.5, {"x": [1, 2]}],
        "on": True,
        "text": "1e-3",
        "κ": "on: off",
        "far": math.inf,
        "none": None,
        "big": 1e10,
        "third": 1 / 3,
    }
    path = tmp_path / "c.yaml"
    save_yaml(path, data, comment="first line\nsecond")
    assert path.read_text(encoding="utf-8").startswith("# first line\n# second\nz: 0.001\n")
    got = load_yaml(path)
    assert got == data
    assert list(got) == list(data)


def test_tuples_and_paths_become_plain(tmp_path):
    save_yaml(tmp_path / "c.yaml", {"a": (1, 2), "p": tmp_path})
    assert load_yaml(tmp_path / "c.yaml") == {"a": [1, 2], "p": str(tmp_path)}


def test_saving_refuses_what_yaml_cannot_hold_and_what_exists(tmp_path):
    path = tmp_path / "c.yaml"
    with pytest.raises(ConfigError, match=r"cannot represent an object: np\.float32\(1\.0\)"):
        save_yaml(path, {"a": np.float32(1)})
    assert list(tmp_path.iterdir()) == []
    save_yaml(path, {"a": 1})
    with pytest.raises(OutputError, match=r"c\.yaml exists"):
        save_yaml(path, {"a": 2})
    save_yaml(path, {"a": 2}, overwrite=True)
    assert load_yaml(path) == {"a": 2}


def test_line_of_finds_keys_and_items(file):
    path = file("# head\na: 1\nfilter:\n  params:\n    gamma: 1\n  list:\n    - x: 1\n    - y: 2\n")
    assert line_of(path, ("a",)) == 2
    assert line_of(path, ("filter", "params", "gamma")) == 5
    assert line_of(path, ("filter", "list", 1, "y")) == 8
    assert line_of(path, ("filter", "nothing")) is None
    assert line_of(path, ("a", "b", "c")) is None
