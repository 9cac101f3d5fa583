"""Frames with their references: cache, EXR folders, splits, windows."""

import dataclasses
import warnings
from pathlib import Path

import pytest
import torch
import trimesh
from planted import planted_case, tiny_frame

import tuning.data.loading
from torchblur.errors import ConfigError, FileFormatError
from torchblur.filters import get_filter
from torchblur.frame import Shutter
from torchblur.io import write_frame, write_image
from torchblur.ops.compiling import cache_folder
from torchblur.params import build
from tuning.config.data import Crops, DataSpec
from tuning.data.loading import load_cases
from tuning.objective.windows import make_samples

SCENE = """
camera: {position: [0, 0, 5]}
bodies:
  - kind: sphere
    radius: 1
    velocity: [VX, 0, 0]
    texture: {kind: checker, color: [0.8, 0.2, 0.1], background: [0.9, 0.9, 0.8], size: 0.5}
"""


def write_scene(folder: Path, name: str, speed: float = 1.0) -> dict:
    (folder / name).write_text(SCENE.replace("VX", str(speed)))
    return {"kind": "scene", "path": name, "size": "24x16", "spp": 4, "color_spp": 2}


def spec_of(root: Path, **sections) -> DataSpec:
    return build(DataSpec, {"root": str(root), **sections})


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHBLUR_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def exr_case(folder: Path, seed: int, stem: str = "", size=(48, 64)) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    frame = tiny_frame(seed, size)
    write_frame(folder / f"sharp{stem}.exr", frame)
    write_image(folder / f"reference{stem}.exr", frame.color)


class TestScenes:
    def test_rendered_once(self, tmp_path, own_cache, monkeypatch):
        item = write_scene(tmp_path, "a.yaml")
        first = load_cases(spec_of(tmp_path, train=[item]))[0]
        assert first.frame.size == (16, 24)
        assert first.variance.shape == first.reference.shape

        def fail(*args, **kwargs):
            raise AssertionError("rendered again")

        monkeypatch.setattr(tuning.data.loading, "render_reference", fail)
        second = load_cases(spec_of(tmp_path, train=[item]))[0]
        assert torch.equal(first.reference, second.reference)
        assert torch.equal(first.frame.velocity, second.frame.velocity)
        with pytest.raises(AssertionError, match="rendered again"):
            load_cases(spec_of(tmp_path, train=[item | {"spp": 8}]))
        with pytest.raises(AssertionError, match="rendered again"):
            load_cases(spec_of(tmp_path, train=[item | {"shutter": 1.0}]))
        write_scene(tmp_path, "a.yaml", speed=2.0)
        with pytest.raises(AssertionError, match="rendered again"):
            load_cases(spec_of(tmp_path, train=[item]))

    def test_a_changed_mesh_is_rendered_again(self, tmp_path, own_cache, monkeypatch):
        """The file of a mesh counts by what it holds, not by its name."""
        (tmp_path / "shapes").mkdir()
        mesh = tmp_path / "shapes" / "ball.ply"
        trimesh.creation.icosphere(subdivisions=1).export(mesh)
        (tmp_path / "a.yaml").write_text(
            "camera: {position: [0, 0, 5]}\nbodies: [{kind: mesh, path: shapes/ball.ply}]\n"
        )
        item = {"kind": "scene", "path": "a.yaml", "size": "24x16", "spp": 4, "color_spp": 2}
        load_cases(spec_of(tmp_path, train=[item]))

        def fail(*args, **kwargs):
            raise AssertionError("rendered again")

        monkeypatch.setattr(tuning.data.loading, "render_reference", fail)
        load_cases(spec_of(tmp_path, train=[item]))
        trimesh.creation.icosphere(subdivisions=2).export(mesh)
        with pytest.raises(AssertionError, match="rendered again"):
            load_cases(spec_of(tmp_path, train=[item]))

    def test_damaged_cache_is_made_anew(self, tmp_path, own_cache):
        item = write_scene(tmp_path, "a.yaml")
        first = load_cases(spec_of(tmp_path, train=[item]))[0]
        (stored,) = (own_cache / "frames").iterdir()
        stored.write_bytes(stored.read_bytes()[:100])
        with pytest.warns(UserWarning, match="rendering again"):
            again = load_cases(spec_of(tmp_path, train=[item]))[0]
        assert torch.equal(first.reference, again.reference)

    def test_cache_that_cannot_be_written(self, tmp_path, monkeypatch):
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("TORCHBLUR_CACHE", str(tmp_path / "file"))
        item = write_scene(tmp_path, "a.yaml")
        with pytest.warns(UserWarning, match="not kept"):
            assert len(load_cases(spec_of(tmp_path, train=[item]))) == 1

    def test_cache_folder_follows_the_environment(self, tmp_path, monkeypatch):
        monkeypatch.delenv("TORCHBLUR_CACHE")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert cache_folder() == tmp_path / "torchblur"

    def test_missing_scene_lists_its_neighbors(self, tmp_path):
        write_scene(tmp_path, "a.yaml")
        spec = spec_of(tmp_path, train=[{"kind": "scene", "path": "b.yaml"}])
        with pytest.raises(ConfigError, match=r"b\.yaml does not exist.*a\.yaml.*train\.0\.path"):
            load_cases(spec)

    def test_reference_and_color_do_not_share_noise(self, tmp_path, own_cache):
        """With nothing moving both are the same image but for independent noise."""
        item = write_scene(tmp_path, "a.yaml", speed=0.0) | {"spp": 16, "color_spp": 16}
        case = load_cases(spec_of(tmp_path, train=[item]))[0]
        assert not torch.equal(case.frame.color, case.reference)


