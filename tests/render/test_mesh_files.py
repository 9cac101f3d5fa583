"""Meshes from files: formats, hierarchy, colors, companions, and what is refused."""

import os

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.transformations import rotation_matrix, translation_matrix
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from torchblur.errors import ConfigError, FileFormatError
from torchblur.ops.color import srgb_to_linear
from torchblur.params import build
from torchblur.render import Scene, load_scene, render_frame
from torchblur.render.mesh_body import load_geometry

SIZE = (21, 31)
BOX = np.array([0.5, 0.25, 1.0])


def geometry_of(path, **others):
    scene = build(Scene, {"camera": {}, "bodies": [{"kind": "mesh", "path": str(path)} | others]})
    return load_geometry(scene.bodies[0].source)


def sorted_rows(points):
    return np.array(sorted(map(tuple, np.round(np.asarray(points).reshape(-1, 3), 5))))


@pytest.mark.parametrize("ending", ["glb", "gltf", "obj", "ply", "PLY"])
def test_each_format_brings_the_same_triangles(tmp_path, ending):
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.export(tmp_path / f"ball.{ending}", file_type=ending.lower()) if ending != "gltf" else (
        trimesh.Scene(ball).export(tmp_path / "ball.gltf")
    )
    found = geometry_of(tmp_path / f"ball.{ending}", smooth=False)
    np.testing.assert_allclose(sorted_rows(found.corners), sorted_rows(ball.triangles), atol=2e-5)
    assert found.normals is None
    volume = torch.linalg.det(found.corners).sum() / 6
    assert float(volume) == pytest.approx(ball.volume, rel=1e-4), "wound as in the file"


def hierarchy():
    """A box on an arm that is turned and moved, and its mirror image."""
    box = trimesh.creation.box(2 * BOX)
    scene = trimesh.Scene()
    scene.graph.update("arm", matrix=translation_matrix([1, 2, 3]))
    turned = rotation_matrix(0.4, [0, 1, 0])
    scene.add_geometry(box, node_name="hand", parent_node_name="arm", transform=turned)
    mirror = translation_matrix([-5, 0, 0]) @ np.diag([-2.0, 1, 1, 1])
    scene.add_geometry(box, node_name="other", parent_node_name="hand", transform=mirror)
    return scene, (translation_matrix([1, 2, 3]) @ turned, mirror)


def test_transforms_of_nodes_are_applied(tmp_path):
    scene, (hand, mirror) = hierarchy()
    scene.export(tmp_path / "arm.glb")
    found = geometry_of(tmp_path / "arm.glb", scale=2.0)
    box = trimesh.creation.box(2 * BOX).vertices
    want = [trimesh.transform_points(box, m) * 2 for m in (hand, hand @ mirror)]
    got = np.unique(np.round(found.corners.reshape(-1, 3).numpy(), 4), axis=0)
    np.testing.assert_allclose(sorted_rows(got), sorted_rows(np.concatenate(want)), atol=2e-4)
    halves = found.corners - torch.stack(
        [found.corners[i : i + 12].mean((0, 1)) for i in (0, 12)]
    ).repeat_interleave(12, 0)[:, None]  # fmt: skip
    volumes = (torch.linalg.det(halves) / 6).view(2, 12).sum(1)
    assert volumes.tolist() == pytest.approx([8.0, 16.0]), "the mirror is not inside out"


def test_normals_of_the_file_are_turned_along(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3)
    scene = trimesh.Scene()
    stretch = rotation_matrix(0.7, [1, 1, 0]) @ np.diag([3.0, 1, 1, 1])
    scene.add_geometry(ball, transform=stretch)
    ball.vertex_normals  # noqa: B018 - computed, so that they are written
    scene.export(tmp_path / "egg.glb", include_normals=True)
    found = geometry_of(tmp_path / "egg.glb")
    assert found.normals is not None
    inverse = torch.from_numpy(np.linalg.inv(stretch[:3, :3]))
    own = found.corners @ inverse.T
    want = torch.nn.functional.normalize(own @ inverse, dim=2)
    assert (found.normals - want).abs().max() < 0.02
    assert geometry_of(tmp_path / "egg.glb", smooth=False).normals is None


