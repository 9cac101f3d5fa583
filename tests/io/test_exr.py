"""The guard around OpenEXR: exact round trips, and one clear error for each way to fail."""

import numpy as np
import OpenEXR
import pytest

from torchblur.errors import FileFormatError, OutputError
from torchblur.io.exr import ExrPart, Window, read_exr, read_metadata, to_half, write_exr


def channels(height=33, width=47, seed=0):
    rng = np.random.default_rng(seed)
    return {
        "R": rng.normal(size=(height, width)).astype(np.float16),
        "layer.Z": rng.normal(size=(height, width)).astype(np.float32) * 1e10,
        "id": rng.integers(0, 2**32, (height, width), dtype=np.uint32),
    }


def assert_same(got, expected):
    assert set(got) == set(expected)
    for name, array in expected.items():
        assert got[name].dtype == array.dtype
        assert got[name].flags.c_contiguous
        np.testing.assert_array_equal(got[name], array, err_msg=name)


@pytest.mark.parametrize("compression", ["none", "rle", "zips", "zip", "piz", "zstd"])
def test_round_trip_keeps_every_bit_and_type(tmp_path, compression):
    content = channels()
    write_exr(tmp_path / "a.exr", [ExrPart(channels=content, compression=compression)])
    part = read_exr(tmp_path / "a.exr").parts[0]
    assert part.compression == compression
    assert_same(part.channels, content)


def test_special_values_survive(tmp_path):
    values = np.array([[np.nan, np.inf, -np.inf, 65504.0]], np.float32)
    write_exr(tmp_path / "a.exr", {"Z": values, "H": values.astype(np.float16)})
    part = read_exr(tmp_path / "a.exr").parts[0]
    np.testing.assert_array_equal(part.channels["Z"], values)
    np.testing.assert_array_equal(part.channels["H"], values.astype(np.float16))


def test_multi_part_keeps_names_views_sizes_and_windows(tmp_path):
    first = ExrPart(channels=channels(), name="rgba_left", view="left")
    second = ExrPart(
        channels=channels(20, 30, seed=1),
        name="depth",
        data_window=Window(5, -3, 30, 20),
        display_window=Window(0, 0, 47, 33),
    )
    write_exr(tmp_path / "a.exr", [first, second])
    parts = read_exr(tmp_path / "a.exr").parts
    assert [(p.name, p.view) for p in parts] == [("rgba_left", "left"), ("depth", "")]
    assert_same(parts[0].channels, first.channels)
    assert_same(parts[1].channels, second.channels)
    assert parts[1].window == Window(5, -3, 30, 20)
    assert parts[1].image_window == Window(0, 0, 47, 33)


def test_arrays_that_are_not_contiguous_are_written_right(tmp_path):
    rng = np.random.default_rng(0)
    content = {
        "transposed": rng.random((47, 33), np.float32).T,
        "mirrored": rng.random((33, 47), np.float32)[::-1, ::-1],
        "strided": rng.random((66, 94), np.float32)[::2, ::2],
    }
    write_exr(tmp_path / "a.exr", content)
    assert_same(read_exr(tmp_path / "a.exr").parts[0].channels, content)


def test_the_given_dict_is_not_changed(tmp_path):
    content = channels()
    before = dict(content)
    metadata = {"a": 1}
    write_exr(tmp_path / "a.exr", content, metadata=metadata)
    assert all(content[name] is before[name] for name in before)
    assert metadata == {"a": 1}
    write_exr(tmp_path / "b.exr", channels(7, 5), metadata=metadata)
    assert read_exr(tmp_path / "b.exr").parts[0].window == Window(0, 0, 5, 7)


def test_layers_are_not_merged_into_rgb(tmp_path):
    content = {f"X.{c}": np.full((4, 4), i, np.float32) for i, c in enumerate("RGBA")}
    write_exr(tmp_path / "a.exr", content)
    assert_same(read_exr(tmp_path / "a.exr").parts[0].channels, content)


