"""`torchblur render` of families: a folder for each scene, and what is kept."""

import pytest
from typer.testing import CliRunner

from torchblur.io import read_frame, read_image
from torchblur.params import build
from torchblur.render import draw_scene, load_family, load_scene, render_frame, render_reference
from tuning.cli.app import app
from tuning.config.data import DataSpec
from tuning.data.loading import load_cases

runner = CliRunner()
FAMILY = """
groups:
  - {name: a, count: [1, 2], kinds: {sphere: 1, box: 1}, motions: {linear: 1}, depth: [3, 5]}
"""


@pytest.fixture
def family(tmp_path):
    path = tmp_path / "some.yaml"
    path.write_text(FAMILY)
    return path


def render(source, out, *more, code=0):
    args = ("render", source, "-o", out, "--size", "32x24", "--spp", "4", *more)
    result = runner.invoke(app, [str(arg) for arg in args])
    assert result.exit_code == code, result.output
    return " ".join(result.output.split())


def test_scenes_have_folders_of_their_own(family, tmp_path):
    out = tmp_path / "out"
    render(family, out, "--seed", "5", "--scenes", "2", "--frames", "2")
    names = ["reference.0000.exr", "reference.0001.exr"]
    for seed in (5, 6):
        stem = f"some-{seed:04d}"
        own = [f"{stem}.0000.exr", f"{stem}.0001.exr", f"{stem}.yaml"]
        assert sorted(f.name for f in (out / stem).iterdir()) == sorted([*names, *own])
        scene = draw_scene(load_family(family), seed)
        assert load_scene(out / stem / f"{stem}.yaml") == scene
        want = render_reference(scene, (24, 32), spp=4, frame=1, seed=seed + 1).mean
        assert read_image(out / stem / "reference.0001.exr").equal(want)
        sharp = read_frame(out / stem / f"{stem}.0000.exr")
        assert sharp.velocity.equal(render_frame(scene, (24, 32), color_spp=1).velocity)


def test_one_scene_if_none_are_asked_for(family, tmp_path):
    said = render(family, tmp_path / "out", "--seed", "12345")
    assert [f.name for f in (tmp_path / "out").iterdir()] == ["some-12345"]
    assert "some-12345/some-12345.0000.exr to some-12345/reference.0000.exr" in said


def test_what_is_there_is_kept(family, tmp_path):
    out = tmp_path / "out"
    render(family, out)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.*")}
    render(family, out, "--scenes", "2")
    after = {path: path.stat().st_mtime_ns for path in out.rglob("*.*")}
    assert after.items() > before.items()


def test_another_scene_of_that_name_is_refused(family, tmp_path):
    out = tmp_path / "out"
    render(family, out)
    family.write_text(FAMILY.replace("[3, 5]", "[4, 4]"))
    assert "some-0000.yaml exists and is another scene" in render(family, out, code=2)
    render(family, out, "--overwrite")
    scene = draw_scene(load_family(family), 0)
    assert load_scene(out / "some-0000" / "some-0000.yaml") == scene
    want = render_reference(scene, (24, 32), spp=4, seed=0).mean
    assert read_image(out / "some-0000" / "reference.0000.exr").equal(want)


def test_families_that_come_with_torchblur_by_name(tmp_path):
    render("everyday", tmp_path, "--seed", "3")
    assert (tmp_path / "everyday-0003" / "reference.0000.exr").is_file()
    assert "did you mean `everyday`?" in render("everday", tmp_path, code=2)


def test_scenes_of_one_scene(tmp_path):
    said = render("fence", tmp_path, "--scenes", "2", code=2)
    assert "`scenes` is a number of scenes of a family" in said


@pytest.mark.parametrize("text", ["groups: []\n", "camera: {}\ngroups: []\nbodies: []\n", "[1]"])
def test_neither_scene_nor_family(tmp_path, text):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    assert "a.yaml" in render(path, tmp_path / "out", code=2)
    assert not (tmp_path / "out").exists()


def test_rendered_scenes_are_data_of_a_fit(family, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHBLUR_CACHE", str(tmp_path / "cache"))
    render(family, tmp_path / "out", "--frames", "2")
    item = {
        "kind": "exr", "path": "some-0000", "sharp": "some-0000.####.exr",
        "reference": "reference.####.exr", "weight": 2.0,
    }  # fmt: skip
    other = {"kind": "family", "path": "../some.yaml", "seed": 1, "scenes": 1}
    quick = {"size": "32x24", "spp": 4, "color_spp": 2}
    data = {"root": str(tmp_path / "out"), "train": [item, other | quick]}
    cases = load_cases(build(DataSpec, data))
    assert [(c.item, c.weight) for c in cases] == [
        ("data.train.0", 2.0), ("data.train.0", 2.0), ("data.train.1", None),
    ]  # fmt: skip
