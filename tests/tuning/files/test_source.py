"""What was made by other source is made anew, wherever in a folder that source lies."""

import pytest

import torchblur
from tuning.files.source import source_hash


@pytest.fixture
def library(tmp_path, monkeypatch):
    """Source that can be changed."""
    for name in ("frame.py", "ops/taps.py", "render/mesh.py", "render/family.py", "io/exr.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    monkeypatch.setattr(torchblur, "__file__", str(tmp_path / "__init__.py"))
    return tmp_path


def hash_now(*places, **options):
    return source_hash.__wrapped__(*places, **options)


@pytest.mark.parametrize("name", ["ops/new.py", "ops/taps/new.py", "ops/taps/deeper/new.py"])
def test_folders_in_folders_count(library, name):
    before = hash_now("ops", "render")
    (library / name).parent.mkdir(parents=True, exist_ok=True)
    (library / name).write_text("new")
    assert hash_now("ops", "render") != before


def test_what_is_not_asked_for_does_not_count(library):
    before = hash_now("", "ops"), hash_now("render", without="family")
    (library / "io" / "exr.py").write_text("changed")
    (library / "render" / "family.py").write_text("changed")
    assert (hash_now("", "ops"), hash_now("render", without="family")) == before
    (library / "frame.py").write_text("changed")
    (library / "render" / "mesh.py").write_text("changed")
    assert hash_now("", "ops") != before[0]
    assert hash_now("render", without="family") != before[1]
