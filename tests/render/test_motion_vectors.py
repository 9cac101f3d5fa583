"""The sharp G-buffer: geometry in closed form, velocity against finite differences of a twin."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchblur.render import render_frame

SIZE = (23, 31)
CHECKER = {"kind": "checker", "size": 0.3, "color": [1, 1, 1], "background": [0, 0, 0]}
FACING = {"kind": "plane", "texture": CHECKER}


def centers(height, width):
    return torch.arange(width) + 0.5 - width / 2, torch.arange(height) + 0.5 - height / 2


def moved(thing, t):
    """Rotation and offset of a placed thing at a time, by scipy, from the documented formula."""
    position = np.array(thing.get("position", (0, 0, 0)), float)
    pivot = np.array(thing.get("pivot", position), float)
    axis = np.array(thing.get("axis", (0, 0, 1)), float)
    turn = Rotation.from_rotvec(
        math.radians(thing.get("spin", 0) * t) * axis / np.linalg.norm(axis)
    )
    rest = Rotation.from_euler("xyz", thing.get("rotation", (0, 0, 0)), degrees=True)
    offset = np.array(thing.get("velocity", (0, 0, 0)), float) * t
    return turn * rest, offset + pivot + turn.apply(position - pivot)


def carry(chain, t, points):
    for thing in reversed(chain):
        rotation, offset = moved(thing, t)
        points = rotation.apply(points) + offset
    return points


def bring_back(chain, t, points):
    for thing in chain:
        rotation, offset = moved(thing, t)
        points = rotation.inv().apply(points - offset)
    return points


def twin_positions(camera, chain, frame, depth, t):
    """Pixels at `frame + t` of the points that are seen at the pixel centers at `frame`."""
    height, width = depth.shape
    x, y = (c.double().numpy() for c in centers(height, width))
    rays = np.stack(np.broadcast_arrays(x[None] / width, -y[:, None] / width, -1.0), -1)
    seen = rays.reshape(-1, 3) * depth.double().reshape(-1, 1).numpy()
    world = carry([camera], frame, seen)
    later = carry(chain, frame + t, bring_back(chain, frame, world))
    local = bring_back([camera], frame + t, later)
    return width * np.stack((-local[:, 0], local[:, 1]) / local[:, 2]).reshape(2, height, width)


BOX = {"kind": "box", "size": [1.5, 1.2, 0.9], "texture": CHECKER, "position": [0.2, 0.1, 0]}
MOTIONS = {
    "translation": ({}, [BOX | {"velocity": [0.3, -0.2, 0.1]}]),
    "rotation about an axis through a pivot": (
        {}, [BOX | {"spin": 25.0, "axis": [0.3, 1, 0.2], "pivot": [0.5, 0, -0.4]}],
    ),
    "towards the viewer": ({}, [BOX | {"velocity": [0, 0, 0.7]}]),
    "camera": ({"velocity": [0.3, 0.1, -0.4], "spin": 4.0, "axis": [0.1, 1, 0.3]}, [BOX]),
    "camera about a point of the scene": (
        {"spin": 6.0, "pivot": [0, 0, 0], "axis": [0, 1, 0]}, [BOX],
    ),
    "turned body in a still group": (
        {}, [{"position": [0.1, 0, 0.2], "rotation": [10, 20, 30]}, BOX | {"spin": 20.0}],
    ),
    "still body in a turning group": (
        {}, [{"position": [0.1, 0, 0.2], "spin": 20.0, "rotation": [10, 0, 0]}, BOX],
    ),
    "turning body in a turning group, moving camera": (
        {"velocity": [0.2, 0, 0], "spin": -3.0, "axis": [0, 1, 0]},
        [{"spin": 15.0, "axis": [0, 1, 1], "velocity": [0, 0.1, 0]}, BOX | {"spin": -30.0}],
    ),
}  # fmt: skip


@pytest.mark.parametrize("frame", [0.0, 1.25])
@pytest.mark.parametrize("name", list(MOTIONS))
def test_velocity_is_the_finite_difference_of_positions(make_scene, name, frame):
    camera, chain = MOTIONS[name]
    camera = {"position": [0, 0, 4], "focal": 1.0} | camera
    body = chain[-1]
    for outer in reversed(chain[:-1]):
        body = outer | {"kind": "group", "bodies": [body]}
    rendered = render_frame(make_scene(body, camera=camera), SIZE, frame=frame, color_spp=1)
    is_body = torch.isfinite(rendered.depth[0, 0])
    assert is_body.sum() > 40
    depth = torch.where(is_body, rendered.depth[0, 0], torch.ones(()))
    h = 1e-3
    before, now, after = (
        twin_positions(camera, chain, frame, depth, t)[:, is_body] for t in (-h, 0, h)
    )
    velocity = rendered.velocity[0][:, is_body].numpy()
    acceleration = rendered.acceleration[0][:, is_body].numpy()
    np.testing.assert_allclose(velocity, (after - before) / (2 * h), atol=1e-3)
    np.testing.assert_allclose(acceleration, (after - 2 * now + before) / h**2, atol=1e-2)
    assert np.abs(velocity).max() > 0.3


def test_sky_moves_as_the_camera_turns_and_not_as_it_travels(make_scene, glow):
    body = {"kind": "sphere", "radius": 0.1, "position": [0, 0, 50]} | glow(1, 1, 1)
    turning = {"position": [0, 0, 4], "focal": 1.0, "spin": -3.0, "velocity": [5, 0, 0]}
    frame = render_frame(make_scene(body, camera=turning), SIZE, color_spp=1)
    x, y = centers(*SIZE)
    rate = math.radians(3.0)  # to the right: the sky goes left
    expected_x = -rate * (31 + x**2 / 31)
    torch.testing.assert_close(frame.velocity[0, 0], expected_x.expand(SIZE), atol=1e-4, rtol=0)
    expected_y = -rate * y[:, None] * x / 31
    torch.testing.assert_close(frame.velocity[0, 1], expected_y, atol=1e-4, rtol=0)
    assert bool(torch.isinf(frame.depth).all())
    assert not frame.normal.any()
    assert not frame.object_id.any()


def test_velocity_in_closed_form(make_scene):
    x, y = centers(*SIZE)
    right_and_up = render_frame(make_scene(FACING | {"velocity": [2, 1, 0]}), SIZE, color_spp=1)
    assert right_and_up.velocity[0, :, 3, 4].tolist() == pytest.approx([31 * 2 / 4, -31 / 4])
    nearer = render_frame(make_scene(FACING | {"velocity": [0, 0, 1]}), SIZE, color_spp=1)
    torch.testing.assert_close(nearer.velocity[0, 0], (x / 4).expand(SIZE))
    torch.testing.assert_close(nearer.velocity[0, 1], (y[:, None] / 4).expand(SIZE))
    spinning = render_frame(make_scene(FACING | {"spin": 10.0}), SIZE, color_spp=1)
    rate = math.radians(10)  # counterclockwise as seen from +z: the right side goes up
    torch.testing.assert_close(spinning.velocity[0, 0], (rate * y[:, None]).expand(SIZE))
    torch.testing.assert_close(spinning.velocity[0, 1], (-rate * x).expand(SIZE))
    torch.testing.assert_close(spinning.acceleration[0, 0], (-(rate**2) * x).expand(SIZE))


def test_depth_is_planar_and_normals_and_ids_are_right(make_scene, glow):
    ball = {"kind": "sphere", "radius": 1.0} | glow(0, 1, 0)
    wall = {"kind": "plane", "position": [0, 0, -2], "object_id": 9} | glow(1, 0, 0)
    frame = render_frame(make_scene(wall, ball), SIZE, color_spp=1)
    other_order = render_frame(make_scene(ball, wall), SIZE, color_spp=1)
    assert torch.equal(frame.depth, other_order.depth), "the nearest wins, not the last"
    is_wall = frame.object_id == 9
    assert bool((frame.depth[is_wall] - 6).abs().max() < 1e-6), "planar, not along the ray"
    assert frame.depth[0, 0, 11, 15] == pytest.approx(3)
    assert frame.object_id.unique().tolist() == [2, 9]
    assert frame.normal[0, :, 11, 15].tolist() == pytest.approx([0, 0, 1])
    assert frame.normal[0, 0, 11, 18] > 0 > frame.normal[0, 0, 11, 12]
    assert frame.normal[0, 1, 9, 15] > 0 > frame.normal[0, 1, 13, 15], "row 0 is the top"
    torch.testing.assert_close(frame.normal.norm(dim=1), torch.ones(1, *SIZE))
    assert torch.equal(frame.color[:, 1:2] == 1, frame.object_id == 2), "one sample at the center"


def test_tilted_plane_has_the_depth_of_its_equation(make_scene):
    frame = render_frame(make_scene(FACING | {"rotation": [0, 30, 0]}), SIZE, color_spp=1)
    x, _ = centers(*SIZE)
    normal = (math.sin(math.radians(30)), math.cos(math.radians(30)))
    depth = 4 * normal[1] / (normal[1] - normal[0] * x / 31)
    torch.testing.assert_close(frame.depth[0, 0], depth.expand(SIZE), atol=1e-5, rtol=1e-5)


def test_light_is_lambert_with_an_ambient_share(make_scene):
    body = {"kind": "plane", "texture": {"kind": "solid", "color": [2.0, 1.0, 0.5]}}
    light = {"direction": [0, 3.0, 4.0], "ambient": 0.2}
    for body_spin, cosine in ((0.0, 0.8), (-90.0, 0.6)):
        scene = make_scene(
            body | {"rotation": [body_spin, 0, 0]},
            light=light,
            camera={"position": [0, 1, 4], "look_at": [0, 0, 0]},
        )
        color = render_frame(scene, (9, 9), color_spp=4).color[0, :, 4, 4]
        factor = 0.2 + 0.8 * cosine
        assert color.tolist() == pytest.approx([2 * factor, factor, factor / 2])


def test_look_at_puts_the_point_into_the_middle(make_scene, glow):
    target = {"kind": "sphere", "radius": 0.3, "position": [3, 1, -2]} | glow(1, 1, 1)
    camera = {"position": [-2, 4, 5], "look_at": [3, 1, -2], "fov": 30.0}
    frame = render_frame(make_scene(target, camera=camera), (41, 61), color_spp=1)
    rows, columns = (frame.object_id[0, 0] == 1).nonzero().double().mean(0)
    assert (rows, columns) == (pytest.approx(20, abs=0.3), pytest.approx(30, abs=0.3))
    assert frame.depth[0, 0, 20, 30] == pytest.approx(math.dist((-2, 4, 5), (3, 1, -2)) - 0.3)
