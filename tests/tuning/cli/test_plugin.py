"""A filter in a file of one's own is fitted, run over files and exported by the command line."""

import pytest
import torch
from planted import tiny_frame
from typer.testing import CliRunner

from torchblur.filters.parts import registry
from torchblur.io import read_image, save_yaml, write_frame, write_image
from torchblur.presets import load_preset
from tuning.cli.app import app

PLUGIN = '''
from typing import Annotated

import torch

from torchblur import BlurFilter, FilterConfig, Param


class FadeConfig(FilterConfig):
    share: Annotated[float, Param(low=0.0, high=1.0, grad="smooth", source="mine",
                                  meaning="how much is taken from the mean")] = 0.5


class FadeBlur(BlurFilter):
    """Fade to the mean of the frame."""

    name = "fade"
    config_class = FadeConfig

    def compute(self, frame, values):
        mean = frame.color.mean((2, 3), keepdim=True)
        return {"color": torch.lerp(frame.color, mean.expand_as(frame.color), values.share)}
'''


@pytest.fixture(autouse=True)
def _fresh(monkeypatch):
    """No plugins before, none after."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv(registry.PLUGINS, "")
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
    monkeypatch.setattr(registry, "_searched", False)


@pytest.fixture
def plugin(tmp_path):
    path = tmp_path / "fade.py"
    path.write_text(PLUGIN)
    return path


@pytest.fixture
def frames(tmp_path):
    """A folder with a frame, and the same faded by 0.2."""
    frame = tiny_frame(1)
    mean = frame.color.mean((2, 3), keepdim=True).expand_as(frame.color)
    (tmp_path / "frames").mkdir()
    write_frame(tmp_path / "frames" / "sharp.exr", frame, half=False)
    write_image(
        tmp_path / "frames" / "reference.exr", torch.lerp(frame.color, mean, 0.2), half=False
    )
    return tmp_path / "frames"


def run(*args, code=0):
    result = CliRunner().invoke(app, list(map(str, args)))
    assert result.exit_code == code, f"{result.output}\n{result.exception!r}"
    assert "Traceback" not in result.output
    return result.output


def test_fit_batch_and_export(tmp_path, plugin, frames):
    data = {
        "filter": {"kind": "fade", "free": ["share"]},
        "data": {"root": str(frames), "train": [{"kind": "exr"}]},
        "objective": {"terms": {"mse": 1.0}, "color_space": "linear"},
        "methods": [{"kind": "gradient", "steps": 30, "starts": 1, "learning_rate": 0.1}],
    }
    save_yaml(tmp_path / "fit.yaml", data)
    run("tune", tmp_path / "fit.yaml", "-o", tmp_path / "run", "--plugin", plugin)
    preset = tmp_path / "run" / "preset.yaml"
    assert load_preset(preset).params["share"] == pytest.approx(0.2, abs=0.02)

    batch = {"filter": str(preset), "inputs": ["sharp.exr"], "output": "{stem}.out.exr"}
    save_yaml(tmp_path / "batch.yaml", batch | {"root": str(frames)})
    run(f"--plugin={plugin}", "batch", tmp_path / "batch.yaml")
    blurred, reference = (read_image(frames / f) for f in ("sharp.out.exr", "reference.exr"))
    assert torch.allclose(blurred, reference, atol=1e-2)

    run("export", preset, "-o", tmp_path / "fade.hlsl", "--plugin", plugin)
    assert "float blur_share = " in (tmp_path / "fade.hlsl").read_text()


def test_the_table_of_parameters_has_it(plugin):
    assert "how much is taken" in run("params", "fade", "--plugin", plugin)


def refused(path, monkeypatch):
    monkeypatch.setenv(registry.PLUGINS, "")
    return run("params", "line", "--plugin", path, code=2)


def test_a_file_that_makes_no_filter_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "empty.py"
    path.write_text("x = 1\n")
    assert f"the plugin {path} makes no filter" in refused(path, monkeypatch)
    path.write_text("x = 1\nx.y\n")
    found = refused(path, monkeypatch)
    assert "AttributeError" in found
    assert "(line 2)" in found
    missing = refused(tmp_path / "none.py", monkeypatch)
    assert f"the plugin {tmp_path / 'none.py'} does not exist" in missing


def test_processes_that_are_started_find_it(plugin, monkeypatch):
    monkeypatch.setenv(registry.PLUGINS, str(plugin))
    assert "fade" in registry.list_filters()
