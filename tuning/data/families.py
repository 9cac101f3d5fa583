"""Families among the data of a fit: the scenes that are drawn, and how each is rendered."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from torchblur.params import build
from torchblur.render import Scene, draw_scene, load_family
from tuning.config.data import FamilyData, FamilyStreamData, SceneData, SceneStreamData

__all__ = ["drawn_name", "drawn_scenes"]


def drawn_name(path: Path, seed: int) -> str:
    """Return the name of one scene of a family: "everyday-0005"."""
    return f"{path.stem}-{seed:04d}"


def drawn_scenes(
    path: Path, item: FamilyData | FamilyStreamData
) -> Iterator[tuple[str, Scene, SceneData | SceneStreamData]]:
    """Yield name, scene, and what a file of this scene would be told, seed by seed.

    A drawn scene is cached as its file would be, by content; families that overlap share frames.

    Args:
        path: File of the family.
        item: Which scenes, and how they are rendered.

    Raises:
        ConfigError: the file is no family.
    """
    family = load_family(path)
    common = item.model_dump(exclude={"kind", "scenes", "seed"})
    if item.of is not None and item.at is None:
        common["at"] = "motion"  # its scenes differ in where anything is
    for seed in item.seeds:
        one: SceneData | SceneStreamData
        if isinstance(item, FamilyData):
            one = build(SceneData, common | {"kind": "scene", "seed": seed})
        else:
            one = build(SceneStreamData, common | {"kind": "scene_stream", "seed": seed})
        yield drawn_name(path, seed), draw_scene(family, seed), one
