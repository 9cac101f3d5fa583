"""Streams on disk: all layers back, sequences in order, what is wrong refused or reported."""

import dataclasses
import re

import pytest
import torch

import torchblur
from torchblur.errors import ConfigError, FileFormatError, FrameError
from torchblur.frame import Frame
from torchblur.io import (
    find_frames,
    inspect_file,
    read_channels,
    read_frame,
    read_image,
    read_sequence,
    write_frame,
    write_image,
)

SIZE = (9, 14)


def stream_frame(seed=0, size=SIZE, **others):
    """A frame as a stream has it, with numbers of its own in every layer."""
    generator = torch.Generator().manual_seed(seed)

    def rand(channels):
        return torch.rand(1, channels, *size, generator=generator)

    depth = 1 + rand(1)
    depth[..., :3] = torch.inf
    layers = {
        "color": rand(3) * 3, "velocity": rand(2) * 40 - 20, "depth": depth,
        "normal": rand(3) - 0.5, "object_id": (rand(1) * 9).long(), "time": rand(1),
        "albedo": rand(3),
    }  # fmt: skip
    return Frame(**(layers | others))


@pytest.fixture
def folder(tmp_path):
    """Frames 3 to 6 of a stream, and references."""
    for number in range(3, 7):
        write_frame(tmp_path / f"stream.{number:04d}.exr", stream_frame(number))
        write_image(tmp_path / f"reference.{number:04d}.exr", stream_frame(number).color)
    return tmp_path


# -- one frame ---------------------------------------------------------------------------------


def test_all_layers_come_back_bit_by_bit(tmp_path):
    frame = stream_frame()
    write_frame(tmp_path / "a.exr", frame)
    read = read_frame(tmp_path / "a.exr")
    assert set(read.layers()) == set(frame.layers())
    for name, layer in frame.layers().items():
        assert torch.equal(read.layers()[name], layer), name
    red = read_channels(tmp_path / "a.exr", "albedo.R")
    assert torch.equal(red, frame.albedo[:, :1])
    assert read_frame(tmp_path / "a.exr", albedo=None, time=None).albedo is None


def test_revealed_albedo_is_its_own(tmp_path):
    frame = stream_frame(revealed=stream_frame(5))
    write_frame(tmp_path / "a.exr", frame)
    read = read_frame(tmp_path / "a.exr")
    assert torch.equal(read.albedo, frame.albedo)
    assert torch.equal(read.revealed.albedo, frame.revealed.albedo)


def test_other_names_and_times_of_another_program(tmp_path):
    frame = stream_frame()
    layers = {
        "velocity": frame.velocity, "shutter": frame.time - 0.5, "diffuse": frame.albedo,
    }  # fmt: skip
    write_image(tmp_path / "a.exr", frame.color, layers=layers, half=False)
    read = read_frame(
        tmp_path / "a.exr", time="shutter", time_start=-0.5, time_end=0.5,
        albedo=("diffuse.R", "diffuse.G", "diffuse.B"),
    )  # fmt: skip
    torch.testing.assert_close(read.time, frame.time, atol=1e-6, rtol=0)
    assert torch.equal(read.albedo, frame.albedo)
    backward = read_frame(tmp_path / "a.exr", time="shutter", time_start=0.5, time_end=-0.5)
    torch.testing.assert_close(backward.time, 1 - frame.time, atol=1e-6, rtol=0)
    with pytest.raises(ConfigError, match=r"`time_start` and `time_end` must differ, got 1\.0"):
        read_frame(tmp_path / "a.exr", time="shutter", time_start=1.0)
    with pytest.raises(FileFormatError, match=r"no channels when"):
        read_frame(tmp_path / "a.exr", time="when")


# -- sequences ---------------------------------------------------------------------------------


def test_a_sequence_is_read_in_order(folder):
    sequence = read_sequence(folder, cuts=(2,))
    assert (len(sequence), sequence.cuts) == (4, (2,))
    for number, frame in enumerate(sequence, start=3):
        assert torch.equal(frame.time, stream_frame(number).time)
        assert frame.source.endswith(f"stream.{number:04d}.exr")
    part = read_sequence(folder / "stream.####.exr", numbers=(4, 5))
    assert torch.equal(part[0].color, stream_frame(4).color)
    assert len(part) == 2
    assert len(read_sequence(folder, numbers=(6, 6))) == 1


