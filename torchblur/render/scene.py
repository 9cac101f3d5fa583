"""What a scene is: a camera, a light, a sky and bodies, as a YAML file gives them."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from torchblur.errors import ConfigError
from torchblur.params import Config, build
from torchblur.render.bodies import Solid
from torchblur.render.camera import Camera
from torchblur.render.mesh_body import Mesh
from torchblur.render.motion import Level, Number, Placed, Triple
from torchblur.render.textures import SolidTexture, Texture

__all__ = ["Group", "Light", "Scene", "load_scene", "read_mapping"]


class Light(Config):
    """A fixed light at no distance, without shadows: ``ambient + (1 - ambient) max(n.l, 0)``."""

    direction: Triple = Field(
        (0.4, 0.8, 0.6), description="from the scene towards the light, in the world"
    )
    ambient: Annotated[Number, Field(ge=0, le=1)] = Field(
        0.35, description="share of the light that falls on all sides, 0 to 1"
    )

    @model_validator(mode="after")
    def _direction_has_length(self) -> Light:
        if not any(self.direction):
            raise ValueError(f"`direction` must not be a zero vector, got {list(self.direction)}")
        return self


class Group(Placed):
    """Bodies that move as one; their own placements are relative to the group."""

    kind: Literal["group"]
    object_id: int | None = Field(
        None, ge=1, description="number of all bodies in it that have none of their own"
    )
    bodies: tuple[Body, ...] = Field(min_length=1, description="bodies and groups in it")


Body = Annotated[Solid | Mesh | Group, Field(discriminator="kind")]
"""A body or a group, told apart by `kind`."""


class Scene(Config):
    """A scene that moves, in scene units and frames.

    The world is right-handed; y is up in the scenes that come with torchblur. Radiance is
    scene-linear.
    """

    camera: Camera = Field(description="the camera and its motion")
    light: Light = Field(default_factory=Light, description="the light on all bodies")
    sky: Texture = Field(
        default_factory=lambda: SolidTexture(kind="solid", color=(0.25, 0.35, 0.5)),
        description="radiance where no body is; patterns are taken at the unit view direction",
    )
    bodies: tuple[Body, ...] = Field(min_length=1, description="bodies and groups, at least one")

    def placed_bodies(self) -> list[tuple[Solid | Mesh, list[Level], int]]:
        """Return each body with its motions, outermost first, and its object id."""
        return [
            found
            for number, body in enumerate(self.bodies, start=1)
            for found in _unfold(body, [], number)
        ]

    def window(self, *, of: tuple[int, int], box: tuple[int, int, int, int]) -> Scene:
        """Return the scene seen through a window of its camera's image.

        Args:
            of: As in `Camera.window`.
            box: As in `Camera.window`.

        Raises:
            ConfigError: a size below 1.
        """
        return self.model_copy(update={"camera": self.camera.window(of=of, box=box)})

    def fingerprint(self) -> str:
        """Return a hash of what the scene says and what its files hold, wherever they lie.

        The materials and images that a mesh file names count, too.
        """
        digest = hashlib.sha256()
        for body, _, _ in self.placed_bodies():
            for file in body.files if isinstance(body, Mesh) else []:
                digest.update(f"{file.name}\n".encode() + file.read_bytes())
        data = _with_paths(self.model_dump(mode="json"), lambda path: Path(path).name)
        digest.update(json.dumps(data, sort_keys=True).encode())
        return digest.hexdigest()[:32]


Group.model_rebuild()
Scene.model_rebuild()


def load_scene(path: str | os.PathLike[str]) -> Scene:
    """Read a scene from a YAML file.

    Args:
        path: The file; `configs/scenes/` has examples. Paths in it start at its folder.

    Returns:
        The scene.

    Raises:
        ConfigError: the file cannot be read, is not YAML, or does not describe a scene; with the
            file, the place in it, the rule and the value.
    """
    data = read_mapping(Path(path), "scene", "`camera` and `bodies`")
    folder = Path(path).absolute().parent
    return build(Scene, _with_paths(data, lambda name: str(folder / name)), os.fspath(path))


def read_mapping(path: Path, kind: str, keys: str) -> dict[Any, Any]:
    """Return the mapping that a YAML file holds; `kind` and `keys` are for the message.

    Raises:
        ConfigError: the file cannot be read, is not YAML, or holds something else.
    """
    try:
        data = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"the {kind} {path} cannot be read: {error}") from error
    except YAMLError as error:
        raise ConfigError(f"{path} is not valid YAML: {error}") from error
    if not isinstance(data, dict):
        raise ConfigError(
            f"a {kind} must be a mapping with {keys}, got {type(data).__name__} ({path})"
        )
    return data


def _with_paths(data: Any, change: Callable[[str], str]) -> Any:
    """Return plain data of a scene with the paths of its meshes changed."""
    if isinstance(data, dict):
        changed = {key: _with_paths(value, change) for key, value in data.items()}
        if changed.get("kind") == "mesh" and isinstance(changed.get("path"), str):
            changed["path"] = change(changed["path"])
        return changed
    return [_with_paths(item, change) for item in data] if isinstance(data, list) else data


def _unfold(
    body: Solid | Mesh | Group, outer: list[Level], number: int
) -> Iterator[tuple[Solid | Mesh, list[Level], int]]:
    levels = [*outer, body.level()]
    number = body.object_id or number
    if not isinstance(body, Group):
        yield body, levels, number
        return
    for inner in body.bodies:
        yield from _unfold(inner, levels, number)
