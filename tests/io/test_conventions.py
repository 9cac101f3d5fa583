"""Each entry of the table, on a file with a known motion; overrides; what "auto" refuses."""

import math

import numpy as np
import pytest
import torch

from torchblur.errors import ConfigError, FileFormatError
from torchblur.io import conventions
from torchblur.io.conventions import CONVENTIONS, ConventionOverrides, get_convention
from torchblur.io.convert import depth_to_distance
from torchblur.io.exr import write_exr
from torchblur.io.frames import read_frame
from torchblur.params import build

HEIGHT, WIDTH = 32, 64

# In every file below things move 4 px to the right and 2 px up per frame: (4, -2) with y down.
# The stored numbers are worked out here by hand from the programs' manuals, not from the table.
STORED = {
    "torchblur": {"velocity.X": 4, "velocity.Y": -2, "Z": 5, "id": 7, "time": 0.25},
    "blender": {  # 3 px right, 1 up from the frame before; 5 right, 3 up to the next; y up
        "ViewLayer.Vector.X": -3,
        "ViewLayer.Vector.Y": -1,  # previous - current
        "ViewLayer.Vector.Z": -5,
        "ViewLayer.Vector.W": -3,  # current - next
        "ViewLayer.Depth.Z": 5,
        "ViewLayer.IndexOB.X": 7,
        "ViewLayer.Combined.R": 0.1,
        "ViewLayer.Combined.G": 0.2,
        "ViewLayer.Combined.B": 0.3,
    },
    "nuke": {"forward.u": 5, "forward.v": 3, "backward.u": -3, "backward.v": -1, "Z": 5},
    "arnold": {"motionvector.R": 4, "motionvector.G": 2, "Z": 5, "ID": 7},
    "vray": {"velocity.R": 4, "velocity.G": 2, "velocity.B": 0, "VRayZDepth": 5},
    "renderman": {"motionFore.R": 4, "motionFore.G": 2, "z": 5, "id": 7},
    "unreal": {
        "FinalImageMotionVectors.R": 0.5 + 4 / WIDTH / 2,
        "FinalImageMotionVectors.G": 0.5 + 2 / HEIGHT / 2,
        "FinalImageWorldDepth.R": 5,
    },
    "karma": {"motionvector.X": 4 / WIDTH, "motionvector.Y": 2 / HEIGHT, "Z": 5},
    "unity": {"Motion Vectors.R": 4 / WIDTH, "Motion Vectors.G": 2 / HEIGHT, "Depth.R": 5},
    "moonray": {  # a pixel half covered; -1 to 1 over the image
        "motionvec.R": 0.5 * 2 * 4 / WIDTH,
        "motionvec.G": 0.5 * 2 * 2 / HEIGHT,
        "A": 0.5,
        "Z": 5,
    },
}
AUTO = sorted(set(CONVENTIONS) - {"arnold", "karma"})


def make(path, values, size=(HEIGHT, WIDTH), types=None):
    values = (
        {"R": 0.1, "G": 0.2, "B": 0.3} | values
        if "R" not in "".join(k for k in values if k.endswith("Combined.R"))
        else values
    )
    write_exr(
        path, {k: np.full(size, v, (types or {}).get(k, np.float32)) for k, v in values.items()}
    )
    return path


