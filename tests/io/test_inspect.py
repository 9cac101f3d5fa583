"""What `inspect_file` reports: values, what was recognized, and each kind of warning."""

import json
import re

import numpy as np
import pytest
import torch

from torchblur.errors import ConfigError, FileFormatError
from torchblur.frame import Shutter
from torchblur.io.exr import ExrPart, Window, write_exr
from torchblur.io.inspect import inspect_file
from torchblur.io.writing import write_image

HEIGHT, WIDTH = 40, 60


def content(types=None, **values):
    rng = np.random.default_rng(0)
    values = {"velocity.X": 20, "velocity.Y": 1, "Z": 5} | values
    planes = {c: rng.random((HEIGHT, WIDTH), np.float32) * 3 for c in "RGB"}
    for name, value in values.items():
        planes[name] = np.full((HEIGHT, WIDTH), value, (types or {}).get(name, np.float32))
    return planes


def warnings_of(path, planes, **options):
    write_exr(path, planes, overwrite=True)
    return inspect_file(path, **options).warnings


def test_a_good_file_has_no_warnings_and_all_facts(tmp_path):
    planes = content(A=1, id=3)
    planes["velocity.X"][:, : WIDTH // 2] = 0
    planes["velocity.Y"][:, : WIDTH // 2] = 0
    planes["velocity.X"][0, WIDTH - 1] = 30
    part = ExrPart(
        channels=planes, name="all", compression="piz", display_window=Window(0, 0, WIDTH, HEIGHT)
    )
    write_exr(tmp_path / "a.exr", [part], metadata={"frame": 3})
    found = inspect_file(tmp_path / "a.exr")
    assert found.warnings == ()
    assert (found.convention, found.evidence) == ("torchblur", "verified")
    assert found.metadata == {"frame": 3}
    assert found.recognized["velocity"] == ("velocity.X", "velocity.Y")
    assert found.recognized["color"] == ("R", "G", "B")
    assert found.recognized["object_id"] == ("id",)
    assert found.parts[0].compression == "piz"
    assert found.parts[0].data_window == Window(0, 0, WIDTH, HEIGHT)
    z = next(c for c in found.parts[0].channels if c.name == "Z")
    assert (z.type, z.minimum, z.mean, z.maximum, z.num_nan, z.num_inf) == ("float", 5, 5, 5, 0, 0)
    assert found.velocity.median == pytest.approx(401**0.5)
    assert found.velocity.percentile_95 == pytest.approx(401**0.5)
    assert found.velocity.maximum == pytest.approx(901**0.5)
    assert len(found.velocity.percentiles) == 101
    ends = [found.velocity.percentiles[percent] for percent in (0, 99, 100)]
    assert ends == pytest.approx([0, 401**0.5, 901**0.5])
    assert found.velocity.moving_share == pytest.approx(0.5)
    assert json.loads(json.dumps(found.as_dict()))["velocity"]["moving_share"] == 0.5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"velocity.X": 0, "velocity.Y": 0},
            r"velocity \(velocity\.X, velocity\.Y\) is zero every",
        ),
        ({"velocity.X": 0.01, "velocity.Y": 0.2}, r'at most 0\.2 px/frame.*velocity_unit="uv"'),
        ({"velocity.X": 0.52, "velocity.Y": 0.5}, r"centers on 0\.5.*velocity_bias=0\.5"),
        ({"velocity.X": 900}, r"reaches 900 px/frame, more than the image's diagonal"),
        ({"Z": -5}, r"`Z` has 2400 negative values: depth_scale=-1"),
        ({"Z": 0}, r'`Z` has 2400 zeros; depth_zero="background"'),
        ({"A": 0.5}, r"alpha `A` is not 1 in 100\.0% of the pixels"),
        ({"R": -0.1}, r"the color has negative values"),
    ],
)
def test_what_looks_wrong_is_said(tmp_path, changes, message):
    (found,) = warnings_of(tmp_path / "a.exr", content(**changes))
    assert re.search(message, found), found


def test_clipped_color_is_said(tmp_path):
    planes = content()
    for name in "RGB":
        planes[name] = planes[name].clip(max=1)
    (found,) = warnings_of(tmp_path / "a.exr", planes)
    assert "the color stops at 1" in found
    planes["R"][0, 0] = 1.01
    assert warnings_of(tmp_path / "a.exr", planes) == ()


def test_half_depth_and_its_overflow_are_said(tmp_path):
    planes = content(types={"Z": np.float16})
    planes["Z"][4, 7] = np.inf
    overflow, half = warnings_of(tmp_path / "a.exr", planes)
    assert "`Z` has 1 inf, the first at x=7, y=4; half float overflows at 65504" in overflow
    assert "`Z` is half float" in half


def test_nan_is_counted_and_the_rest_still_looked_at(tmp_path):
    planes = content(**{"velocity.Y": 0})
    planes["velocity.X"][3, 2] = planes["velocity.X"][9, 9] = np.nan
    write_exr(tmp_path / "a.exr", planes)
    found = inspect_file(tmp_path / "a.exr")
    assert found.warnings == ("channel `velocity.X` has 2 NaN, the first at x=2, y=3",)
    assert found.velocity.moving_share == pytest.approx(1 - 2 / planes["Z"].size, abs=1e-6)
    planes["G"][:] = np.nan
    assert any("`G` has 2400 NaN" in w for w in warnings_of(tmp_path / "a.exr", planes))


