"""Scenes: what comes with torchblur loads, what is wrong is refused with one clear message."""

import copy

import pytest
import torch
from pydantic import BaseModel

from torchblur.errors import ConfigError
from torchblur.params import build
from torchblur.render import Renderer, Scene, load_scene, render_frame, render_revealed
from torchblur.render.bodies import Solid
from torchblur.render.mesh_body import Mesh
from torchblur.render.mesh_shapes import Blob, Gear, Lathe, TorusKnot
from torchblur.render.scene import Group

BALL = {"kind": "sphere", "radius": 1.0, "texture": {"kind": "solid", "color": [1, 1, 1]}}
GOOD = {"camera": {"position": [0, 0, 5]}, "bodies": [BALL]}
CLAIMS = (
    "crossing_spheres", "thin_pole", "spinning_wheel", "overlapping_rotations", "towards_viewer",
    "static_foreground", "three_wheels", "sideways_camera", "spinning_cube", "crossing_boxes",
    "fence", "opposite_motion", "crosswise_motion", "double_dominant",
    "crossing_spheres_long", "slow_sideways_camera", "turning_camera", "colonnade",
    "vase_cushion", "depth_layers", "mesh_shapes",
)  # fmt: skip
SEQUENCES = (
    "crossing_spheres_long", "slow_sideways_camera", "turning_camera", "colonnade",
)  # fmt: skip
SLOW = ("slow_sideways_camera",)  # at frame 0


def changed(path, value):
    """Return the good scene with one value set, or removed if it is `...`."""
    data = copy.deepcopy(GOOD)
    target = data
    for key in path[:-1]:
        target = target[key]
    if value is ...:
        del target[path[-1]]
    else:
        target[path[-1]] = value
    return data


def test_configs_has_the_scenes_of_the_papers(repository):
    files = {path.stem for path in (repository / "configs" / "scenes").glob("*.yaml")}
    assert files == set(CLAIMS)


@pytest.mark.parametrize("name", CLAIMS)
def test_scene_file_renders_and_moves(repository, name):
    path = repository / "configs" / "scenes" / f"{name}.yaml"
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first.startswith("# "), "the first line says which claim of which paper it shows"
    scene = load_scene(path)
    assert build(Scene, scene.model_dump(mode="json")) == scene
    frame = render_frame(scene, (36, 64), color_spp=1)
    blur_at_320 = 0.5 * 5 * frame.velocity.norm(dim=1)
    low, high = (1, 5) if name in SLOW else (5, 45)
    assert low < float(blur_at_320.quantile(0.95)) < high
    assert frame.object_id.unique().numel() >= 3
    assert frame.color.std() > 0.05