def test_ten_comes_after_nine(tmp_path):
    for number in (10, 9, 11):
        write_frame(tmp_path / f"stream.{number}.exr", stream_frame(number))
    assert torch.equal(read_sequence(tmp_path)[1].color, stream_frame(10).color)


def test_other_sequences_of_a_folder_by_name(folder):
    for number in range(2):
        write_frame(folder / f"stream02.{number:04d}.exr", stream_frame(20 + number))
        sharp = dataclasses.replace(stream_frame(40 + number), time=None)
        write_frame(folder / f"sharp.{number:04d}.exr", sharp)
    second = read_sequence(folder, name="stream02")
    assert torch.equal(second[1].color, stream_frame(21).color)
    sharp = read_sequence(folder, name="sharp")
    assert torch.equal(sharp[0].color, stream_frame(40).color)
    with pytest.raises(FileFormatError, match=r"sharp\.0000\.exr has no layer `time`.*needs=\(\)"):
        read_sequence(folder, name="sharp", needs=("time",))
    write_frame(folder / "stream.0003.exr", sharp[0], overwrite=True)
    with pytest.raises(FileFormatError, match=r"stream\.0003\.exr has no layer `time`"):
        read_sequence(folder)


def test_files_in_an_order_of_their_own(folder):
    paths = [folder / "stream.0006.exr", str(folder / "stream.0003.exr")]
    sequence = torchblur.read_sequence(paths, cuts=(1,))
    assert [frame.source for frame in sequence] == [str(path) for path in paths]
    assert torch.equal(sequence[1].color, stream_frame(3).color)
    assert len(read_sequence(iter(paths))) == 2
    with pytest.raises(FileFormatError, match=r"no frames fit .*gone\.exr"):
        read_sequence([folder / "gone.exr"])
    with pytest.raises(FileFormatError, match="at least one file, got none"):
        read_sequence([])


def test_a_g_buffer_beside_a_stream_is_not_its_own(folder):
    still = dataclasses.replace(stream_frame(99), time=None)
    for name in ("gbuffer", "revealed", "sharp"):
        write_frame(folder / f"{name}.0003.exr", still)
    frame = read_sequence(folder)[0]
    assert torch.equal(frame.velocity, stream_frame(3).velocity)
    assert frame.revealed is None
    assert find_frames(folder / "sharp.####.exr")[0].gbuffer is not None


def test_a_gap_is_refused_with_both_ends(folder):
    (folder / "stream.0005.exr").unlink()
    with pytest.raises(
        FileFormatError,
        match=r"frame 5 is missing between .*stream\.0004\.exr and stream\.0006\.exr; "
        r"numbers=\(3, 4\)",
    ):
        read_sequence(folder)
    (folder / "stream.0004.exr").unlink()
    with pytest.raises(FileFormatError, match=r"frames 4 to 5 are missing between"):
        read_sequence(folder)
    with pytest.raises(FileFormatError, match=r"the frames 3 to 9; .* has 3 to 6"):
        read_sequence(folder, numbers=(3, 9))


def test_another_size_is_refused_with_both_files(folder):
    write_frame(folder / "stream.0005.exr", stream_frame(size=(8, 14)), overwrite=True)
    with pytest.raises(
        FileFormatError, match=r"stream\.0003\.exr is 14x9, .*stream\.0005\.exr is 14x8"
    ):
        read_sequence(folder)


def test_missing_layers_and_strange_times_are_refused(folder):
    shifted = stream_frame(time=torch.rand(1, 1, *SIZE) - 0.5)
    write_frame(folder / "stream.0004.exr", shifted, overwrite=True)
    with pytest.raises(
        FileFormatError, match=r"`time` must lie in \[0, 1\].*got -0\.\d+ to 0\.\d+ .*0004"
    ):
        read_sequence(folder)
    flat = stream_frame(depth=None)
    write_frame(folder / "stream.0003.exr", flat, overwrite=True)
    with pytest.raises(FileFormatError, match=r"stream\.0003\.exr has no layer `depth`; present: "):
        read_sequence(folder, needs=("depth",))
    with pytest.raises(FileFormatError, match=r"no frames fit .*stream01\.####\.exr"):
        read_sequence(folder, name="stream01")
    with pytest.raises(FrameError, match=r"`cuts` must lie in \[0, 1\], got 7"):
        read_sequence(folder, numbers=(5, 6), cuts=[7])
    with pytest.raises(ConfigError, match="unknown convention"):
        read_sequence(folder, convention="nobody")


# -- what inspect says -------------------------------------------------------------------------


