"""Sequences as data: rendered streams, streams on disk, cuts, warm-up, windows through time."""

import dataclasses

import pytest
import torch
from planted_sequences import Recall, moving_sequence, sequence_case

import tuning.data.streams
from torchblur.errors import ConfigError, FileFormatError
from torchblur.filters import get_filter
from torchblur.frame import Shutter
from torchblur.io import write_frame, write_image
from torchblur.params import build
from tuning.config.data import Crops, DataSpec
from tuning.data.cases import SequenceCase, check_needs
from tuning.data.loading import load_cases
from tuning.data.streams import shot_starts
from tuning.objective.windows import make_samples

SCENE = """
camera: {position: [0, 0, 5]}
bodies:
  - kind: sphere
    radius: 1
    velocity: [1, 0, 0]
    texture: {kind: checker, color: [0.8, 0.2, 0.1], background: [0.9, 0.9, 0.8], size: 0.5}
"""


def spec_of(root, **sections) -> DataSpec:
    return build(DataSpec, {"root": str(root), **sections})


@pytest.fixture
def item(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHBLUR_CACHE", str(tmp_path / "cache"))
    (tmp_path / "a.yaml").write_text(SCENE)
    return {
        "kind": "scene_stream", "path": "a.yaml", "size": "24x16", "spp": 4, "color_spp": 2,
        "frames": {"start": 0, "stop": 3},
    }  # fmt: skip


def load(root, item):
    (case,) = load_cases(spec_of(root, train=[item]))
    assert isinstance(case, SequenceCase)
    return case


class TestSceneStreams:
    def test_what_it_has(self, tmp_path, item):
        case = load(tmp_path, item | {"stream_spp": 2, "warm_up": 1})
        assert case.name == "a 0-2"
        assert len(case) == len(case.references) == len(case.bands) == len(case.sharp) == 3
        assert case.labels == ("0", "1", "2")
        assert case.shutter == Shutter(1.0)
        assert len(case.samples) == 2
        first, second = (samples[1] for samples in case.samples)
        assert not torch.equal(first.time, second.time)
        assert not torch.equal(case.samples[0][0].time, first.time)
        assert case.sharp[0].time is None
        assert [len(step) for step in case.steps()] == [2, 2, 2]

    def test_rendered_once_and_frame_by_frame(self, tmp_path, item, monkeypatch):
        first = load(tmp_path, item)
        drawn = []
        render = tuning.data.streams.render_stream

        def watched(*args, frame, **kwargs):
            drawn.append(frame)
            return render(*args, frame=frame, **kwargs)

        monkeypatch.setattr(tuning.data.streams, "render_stream", watched)
        again = load(tmp_path, item | {"frames": [1, 2, 3], "warm_up": 1, "cuts": [2]})
        assert drawn == [3.0]
        assert torch.equal(again.samples[0][0].color, first.samples[0][1].color)
        assert torch.equal(again.references[0], first.references[1])
        load(tmp_path, item | {"seed": 5})
        assert drawn == [3.0, 0.0, 1.0, 2.0]

    def test_references_are_of_the_pixels_center(self, tmp_path, item):
        """The mean of many samples of the stream is the reference."""
        case = load(tmp_path, item | {"spp": 400, "stream_spp": 400, "frames": [0]})
        mean = torch.stack([samples[0].color for samples in case.samples]).mean(0)
        error = (mean - case.references[0]).abs()
        assert float(error.max()) < 0.12  # 5 deviations of 400 draws of 0 or 1
        boxed = load(tmp_path, item | {"spp": 400, "pixel": "box", "frames": [0]})
        assert float((boxed.references[0] - mean).abs().mean()) > 1.5 * float(error.mean())

    def test_a_filter_without_times_gets_sharp_frames(self, tmp_path, item):
        case = load(tmp_path, item)
        assert case.steps(get_filter("line")())[1] == (case.sharp[1],)
        assert case.steps(Recall())[1] == (case.samples[0][1],)
        blind = dataclasses.replace(case, sharp=None)
        assert blind.steps(get_filter("line")())[1] == (case.samples[0][1],)

    def test_moving_to_a_device_keeps_everything(self, tmp_path, item):
        case = load(tmp_path, item | {"cuts": [1]})
        moved = case.to("cpu")
        assert (moved.cuts, moved.labels, len(moved.samples)) == ((1,), ("0", "1", "2"), 1)


class TestShots:
    def test_cuts_and_gaps(self, tmp_path, item):
        case = load(tmp_path, item | {"frames": [0, 1, 4, 5], "cuts": [5]})
        assert case.cuts == case.sharp.cuts == (2, 3)
        assert shot_starts([1, 2, 3], [], "") == ()
        assert shot_starts([1, 2, 3], [1], "") == ()

    @pytest.mark.parametrize(
        ("changes", "said"),
        [
            ({"cuts": [7]}, r"`cuts` must be numbers of frames, 0-2, got 7 \(a 0-2\)"),
            ({"warm_up": 3}, r"`warm_up` must leave a frame.*a 0-2 has 3 frames, got 3"),
        ],
    )
    def test_refused_with_the_frames(self, tmp_path, item, changes, said):
        with pytest.raises(ConfigError, match=said):
            load(tmp_path, item | changes)

    @pytest.mark.parametrize(
        ("frames", "said"),
        [
            ({"start": 3, "stop": 3}, "`start < stop` must hold, got 3 and 3"),
            ({"first": 3}, r"a list or {start: 0, stop: 8}, got {'first': 3}"),
            ([2, 1], "must rise, got 2 before 1"),
            ([], "at least 1 item"),
        ],
    )
    def test_refused_frames(self, tmp_path, item, frames, said):
        with pytest.raises(ConfigError, match=said):
            spec_of(tmp_path, train=[item | {"frames": frames}])


class TestSplit:
    def test_frames_in_both(self, tmp_path, item):
        later = item | {"frames": [2, 3], "seed": 4}
        with pytest.raises(ConfigError, match=r"same frame.*train and data\.holdout.*'a 2-3'"):
            load_cases(spec_of(tmp_path, train=[item], holdout=[later]))

    def test_a_single_frame_of_the_sequence(self, tmp_path, item):
        single = {"kind": "scene", "path": "a.yaml", "size": "24x16", "spp": 4, "frames": [1]}
        with pytest.raises(ConfigError, match=r"train and data\.holdout: 'a 0-2' and 'a 1'"):
            load_cases(spec_of(tmp_path, train=[item], holdout=[single]))

    def test_twice_only_with_another_seed(self, tmp_path, item):
        cases = load_cases(spec_of(tmp_path, train=[item, item | {"seed": 4}]))
        assert [case.name for case in cases] == ["a 0-2", "a 0-2 (2)"]
        with pytest.raises(ConfigError, match=r"stands twice in data\.train"):
            load_cases(spec_of(tmp_path, train=[item, item | {"frames": [2, 3]}]))


def write_stream(folder, count=3, samples=("stream",), center=False):
    folder.mkdir(parents=True)
    for number, frame in enumerate(moving_sequence(count), start=1):
        for name in samples:
            write_frame(folder / f"{name}.{number:04d}.exr", frame, half=False)
        if center:
            still = dataclasses.replace(frame, time=None)
            write_frame(folder / f"center.{number:04d}.exr", still, half=False)
        write_image(folder / f"reference.{number:04d}.exr", frame.color, half=False)


class TestExrStreams:
    def test_read(self, tmp_path):
        write_stream(tmp_path / "walk", center=True)
        item = {"kind": "exr_stream", "path": "walk", "center": "center.####.exr"}
        case = load(tmp_path, item)
        assert (case.name, case.labels) == ("walk 1-3", ("1", "2", "3"))
        want = moving_sequence(3)[1]
        torch.testing.assert_close(case.samples[0][1].time, want.time)
        torch.testing.assert_close(case.references[1], want.color)
        assert case.sharp[1].time is None
        picked = load(tmp_path, item | {"frames": [1, 3]})
        assert (picked.labels, picked.cuts) == (("1", "3"), (1,))

    def test_several_samples_per_pixel(self, tmp_path):
        names = ("stream01", "stream02")
        write_stream(tmp_path / "walk", samples=names)
        stream = [f"{name}.####.exr" for name in names]
        case = load(tmp_path, {"kind": "exr_stream", "path": "walk", "stream": stream})
        assert [len(step) for step in case.steps()] == [2, 2, 2]
        assert case.sharp is None

    def test_bad_files(self, tmp_path):
        write_stream(tmp_path / "walk")
        item = {"kind": "exr_stream", "path": "walk"}
        with pytest.raises(ConfigError, match=r"called other\.####\.exr.*train\.0\.stream"):
            load(tmp_path, item | {"stream": "other.####.exr"})
        with pytest.raises(ConfigError, match=r"needs #### for the frame number, got 'x\.exr'"):
            load(tmp_path, item | {"reference": "x.exr"})
        with pytest.raises(FileFormatError, match=r"stream\.0009\.exr does not exist"):
            load(tmp_path, item | {"frames": [1, 9]})
        write_image(tmp_path / "walk/reference.0002.exr", torch.rand(1, 3, 8, 9), overwrite=True)
        with pytest.raises(FileFormatError, match=r"first is 64x48, .*reference\.0002.* is 9x8"):
            load(tmp_path, item)

    @pytest.mark.shared
    def test_stream_of_another_renderer(self, shared_data):
        item = {
            "kind": "exr_stream", "path": "walk_stream", "center": "center.####.exr",
            "reference": "reference_pointsampled.####.exr", "frames": [1, 2],
        }  # fmt: skip
        case = load(shared_data, item)
        assert case.size == (180, 320)
        assert 0 <= float(case.samples[0][0].time.min()) < 0.02
        assert 0.01 < float(case.bands[0].float().mean()) < 0.9


class TestNeeds:
    def test_layers_that_are_not_there(self):
        case = sequence_case(3)
        blur = Recall()
        check_needs(blur, [case])
        bare = case.samples[0].map(lambda f: dataclasses.replace(f, time=None))
        with pytest.raises(
            ConfigError,
            match=r"recall needs the layer `time`.*data\.train 'tiny' has color, depth, velocity",
        ):
            check_needs(blur, [dataclasses.replace(case, samples=(bare,), sharp=None)])


class TestWindows:
    def test_the_same_place_through_time(self):
        case = sequence_case(3)
        case = dataclasses.replace(case, references=tuple(f.color for f in case.samples[0]))
        samples = make_samples(
            [case], Crops(size=16, per_frame=5, context=4), tile_size=4, seed=0, blur=Recall()
        )
        assert len(samples) == 5
        for sample in samples:
            top, left, height, width = sample.inner
            assert (height, width) == (16, 16)
            for step, reference, band in zip(
                sample.steps, sample.references, sample.bands, strict=True
            ):
                inner = step[0].color[..., top : top + height, left : left + width]
                assert torch.equal(inner, reference)
                assert band.shape[-2:] == (16, 16)

    def test_drawn_where_something_moves_at_any_time(self):
        case = sequence_case(4)

        def still(frame):
            velocity = torch.zeros_like(frame.velocity)
            if frame is case.samples[0][3]:
                velocity[..., 30:40, 40:56] = 8.0
            return dataclasses.replace(frame, velocity=velocity)

        case = dataclasses.replace(case, samples=(case.samples[0].map(still),), sharp=None)
        crops = Crops(size=16, per_frame=50, context=0)
        for sample in make_samples([case], crops, tile_size=1, seed=0, blur=Recall()):
            top, left, height, width = sample.inner
            last = sample.steps[3][0].velocity[..., top : top + height, left : left + width]
            assert bool((last != 0).any())