class TestSplit:
    def test_same_frame_in_both(self, tmp_path, own_cache):
        item = write_scene(tmp_path, "a.yaml")
        copy = write_scene(tmp_path, "copy.yaml")
        spec = spec_of(tmp_path, train=[item], holdout=[copy | {"spp": 8}])
        with pytest.raises(ConfigError, match=r"same frame.*train and data\.holdout.*'copy 0'"):
            load_cases(spec)

    def test_same_frame_twice(self, tmp_path, own_cache):
        item = write_scene(tmp_path, "a.yaml")
        with pytest.raises(ConfigError, match=r"stands twice in data\.train"):
            load_cases(spec_of(tmp_path, train=[item, item]))

    def test_another_time_of_the_same_scene_is_told(self, tmp_path, own_cache):
        item = write_scene(tmp_path, "a.yaml")
        spec = spec_of(tmp_path, train=[item], holdout=[item | {"frames": [1.0]}])
        with pytest.warns(
            UserWarning, match="frames of scenes that are fitted at other times: a 1"
        ):
            cases = load_cases(spec)
        assert [(c.name, c.split) for c in cases] == [("a 0", "train"), ("a 1", "holdout")]

    def test_same_exr_in_both(self, tmp_path):
        for name in ("one", "two"):
            exr_case(tmp_path / name, seed=1)
        items = [{"kind": "exr", "path": name} for name in ("one", "two")]
        with pytest.raises(ConfigError, match="'one' and 'two'"):
            load_cases(spec_of(tmp_path, train=items[:1], holdout=items[1:]))