def test_a_stream_is_recognized(tmp_path):
    write_frame(tmp_path / "a.exr", stream_frame(size=(80, 90)))
    found = inspect_file(tmp_path / "a.exr")
    assert found.warnings == ()
    assert found.recognized["time"] == ("time",)
    assert found.recognized["albedo"] == ("albedo.R", "albedo.G", "albedo.B")
    assert found.time.is_stream
    assert 0 <= found.time.minimum < 0.01 < 0.99 < found.time.maximum < 1
    assert found.time.mean == pytest.approx(0.5, abs=0.02)
    assert found.time.distance < 0.03
    assert abs(found.time.neighbors) < 0.05
    assert found.time.outside == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t * 0 + 0.5, r"`time` is 0\.5 everywhere: a frame seen at one time"),
        (lambda t: t - 0.5, r"outside \[0, 1\] in (49|50|51)\.\d% of the pixels \(-0\.(5|499)"),
        (lambda t: t**3, r"far from uniform over the shutter.*mean 0\.2\d\d, distance 0\.[34]"),
        (
            lambda t: torch.linspace(0, 1, t.shape[-1]).expand_as(t),
            r"alike in neighboring pixels \(correlation 1\.00\)",
        ),
    ],
)
def test_strange_times_are_reported(tmp_path, change, message):
    frame = stream_frame(size=(80, 90))
    frame = dataclasses.replace(frame, time=change(frame.time).contiguous())
    write_frame(tmp_path / "a.exr", frame)
    (warning,) = inspect_file(tmp_path / "a.exr").warnings
    assert re.search(message, warning), warning


def test_a_frame_without_times_has_none(tmp_path):
    write_frame(tmp_path / "a.exr", stream_frame(time=None))
    assert inspect_file(tmp_path / "a.exr").time is None


# -- a stream of another renderer --------------------------------------------------------------


def moved(image, offset):
    """Look up an image at each pixel plus an offset in px, bilinear."""
    height, width = image.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    grid = torch.stack(((x + offset[:, 0]) / width, (y + offset[:, 1]) / height), -1) * 2 - 1
    return torch.nn.functional.grid_sample(
        image, grid.float(), padding_mode="border", align_corners=False
    )


@pytest.mark.shared
def test_walkers_are_read_as_they_are(shared_data):
    place = shared_data / "walk_stream"
    first = find_frames(place / "stream.####.exr")[0]
    assert first.center == place / "center.0001.exr"
    assert first.reference_pointsampled == place / "reference_pointsampled.0001.exr"
    sequence = read_sequence(place, cuts=())
    assert len(sequence) == 12
    for frame in sequence:
        assert set(frame.layers()) == {"color", "velocity", "depth", "object_id", "time"}
        steps = frame.time.double() * 64 - 0.5
        assert torch.equal(steps, steps.round()), "the times are (k + 1/2) / 64"
        sky = frame.object_id == 0
        assert (frame.depth[sky] == 1e10).all()
        assert frame.depth[~sky].max() < 1e3
    found = inspect_file(place / "stream.0006.exr")
    assert (found.convention, found.warnings, found.time.is_stream) == ("torchblur", (), True)
    assert inspect_file(place / "center.0006.exr").warnings[0].startswith("the time `time` is 0.5")


@pytest.mark.shared
def test_walkers_velocity_is_forward_and_y_down(shared_data):
    """The stream's color is the sharp frame's at (x, y) + velocity (1/2 - t), as its page says."""
    place = shared_data / "walk_stream"
    scores = {"as read": [], "backward": [], "y flipped": [], "not moved": []}
    for frame, number in zip(read_sequence(place), range(1, 13), strict=True):
        center = read_image(place / f"center.{number:04d}.exr").clamp(0, 1)
        step = frame.velocity * (0.5 - frame.time)
        flip = torch.tensor([1.0, -1.0])[:, None, None]
        steps = {
            "as read": step,
            "backward": -step,
            "y flipped": step * flip,
            "not moved": 0 * step,
        }
        for name, offset in steps.items():
            error = (moved(center, offset) - frame.color.clamp(0, 1)).square().mean()
            scores[name].append(float(-10 * error.log10()))
    means = {name: sum(values) / 12 for name, values in scores.items()}
    assert means["as read"] == pytest.approx(28.3, abs=0.1)
    assert means["backward"] == pytest.approx(21.5, abs=0.1)
    assert means["y flipped"] == pytest.approx(27.2, abs=0.1)
    assert means["not moved"] == pytest.approx(22.5, abs=0.1)
