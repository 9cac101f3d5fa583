"""Outputs appear whole or not at all, and a bad place is one clear error."""

import os

import pytest

from torchblur.errors import FileFormatError, OutputError
from torchblur.io.paths import input_file, output_file


def test_the_file_appears_only_at_the_end(tmp_path):
    path = tmp_path / "a.txt"
    with output_file(path) as temporary:
        temporary.write_text("new")
        assert not path.exists()
        assert temporary.parent == tmp_path
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_keeps_the_old_file_and_removes_the_new(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def interrupted():
        with output_file(path, overwrite=True) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_mode_is_that_of_any_new_file(tmp_path):
    with output_file(tmp_path / "a.txt") as temporary:
        temporary.write_text("x")
    (tmp_path / "b.txt").write_text("x")
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "b.txt").stat().st_mode


def test_bad_places_are_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    for path, message in (
        (tmp_path / "none" / "a.txt", r"cannot write into the folder .*none: No such file"),
        (tmp_path / "file" / "a.txt", r"cannot write into the folder .*file: Not a directory"),
        (tmp_path, "is a folder; the name of a file is needed"),
        (tmp_path / "file", "exists; overwrite=True"),
    ):
        with pytest.raises(OutputError, match=message), output_file(path):
            pytest.fail("the block must not run")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match=r"cannot write into the folder .*: Permission denied"):
        with output_file(tmp_path / "a.txt"):
            pytest.fail("the block must not run")
    tmp_path.chmod(0o700)


def test_an_unreadable_folder_is_reported(tmp_path, monkeypatch):
    def refuse(self, *args, **kwargs):
        raise PermissionError(13, "Permission denied")

    (tmp_path / "a.exr").write_text("x")
    monkeypatch.setattr(type(tmp_path), "open", refuse)
    with pytest.raises(FileFormatError, match=r"a\.exr cannot be read: Permission denied"):
        input_file(tmp_path / "a.exr")
    with pytest.raises(OutputError, match=r"cannot write into the folder .*: Permission denied"):
        with output_file(tmp_path / "b.exr"):
            pytest.fail("the block must not run")
