"""Windows of a larger image, as data of a fit and as files: their pixels, places and names."""

import pytest
import torch
from typer.testing import CliRunner

import tuning.data.framing
import tuning.data.loading
from torchblur.errors import ConfigError
from torchblur.frame import Shutter
from torchblur.io import read_frame, read_metadata
from torchblur.params import build
from torchblur.render import Scene, draw_scene, load_family, load_scene, render_frame
from tuning.cli.app import app
from tuning.config.data import DataSpec, FamilyData, SceneData
from tuning.data.framing import busiest_box
from tuning.data.loading import load_cases

runner = CliRunner()
SCENE = """
camera: {position: [0, 0, 5], spin: 1.5, axis: [0, 1, 0]}
bodies:
  - kind: sphere
    radius: 1
    velocity: [0.5, 0.2, 0]
    texture: {kind: checker, color: [0.8, 0.2, 0.1], background: [0.9, 0.9, 0.8], size: 0.5}
"""
FAMILY = """
groups:
  - {name: a, count: [1, 2], kinds: {sphere: 1, box: 1}, motions: {linear: 1}, depth: [3, 5]}
"""
WINDOW = {"size": "24x16", "of": "96x64", "spp": 4, "color_spp": 1}
BALL = {"kind": "sphere", "texture": {"kind": "solid", "color": [1, 1, 1]}}


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "a.yaml").write_text(SCENE)
    return {"kind": "scene", "path": "a.yaml"} | WINDOW


@pytest.fixture
def family(tmp_path):
    (tmp_path / "some.yaml").write_text(FAMILY)
    return {"kind": "family", "path": "some.yaml", "scenes": 2} | WINDOW


def load(root, *train, **sections):
    return load_cases(build(DataSpec, {"root": str(root), "train": train, **sections}))


def assert_is_part(frame, whole, left, top):
    part = whole.crop(top, left, *frame.size)
    for name in ("depth", "velocity", "normal", "object_id", "acceleration"):
        want = part.layers()[name]
        torch.testing.assert_close(frame.layers()[name], want, rtol=1e-5, atol=1e-5, msg=name)