def assert_known_motion(frame):
    expected = torch.tensor([4.0, -2.0])[None, :, None, None].expand(1, 2, HEIGHT, WIDTH)
    torch.testing.assert_close(frame.velocity, expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(
        frame.color, torch.tensor([0.1, 0.2, 0.3])[None, :, None, None].expand_as(frame.color)
    )
    assert torch.equal(frame.depth, torch.full_like(frame.depth, 5))


def test_every_entry_of_the_table_is_tried_here():
    assert set(STORED) == set(CONVENTIONS)


@pytest.mark.parametrize("name", sorted(CONVENTIONS))
def test_each_program_gives_the_same_frame(tmp_path, name):
    frame = read_frame(make(tmp_path / "a.exr", STORED[name]), name)
    assert_known_motion(frame)
    if name in ("torchblur", "blender", "arnold", "renderman"):
        assert frame.object_id.unique().tolist() == [7]
    if name in ("blender", "nuke"):
        assert frame.acceleration[0, :, 3, 5].tolist() == [2, -2]
    else:
        assert frame.acceleration is None


@pytest.mark.parametrize("name", AUTO)
def test_auto_finds_the_convention(tmp_path, name):
    assert_known_motion(read_frame(make(tmp_path / "a.exr", STORED[name])))


def test_auto_refuses_what_fits_two_programs(tmp_path):
    path = make(tmp_path / "a.exr", STORED["arnold"])
    with pytest.raises(FileFormatError, match=r'"arnold" \(.*\), "karma" \(.*name one'):
        read_frame(path)


def test_auto_trusts_the_signature_of_a_program(tmp_path):
    import OpenEXR

    header = {"arnold/version": "7.2", "type": OpenEXR.scanlineimage}
    values = {"R": 0.1, "G": 0.2, "B": 0.3} | STORED["arnold"]
    content = {k: np.full((HEIGHT, WIDTH), v, np.float32) for k, v in values.items()}
    OpenEXR.File(header, content).write(str(tmp_path / "a.exr"))
    assert_known_motion(read_frame(tmp_path / "a.exr"))


def test_auto_lists_what_is_there_and_what_was_tried(tmp_path):
    path = make(tmp_path / "a.exr", {"wind.X": 1, "wind.Y": 2})
    with pytest.raises(FileFormatError, match=r"Present: B, G, R, wind\.X, wind\.Y\. Tried") as e:
        read_frame(path)
    assert all(f"{name}: " in str(e.value) for name in CONVENTIONS)


def test_auto_does_not_take_velocity_in_space_for_screen_velocity(tmp_path):
    path = make(tmp_path / "a.exr", {"velocity.X": 4, "velocity.Y": -2, "velocity.Z": 1, "Z": 5})
    with pytest.raises(FileFormatError, match="no velocity channels that are known"):
        read_frame(path)
    assert_known_motion(read_frame(path, "torchblur"))


def test_names_are_found_whatever_their_case(tmp_path):
    assert_known_motion(
        read_frame(make(tmp_path / "a.exr", {"velocity.x": 4, "Velocity.y": -2, "z": 5}))
    )


# -- overrides ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "overrides"),
    [
        ({"mv.a": 4, "mv.b": -2}, {"velocity": ("mv.a", "mv.b")}),
        ({"mv.a": 4, "mv.b": 2}, {"velocity": ["mv.a", "mv.b"], "velocity_y": "up"}),
        ({"mv.a": -4, "mv.b": 2}, {"velocity": ("mv.a", "mv.b"), "velocity_sign": -1}),
        ({"mv.a": 2, "mv.b": -1}, {"velocity": ("mv.a", "mv.b"), "velocity_scale": 2}),
        (
            {"mv.a": 4 / WIDTH, "mv.b": -2 / HEIGHT},
            {"velocity": ("mv.a", "mv.b"), "velocity_unit": "uv"},
        ),
        (
            {"mv.a": 8 / WIDTH, "mv.b": -4 / HEIGHT},
            {"velocity": ("mv.a", "mv.b"), "velocity_unit": "ndc"},
        ),
        ({"mv.a": 4.5, "mv.b": -1.5}, {"velocity": ("mv.a", "mv.b"), "velocity_bias": 0.5}),
        (
            {"mv.a": -4, "mv.b": 2},
            {"velocity_previous": ("mv.a", "mv.b"), "velocity_previous_sign": -1},
        ),
    ],
)
def test_everything_about_the_velocity_can_be_said(tmp_path, values, overrides):
    assert_known_motion(read_frame(make(tmp_path / "a.exr", values | {"Z": 5}), **overrides))


def test_naming_the_velocity_drops_the_previous_pair(tmp_path):
    path = make(tmp_path / "a.exr", STORED["nuke"])
    frame = read_frame(path, "nuke", velocity=("forward.u", "forward.v"))
    assert frame.velocity[0, :, 0, 0].tolist() == [5, -3]
    assert frame.acceleration is None


