"""Frames in and out: round trips, layers, views, windows, and what is refused."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from torchblur.errors import FileFormatError, FrameError, OutputError
from torchblur.frame import Frame
from torchblur.io.exr import ExrPart, Window, read_exr, write_exr
from torchblur.io.frames import read_channels, read_frame, read_image
from torchblur.io.sequences import find_frames
from torchblur.io.writing import write_frame, write_image


def full_frame(height=9, width=13, revealed=True):
    rand = torch.rand
    depth = rand(1, 1, height, width) + 0.5
    depth[0, 0, 0, 0] = math.inf
    return Frame(
        color=rand(1, 3, height, width) * 1e5,
        velocity=torch.randn(1, 2, height, width) * 30,
        depth=depth,
        normal=torch.randn(1, 3, height, width),
        object_id=torch.randint(0, 2**32, (1, 1, height, width)),
        time=rand(1, 1, height, width),
        acceleration=torch.randn(1, 2, height, width),
        valid=rand(1, 1, height, width) > 0.5,
        revealed=full_frame(height, width, revealed=False) if revealed else None,
    )


def assert_same_frames(got, expected):
    assert set(got.layers()) == set(expected.layers())
    for name, layer in expected.layers().items():
        assert torch.equal(got.layers()[name], layer), name


# -- our own layout ----------------------------------------------------------------------------


def test_a_frame_comes_back_bit_by_bit(tmp_path):
    frame = full_frame()
    write_frame(tmp_path / "a.exr", frame, metadata={"frame": 7})
    got = read_frame(tmp_path / "a.exr")
    assert_same_frames(got, frame)
    assert_same_frames(got.revealed, frame.revealed)
    assert read_exr(tmp_path / "a.exr").metadata == {"frame": 7}


def test_half_color_is_rounded_once_and_the_rest_kept(tmp_path):
    frame = full_frame(revealed=False)
    frame = Frame(**frame.layers() | {"color": frame.color / 1e4})
    write_frame(tmp_path / "a.exr", frame, half=True)
    got = read_frame(tmp_path / "a.exr")
    assert torch.equal(got.color, frame.color.half().float())
    assert torch.equal(got.depth, frame.depth)
    types = {k: v.dtype.name for k, v in read_exr(tmp_path / "a.exr").parts[0].channels.items()}
    assert (types["R"], types["Z"], types["id"]) == ("float16", "float32", "uint32")


def test_color_of_either_type_is_accepted(tmp_path):
    for dtype in (np.float16, np.float32):
        content = {c: np.full((4, 5), 0.25, dtype) for c in "RGB"}
        content |= {f"velocity.{c}": np.zeros((4, 5), np.float16) for c in "XY"}
        write_exr(tmp_path / "a.exr", content, overwrite=True)
        frame = read_frame(tmp_path / "a.exr")
        assert frame.color.dtype == torch.float32
        assert frame.color.unique().tolist() == [0.25]


def test_an_image_with_layers(tmp_path):
    color, variance = torch.rand(3, 6, 7), torch.rand(1, 3, 6, 7)
    layers = {
        "variance": variance,
        "A": torch.ones(1, 6, 7),
        "flow": torch.rand(1, 2, 6, 7),
        "count": torch.full((1, 1, 6, 7), 4096),
    }
    write_image(tmp_path / "a.exr", color, layers=layers)
    assert torch.equal(read_image(tmp_path / "a.exr"), color[None].half().float())
    names = ("variance.R", "variance.G", "variance.B")
    assert torch.equal(read_channels(tmp_path / "a.exr", *names), variance)
    assert torch.equal(read_channels(tmp_path / "a.exr", "flow.X", "flow.Y"), layers["flow"])
    assert read_channels(tmp_path / "a.exr", "count").unique().tolist() == [4096]
    with pytest.raises(FileFormatError, match=r"has no channel `flow\.Z`; present: A, B, G, R"):
        read_channels(tmp_path / "a.exr", "flow.Z")


def test_images_that_do_not_fit_are_refused(tmp_path):
    path = tmp_path / "a.exr"
    with pytest.raises(OutputError, match=r"`color` must have shape \(1, 3, H, W\), got \(2, 3,"):
        write_image(path, torch.zeros(2, 3, 4, 5))
    with pytest.raises(
        OutputError, match=r"channel `G`: half float holds up to 65504, got 1 value"
    ):
        write_image(path, torch.tensor([1.0, 7e4, 1.0])[:, None, None])
    with pytest.raises(OutputError, match=r"layer `x` must have 1 to 4 channels.*\(1, 5, 4, 4\)"):
        write_image(path, torch.zeros(3, 4, 4), layers={"x": torch.zeros(1, 5, 4, 4)})
    with pytest.raises(OutputError, match=r"`n` must lie in \[0, 2\^32\)"):
        write_image(path, torch.zeros(3, 4, 4), layers={"n": torch.full((1, 4, 4), -1)})
    assert list(tmp_path.iterdir()) == []
    write_image(path, torch.tensor([1.0, 7e4, 1.0])[:, None, None], half=False)
    assert read_image(path)[0, 1].item() == 7e4
    with pytest.raises(OutputError, match=r"a\.exr exists"):
        write_image(path, torch.zeros(3, 4, 4))
    assert read_image(path)[0, 1].item() == 7e4


# -- bad values --------------------------------------------------------------------------------


def planes(height=8, width=10, **values):
    values = {"R": 0.5, "G": 0.5, "B": 0.5, "velocity.X": 1, "velocity.Y": 0, "Z": 5} | values
    return {k: np.full((height, width), v, np.float32) for k, v in values.items()}


@pytest.mark.parametrize(
    ("channel", "value", "rule"),
    [
        ("velocity.Y", math.nan, "be finite"),
        ("velocity.X", math.inf, "be finite"),
        ("G", math.nan, "be finite"),
        ("Z", math.nan, "be a positive distance"),
        ("Z", -1.0, "be a positive distance"),
        ("Z", 0.0, "be a positive distance"),
    ],
)
def test_bad_values_name_file_channel_count_and_place(tmp_path, channel, value, rule):
    content = planes()
    content[channel][5, 3] = content[channel][6, 1] = value
    write_exr(tmp_path / "shot.exr", content)
    message = (
        rf"channel `{channel}` of .*shot\.exr must {rule}, got 2 values .*"
        rf"first {value} at x=3, y=5; on_invalid"
    )
    with pytest.raises(FrameError, match=message):
        read_frame(tmp_path / "shot.exr")
    with pytest.warns(UserWarning, match=r"2 values.*shot\.exr"):
        frame = read_frame(tmp_path / "shot.exr", on_invalid="mask")
    assert (~frame.valid).nonzero()[:, 2:].tolist() == [[5, 3], [6, 1]]


def test_far_values_are_no_bad_values(tmp_path):
    content = planes()
    content["Z"][0, 0], content["Z"][0, 1] = math.inf, 1e10
    write_exr(tmp_path / "a.exr", content)
    frame = read_frame(tmp_path / "a.exr")
    assert frame.depth[0, 0, 0, :2].tolist() == [math.inf, 1e10]
    assert frame.valid is None


def test_ids_that_are_no_numbers_of_objects_are_refused(tmp_path):
    content = planes(id=2)
    content["id"][2, 1] = 1.5
    write_exr(tmp_path / "a.exr", content)
    with pytest.raises(FrameError, match=r"`id` of .* must hold whole numbers, got 1 .* x=1, y=2"):
        read_frame(tmp_path / "a.exr")
    assert read_frame(tmp_path / "a.exr", object_id=None).object_id is None


def test_a_reference_with_nan_is_refused(tmp_path):
    content = planes()
    content["B"][1, 2] = math.nan
    write_exr(tmp_path / "a.exr", content)
    with pytest.raises(FrameError, match=r"`B` of .*a\.exr .*got 1 .*x=2, y=1"):
        read_image(tmp_path / "a.exr")


# -- two files, folders ------------------------------------------------------------------------


def test_layers_come_from_the_gbuffer_and_color_from_the_other(tmp_path):
    write_exr(tmp_path / "sharp.exr", planes(R=0.1))
    write_exr(tmp_path / "gbuffer.exr", planes(R=0.9, Z=7) | planes(**{"velocity.X": 3}, Z=7))
    frame = read_frame(tmp_path / "sharp.exr", gbuffer=tmp_path / "gbuffer.exr")
    assert frame.color[0, 0, 0, 0].item() == pytest.approx(0.1)
    assert frame.velocity[0, 0, 0, 0].item() == 3
    assert frame.depth[0, 0, 0, 0].item() == 7
    assert frame.source.endswith("gbuffer.exr")
    assert_same_frames(read_frame(tmp_path), frame)


def test_a_color_file_without_velocity_is_enough_beside_a_gbuffer(tmp_path):
    write_exr(tmp_path / "sharp.exr", {c: np.full((8, 10), 0.5, np.float32) for c in "RGB"})
    write_exr(tmp_path / "gbuffer.exr", {k: v for k, v in planes().items() if k not in "RGB"})
    frame = read_frame(tmp_path / "sharp.exr", gbuffer=tmp_path / "gbuffer.exr")
    assert set(frame.layers()) == {"color", "velocity", "depth"}


def test_sizes_that_differ_are_refused_with_both_files(tmp_path):
    write_exr(tmp_path / "sharp.exr", planes(8, 10))
    write_exr(tmp_path / "gbuffer.exr", planes(9, 12))
    message = r"must have one size: .*sharp\.exr is 10x8, .*gbuffer\.exr is 12x9"
    with pytest.raises(FileFormatError, match=message):
        read_frame(tmp_path)


def test_a_folder_of_several_frames_is_no_frame(tmp_path):
    for number in (1, 2):
        write_exr(tmp_path / f"sharp.{number:04d}.exr", planes())
    with pytest.raises(FileFormatError, match=r"holds 2 frames, sharp\.0001\.exr to sharp\.0002"):
        read_frame(tmp_path)


def test_a_revealed_file_becomes_the_revealed_frame(tmp_path):
    write_exr(tmp_path / "sharp.exr", planes(Z=5))
    write_exr(tmp_path / "revealed.exr", planes(Z=8))
    assert read_frame(tmp_path).revealed.depth.unique().tolist() == [8]
    assert read_frame(find_frames(tmp_path)[0]).revealed is not None


# -- layers, parts, views, windows -------------------------------------------------------------


def test_two_view_layers_are_ambiguous_until_one_is_named(tmp_path):
    def layer(name, value):
        names = (
            "Combined.R",
            "Combined.G",
            "Combined.B",
            "Vector.X",
            "Vector.Y",
            "Vector.Z",
            "Vector.W",
        )
        return {f"{name}.{n}": np.full((4, 5), value, np.float32) for n in names}

    write_exr(tmp_path / "a.exr", layer("Near", 1) | layer("Far away", 2))
    with pytest.raises(FileFormatError, match=r"several channels fit `Vector\.Z`: .*layer="):
        read_frame(tmp_path / "a.exr")
    frame = read_frame(tmp_path / "a.exr", layer="Far away")
    assert frame.color.unique().tolist() == [2]
    assert frame.velocity[0, :, 0, 0].tolist() == [-2, 2]
    with pytest.raises(FileFormatError, match=r"no layer `Nea` \(did you mean `Near"):
        read_frame(tmp_path / "a.exr", layer="Nea")


def test_parts_named_after_their_layer(tmp_path):
    def part(name, **values):
        content = {k: np.full((4, 5), v, np.float32) for k, v in values.items()}
        return ExrPart(channels=content, name=name)

    write_exr(
        tmp_path / "a.exr",
        [
            part("motionvec", R=0.5, G=0.5),
            part("rgba", R=1, G=2, B=3, A=1),
            part("depth", Z=5),
            part("albedo", R=7, G=8, B=9),
        ],
    )
    frame = read_frame(tmp_path / "a.exr")
    assert frame.color[0, :, 0, 0].tolist() == [1, 2, 3]
    assert frame.velocity[0, :, 0, 0].tolist() == [1.25, -1]
    assert frame.depth.unique().tolist() == [5]
    assert read_image(tmp_path / "a.exr", layer="albedo")[0, :, 0, 0].tolist() == [7, 8, 9]


def test_views_in_one_part_and_in_several_are_the_same(tmp_path):
    import OpenEXR

    one = {}
    parts = []
    for view, value, prefix in (("right", 1, ""), ("left", 2, "left.")):
        color = {c: np.full((4, 5), value, np.float32) for c in "RGB"}
        motion = {c: np.full((4, 5), 10 * value, np.float32) for c in "uv"}
        one |= {prefix + c: a for c, a in color.items()}
        one |= {f"forward.{view}.{c}": a for c, a in motion.items()}
        parts.append(ExrPart(channels=color, name=f"rgba_{view}", view=view))
        motion = {f"forward.{c}": a for c, a in motion.items()}
        parts.append(ExrPart(channels=motion, name=f"forward_{view}", view=view))
    header = {"multiView": ["right", "left"], "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, one).write(str(tmp_path / "one.exr"))
    write_exr(tmp_path / "many.exr", parts)
    for view, value in ((None, 1), ("right", 1), ("left", 2)):
        frames = [read_frame(tmp_path / n, view=view) for n in ("one.exr", "many.exr")]
        assert frames[0].color.unique().tolist() == [value]
        assert frames[0].velocity[0, :, 0, 0].tolist() == [10 * value, -10 * value]
        assert_same_frames(*frames)
    with pytest.raises(FileFormatError, match=r"no view `up`; views: right, left"):
        read_frame(tmp_path / "one.exr", view="up")


@pytest.mark.parametrize("unit", ["px", "uv"])
def test_the_display_window_frames_the_image(tmp_path, unit):
    content = planes(8, 10, **{"velocity.X": 2})
    content["R"][:] = np.arange(80).reshape(8, 10)
    part = ExrPart(
        channels=content, data_window=Window(-2, 3, 10, 8), display_window=Window(0, 0, 6, 20)
    )
    write_exr(tmp_path / "a.exr", [part])
    frame = read_frame(tmp_path / "a.exr", velocity_unit=unit)
    assert frame.size == (20, 6)
    np.testing.assert_array_equal(frame.color[0, 0, 3:11, :6], content["R"][:, 2:8])
    assert frame.color[0, 0, :3].abs().max() == 0
    assert frame.velocity[0, 0, 3, 0].item() == (2 if unit == "px" else 2 * 6)
    assert frame.velocity[0, 0, 0, 0].item() == 0
    assert torch.isinf(frame.depth[0, 0, :3]).all()
    assert frame.depth[0, 0, 3:11].unique().tolist() == [5]
    whole = read_frame(tmp_path / "a.exr", velocity_unit=unit, window="data")
    assert whole.size == (8, 10)
    np.testing.assert_array_equal(whole.color[0, 0], content["R"])
    assert whole.velocity[0, 0, 0, 0].item() == (2 if unit == "px" else 2 * 6)
    with pytest.raises(FrameError, match="`window` must be 'display' or 'data', got 'crop'"):
        read_frame(tmp_path / "a.exr", window="crop")


# -- frames of other programs ------------------------------------------------------------------


def along_path(color, velocity, acceleration, times):
    """Average the color along each pixel's own path: an oracle for signs and units."""
    height, width = color.shape[-2:]
    rows, columns = torch.meshgrid(
        torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij"
    )
    total = 0
    for t in times:
        d = velocity * t + acceleration * t * t / 2
        grid = torch.stack(
            [(columns - d[:, 0]) / width * 2 - 1, (rows - d[:, 1]) / height * 2 - 1], -1
        )
        total = total + F.grid_sample(color, grid, padding_mode="border", align_corners=False)
    return total / len(times)


