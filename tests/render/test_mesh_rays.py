"""Meshes against procedural bodies of the same shape."""

import subprocess
import sys

import pytest
import torch
import trimesh

from torchblur.errors import ConfigError
from torchblur.frame import Shutter
from torchblur.render import Renderer, render_frame, render_reference, render_revealed
from torchblur.render.trace import Tracer

SIZE = (90, 120)
CHECKER = {"kind": "checker", "size": 0.4, "color": [1, 0.6, 0.2], "background": [0, 0.1, 0.3]}
MOTION = {"position": [0.2, 0, 0], "rotation": [10, 25, 5], "velocity": [0.3, -0.1, 0.2]}
MOTION |= {"spin": 12.0, "axis": [0.3, 1, 0.2]}
WALL = {"kind": "plane", "position": [0, 0, -3], "texture": CHECKER, "object_id": 9}
CAMERA = {"position": [0.3, 0.2, 4], "focal": 1.0, "spin": 2.0}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with a ball of 327 680 triangles, and a box."""
    folder = tmp_path_factory.mktemp("meshes")
    trimesh.creation.icosphere(subdivisions=7).export(folder / "ball.glb")
    trimesh.creation.box((1.5, 1.0, 0.5)).export(folder / "box.ply")
    return folder


def as_mesh(path, **others):
    return {"kind": "mesh", "path": str(path), "texture": CHECKER} | MOTION | others


@pytest.mark.parametrize("inside_group", [False, True])
def test_ball_of_many_triangles_is_the_sphere(make_scene, files, inside_group):
    ball = {"kind": "sphere", "radius": 0.9, "texture": CHECKER} | MOTION
    mesh = as_mesh(files / "ball.glb", scale=0.9, smooth=True)
    if inside_group:
        outer = {"kind": "group", "spin": 20.0, "axis": [0, 1, 1], "velocity": [0, 0.2, 0]}
        ball, mesh = (outer | {"bodies": [body]} for body in (ball, mesh))
    scenes = [make_scene(body, WALL, camera=CAMERA) for body in (ball, mesh)]
    want, got = (render_frame(scene, SIZE, frame=0.7, color_spp=1) for scene in scenes)
    assert (want.object_id == 1).double().mean() > 0.1
    assert (want.object_id != got.object_id).double().mean() < 1e-3
    both = (want.object_id == got.object_id) & (want.object_id == 1)
    assert (want.depth - got.depth)[both].abs().max() < 1e-3
    inner = both & (want.normal[:, 2:] > 0.5)  # at the rim a triangle's chord matters
    for name, limit in (("depth", 1e-4), ("normal", 1e-3), ("velocity", 5e-3)):
        difference = getattr(want, name) - getattr(got, name)
        assert difference[inner.expand_as(difference)].abs().max() < limit, name
    assert ((want.color - got.color).abs().amax(1) > 0.02)[both[:, 0]].double().mean() < 0.01


def test_box_is_the_box_exactly(make_scene, files):
    box = {"kind": "box", "size": [1.5, 1.0, 0.5], "texture": CHECKER} | MOTION
    scenes = [make_scene(b, WALL, camera=CAMERA) for b in (box, as_mesh(files / "box.ply"))]
    want, got = (render_frame(scene, SIZE, frame=-0.4, color_spp=1) for scene in scenes)
    assert (want.object_id == 1).double().mean() > 0.1
    assert (want.object_id != got.object_id).double().mean() < 2e-4
    both = (want.object_id == got.object_id) & (want.object_id == 1)
    assert (want.depth - got.depth)[both].abs().max() < 1e-6
    for name, limit in (("normal", 1e-6), ("velocity", 1e-5), ("acceleration", 1e-4)):
        difference = (getattr(want, name) - getattr(got, name)).abs()
        assert difference[both.expand_as(difference)].quantile(0.999) < limit, name
    assert (want.color - got.color).abs()[both.expand(-1, 3, -1, -1)].quantile(0.99) < 1e-6


def test_blurred_box_is_the_blurred_box(make_scene, files):
    box = {"kind": "box", "size": [1.5, 1.0, 0.5], "texture": CHECKER} | MOTION
    scenes = [make_scene(b, WALL, camera=CAMERA) for b in (box, as_mesh(files / "box.ply"))]
    want, got = (
        render_reference(scene, SIZE, spp=32, shutter=Shutter(1.0), seed=1).mean for scene in scenes
    )
    assert ((want - got).abs() > 1e-4).double().mean() < 5e-3  # a ray at an edge goes either way
    assert (want - got).abs().mean() < 1e-4


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_distances_are_exact_from_far_away(make_scene, files, dtype):
    """Where a ray enters decides float32's error, not how far away it comes from."""
    scene = make_scene(as_mesh(files / "box.ply", position=[0, 0, 0], rotation=[0, 0, 0]))
    tracer = Tracer(scene, dtype=dtype)
    origin = torch.tensor([[0.1], [0.2], [1000.0]], dtype=dtype)
    direction = torch.tensor([[0.0], [0.0], [-2.0]], dtype=dtype)
    hit = tracer.closest_hit(origin, direction, torch.zeros(1, dtype=dtype))
    limit = 1e-10 if dtype == torch.float64 else 1e-4
    assert abs(float(hit.distance) - (1000 - 0.25) / 2) < limit
    assert hit.normal[:, 0].tolist() == pytest.approx([0, 0, 1], abs=1e-6)


