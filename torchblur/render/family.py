"""Scenes drawn at random from a family: any number of them, each decided by its seed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from torchblur.errors import ConfigError
from torchblur.params import build
from torchblur.render.family_bodies import draw_body
from torchblur.render.family_config import SceneFamily
from torchblur.render.family_dice import Dice
from torchblur.render.family_textures import draw_light, draw_sky, draw_texture
from torchblur.render.family_view import View, draw_view, plain
from torchblur.render.scene import Scene, read_mapping

__all__ = ["SceneFamily", "draw_scene", "load_family"]


def draw_scene(family: SceneFamily, seed: int) -> Scene:
    """Draw one scene of a family.

    Every number has a name and depends on the seed and that name alone (SHA-256): the scene is
    the same on every machine, and another body, group or texture changes none of the others.
    Bodies are where they were drawn to be at frame 0.

    Args:
        family: What may come.
        seed: Which scene; any integer.

    Returns:
        The scene, as a file would give it. Kinds of meshes need the extra `render` to be rendered.

    Raises:
        ConfigError: the seed is no integer.
    """
    if not isinstance(seed, int) or isinstance(seed, bool):
        raise ConfigError(f"`seed` must be an integer, got {seed!r}")
    dice = Dice(seed)
    view = draw_view(family.camera, dice.of("camera"))
    exposure = dice.log_between("exposure", family.exposure)
    floor = _floor(family, view, exposure, dice.of("floor"))
    walls = floor + _backdrop(family, view, exposure, dice.of("backdrop"))
    bodies = [
        draw_body(
            group,
            view,
            group.textures or family.textures,
            exposure,
            dice.of(group.name).of(index),
            has_floor=bool(floor),
        )
        for group in family.groups
        for index in range(dice.of(group.name).whole("count", group.count))
    ]
    data = {
        "camera": view.fields(),
        "light": draw_light(family.light, dice.of("light")),
        "sky": draw_sky(family.sky, exposure, dice.of("sky")),
        "bodies": walls + bodies,
    }
    return build(Scene, data, f"scene {seed} of a family")


def load_family(path: str | os.PathLike[str]) -> SceneFamily:
    """Read a family from a YAML file.

    Args:
        path: The file; `configs/families/` has examples.

    Returns:
        The family.

    Raises:
        ConfigError: the file cannot be read, is not YAML, or does not describe a family; with the
            file, the place in it, the rule and the value.
    """
    return build(SceneFamily, read_mapping(Path(path), "family", "`groups`"), os.fspath(path))


def _floor(family: SceneFamily, view: View, exposure: float, dice: Dice) -> list[dict[str, Any]]:
    if dice.chance("is there") >= family.floor.chance:
        return []
    looks = family.floor.textures or family.textures
    width = view.width(family.camera.subject)
    texture = draw_texture(looks, width, exposure, dice.of("texture"))
    return [{"kind": "plane", "rotation": [-90.0, 0.0, 0.0], "texture": texture}]


def _backdrop(family: SceneFamily, view: View, exposure: float, dice: Dice) -> list[dict[str, Any]]:
    if dice.chance("is there") >= family.backdrop.chance:
        return []
    looks = family.backdrop.textures or family.textures
    depth = dice.log_between("depth", family.backdrop.depth)
    texture = draw_texture(looks, view.width(depth), exposure, dice.of("texture"))
    return [{"kind": "plane", "position": [0.0, 0.0, plain(-depth)], "texture": texture}]