def test_metadata_come_back_as_they_were(tmp_path):
    metadata = {"big": 2**60, "list": [1, 2], "none": None, "yes": True, "κ": {"x": [0.1]}}
    write_exr(tmp_path / "a.exr", channels(), metadata=metadata)
    assert read_exr(tmp_path / "a.exr").metadata == metadata


def test_a_file_without_metadata_has_none(tmp_path):
    write_exr(tmp_path / "a.exr", channels())
    assert read_exr(tmp_path / "a.exr").metadata == {}


def test_foreign_metadata_are_refused(tmp_path):
    header = {"torchblur": "not json", "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"R": np.zeros((4, 4), np.float32)}).write(str(tmp_path / "a.exr"))
    with pytest.raises(FileFormatError, match=r"`torchblur` is not a JSON object: 'not json'"):
        _ = read_exr(tmp_path / "a.exr").metadata


def test_tiled_files_are_read(tmp_path):
    content = channels()
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    header = {"type": OpenEXR.tiledimage, "tiles": tiles}
    OpenEXR.File(header, dict(content)).write(str(tmp_path / "a.exr"))
    assert_same(read_exr(tmp_path / "a.exr").parts[0].channels, content)


# -- damaged files -----------------------------------------------------------------------------


@pytest.mark.parametrize("parts", [1, 2])
@pytest.mark.parametrize("compression", ["none", "zip", "piz"])
def test_a_truncated_file_is_refused_without_noise(tmp_path, capfd, compression, parts):
    path = tmp_path / "a.exr"
    write_exr(
        path,
        [ExrPart(channels=channels(), compression=compression, name=f"p{i}") for i in range(parts)],
    )
    whole = path.read_bytes()
    for length in (9, 60, 400, len(whole) // 4, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(FileFormatError, match=rf"a\.exr is truncated: it ends after {length} "):
            read_exr(path)
    assert capfd.readouterr() == ("", "")


def test_a_truncated_tiled_file_is_refused(tmp_path):
    path = tmp_path / "a.exr"
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    OpenEXR.File({"type": OpenEXR.tiledimage, "tiles": tiles}, channels()).write(str(path))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(FileFormatError, match="is truncated"):
        read_exr(path)


def test_an_unfinished_file_is_refused(tmp_path):
    """A renderer that is killed leaves the table of blocks empty."""
    path = tmp_path / "a.exr"
    write_exr(path, [ExrPart(channels=channels(), compression="none")])
    whole = bytearray(path.read_bytes())
    start = whole.index(b"screenWindowWidth\0float\0") + len(b"screenWindowWidth\0float\0") + 8
    start = whole.index(b"\0", start) if whole[start] else start
    table = start + 1
    whole[table : table + 8 * 33] = bytes(8 * 33)
    path.write_bytes(whole)
    with pytest.raises(FileFormatError, match="is truncated"):
        read_exr(path)


@pytest.mark.parametrize(("parts", "message"), [(1, "1 of 1 parts"), (3, "1 of 3 parts")])
def test_damaged_pixels_are_refused(tmp_path, parts, message):
    path = tmp_path / "a.exr"
    smooth = np.sin(np.arange(40.0) / 9)[:, None] * np.arange(50.0)  # compresses: raw has no check
    content = {"R": smooth.astype(np.float16), "Z": smooth.astype(np.float32)}
    write_exr(path, [ExrPart(channels=content, name=f"p{i}") for i in range(parts)])
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 2 + 100 : len(whole) // 2 + 300] = bytes(200)
    path.write_bytes(whole)
    with pytest.raises(FileFormatError, match=rf"damaged: the pixels of {message}"):
        read_exr(path)


def test_four_kinds_of_no_file_have_four_messages(tmp_path):
    (tmp_path / "text.exr").write_text("hello world, this is no image")
    (tmp_path / "empty.exr").touch()
    for name, message in (
        ("missing.exr", r"missing\.exr does not exist"),
        ("no/folder/a.exr", r"does not exist; the nearest folder that exists is .*"),
        ("", "is a folder; a file is needed"),
        ("empty.exr", r"is empty \(0 bytes\)"),
        ("text.exr", r"is not an OpenEXR file; it begins with b'hello world,'"),
    ):
        with pytest.raises(FileFormatError, match=message):
            read_exr(tmp_path / name)


# -- refused on writing ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "at least one channel"),
        ({"R": np.zeros((4, 4))}, "`R` must be float16, float32 or uint32, got float64"),
        ({"R": np.zeros((4, 4), np.uint8)}, "got uint8"),
        ({"R": np.zeros((3, 4, 4), np.float32)}, r"one shape \(H, W\), got .*\(3, 4, 4\)"),
        ({"R": np.zeros((0, 4), np.float32)}, r"one shape \(H, W\)"),
        (
            {"R": np.zeros((4, 4), np.float32), "G": np.zeros((4, 5), np.float32)},
            r"'R': \(4, 4\), 'G': \(4, 5\)",
        ),
    ],
)
def test_wrong_arrays_are_refused(tmp_path, content, message):
    with pytest.raises(OutputError, match=message):
        write_exr(tmp_path / "a.exr", content)
    assert list(tmp_path.iterdir()) == []