class TestExr:
    def test_sequence_by_pattern(self, tmp_path):
        for seed, stem in ((1, ".0001"), (2, ".0002"), (3, ".0010")):
            exr_case(tmp_path / "walk", seed, stem)
        item = {
            "kind": "exr", "path": "walk", "sharp": "sharp.####.exr",
            "reference": "reference.####.exr",
        }  # fmt: skip
        cases = load_cases(spec_of(tmp_path, train=[item]))
        assert [c.name for c in cases] == ["walk 0001", "walk 0002", "walk 0010"]
        assert torch.allclose(cases[1].frame.velocity, tiny_frame(2).velocity)
        picked = load_cases(spec_of(tmp_path, train=[item | {"frames": [10]}]))
        assert [c.name for c in picked] == ["walk 0010"]

    def test_lines_of_a_larger_camera(self, tmp_path):
        exr_case(tmp_path / "a", 1)
        item = {"kind": "exr", "path": "a"}
        spec = spec_of(tmp_path, train=[item])
        assert load_cases(spec)[0].lines == 48
        assert "lines" not in spec.model_dump()["train"][0]
        spec = spec_of(tmp_path, train=[item | {"lines": 1080}])
        assert load_cases(spec)[0].lines == 1080
        assert build(DataSpec, spec.model_dump()) == spec
        small = spec_of(tmp_path, train=[item | {"lines": 47}])
        with pytest.raises(ConfigError, match=r"at least the frame's, 48 px, got 47 \(data\.train"):
            load_cases(small)

    def test_layers_of_a_gbuffer(self, tmp_path):
        exr_case(tmp_path / "one", seed=1)
        other = tiny_frame(2)
        write_frame(tmp_path / "one" / "gbuffer.exr", other)
        item = {"kind": "exr", "path": "one", "gbuffer": "gbuffer.exr"}
        case = load_cases(spec_of(tmp_path, train=[item]))[0]
        assert torch.allclose(case.frame.color, tiny_frame(1).color, atol=1e-3)
        assert torch.allclose(case.frame.velocity, other.velocity)

    def test_bad_folders(self, tmp_path):
        exr_case(tmp_path / "one", seed=1)
        item = {"kind": "exr", "path": "two"}
        with pytest.raises(ConfigError, match=r"two does not exist; in .*: one"):
            load_cases(spec_of(tmp_path, train=[item]))
        item = {"kind": "exr", "path": "one", "sharp": "s.####.exr"}
        with pytest.raises(ConfigError, match=r"no file in .* is called s\.####\.exr"):
            load_cases(spec_of(tmp_path, train=[item]))
        item = {"kind": "exr", "path": "one", "frames": [1]}
        with pytest.raises(ConfigError, match=r"`frames` needs #### in `sharp`, got 'sharp\.exr'"):
            load_cases(spec_of(tmp_path, train=[item]))
        item = {"kind": "exr", "path": "one", "reference": "other.exr"}
        with pytest.raises(FileFormatError, match=r"other\.exr does not exist"):
            load_cases(spec_of(tmp_path, train=[item]))

    def test_reference_of_another_size(self, tmp_path):
        exr_case(tmp_path / "one", seed=1)
        write_image(tmp_path / "one" / "reference.exr", torch.rand(1, 3, 8, 9), overwrite=True)
        with pytest.raises(FileFormatError, match="64x48, got 9x8"):
            load_cases(spec_of(tmp_path, train=[{"kind": "exr", "path": "one"}]))

    @pytest.mark.shared
    def test_frames_of_another_renderer(self, shared_data):
        item = {
            "kind": "exr", "path": "walk_sequence", "sharp": "sharp.####.exr",
            "gbuffer": "gbuffer.####.exr", "reference": "reference.####.exr",
            "convention": "blender", "frames": [1],
        }  # fmt: skip
        case = load_cases(spec_of(shared_data, train=[item]))[0]
        assert case.frame.size == (180, 320)
        assert 0.01 < float(case.band.float().mean()) < 0.9


