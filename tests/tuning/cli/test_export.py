"""The command `export`: formats, names, and what it refuses."""

import json

import pytest
import torch
from tiny_shots import moving_square
from typer.testing import CliRunner

from torchblur.frame import Frame
from torchblur.presets import create_filter, load_preset
from tuning.cli.app import app


@pytest.fixture(autouse=True)
def _wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")


def run(*args, code=0):
    result = CliRunner().invoke(app, ["export", *map(str, args)])
    assert result.exit_code == code, f"{result.output}\n{result.exception!r}"
    assert "Traceback" not in result.output
    return result.output


@pytest.fixture
def preset(repository):
    return repository / "configs" / "filters" / "guertin2014-tuned.yaml"


@pytest.mark.parametrize(
    ("file", "options", "begins"),
    [
        ("a.hlsl", [], "// Motion-blur filter guertin2014, guertin2014-tuned.yaml;"),
        ("a.glsl", ["--prefix", "MB_"], "// Motion-blur filter guertin2014"),
        ("a.inc", ["--format", "hlsl"], "// Motion-blur filter guertin2014"),
        ("a.json", [], "{"),
    ],
)
def test_constants(tmp_path, preset, file, options, begins):
    path = tmp_path / file
    assert f"wrote {path}" in run(preset, "-o", path, *options)
    text = path.read_text()
    assert text.startswith(begins)
    name = "MB_kappa" if options[:1] == ["--prefix"] else "blur_kappa"
    kappa = load_preset(preset).params["kappa"]
    assert (f'"value": {kappa}' if file == "a.json" else f" float {name} = {kappa};") in text


def test_a_filter_as_published_and_changed(tmp_path):
    path = tmp_path / "x.json"
    run("line", "-o", path, "--set", "num_samples=9")
    document = json.loads(path.read_text())
    assert document["preset"] == "as published, changed: num_samples=9"
    assert [p["value"] for p in document["parameters"] if p["tuned"]] == [9]
    assert document["evidence"] == {}


def test_a_program(tmp_path):
    path = tmp_path / "blur.pt2"
    run("mcguire2012", "-o", path, "--size", "48x32", "--set", "num_samples=3")
    notes = {"torchblur.json": ""}
    program = torch.export.load(path, extra_files=notes).module()
    assert json.loads(notes["torchblur.json"])["filter"] == "mcguire2012"
    square = moving_square(size=(32, 48))
    frame = Frame(color=square.color, velocity=square.velocity, depth=square.depth)
    with torch.no_grad():
        want = create_filter("mcguire2012", num_samples=3)(frame)
    got = program(frame.color, frame.velocity, frame.depth)
    torch.testing.assert_close(got, want, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["line", "-o", "{}/x.txt"], "the ending of x.txt names no format; --format json|hlsl"),
        (["line", "-o", "{}/x.txt", "--format", "jsn"], "unknown format `jsn` (did you mean"),
        (["lin", "-o", "{}/x.json"], "unknown filter `lin` (did you mean `line`?)"),
        (["line", "-o", "{}/old.json"], "old.json exists; overwrite=True (--overwrite) replaces"),
        (["line", "-o", "{}/old.pt2"], "old.pt2 exists; overwrite=True (--overwrite) replaces"),
        (["line", "-o", "{}/x.json", "--set", "shuter=1"], "unknown key `shuter` (did you mean"),
        (["line", "-o", "{}/x.hlsl", "--prefix", "1_"], "`prefix` must be letters"),
        (["warp", "-o", "{}/x.pt2"], "`warp` cannot be exported as a program"),
        (["line", "-o", "{}/x.pt2", "--size", "48"], "`size` must be WIDTHxHEIGHT"),
    ],
)
def test_refused_with_one_error(tmp_path, args, message):
    for name in ("old.json", "old.pt2"):
        (tmp_path / name).write_text("old")
    output = run(*(a.format(tmp_path) for a in args), code=2)
    assert message in output
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["old.json", "old.pt2"]
    assert (tmp_path / "old.json").read_text() == "old"