def test_other_layers_can_be_named_or_left_out(tmp_path):
    values = STORED["torchblur"] | {"diffuse.R": 1, "diffuse.G": 2, "diffuse.B": 3, "far": 9}
    path = make(tmp_path / "a.exr", values)
    frame = read_frame(path, color="diffuse", depth="far", object_id=None)
    assert frame.color[0, :, 0, 0].tolist() == [1, 2, 3]
    assert frame.depth.unique().tolist() == [9]
    assert frame.object_id is None
    frame = read_frame(path, color=("B", "G", "R"), depth=None)
    torch.testing.assert_close(frame.color[0, :, 0, 0], torch.tensor([0.3, 0.2, 0.1]))
    assert frame.depth is None


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"depth": "far"}, r"has no channels far \(convention `torchblur`\); present: B, G, R, Z"),
        ({"velocity": ("u", "v")}, r"has no channels u/v .*present"),
        ({"color": "beauty"}, r"has no channels beauty\.R/beauty\.G/beauty\.B"),
    ],
)
def test_a_named_channel_that_is_missing_is_refused(tmp_path, overrides, message):
    path = make(tmp_path / "a.exr", STORED["torchblur"])
    with pytest.raises(FileFormatError, match=message):
        read_frame(path, **overrides)


def test_a_convention_whose_channels_are_missing_is_refused(tmp_path):
    path = make(tmp_path / "a.exr", STORED["torchblur"])
    with pytest.raises(
        FileFormatError, match=r"has no channels forward\.u/forward\.v or .*`nuke`.*velocity\.X"
    ):
        read_frame(path, "nuke")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"velocty": ("a", "b")}, r"unknown key `velocty` \(did you mean `velocity`\?\)"),
        ({"velocity_unit": "pixels"}, r"`velocity_unit`: .*, got 'pixels'"),
        ({"velocity_sign": 2}, r"`velocity_sign`: .*, got 2"),
        ({"velocity": "a"}, r"`velocity`: .*, got 'a'"),
        ({"depth_near": 0}, r"`depth_near`: .*greater than 0, got 0"),
        ({"velocity_scale": math.nan}, r"`velocity_scale`: .*finite"),
    ],
)
def test_wrong_overrides_are_refused(overrides, message):
    with pytest.raises(ConfigError, match=message):
        get_convention("nuke", **overrides)


def test_an_unknown_convention_names_the_nearest():
    with pytest.raises(
        ConfigError, match=r"`blendr` \(did you mean `blender`\?\); there are: auto"
    ):
        get_convention("blendr")


def test_overrides_cover_every_field_and_come_from_plain_data():
    own = set(conventions.Convention.model_fields)
    assert set(ConventionOverrides.model_fields) == own - {
        "name",
        "program",
        "evidence",
        "note",
        "signature",
    }
    overrides = build(ConventionOverrides, {"velocity": ["a", "b"], "velocity_unit": "uv"})
    changed = CONVENTIONS["nuke"].override(overrides)
    assert (changed.velocity, changed.velocity_unit) == ((("a", "b"),), "uv")


# -- depth -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stored", "overrides", "distance"),
    [
        (5.0, {}, 5.0),
        (0.0, {"depth_zero": "background"}, math.inf),
        (0.0, {"depth_zero": "invalid"}, 0.0),
        (-5.0, {"depth_scale": -1}, 5.0),
        (500.0, {"depth_scale": 0.01}, 5.0),
        (0.2, {"depth_kind": "inverse"}, 5.0),
        (0.0, {"depth_kind": "inverse"}, math.inf),
        (0.02, {"depth_kind": "reversed", "depth_near": 0.1}, 5.0),
        (0.0, {"depth_kind": "reversed"}, math.inf),
        # (1/near - 1/z) / (1/near - 1/far) with near 0.1, far 100, z 5: (10 - 0.2) / (10 - 0.01)
        (9.8 / 9.99, {"depth_kind": "hyperbolic", "depth_near": 0.1, "depth_far": 100}, 5.0),
        (1.0, {"depth_kind": "hyperbolic", "depth_near": 0.1, "depth_far": 100}, 100.0),
    ],
)
def test_depth_becomes_a_distance(stored, overrides, distance):
    entry = get_convention("torchblur", **overrides)
    got = depth_to_distance(torch.full((1, 1, 2, 3), stored, dtype=torch.float64), entry)
    torch.testing.assert_close(got, torch.full_like(got, distance))