class TestWindows:
    def test_full_frames(self):
        case = planted_case(1)
        (sample,) = make_samples([case], None, tile_size=20, seed=0)
        assert sample.frame is case.frame
        assert sample.inner == (0, 0, 48, 64)

    def test_windows_score_what_they_filter(self):
        """The scored part of the window is the same place of frame, reference and band."""
        case = planted_case(1)
        case = dataclasses.replace(case, reference=case.frame.color)
        samples = make_samples([case], Crops(size=16, per_frame=6, context=4), tile_size=4, seed=0)
        assert len(samples) == 6
        for sample in samples:
            top, left, height, width = sample.inner
            inner = sample.frame.color[..., top : top + height, left : left + width]
            assert torch.equal(inner, sample.reference)
            assert sample.band.shape[-2:] == (16, 16)

    @pytest.mark.parametrize("tile_size", [4, 6, 12])
    def test_context_is_there_and_tiles_are_aligned(self, tile_size):
        frame = tiny_frame(1, (96, 128))
        position = torch.arange(96 * 128, dtype=torch.float32).view(1, 1, 96, 128)
        frame = dataclasses.replace(frame, color=position.expand(1, 3, -1, -1).contiguous())
        case = dataclasses.replace(
            planted_case(1), frame=frame, reference=frame.color,
            band=torch.zeros(1, 1, 96, 128, dtype=torch.bool),
        )  # fmt: skip
        crops = Crops(size=16, per_frame=12, context=2 * tile_size)
        samples = make_samples([case], crops, tile_size=tile_size, seed=3)
        assert len({sample.frame.size for sample in samples}) == 1
        for sample in samples:
            origin = int(sample.frame.color[0, 0, 0, 0])
            outer_top, outer_left = origin // 128, origin % 128
            rows, columns = sample.frame.size
            top, left, height, width = sample.inner
            at_end = outer_top + rows == 96
            assert outer_top % tile_size == 0 or at_end
            assert top >= 2 * tile_size or outer_top == 0
            assert rows - top - height >= 2 * tile_size or at_end
            assert columns - left - width >= 2 * tile_size or outer_left + columns == 128

    @pytest.mark.parametrize(
        ("shutter", "params", "context"),
        [
            (Shutter(1.0), {"reach": "tile"}, 16),
            (Shutter(1.0), {"reach": "frame"}, 25 + 8),
            (Shutter(0.5), {"reach": "frame"}, 13 + 8),
            (Shutter(0.5, "trailing"), {"reach": "frame"}, 25 + 8),
            (Shutter(1.0), {"reach": "frame", "max_reach": 10.0}, 10 + 8),
        ],
    )
    def test_context_follows_the_reach(self, shutter, params, context):
        size = (400, 400)
        frame = tiny_frame(1, size)
        velocity = torch.zeros_like(frame.velocity)
        velocity[:, 0, 200:216, 200:216] = 50.0
        case = dataclasses.replace(
            planted_case(1),
            frame=dataclasses.replace(frame, velocity=velocity),
            reference=frame.color,
            band=torch.zeros(1, 1, *size, dtype=torch.bool),
            shutter=shutter,
        )
        blur = get_filter("guertin2014")(tile_size=8, **params)
        crops = Crops(size=16, per_frame=4)
        for sample in make_samples([case], crops, tile_size=8, seed=0, blur=blur):
            top, left, height, width = sample.inner
            ends = [
                size - at - edge
                for size, at, edge in zip(sample.size, (top, left), (height, width), strict=True)
            ]
            assert min(top, left) >= context
            assert min(ends) >= context
            assert max(top, left) < context + 8

    def test_windows_lie_where_something_moves(self):
        frame = tiny_frame(1)
        velocity = torch.zeros_like(frame.velocity)
        velocity[..., 30:40, 40:56] = 8.0
        case = dataclasses.replace(
            planted_case(1), frame=dataclasses.replace(frame, velocity=velocity)
        )
        crops = Crops(size=16, per_frame=50, context=0)
        for sample in make_samples([case], crops, tile_size=1, seed=0):
            top, left, height, width = sample.inner
            inner = sample.frame.velocity[..., top : top + height, left : left + width]
            assert bool((inner != 0).any())

    def test_same_seed_same_windows(self):
        def corners(seed):
            crops = Crops(size=16, per_frame=4)
            cases = [planted_case(1), planted_case(2)]
            return [s.reference.sum() for s in make_samples(cases, crops, tile_size=4, seed=seed)]

        assert corners(1) == corners(1)
        assert corners(1) != corners(2)

    def test_nothing_moves(self):
        frame = tiny_frame(1)
        still = dataclasses.replace(frame, velocity=torch.zeros_like(frame.velocity))
        case = dataclasses.replace(planted_case(1), frame=still)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert len(make_samples([case], Crops(size=16), tile_size=4, seed=0)) == 4