def test_inside_of_a_mesh_is_seen_and_faces_the_ray(make_scene, files):
    scene = make_scene(as_mesh(files / "box.ply", position=[0, 0, 0], rotation=[0, 0, 0]))
    tracer = Tracer(scene, dtype=torch.float64)
    direction = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0]], dtype=torch.float64)
    zero = torch.zeros(3, dtype=torch.float64)
    hit = tracer.closest_hit(torch.zeros_like(direction), direction, zero)
    assert hit.distance.tolist() == pytest.approx([0.75, 0.5, 0.25], abs=1e-9)
    assert torch.allclose((hit.normal * direction).sum(0), torch.full((3,), -1.0).double())


def test_nearer_bodies_hide_a_mesh_and_farther_ones_do_not(make_scene, files):
    front = {"kind": "sphere", "radius": 0.3, "position": [0, 0, 2], "texture": CHECKER}
    back = {"kind": "sphere", "radius": 0.3, "position": [0, 0, -2], "texture": CHECKER}
    mesh = as_mesh(files / "ball.glb", position=[0, 0, 0])
    frame = render_frame(make_scene(mesh, front, back), SIZE, color_spp=1)
    ids = frame.object_id[0, 0]
    assert ids[SIZE[0] // 2, SIZE[1] // 2] == 2
    assert set(ids.unique().tolist()) == {0, 1, 2}


def test_mesh_reveals_what_is_behind(make_scene, files):
    scene = make_scene(as_mesh(files / "box.ply"), WALL)
    mask = render_frame(scene, SIZE, color_spp=1).object_id == 1
    revealed = render_revealed(scene, SIZE, mask=mask, color_spp=1)
    want = render_frame(make_scene(WALL), SIZE, color_spp=1)
    assert torch.equal(revealed.hit, mask)
    assert (revealed.frame.object_id[mask] == 9).all()
    assert torch.allclose(revealed.frame.depth[mask], want.depth[mask])


@pytest.mark.slow
def test_compiled_equals_eager(make_scene, files):
    scene = make_scene(as_mesh(files / "ball.glb"), as_mesh(files / "box.ply"), WALL)
    compiled, eager = (
        Renderer(scene, engine=name).reference((36, 64), spp=8, seed=2).mean
        for name in ("compiled", "eager")
    )
    assert ((compiled - eager).abs() > 1e-4).double().mean() < 1e-3
    assert (compiled - eager).abs().mean() < 1e-5


SCRIPT = """
import torch
from torchblur.params import build
from torchblur.render import Scene, render_frame
body = {"kind": "mesh", "generator": {"kind": "blob", "subdivisions": 2}}
scene = build(Scene, {"camera": {"position": [0, 0, 4]}, "bodies": [body]})
print(int(render_frame(scene, (8, 8), color_spp=1).object_id.max()))
"""


def test_warp_is_quiet_and_compiles_into_its_own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "warp"))
    result = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True)
    assert (result.stdout, result.stderr, result.returncode) == ("1\n", "", 0)
    assert any((tmp_path / "warp").rglob("*mesh_kernel*"))


def test_procedural_scenes_need_neither_warp_nor_trimesh():
    script = SCRIPT.replace('"kind": "mesh", "generator": {"kind": "blob", "subdivisions": 2}',
                            '"kind": "sphere", "radius": 1.0, "texture": '
                            '{"kind": "solid", "color": [1.0, 1.0, 1.0]}')  # fmt: skip
    script += "import sys; print({'warp', 'trimesh'} & set(sys.modules))"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (result.stdout, result.stderr) == ("1\nset()\n", "")


@pytest.mark.parametrize("missing", ["warp", "trimesh"])
def test_absent_extra_says_what_to_install(make_scene, tmp_path, monkeypatch, missing):
    path = tmp_path / "box.ply"
    trimesh.creation.box((1, 1, 1)).export(path)
    scene = make_scene({"kind": "mesh", "path": str(path)})
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.delitem(sys.modules, "torchblur.render.mesh_kernel", raising=False)
    with pytest.raises(ConfigError, match=rf"trimesh and warp.*{missing}.*torchblur\[render\]"):
        render_frame(scene, (4, 4))


def test_twice_the_size_twice_as_far_looks_the_same(make_scene, files):
    near = make_scene(as_mesh(files / "box.ply", velocity=[0, 0, 0], position=[0, 0, 0]))
    far = make_scene(as_mesh(files / "box.ply", velocity=[0, 0, 0], position=[0, 0, -4], scale=2.0))
    a, b = (render_frame(scene, SIZE, color_spp=1) for scene in (near, far))
    assert (a.object_id != b.object_id).double().mean() < 2e-4
    both = (a.object_id == 1) & (b.object_id == 1)
    assert torch.allclose(2 * a.depth[both], b.depth[both], atol=1e-5)
