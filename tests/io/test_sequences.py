"""Which files make a frame, and in which order."""

import pytest

from torchblur.errors import FileFormatError
from torchblur.io.sequences import find_frames


@pytest.fixture
def folder(tmp_path):
    def make(*names):
        for name in names:
            (tmp_path / name).touch()
        return tmp_path

    return make


def test_companions_of_the_same_number_come_along(folder):
    place = folder(
        "sharp.0001.exr",
        "sharp.0002.exr",
        "gbuffer.0001.exr",
        "reference.0002.exr",
        "revealed.0001.exr",
        "revealed_gbuffer.0001.exr",
        "note.txt",
        ".sharp.0003.exr.part",
    )
    first, second = find_frames(place)
    assert (first.number, second.number) == (1, 2)
    assert first.gbuffer == place / "gbuffer.0001.exr"
    assert first.reference is None
    assert first.revealed == place / "revealed.0001.exr"
    assert first.revealed_gbuffer == place / "revealed_gbuffer.0001.exr"
    assert second.gbuffer is None
    assert second.reference == place / "reference.0002.exr"


def test_a_folder_with_one_frame_needs_no_numbers(folder):
    place = folder("sharp.exr", "gbuffer.exr", "reference.exr", "reference_full.exr")
    (frame,) = find_frames(place)
    assert frame.path == place / "sharp.exr"
    assert frame.gbuffer == place / "gbuffer.exr"
    assert frame.reference == place / "reference.exr"


@pytest.mark.parametrize("pattern", ["shot.####.exr", "shot.%04d.exr", "shot.*.exr", "shot.#.exr"])
def test_patterns_give_the_order_of_numbers(folder, pattern):
    place = folder("shot.10.exr", "shot.2.exr", "shot.1.exr", "shot.x2.txt", "other.3.exr")
    assert [f.number for f in find_frames(place / pattern)] == [1, 2, 10]


def test_names_without_numbers_are_in_natural_order(folder):
    place = folder("b10_a.exr", "b2_a.exr", "a_a.exr")
    frames = find_frames(place / "*.exr")
    assert [f.path.name for f in frames] == ["a_a.exr", "b2_a.exr", "b10_a.exr"]
    assert [f.number for f in frames] == [1, 2, 3]


def test_numbers_count_and_not_what_separates_them(folder):
    place = folder("shot_1.exr", "shot.2.exr", "shot-3.exr")
    assert [f.number for f in find_frames(place / "shot*.exr")] == [1, 2, 3]


def test_one_file_is_one_frame(folder):
    place = folder("stream.0007.exr", "reference.0007.exr")
    (frame,) = find_frames(place / "stream.0007.exr")
    assert (frame.number, frame.reference) == (7, place / "reference.0007.exr")


def test_a_companion_read_for_itself_is_no_companion_of_itself(folder):
    place = folder("gbuffer.0001.exr")
    (frame,) = find_frames(place / "gbuffer.####.exr")
    assert frame.gbuffer is None


def test_streams_and_centers_come_along(folder):
    names = ("center", "reference", "reference_pointsampled", "stream")
    place = folder("shot.0001.exr", *(f"{name}.0001.exr" for name in names), "stream.0002.exr")
    (shot,) = find_frames(place)
    assert shot.path == place / "shot.0001.exr"
    assert shot.center == place / "center.0001.exr"
    assert shot.reference_pointsampled == place / "reference_pointsampled.0001.exr"
    assert shot.streams == (place / "stream.0001.exr",)
    first, second = find_frames(place / "stream.####.exr")
    assert (first.path, first.center) == (place / "stream.0001.exr", place / "center.0001.exr")
    assert (second.center, second.reference) == (None, None)


def test_a_folder_of_companions_alone_gives_the_center_else_the_stream(folder):
    place = folder("reference.0001.exr", "stream01.0001.exr", "stream02.0001.exr")
    assert find_frames(place)[0].path == place / "stream01.0001.exr"
    folder("center.0001.exr")
    assert find_frames(place)[0].path == place / "center.0001.exr"


def test_samples_are_in_their_order(folder):
    place = folder("shot.7.exr", "stream.7.exr", *(f"stream{k}.7.exr" for k in (10, 2, 1, 9)))
    (shot,) = find_frames(place)
    assert [path.name for path in shot.streams] == [f"stream{k}.7.exr" for k in (1, 2, 9, 10)]


def test_refusals_name_what_is_there(folder, tmp_path):
    place = folder("center.0001.exr", "left.0001.exr", "right.0001.exr")
    with pytest.raises(FileFormatError, match=r"several sequences: left, right; name one: .*"):
        find_frames(place)
    with pytest.raises(FileFormatError, match=r"no frames fit .*x\.####\.exr; .*center\.0001\.exr"):
        find_frames(place / "x.####.exr")
    with pytest.raises(FileFormatError, match=r"the folder .*none does not exist"):
        find_frames(tmp_path / "none" / "x.####.exr")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileFormatError, match=r"empty holds no \.exr file"):
        find_frames(tmp_path / "empty")


def test_two_files_of_one_number_are_refused(folder):
    place = folder("shot.1.exr", "shot.0001.exr")
    with pytest.raises(FileFormatError, match="two files have number 1"):
        find_frames(place)