def seen(path, *, make_scene, **others):
    """The unlit color in the middle of each half of the image, a mesh filling it."""
    body = {"kind": "mesh", "path": str(path), "emissive": True} | others
    frame = render_frame(make_scene(body), SIZE, color_spp=1)
    assert (frame.object_id == 1).any()
    return frame


def wall():
    """Two triangles over the whole image, texture coordinates from lower left to upper right."""
    vertices = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], float)
    place = (vertices[:, :2] / 4) + 0.5  # one image over the 4 units that the camera sees
    return vertices, np.array([[0, 1, 2], [0, 2, 3]]), place


@pytest.mark.parametrize("ending", ["glb", "obj"])
def test_image_and_factor_are_the_color(make_scene, tmp_path, ending):
    rng = np.random.default_rng(1)
    pixels = rng.integers(0, 255, (4, 4, 3), np.uint8)
    factor = np.array([0.2, 0.6, 1.0])
    image = Image.fromarray(pixels)
    if ending == "glb":
        material = PBRMaterial(baseColorTexture=image, baseColorFactor=[*factor, 1.0])
    else:
        material = SimpleMaterial(image=image, diffuse=[*factor, 1.0])
    vertices, faces, place = wall()
    visual = TextureVisuals(uv=place, material=material)
    trimesh.Trimesh(vertices, faces, visual=visual, process=False).export(
        tmp_path / f"wall.{ending}"
    )
    camera = {"position": [0, 0, 4], "focal": 1.0}
    body = {"kind": "mesh", "path": str(tmp_path / f"wall.{ending}"), "emissive": True}
    frame = render_frame(make_scene(body, camera=camera), (8, 8), color_spp=1)
    linear = srgb_to_linear(torch.from_numpy(pixels / 255)).permute(2, 0, 1)[None].float()
    # 8x8 pixels over 4x4 texels that repeat: the image, bilinearly, at quarters of texels.
    padded = torch.nn.functional.pad(linear, (1, 1, 1, 1), mode="circular")
    fine = torch.nn.functional.interpolate(padded, scale_factor=2, mode="bilinear")
    want = fine[..., 2:-2, 2:-2] * torch.from_numpy(np.round(factor * 255) / 255).float().view(
        1, 3, 1, 1
    )
    torch.testing.assert_close(frame.color, want, atol=1e-3, rtol=0)


@pytest.mark.parametrize(("ending", "linear"), [("ply", False), ("glb", True)])
def test_vertex_colors_are_interpolated(make_scene, tmp_path, ending, linear):
    vertices, faces, _ = wall()
    colors = np.array([[255, 0, 0], [0, 128, 0], [0, 0, 64], [90, 90, 90]], np.uint8)
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    mesh.export(tmp_path / f"wall.{ending}")
    frame = seen(tmp_path / f"wall.{ending}", make_scene=make_scene)
    values = torch.from_numpy(colors / 255)
    values = values if linear else srgb_to_linear(values)
    # The middle lies half way between corners 0 and 2.
    want = (values[0] + values[2]) / 2
    assert frame.color[0, :, SIZE[0] // 2, SIZE[1] // 2].tolist() == pytest.approx(
        want.tolist(), abs=0.02
    )