@pytest.mark.parametrize("name", SEQUENCES)
def test_sequence_keeps_moving_in_view_for_60_frames(repository, name):
    renderer = Renderer(load_scene(repository / "configs" / "scenes" / f"{name}.yaml"))
    frames = [renderer.frame((18, 32), frame=t, color_spp=1) for t in (*range(0, 60, 6), 59)]
    speed = [frame.velocity.norm(dim=1) for frame in frames]
    fast = torch.stack([each.quantile(0.95) for each in speed])
    assert fast.max() < 2 * fast.min(), "as fast in all frames"
    assert all((each > 0.05).double().mean() > 0.08 for each in speed)
    assert all(frame.object_id.unique().numel() >= 3 for frame in frames)
    assert min(float(frame.depth.min()) for frame in frames) > 0.8, "nothing meets the camera"


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("camera", "fovv"), 40, r"unknown key `fovv` \(did you mean `fov`\?\)"),
        (("bodies", 0, "radios"), 1, r"unknown key `radios` \(did you mean `radius`\?\)"),
        (("bodies", 0, "radius"), -1.0, r"`radius`.*greater than 0, got -1.0.*bodies.0.radius"),
        (("bodies", 0, "radius"), float("nan"), r"`radius`.*finite.*got nan"),
        (("bodies", 0, "radius"), "1", r"`radius`.*number, got '1'"),
        (("bodies", 0, "radius"), ..., r"`radius` is required"),
        (("bodies", 0, "texture", "kind"), "marble", r"'marble'.*'checker'.*bodies.0.texture"),
        (("bodies", 0, "kind"), "torus", r"'torus'.*'sphere'.*bodies.0"),
        (("bodies", 0, "texture", "color"), [1, -1, 1], r"greater than or equal to 0, got -1"),
        (("bodies", 0, "axis"), [0, 0, 0], r"`axis` must not be a zero vector"),
        (("bodies", 0, "object_id"), 0, r"`object_id`.*greater than or equal to 1, got 0"),
        (("bodies",), [], r"`bodies`.*at least 1 item.*got \[\]"),
        (("bodies",), [{"kind": "group", "bodies": []}], r"at least 1 item.*bodies.0"),
        (("camera",), {"fov": 40, "focal": 1.0}, "`fov` or `focal`, not both"),
        (("camera", "fov"), 180, r"`fov`.*less than 180, got 180"),
        (("camera", "look_at"), [0, 0, 5], r"`look_at` \[0.0, 0.0, 5.0\] must differ"),
        (("camera", "look_at"), [0, 3, 5], r"along `up`"),
        (("camera",), {"look_at": [0, 0, -1], "rotation": [1, 0, 0]}, "`look_at` or `rotation`"),
        (("light",), {"direction": [0, 0, 0]}, "`direction` must not be a zero vector"),
    ],
)  # fmt: skip
def test_bad_scene_is_refused(path, value, message):
    build(Scene, GOOD)
    with pytest.raises(ConfigError, match=message):
        build(Scene, changed(path, value), "scene.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"must be a mapping.*got NoneType \(.*bad.yaml\)"),
        ("- 1", r"must be a mapping.*got list"),
        ("camera: {", r"bad.yaml is not valid YAML"),
        ("camera: {}\nbodies: [{kind: sphere, radius: -2, texture: {kind: solid, color: [1,1,1]}}]",
         r"`radius`.*got -2 \(.*bad.yaml: bodies.0.radius\)"),
    ],
)  # fmt: skip
def test_bad_file_is_refused(tmp_path, text, message):
    path = tmp_path / "bad.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        load_scene(path)


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"none.yaml cannot be read"):
        load_scene(tmp_path / "none.yaml")


def test_every_field_is_documented():
    def undocumented(model: type[BaseModel], seen: set) -> list[str]:
        seen.add(model)
        names = [f"{model.__name__}.{n}" for n, f in model.model_fields.items()
                 if not f.description and n != "kind"]  # fmt: skip
        return names

    models = [Scene, Group, *Solid.__args__, Mesh, TorusKnot, Gear, Blob, Lathe]
    assert [name for model in models for name in undocumented(model, set())] == []


@pytest.mark.parametrize(
    ("name", "number", "behind"),
    [("vase_cushion", 20, {3, 10}), ("static_foreground", 20, {1}), ("depth_layers", 11, {15})],
)
def test_an_object_in_front_has_a_revealed_layer(repository, name, number, behind):
    scene = load_scene(repository / "configs" / "scenes" / f"{name}.yaml")
    mask = render_frame(scene, (36, 64), color_spp=1).object_id == number
    revealed = render_revealed(scene, (36, 64), mask=mask, color_spp=1)
    assert mask.double().mean() > 0.04
    assert torch.equal(revealed.hit, mask), "five rays find what is behind every pixel"
    ids = revealed.frame.object_id[mask]
    assert behind <= set(ids.unique().tolist())
    assert number not in ids


def test_object_ids_come_from_body_group_or_position():
    group = {"kind": "group", "object_id": 7, "bodies": [BALL, BALL | {"object_id": 3}]}
    scene = build(Scene, GOOD | {"bodies": [BALL, group, {"kind": "group", "bodies": [BALL]}]})
    assert [number for *_, number in scene.placed_bodies()] == [1, 7, 3, 3]