def test_wrong_parts_are_refused(tmp_path):
    content = channels()
    same = [ExrPart(channels=content, name="a"), ExrPart(channels=content, name="a")]
    with pytest.raises(OutputError, match=r"distinct names, got \['a', 'a'\]"):
        write_exr(tmp_path / "a.exr", same)
    with pytest.raises(OutputError, match=r"`compression` must be one of .*, got 'dwaa'"):
        write_exr(tmp_path / "a.exr", [ExrPart(channels=content, compression="dwaa")])
    with pytest.raises(OutputError, match=r"width=3, height=3\) does not fit"):
        write_exr(tmp_path / "a.exr", [ExrPart(channels=content, data_window=Window(0, 0, 3, 3))])
    with pytest.raises(OutputError, match="the metadata are not JSON"):
        write_exr(tmp_path / "a.exr", content, metadata={"a": np.float32(1)})


def test_half_overflow_is_refused_before_the_cast():
    with pytest.raises(
        OutputError, match=r"`Z`: half float holds up to 65504, got 2 values .*1e\+10"
    ):
        to_half(np.array([1.0, 1e10, -65520], np.float32), "Z")
    kept = to_half(np.array([65504.0, -65519.0, np.inf, np.nan], np.float32), "Z")
    np.testing.assert_array_equal(kept, np.array([65504, -65504, np.inf, np.nan], np.float16))


def test_an_existing_file_stays_unless_overwrite(tmp_path):
    path = tmp_path / "a.exr"
    path.write_bytes(b"precious")
    with pytest.raises(OutputError, match=r"a\.exr exists; overwrite=True"):
        write_exr(path, channels())
    assert path.read_bytes() == b"precious"
    write_exr(path, channels(), overwrite=True)
    assert_same(read_exr(path).parts[0].channels, channels())


def test_a_failing_write_leaves_nothing_behind(tmp_path, monkeypatch):
    path = tmp_path / "a.exr"
    path.write_bytes(b"precious")

    class FullDisk:
        def __init__(self, parts):
            pass

        def write(self, name):
            with open(name, "wb") as file:  # noqa: PTH123
                file.write(b"half of it")
            raise RuntimeError("No space left on device")

    monkeypatch.setattr(OpenEXR, "File", FullDisk)
    with pytest.raises(OutputError, match=r"cannot write .*a\.exr: No space left"):
        write_exr(path, channels(), overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]
    assert path.read_bytes() == b"precious"


def test_metadata_without_the_pixels(tmp_path):
    write_exr(tmp_path / "a.exr", channels(), metadata={"κ": 40.0, "list": [1, None]})
    assert read_metadata(tmp_path / "a.exr") == {"κ": 40.0, "list": [1, None]}
    write_exr(tmp_path / "b.exr", channels())
    assert read_metadata(tmp_path / "b.exr") == {}


def test_metadata_of_a_file_cut_short_are_refused(tmp_path):
    write_exr(tmp_path / "a.exr", channels(), metadata={"a": 1})
    content = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(content[:-100])
    with pytest.raises(FileFormatError, match=r"a\.exr is truncated"):
        read_metadata(tmp_path / "a.exr")