def test_unknown_and_ambiguous_channels_are_findings(tmp_path):
    planes = {c: np.ones((4, 5), np.float32) for c in "RGB"}
    (found,) = warnings_of(tmp_path / "a.exr", planes)
    assert "no velocity channels that are known. Present: B, G, R" in found
    write_exr(tmp_path / "b.exr", planes | {f"motionvector.{c}": planes["R"] * 9 for c in "RG"})
    (found,) = inspect_file(tmp_path / "b.exr").warnings
    assert '"arnold"' in found
    chosen = inspect_file(tmp_path / "b.exr", convention="arnold")
    assert chosen.convention == "arnold"
    assert any("known from documentation only" in w for w in chosen.warnings)
    with pytest.raises(ConfigError, match="unknown convention `arnol`"):
        inspect_file(tmp_path / "b.exr", convention="arnol")
    with pytest.raises(FileFormatError, match="does not exist"):
        inspect_file(tmp_path / "c.exr")


def scene(path, velocity_y):
    """A striped image, and the same averaged along (24, -12) px/frame over half a frame."""
    generator = torch.Generator().manual_seed(3)
    blocks = torch.rand(1, 3, 12, 16, generator=generator)
    color = blocks.repeat_interleave(8, dim=2).repeat_interleave(8, dim=3)
    times = [(i + 0.5) / 48 * 0.5 - 0.25 for i in range(48)]
    shifts = [(round(-12 * t), round(24 * t)) for t in times]
    blurred = sum(torch.roll(color, s, dims=(2, 3)) for s in shifts) / len(times)
    velocity = torch.tensor([24.0, velocity_y])[None, :, None, None].expand(1, 2, 96, 128)
    write_image(path / "a.exr", color, layers={"velocity": velocity}, overwrite=True)
    write_image(path / "reference.exr", blurred, overwrite=True)
    return velocity, blurred


def test_a_reference_shows_a_wrong_sign(tmp_path):
    scene(tmp_path, velocity_y=-12.0)
    right = inspect_file(tmp_path / "a.exr", tmp_path / "reference.exr")
    assert right.warnings == ()
    assert len(right.signs) == 9
    assert any("cannot tell apart: as read; x and y negated" in note for note in right.notes)
    scene(tmp_path, velocity_y=12.0)
    wrong = inspect_file(tmp_path / "a.exr", tmp_path / "reference.exr")
    assert wrong.signs[0].change in ("y negated", "x negated")
    assert any("the reference is met best with" in w and "seem wrong" in w for w in wrong.warnings)
    fixed = inspect_file(tmp_path / "a.exr", tmp_path / "reference.exr", velocity_y="up")
    assert fixed.warnings == ()


def test_a_reference_in_place_of_the_color_is_noticed(tmp_path):
    velocity, blurred = scene(tmp_path, velocity_y=-12.0)
    write_image(tmp_path / "a.exr", blurred, layers={"velocity": velocity}, overwrite=True)
    found = inspect_file(tmp_path / "a.exr", tmp_path / "reference.exr")
    assert found.blur.blurred is True
    assert any("seems to hold motion blur already" in w for w in found.warnings)
    assert any("no sign or order of axes" in w for w in found.warnings)


def test_a_reference_of_another_size_is_said(tmp_path):
    write_exr(tmp_path / "a.exr", content())
    write_image(tmp_path / "r.exr", torch.rand(3, 7, 9))
    (found,) = inspect_file(tmp_path / "a.exr", tmp_path / "r.exr").warnings
    assert found.endswith("r.exr is 9x7, the frame 60x40")


@pytest.mark.shared
def test_real_frames_are_recognized_without_alarm(shared_data):
    found = inspect_file(shared_data / "fan" / "sharp.exr", shared_data / "fan" / "reference.exr")
    assert (found.convention, found.warnings) == ("blender", ())
    assert found.signs[0].change in ("as read", "x and y negated")
    trailing = inspect_file(
        shared_data / "vase" / "sharp.exr",
        shared_data / "vase" / "reference_trailing.exr",
        shutter=Shutter(0.5, "trailing"),
    )
    assert trailing.warnings == ()
    assert trailing.velocity.median == pytest.approx(44, abs=0.6)  # the data's own table: 44
    psnr = {match.change: match.psnr for match in trailing.signs}
    assert psnr["as read"] > psnr["x and y negated"] + 9


@pytest.mark.shared
def test_the_beachball_is_seen_through(shared_data):
    found = inspect_file(shared_data / "beachball" / "multipart.0001.exr")
    assert (found.convention, found.views) == ("nuke", ("right", "left"))
    assert len(found.parts) == 10
    assert any("motion blur already" in w for w in found.warnings)
    assert any("`depth_right:Z` is half float" in w for w in found.warnings)
    assert any("alpha" in w for w in found.warnings)
    assert any("zeros, which are read as infinitely far" in note for note in found.notes)


def test_an_infinite_background_is_nothing_wrong(tmp_path):
    planes = content()
    planes["Z"][:5] = np.inf
    assert warnings_of(tmp_path / "a.exr", planes) == ()
    planes["Z"][:5] = -np.inf
    assert any("`Z` has 300 inf" in text for text in warnings_of(tmp_path / "a.exr", planes))
