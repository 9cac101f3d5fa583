"""Triangle meshes from glTF, GLB, OBJ and PLY files, by trimesh.

Node transforms are applied. Of the colors there come along: the base color's image and factor,
vertex and face colors, and a diffuse color; images are repeated and taken bilinearly. Not read:
transparency, emission, roughness and normal maps, animation, morph targets.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchblur.errors import ConfigError, FileFormatError
from torchblur.ops.color import srgb_to_linear
from torchblur.render.mesh_geometry import Coloring, Geometry

__all__ = ["FORMATS", "GRAY", "companions", "missing_extra", "read_mesh"]

FORMATS = (".glb", ".gltf", ".obj", ".ply")
GRAY = 0.8
"""Linear color of a surface that has none."""


def read_mesh(path: Path) -> Geometry:
    """Read all triangles of a file, as they lie in the file's world.

    Args:
        path: The file; its ending names the format, one of `FORMATS`.

    Returns:
        The triangles, unchecked; with corner normals if all parts of the file have them, and with
        colors if any has some.

    Raises:
        ConfigError: if trimesh is not installed.
        FileFormatError: if the file cannot be read, or a triangle names a vertex that is not there.
    """
    try:
        import trimesh
    except ImportError as error:
        raise missing_extra(error) from error
    try:
        scene = trimesh.load_scene(path, process=False)
        parts = [_part(scene, node, path) for node in scene.graph.nodes_geometry]
    except FileFormatError:
        raise
    except Exception as error:  # trimesh raises what its parsers happen to raise
        raise FileFormatError(f"the mesh {path} cannot be read: {error}") from error
    return _joined([part for part in parts if part is not None])


def companions(path: Path) -> list[Path]:
    """Return the files that a mesh file names and that are there: buffers, materials, images.

    Args:
        path: The mesh file.
    """
    if path.suffix.lower() == ".gltf":
        names = _gltf_names(path)
    elif path.suffix.lower() == ".obj":
        names = _named(path, r"^\s*mtllib\s+(.+?)\s*$")
        for material in [path.parent / name for name in names]:
            names += _named(material, r"^\s*map_\w+\s+(?:-\S+\s+\S+\s+)*(.+?)\s*$")
    else:
        names = []
    files = [path.parent / name for name in dict.fromkeys(names)]
    return [file for file in files if file.is_file()]


def missing_extra(error: ImportError) -> ConfigError:
    """Return the error that says how to install what meshes need."""
    return ConfigError(
        f"meshes need the packages trimesh and warp ({error}); install them with: "
        "pip install 'torchblur[render]'"
    )


# -- parts of a file -------------------------------------------------------------------------------


def _part(scene: Any, node: str, path: Path) -> Geometry | None:
    matrix, name = scene.graph[node]
    mesh = scene.geometry[name]
    faces = getattr(mesh, "faces", None)  # point clouds and lines have none
    if faces is None or not len(faces):
        return None
    faces = np.asarray(faces, np.int64)
    vertices = np.asarray(mesh.vertices, np.float64)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise FileFormatError(
            f"the triangles of a mesh must name vertices 0 to {len(vertices) - 1}, got "
            f"{faces.min()} to {faces.max()} ({path})"
        )
    matrix = np.asarray(matrix, np.float64)
    if np.linalg.det(matrix[:3, :3]) < 0:  # a mirror turns triangles inside out
        faces = faces[:, ::-1]
    corners = (vertices @ matrix[:3, :3].T + matrix[:3, 3])[faces]
    normals = None
    if "vertex_normals" in mesh._cache.cache:
        turned = np.asarray(mesh.vertex_normals) @ np.linalg.pinv(matrix[:3, :3])
        unit = torch.nn.functional.normalize(torch.from_numpy(turned[faces]), dim=2)
        normals = unit.double()
    coloring = _coloring(mesh.visual, faces, path.suffix.lower() in (".glb", ".gltf"))
    return Geometry(corners=torch.from_numpy(corners), normals=normals, coloring=coloring)


def _coloring(visual: Any, faces: Any, is_linear: bool) -> Coloring | None:
    """Return the colors of a part; vertex colors of glTF are linear, of others sRGB."""
    tint, place = np.ones((len(faces), 3, 3)), np.zeros((len(faces), 3, 2))
    pixels = None
    if visual.kind == "texture":
        factor, pixels = _material(visual.material)
        tint *= factor
        extra = visual.vertex_attributes.get("color")
        if extra is not None and len(extra) > faces.max():
            tint *= _fractions(np.asarray(extra))[faces]
        if visual.uv is None or len(visual.uv) <= faces.max():
            pixels = None
        else:
            place = np.asarray(visual.uv, np.float64)[faces]
    elif visual.kind in ("vertex", "face"):
        is_vertex = visual.kind == "vertex"
        colors = _fractions(np.asarray(visual.vertex_colors if is_vertex else visual.face_colors))
        tint = colors[faces] if is_vertex else colors[:, None].repeat(3, 1)
        tint = tint if is_linear else _linear(tint)
    else:
        return None
    size = [] if pixels is None else [[0, *pixels.shape[:2]]]
    flat = np.zeros((0, 3)) if pixels is None else pixels.reshape(-1, 3)
    return Coloring(
        tint=torch.from_numpy(tint).float(),
        place=torch.from_numpy(place),
        image=torch.full((len(faces),), len(size) - 1),
        images=torch.tensor(size, dtype=torch.long).reshape(-1, 3),
        pixels=torch.from_numpy(flat).float(),
    )


def _material(material: Any) -> tuple[Any, Any]:
    """Return the factor, (3,), and the image, (H, W, 3) or None, both linear."""
    factor = getattr(material, "baseColorFactor", None)  # glTF's
    image = getattr(material, "baseColorTexture", None)
    if hasattr(material, "diffuse"):
        factor, image = material.diffuse, material.image
    factor = np.ones(3) if factor is None else _fractions(np.asarray(factor))
    if image is None:
        return factor, None
    return factor, _linear(_fractions(np.asarray(image.convert("RGB"))))


def _fractions(colors: Any) -> Any:
    """Return colors as three numbers from 0 to 1."""
    limit = np.iinfo(colors.dtype).max if colors.dtype.kind in "iu" else 1
    return colors[..., :3] / limit


def _linear(colors: Any) -> Any:
    return srgb_to_linear(torch.from_numpy(colors)).numpy()


def _joined(parts: list[Geometry]) -> Geometry:
    if not parts:
        return Geometry(corners=torch.zeros((0, 3, 3), dtype=torch.float64))
    normals = None
    if all(part.normals is not None for part in parts):
        normals = torch.cat([part.normals for part in parts if part.normals is not None])
    coloring = None
    if any(part.coloring is not None for part in parts):
        coloring = _joined_colors([part.coloring or _gray(part) for part in parts])
    return Geometry(
        corners=torch.cat([part.corners for part in parts]), normals=normals, coloring=coloring
    )


def _joined_colors(parts: list[Coloring]) -> Coloring:
    image, images, number, pixels = [], [], 0, 0
    for part in parts:
        image.append(torch.where(part.image < 0, -1, part.image + number))
        images.append(part.images + torch.tensor([pixels, 0, 0]))
        number, pixels = number + len(part.images), pixels + len(part.pixels)
    return Coloring(
        tint=torch.cat([part.tint for part in parts]),
        place=torch.cat([part.place for part in parts]),
        image=torch.cat(image),
        images=torch.cat(images),
        pixels=torch.cat([part.pixels for part in parts]),
    )


def _gray(part: Geometry) -> Coloring:
    count = len(part.corners)
    return Coloring(
        tint=torch.full((count, 3, 3), GRAY),
        place=torch.zeros((count, 3, 2), dtype=torch.float64),
        image=torch.full((count,), -1),
        images=torch.zeros((0, 3), dtype=torch.long),
        pixels=torch.zeros((0, 3)),
    )


# -- names of other files --------------------------------------------------------------------------


def _gltf_names(path: Path) -> list[str]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        items = [*data.get("buffers", ()), *data.get("images", ())]
        return [i["uri"] for i in items if not i.get("uri", "data:").startswith("data:")]
    except (OSError, ValueError, AttributeError, TypeError):
        return []  # reading the mesh says what is wrong with it


def _named(path: Path, pattern: str) -> list[str]:
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    return re.findall(pattern, text, re.MULTILINE | re.IGNORECASE)