def test_parts_keep_their_own_colors(make_scene, tmp_path):
    """Two walls side by side: one has an image, one vertex colors, a third has none."""
    vertices, faces, place = wall()
    scene = trimesh.Scene()
    red = Image.new("RGB", (2, 2), (255, 0, 0))
    blue = Image.new("RGB", (5, 3), (0, 0, 255))
    for number, image in enumerate((red, blue)):
        visual = TextureVisuals(uv=place, material=PBRMaterial(baseColorTexture=image))
        part = trimesh.Trimesh(vertices, faces, visual=visual, process=False)
        scene.add_geometry(part, transform=translation_matrix([6.0 * number - 6, 0, 0]))
    plain = trimesh.Trimesh(vertices, faces, process=False)
    scene.add_geometry(plain, transform=translation_matrix([6, 0, 0]))
    scene.export(tmp_path / "walls.glb")
    frame = seen(
        tmp_path / "walls.glb", make_scene=lambda b: make_scene(b, camera={
            "position": [0, 0, 9], "focal": 0.5})
    )  # fmt: skip
    row = frame.color[0, :, SIZE[0] // 2]
    assert row[:, 3].tolist() == pytest.approx([1, 0, 0])
    assert row[:, SIZE[1] // 2].tolist() == pytest.approx([0, 0, 1])
    assert row[0, -4] == row[1, -4] == row[2, -4] > 0.1


def test_a_texture_replaces_the_colors_of_the_file(make_scene, tmp_path):
    vertices, faces, _ = wall()
    colors = np.full((4, 3), 200, np.uint8)
    trimesh.Trimesh(vertices, faces, vertex_colors=colors).export(tmp_path / "wall.ply")
    green = {"kind": "solid", "color": [0, 2, 0]}
    frame = seen(tmp_path / "wall.ply", make_scene=make_scene, texture=green)
    assert frame.color[0, :, 10, 15].tolist() == [0, 2, 0]


SCENE = """
camera: {position: [0, 0, 4]}
bodies:
  - kind: group
    bodies:
      - {kind: mesh, path: shapes/thing.obj}
"""


def textured_thing(folder, color):
    folder.mkdir(parents=True, exist_ok=True)
    vertices, faces, place = wall()
    material = SimpleMaterial(image=Image.new("RGB", (2, 2), color), name="skin")
    visual = TextureVisuals(uv=place, material=material)
    trimesh.Trimesh(vertices, faces, visual=visual, process=False).export(folder / "thing.obj")


def test_paths_start_at_the_folder_of_the_scene_file(tmp_path, monkeypatch):
    textured_thing(tmp_path / "scenes" / "shapes", (255, 0, 0))
    path = tmp_path / "scenes" / "one.yaml"
    path.write_text(SCENE, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    scene = load_scene("scenes/one.yaml")
    monkeypatch.chdir("/")
    assert (render_frame(scene, SIZE, color_spp=1).object_id == 1).any()
    assert build(Scene, scene.model_dump(mode="json")) == scene


def test_fingerprint_follows_the_files_and_not_the_place(tmp_path):
    def fingerprint(folder, color=(255, 0, 0), text=SCENE):
        textured_thing(tmp_path / folder / "shapes", color)
        (tmp_path / folder / "one.yaml").write_text(text, encoding="utf-8")
        return load_scene(tmp_path / folder / "one.yaml").fingerprint()

    first = fingerprint("a")
    assert first == fingerprint("b")
    assert first != fingerprint("c", color=(255, 0, 1)), "the image counts"
    assert first != fingerprint("d", text=SCENE.replace("4]", "5]"))
    material = next((tmp_path / "a" / "shapes").glob("*.mtl"))
    material.write_text(material.read_text() + "\n# more\n", encoding="utf-8")
    assert first != load_scene(tmp_path / "a" / "one.yaml").fingerprint(), "so does the material"


def test_buffers_of_gltf_count(tmp_path):
    trimesh.Scene(trimesh.creation.box((1, 1, 1))).export(tmp_path / "box.gltf")
    (tmp_path / "s.yaml").write_text(
        "camera: {position: [0, 0, 4]}\nbodies: [{kind: mesh, path: box.gltf}]", encoding="utf-8"
    )
    scene = load_scene(tmp_path / "s.yaml")
    first = scene.fingerprint()
    buffer = next(tmp_path.glob("*.bin"))
    buffer.write_bytes(buffer.read_bytes()[::-1])
    assert scene.fingerprint() != first


def test_a_file_is_read_again_only_after_it_changed(tmp_path):
    path = tmp_path / "box.ply"
    trimesh.creation.box((1, 1, 1)).export(path)
    first = geometry_of(path)
    assert geometry_of(path, position=[1, 0, 0]) is first
    trimesh.creation.box((2, 2, 2)).export(path)
    os.utime(path, (1, 1))
    assert float(geometry_of(path).corners.max()) == 1.0


# -- what is refused -------------------------------------------------------------------------------


def ply(vertices, faces):
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property float {name}" for name in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(map(str, v)) for v in vertices]
    lines += [" ".join(map(str, (3, *f))) for f in faces]
    return "\n".join(lines) + "\n"


CORNERS = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0)]


@pytest.mark.parametrize(
    ("name", "text", "error", "message"),
    [
        ("m.ply", ply(CORNERS, []), ConfigError, r"must have triangles, got none \(.*m.ply\)"),
        ("m.ply", ply(CORNERS, [(0, 1, 3), (0, 0, 1)]), ConfigError,
         r"all 2 triangles of a mesh have no area \(.*m.ply\)"),
        ("m.ply", ply([(0, 0, "nan"), *CORNERS[1:]], [(1, 2, 3), (0, 1, 2)]), ConfigError,
         r"must be finite, got 1 of 2 triangles .*triangle 1 at \[nan, .*m.ply"),
        ("m.ply", ply(CORNERS, [(0, 1, 7)]), FileFormatError, r"0 to 3, got 0 to 7|cannot be read"),
        ("m.ply", "no mesh at all", FileFormatError, r"m.ply cannot be read: "),
        ("m.glb", "no mesh at all", FileFormatError, r"m.glb cannot be read: "),
        ("m.gltf", "{]", FileFormatError, r"m.gltf cannot be read: "),
        ("m.obj", "", ConfigError, r"must have triangles, got none \(.*m.obj\)"),
    ],
)  # fmt: skip
def test_bad_file_is_refused(make_scene, tmp_path, name, text, error, message):
    (tmp_path / name).write_text(text, encoding="utf-8")
    scene = make_scene({"kind": "mesh", "path": str(tmp_path / name)})
    with pytest.raises(error, match=message):
        render_frame(scene, SIZE)


def test_triangles_without_area_are_left_out_with_a_count(tmp_path):
    (tmp_path / "m.ply").write_text(ply(CORNERS, [(0, 1, 2), (0, 1, 3), (1, 1, 2)]))
    with pytest.warns(UserWarning, match=r"2 of 3 triangles have no area.*m.ply"):
        found = geometry_of(tmp_path / "m.ply")
    assert found.corners.tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"path": "none.glb"}, r"`path`: the file does not exist, got '.*none.glb'.*bodies.0.path"),
        (
            {"path": "a.fbx"},
            r"`path`: a mesh must be a file ending in .glb, .gltf, .obj, .ply.*fbx",
        ),
        ({}, r"give either `path` or `generator`"),
        ({"path": "box.ply", "generator": {"kind": "blob"}}, r"give either `path` or `generator`"),
        ({"path": "box.ply", "scale": 0}, r"`scale`.*greater than 0, got 0"),
        ({"generator": {"kind": "cone"}}, r"'cone'.*'torus_knot'.*bodies.0.generator"),
        ({"generator": {"kind": "gear", "bore": 0.9}}, r"`bore` \+ `depth` must be less than"),
        ({"generator": {"kind": "torus_knot", "windings": [2, 4]}}, r"without a common divisor"),
        ({"path": "box.ply", "radius": 1}, r"unknown key `radius`"),
    ],
)
def test_bad_description_is_refused(tmp_path, fields, message):
    from torchblur.io.yaml import save_yaml

    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.ply")
    scene = {"camera": {}, "bodies": [{"kind": "mesh"} | fields]}
    save_yaml(tmp_path / "s.yaml", scene)
    with pytest.raises(ConfigError, match=message):
        load_scene(tmp_path / "s.yaml")
