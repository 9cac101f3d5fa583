"""Computed surfaces: closed, wound outwards, of the size and number of triangles they claim."""

import math

import numpy as np
import pytest
import torch
import trimesh
from pydantic import TypeAdapter

from torchblur.render.mesh_geometry import smooth_normals
from torchblur.render.mesh_shapes import Blob, Gear, Generator, Lathe, TorusKnot

VASE = [[0, -1], [0.5, -1], [0.7, 0], [0.3, 0.8], [0.4, 1], [0, 1]]
CASES = [
    ({"kind": "torus_knot", "segments": 200, "sides": 12}, 2 * 200 * 12),
    ({"kind": "gear", "teeth": 11}, 32 * 11),
    ({"kind": "blob", "subdivisions": 3}, 20 * 64),
    ({"kind": "lathe", "profile": VASE, "steps": 8, "segments": 30}, None),
    ({"kind": "lathe", "profile": VASE, "is_curved": False, "segments": 30}, 30 * 2 * 4),
]


@pytest.mark.parametrize(("fields", "count"), CASES)
def test_surface_is_closed_and_faces_outwards(fields, count):
    surface = TypeAdapter(Generator).validate_python(fields).surface()
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=True)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0.1
    assert mesh.area_faces.min() > 0
    assert count in (None, len(surface.faces))


def test_knot_is_as_large_as_its_radii_say():
    knot = TorusKnot(kind="torus_knot", radius=2.0, tube=0.25, segments=2048, sides=64).surface()
    radius = np.linalg.norm(knot.vertices[:, :2], axis=1)
    assert radius.max() == pytest.approx(2.25, abs=0.01)
    rings = knot.vertices.reshape(2048, 64, 3)
    tube = np.linalg.norm(rings - rings.mean(1, keepdims=True), axis=2)
    np.testing.assert_allclose(tube, 0.25, atol=1e-4)
    along = np.roll(rings.mean(1), -1, 0) - np.roll(rings.mean(1), 1, 0)
    spoke = rings[:, 0] - rings.mean(1)
    cosine = (along * spoke).sum(1) / np.linalg.norm(along, axis=1) / 0.25
    assert np.abs(cosine).max() < 1e-3, "sections stand across the tube"


def test_gear_has_its_teeth_and_bore():
    gear = Gear(kind="gear", radius=1.0, depth=0.2, bore=0.3, width=0.4, teeth=9).surface()
    radius = np.linalg.norm(gear.vertices[:, [0, 2]], axis=1)
    np.testing.assert_allclose(np.unique(radius.round(6)), [0.3, 0.8, 1.0])
    assert (radius > 0.9).sum() == 9 * 2 * 2
    assert np.abs(gear.vertices[:, 1]).max() == 0.2
    assert not gear.is_smooth


def test_still_blob_is_a_sphere_and_its_smooth_normals_are_radii():
    ball = Blob(kind="blob", radius=0.7, waves=0.0, subdivisions=4).surface()
    np.testing.assert_allclose(np.linalg.norm(ball.vertices, axis=1), 0.7)
    corners = torch.from_numpy(ball.vertices[ball.faces])
    assert (smooth_normals(corners) - corners / 0.7).abs().max() < 3e-3
    waves = Blob(kind="blob", radius=0.7, waves=0.2, subdivisions=4).surface()
    radius = np.linalg.norm(waves.vertices, axis=1) / 0.7
    assert 0.8 <= radius.min() < 0.9
    assert 1.1 < radius.max() <= 1.2


def test_lathe_goes_through_its_points():
    line = [[0, 0], [1.0, 0.5], [0.5, 2.0], [0, 2.5]]
    found = Lathe(kind="lathe", profile=line, steps=7, segments=16).surface().vertices
    profile = np.stack((np.linalg.norm(found[:, [0, 2]], axis=1), found[:, 1]), 1)
    for point in line:
        assert np.abs(profile - point).sum(1).min() < 1e-9
    straight = Lathe(kind="lathe", profile=line, is_curved=False, segments=4000).surface()
    mesh = trimesh.Trimesh(straight.vertices, straight.faces)
    cones = [0.5 * 1, 1.5 * (1 + 0.5 + 0.25), 0.5 * 0.25]
    assert mesh.volume == pytest.approx(math.pi / 3 * sum(cones), rel=1e-4)


def test_a_sheet_with_two_sides_keeps_its_flat_normals():
    """Where the normals around a vertex cancel there is no mean."""
    front = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=torch.float64)
    normals = smooth_normals(torch.cat((front, front.flip(1))))
    assert normals[0].tolist() == [[0, 0, 1]] * 3
    assert normals[1].tolist() == [[0, 0, -1]] * 3


def test_smooth_normals_do_not_see_seams():
    corners = torch.from_numpy(trimesh.creation.icosphere(subdivisions=2).triangles.copy())
    moved = corners + 1e-9 * torch.randn_like(corners)  # as a file with vertices apart has them
    assert (smooth_normals(moved) - smooth_normals(corners)).abs().max() < 1e-6
