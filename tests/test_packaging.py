"""What an installed torchblur must have beside its modules."""

import subprocess
import sys
import tomllib
import zipfile

import pytest

import torchblur


def test_the_version_is_written_once(repository):
    project = tomllib.loads((repository / "pyproject.toml").read_text())
    assert "version" in project["project"]["dynamic"]
    written = repository / project["tool"]["hatch"]["version"]["path"]
    assert f'__version__ = "{torchblur.__version__}"' in written.read_text().splitlines()


def test_the_wheel_has_types_and_version(repository, tmp_path):
    pytest.importorskip("hatchling", reason="hatchling builds the wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=repository, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name == f"torchblur-{torchblur.__version__}-py3-none-any.whl"
    names = zipfile.ZipFile(wheel).namelist()
    assert {"torchblur/py.typed", "tuning/py.typed"} <= set(names)
    templates = (repository / "tuning" / "report" / "templates").iterdir()
    assert {f"tuning/report/templates/{path.name}" for path in templates} <= set(names)
    assert not [name for name in names if name.startswith(("tests/", "configs/", "tools/"))]


def test_nothing_but_packages_goes_into_the_wheel_by_force(repository):
    # An editable install copies such files to a folder of that name, which hides the package.
    project = tomllib.loads((repository / "pyproject.toml").read_text())
    assert "force-include" not in project["tool"]["hatch"]["build"]["targets"]["wheel"]
