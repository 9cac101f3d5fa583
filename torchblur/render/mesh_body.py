"""Triangle meshes as bodies: what the YAML says of them, and their triangles, kept once read."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import Field, field_validator, model_validator

from torchblur.render.bodies import Body
from torchblur.render.mesh_files import FORMATS, companions, read_mesh
from torchblur.render.mesh_geometry import Geometry, make_geometry, smooth_normals
from torchblur.render.mesh_shapes import Generator
from torchblur.render.motion import Number
from torchblur.render.textures import Texture

__all__ = ["Mesh", "Source", "load_geometry"]


class Mesh(Body):
    """A mesh of triangles, from a file or computed; seen from both sides, needs `[render]`."""

    kind: Literal["mesh"]
    path: str | None = Field(
        None,
        description="glTF, GLB, OBJ or PLY file, from the folder of the scene file on; "
        "instead of `generator`",
    )
    generator: Generator | None = Field(
        None, description="a surface that is computed; instead of `path`"
    )
    scale: Annotated[Number, Field(gt=0)] = Field(1.0, description="factor on all positions")
    smooth: bool | None = Field(
        None,
        description="true: normals are interpolated (the file's, or means over the triangles "
        "around a vertex); false: flat triangles; left out: smooth if the file has normals or "
        "the generator's surface is round",
    )
    texture: Texture | None = Field(
        None, description="color over the surface; left out: the file's own colors, else gray"
    )

    @field_validator("path")
    @classmethod
    def _is_a_mesh_file(cls, path: str | None) -> str | None:
        if path is None:
            return path
        if Path(path).suffix.lower() not in FORMATS:
            raise ValueError(f"a mesh must be a file ending in {', '.join(FORMATS)}")
        if not Path(path).is_file():
            raise ValueError("the file does not exist")
        return path

    @model_validator(mode="after")
    def _has_one_source(self) -> Mesh:
        if (self.path is None) == (self.generator is None):
            raise ValueError("give either `path` or `generator`")
        return self

    @property
    def files(self) -> list[Path]:
        """The files that the mesh is read from, companions (materials, images) included."""
        return [] if self.path is None else [Path(self.path), *companions(Path(self.path))]

    @property
    def source(self) -> Source:
        """What decides the triangles; equal sources are read once."""
        stamps = tuple((str(file), file.stat().st_mtime_ns) for file in self.files)
        return Source(self.path, stamps, self.generator, self.scale, self.smooth)


class Source(NamedTuple):
    """What decides the triangles of a mesh: its file (and when it was written) or generator."""

    path: str | None
    stamps: tuple[tuple[str, int], ...]
    generator: Generator | None
    scale: float
    smooth: bool | None


@functools.lru_cache(maxsize=16)
def load_geometry(source: Source) -> Geometry:
    """Read or compute the triangles of a mesh; the last 16 are kept.

    Args:
        source: From `Mesh.source`.

    Raises:
        ConfigError: no triangle with an area, NaN or inf in a vertex, or the extra is missing.
        FileFormatError: the file cannot be read.
    """
    if source.generator is None:
        raw, name = read_mesh(Path(source.path or "")), str(source.path)
        is_smooth = raw.normals is not None
    else:
        surface = source.generator.surface()
        corners = torch.from_numpy(surface.vertices[surface.faces])
        raw, name = Geometry(corners=corners), f"generator {source.generator.kind}"
        is_smooth = surface.is_smooth
    geometry = make_geometry(raw, source.scale, name)
    if not (is_smooth if source.smooth is None else source.smooth):
        return dataclasses.replace(geometry, normals=None)
    if geometry.normals is None:
        return dataclasses.replace(geometry, normals=smooth_normals(geometry.corners))
    return geometry