def psnr(image, reference):
    return -10 * math.log10(float((image - reference).square().mean()))


@pytest.mark.shared
@pytest.mark.parametrize(
    ("reference", "interval", "expected"),
    [  # the PSNRs are those of the data's own check, which shares no code with ours
        ("vase/reference_trailing", (-0.5, 0), {"as read": 34.72, "reversed": 25.28}),
        ("fan/reference", (-0.25, 0.25), {"as read": 34.11, "y flipped": 32.13}),
        ("weapon/reference", (-0.25, 0.25), {"as read": 44.22}),
        ("cars/reference_full", (-0.5, 0.5), {"as read": 35.72}),
        ("approach/reference", (-0.25, 0.25), {"as read": 38.44, "y flipped": 33.87}),
    ],
)
def test_blender_signs_and_units_meet_its_own_motion_blur(
    shared_data, reference, interval, expected
):
    path = shared_data / f"{reference}.exr"
    frame, image = read_frame(path.parent), read_image(path)
    start, end = interval
    for change, decibels in expected.items():
        sign = torch.tensor([1.0, -1.0 if change == "y flipped" else 1.0])[:, None, None]
        backward = -1 if change == "reversed" else 1
        times = [backward * (start + (i + 0.5) / 31 * (end - start)) for i in range(31)]
        got = along_path(frame.color, frame.velocity * sign, frame.acceleration * sign, times)
        assert psnr(got, image) == pytest.approx(decibels, abs=0.02), change


