"""`torchblur render --stream`: what is written, and what is kept when more is asked for."""

import pytest
import torch
from typer.testing import CliRunner

from torchblur.frame import Shutter
from torchblur.io import find_frames, inspect_file, read_frame, read_image, read_sequence
from torchblur.render import load_scene, render_frame, render_reference, render_stream
from tuning.cli.app import app

runner = CliRunner()


@pytest.fixture
def scene(repository):
    return repository / "configs/scenes/crossing_boxes.yaml"


def render(scene, out, *more):
    args = ("render", scene, "-o", out, "--size", "64x48", "--spp", "4", *more)
    result = runner.invoke(app, [str(arg) for arg in args])
    assert result.exit_code == 0, result.output


def test_streams_and_references_of_pixel_centers(scene, tmp_path):
    render(
        scene, tmp_path, "--frames", "2", "--start", "-1", "--shutter", "1", "--seed", "3",
        "--stream", "--point-sampled",
    )  # fmt: skip
    kinds = (scene.stem, "reference", "reference_pointsampled", "stream")
    names = {f"{kind}.{number:04d}.exr" for kind in kinds for number in range(2)}
    assert {path.name for path in tmp_path.iterdir()} == names
    loaded = load_scene(scene)
    (want,) = render_stream(loaded, (48, 64), frame=-1, shutter=Shutter(1.0), seed=3)
    for name, layer in want.layers().items():
        read = read_frame(tmp_path / "stream.0000.exr").layers()[name]
        torch.testing.assert_close(read, layer, msg=name)
    centers = render_reference(
        loaded, (48, 64), spp=4, shutter=Shutter(1.0), frame=0, seed=4, pixel="center"
    )
    found = read_image(tmp_path / "reference_pointsampled.0001.exr")
    torch.testing.assert_close(found, centers.mean)
    sharp = read_frame(tmp_path / f"{scene.stem}.0001.exr")
    assert torch.equal(sharp.depth, render_frame(loaded, (48, 64), color_spp=1).depth)
    assert len(read_sequence(tmp_path)) == 2
    (entry, _) = find_frames(tmp_path)
    assert entry.path.stem == f"{scene.stem}.0000"
    assert entry.streams == (tmp_path / "stream.0000.exr",)


def test_more_samples_of_a_stream_keep_the_first(scene, tmp_path):
    render(scene, tmp_path, "--stream-spp", "2")
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    render(scene, tmp_path, "--stream", "--stream-spp", "3")
    after = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert after.items() > before.items()
    (new,) = set(after) - set(before)
    assert new.name == "stream03.0000.exr"
    times = [read_frame(tmp_path / f"stream{k:02d}.0000.exr").time for k in (1, 2, 3)]
    want = render_stream(load_scene(scene), (48, 64), shutter=Shutter(0.5), spp=3)
    for time, frame in zip(times, want, strict=True):
        assert torch.equal(time, frame.time)


def test_another_seed_of_a_stream_is_refused(scene, tmp_path):
    render(scene, tmp_path, "--stream")
    (tmp_path / "reference.0000.exr").unlink()
    (tmp_path / f"{scene.stem}.0000.exr").unlink()
    args = ("render", scene, "-o", tmp_path, "--size", "64x48", "--spp", "4", "--stream")
    output = runner.invoke(app, [*map(str, args), "--seed", "9"]).output
    assert "stream.0000.exr exists and was made with other settings" in " ".join(output.split())


def test_inspect_says_that_it_is_a_stream(scene, tmp_path):
    render(scene, tmp_path, "--stream", "--shutter", "1")
    assert inspect_file(tmp_path / "stream.0000.exr").warnings == ()
    output = runner.invoke(app, ["inspect", str(tmp_path / "stream.0000.exr")]).output
    assert "a stream" in output
    assert "albedo.R, albedo.G, albedo.B" in output
    sharp = runner.invoke(app, ["inspect", str(tmp_path / f"{scene.stem}.0000.exr")]).output
    assert "a stream" not in sharp