class TestData:
    @pytest.mark.parametrize(
        ("at", "left", "top"),
        [([0.3, 0.7], 17, 37), (None, 36, 24), ([0, 1], 0, 48), ("1,0.5", 72, 24)],
    )
    def test_a_case_is_a_part_of_the_whole(self, tmp_path, scene, at, left, top):
        (case,) = load(tmp_path, scene if at is None else scene | {"at": at})
        whole = render_frame(load_scene(tmp_path / "a.yaml"), (64, 96), color_spp=1)
        assert case.size == (16, 24)
        assert case.name == "a 0 (64p)"
        assert case.reference.shape[-2:] == (16, 24)
        assert_is_part(case.frame, whole, left, top)

    @pytest.mark.parametrize("kind", ["scene", "scene_stream"])
    def test_lines_are_those_of_the_whole(self, tmp_path, scene, kind):
        (window,) = load(tmp_path, scene | {"kind": kind})
        whole = {key: value for key, value in scene.items() if key != "of"}
        (own,) = load(tmp_path, whole | {"kind": kind})
        assert (window.lines, own.lines) == (64, 16)
        assert window.to("cpu").lines == 64

    def test_a_sequence_is_the_same_part_in_all_frames(self, tmp_path, scene):
        item = scene | {"kind": "scene_stream", "frames": [0, 1, 2], "at": "motion"}
        (case,) = load(tmp_path, item)
        assert case.name == "a 0-2 (64p)"
        loaded = load_scene(tmp_path / "a.yaml")
        top, left, *_ = busiest_box(loaded, (16, 24), (64, 96), 1.0, Shutter(1.0))
        for number, frame in enumerate(case.sharp):
            whole = render_frame(loaded, (64, 96), frame=number, color_spp=1)
            assert_is_part(frame, whole, left, top)

    def test_scenes_of_a_family_are_seen_where_they_move(self, tmp_path, family):
        first, second = load(tmp_path, family)
        assert [first.name, second.name] == ["some-0000 0 (64p)", "some-0001 0 (64p)"]
        for seed, case in enumerate((first, second)):
            drawn = draw_scene(load_family(tmp_path / "some.yaml"), seed)
            top, left, *_ = busiest_box(drawn, (16, 24), (64, 96), 0.0, Shutter())
            assert_is_part(case.frame, render_frame(drawn, (64, 96), color_spp=1), left, top)
        (middle, _) = load(tmp_path, family | {"at": [0.5, 0.5]})
        assert_is_part(
            middle.frame,
            render_frame(draw_scene(load_family(tmp_path / "some.yaml"), 0), (64, 96), color_spp=1),
            36, 24,
        )  # fmt: skip

    def test_names_are_unique_and_windows_may_share_a_frame(self, tmp_path, scene):
        whole = {"kind": "scene", "path": "a.yaml", "size": "24x16", "spp": 4, "color_spp": 1}
        cases = load(tmp_path, whole, scene, scene | {"at": [0.2, 0.2]})
        assert [c.name for c in cases] == ["a 0", "a 0 (64p)", "a 0 (64p) (2)"]
        with pytest.raises(ConfigError, match=r"stands twice in data\.train: 'a 0 \(64p\)'"):
            load(tmp_path, scene, scene | {"at": [0.5, 0.5]})

    def test_a_window_of_a_fitted_frame_is_no_holdout(self, tmp_path, scene):
        with pytest.raises(ConfigError, match=r"same frame is in data\.train and data\.holdout"):
            load(tmp_path, scene, holdout=[scene | {"at": [0.1, 0.1]}])

    def test_found_again_in_the_cache(self, tmp_path, scene, monkeypatch):
        monkeypatch.setenv("TORCHBLUR_CACHE", str(tmp_path / "cache"))
        item = scene | {"at": "motion"}
        (first,) = load(tmp_path, item)

        def fail(*args, **kwargs):
            raise AssertionError("rendered again")

        with monkeypatch.context() as patched:
            patched.setattr(tuning.data.loading, "render_reference", fail)
            patched.setattr(tuning.data.framing, "busiest_box", fail)
            (second,) = load(tmp_path, item)
            assert torch.equal(first.reference, second.reference)
            with pytest.raises(AssertionError, match="rendered again"):
                load(tmp_path, scene | {"at": [0.1, 0.1]})
            with pytest.raises(AssertionError, match="rendered again"):
                load(tmp_path, item | {"of": "96x60"})