@pytest.mark.shared
def test_blender_time_runs_forward(shared_data):
    """The frame before, moved by the way it came, looks like this frame."""
    frames = [read_frame(files) for files in find_frames(shared_data / "walk_sequence")[4:6]]
    came = frames[1].velocity - frames[1].acceleration / 2
    zero = torch.zeros_like(came)
    moved = psnr(along_path(frames[0].color, came, zero, [1]), frames[1].color)
    back = psnr(along_path(frames[0].color, came, zero, [-1]), frames[1].color)
    assert moved > back + 4


@pytest.mark.shared
@pytest.mark.parametrize("view", ["left", "right"])
def test_beachball_in_one_part_and_in_ten_is_one_frame(shared_data, view):
    single, multi = (
        read_frame(shared_data / "beachball" / f"{name}.0001.exr", view=view)
        for name in ("singlepart", "multipart")
    )
    assert single.size == (1556, 2048)
    assert_same_frames(single, multi)
    nothing = torch.isinf(single.depth)
    assert 0.7 < nothing.float().mean() < 0.9  # stored as 0
    assert single.color[nothing.expand(1, 3, -1, -1)].max() < 0.5
    assert single.velocity[:, 1].max() > 0  # v is stored negative, y up: the ball comes down
    assert single.velocity[:, 0].min() == 0


@pytest.mark.shared
def test_the_stream_is_read_as_it_is_described(shared_data):
    frame = read_frame(shared_data / "walk_stream" / "stream.0003.exr")
    assert set(frame.layers()) == {"color", "velocity", "depth", "object_id", "time"}
    steps = frame.time * 64 - 0.5
    assert torch.equal(steps, steps.round())
    assert (steps.min(), steps.max()) == (0, 63)
    assert set(frame.object_id.unique().tolist()) <= set(range(8))
    sky = frame.object_id == 0
    assert frame.depth[sky].unique().tolist() == [1e10]
    stored = read_exr(shared_data / "walk_stream" / "stream.0003.exr").parts[0].channels
    np.testing.assert_array_equal(frame.velocity[0, 1], stored["velocity.Y"])


@pytest.mark.shared
def test_revealed_frames_are_found(shared_data):
    for case in ("vase", "weapon"):
        frame = read_frame(shared_data / case)
        behind = frame.revealed
        assert behind is not None
        hidden = frame.depth < behind.depth
        assert 0.01 < hidden.float().mean() < 0.3
        assert not (frame.depth > behind.depth).any()
    assert Path(behind.source).name == "revealed_gbuffer.exr"