class TestPlace:
    @pytest.mark.parametrize("x", [-1.6, 1.6])
    @pytest.mark.parametrize("y", [-0.8, 0.8])
    def test_motion_is_found(self, x, y):
        still = BALL | {"radius": 0.6, "position": [-x, -y, 0]}
        moving = BALL | {"radius": 0.2, "position": [x, y, 0], "velocity": [0.1, 0, 0]}
        data = {"camera": {"position": [0, 0, 5]}, "bodies": [still, moving]}
        top, left, height, width = busiest_box(
            build(Scene, data), (90, 160), (360, 640), 0.0, Shutter()
        )
        assert (height, width) == (90, 160)
        frame = render_frame(build(Scene, data), (360, 640), color_spp=1)
        found = (frame.object_id == 2)[..., top : top + height, left : left + width]
        assert int(found.sum()) == int((frame.object_id == 2).sum()) > 0

    def test_borders_decide_where_all_moves(self):
        ball = BALL | {"radius": 0.3, "position": [1.4, 0.7, 0], "velocity": [0.1, 0, 0]}
        wall = {"kind": "plane", "position": [0, 0, -1], "texture": BALL["texture"]}
        camera = {"position": [0, 0, 5], "spin": 2, "axis": [0, 1, 0]}
        scene = build(Scene, {"camera": camera, "bodies": [ball, wall]})
        top, left, *_ = busiest_box(scene, (90, 160), (360, 640), 0.0, Shutter())
        assert top < 90
        assert left > 320

    def test_the_middle_where_nothing_moves(self):
        scene = build(Scene, {"camera": {"position": [0, 0, 5]}, "bodies": [BALL | {"radius": 1}]})
        assert busiest_box(scene, (90, 160), (360, 640), 0.0, Shutter()) == (135, 240, 90, 160)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"of": "1920"}, "`of` must be WIDTHxHEIGHT in px, got '1920'"),
        ({"of": "0x5"}, "`of` must be WIDTHxHEIGHT in px, got '0x5'"),
        ({"of": "23x64"}, "a window of 24x16 px does not fit in `of` 23x64"),
        ({"of": "96x15"}, "a window of 24x16 px does not fit in `of` 96x15"),
        ({"of": None, "at": [0.5, 0.5]}, "give its size, `of`, too"),
        ({"at": [0.5, 1.5]}, r"`at` must be \[x, y\], shares from 0 to 1, or motion; got"),
        ({"at": [0.5]}, r"`at` must be \[x, y\]"),
        ({"at": "left"}, r"`at` must be \[x, y\].*got 'left'"),
        ({"at": 3}, r"`at` must be \[x, y\].*got 3"),
    ],
)
@pytest.mark.parametrize("model", [SceneData, FamilyData])
def test_what_is_no_window_is_refused(model, changes, message):
    kind = "scene" if model is SceneData else "family"
    with pytest.raises(ConfigError, match=message) as caught:
        build(model, {"kind": kind, "path": "a.yaml"} | WINDOW | changes)
    assert len(str(caught.value).splitlines()) == 1


def test_items_without_a_window_are_written_as_before():
    """Runs are resumed, and frames are found in the cache, by what is written."""
    item = build(SceneData, {"kind": "scene", "path": "a.yaml"})
    assert not {"of", "at"} & item.model_dump().keys()
    window = build(SceneData, {"kind": "scene", "path": "a.yaml", "at": [0.2, 0.3]} | WINDOW)
    assert build(SceneData, window.model_dump(mode="json")) == window


class TestCommand:
    def render(self, *args, code=0):
        result = runner.invoke(app, ["render", *map(str, args), "--size", "24x16", "--spp", "4"])
        assert result.exit_code == code, result.output
        return " ".join(result.output.split())

    def test_files_are_parts_of_the_whole(self, tmp_path, scene):
        file, out = tmp_path / "a.yaml", tmp_path / "out"
        self.render(file, "-o", out, "--of", "96x64", "--at", "0.3,0.7", "--frames", "2")
        for number in range(2):
            whole = render_frame(load_scene(file), (64, 96), frame=number, color_spp=1)
            assert_is_part(read_frame(out / f"a.{number:04d}.exr"), whole, 17, 37)
        made = read_metadata(out / "reference.0000.exr")["recipe"]
        assert made["window"] == "24x16+17+37 of 96x64"
        self.render(file, "-o", out, "--of", "96x64", "--at", "0.3,0.7", "--frames", "2")
        said = self.render(file, "-o", out, "--of", "96x64", code=2)
        assert "made with other settings" in said

    def test_of_a_family_where_it_moves(self, tmp_path, family):
        file, out = tmp_path / "some.yaml", tmp_path / "out"
        self.render(file, "-o", out, "--of", "96x64")
        drawn = draw_scene(load_family(file), 0)
        assert load_scene(out / "some-0000" / "some-0000.yaml") == drawn
        top, left, *_ = busiest_box(drawn, (16, 24), (64, 96), 0.0, Shutter())
        whole = render_frame(drawn, (64, 96), color_spp=1)
        assert_is_part(read_frame(out / "some-0000" / "some-0000.0000.exr"), whole, left, top)

    def test_a_place_in_nothing_is_refused(self, tmp_path, scene):
        said = self.render(tmp_path / "a.yaml", "-o", tmp_path / "out", "--at", "0.3,0.7", code=2)
        assert "give its size, `of`, too" in said
        assert not (tmp_path / "out").exists()
