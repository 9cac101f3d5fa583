"""Rendering scenes of a family to files: each in a folder of its own, with the scene beside."""

from __future__ import annotations

from pathlib import Path

from torchblur.errors import ConfigError, OutputError, TorchblurError
from torchblur.io import load_yaml, save_yaml
from torchblur.render import Scene, draw_scene, load_family, load_scene
from tuning.data.families import drawn_name
from tuning.progress import Progress
from tuning.render.scene import RenderSettings, render_sequence

__all__ = ["is_family", "render_family", "render_file"]


def is_family(path: Path) -> bool:
    """Return whether a file describes a family, not one scene: it has `groups` and no `bodies`."""
    try:
        data = load_yaml(path)
    except TorchblurError:  # whoever reads it as a scene says what is wrong
        return False
    return "groups" in data and "bodies" not in data


def render_file(
    path: Path,
    folder: Path,
    settings: RenderSettings,
    *,
    scenes: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Render a scene into a folder, or scenes of a family into folders of their own in it.

    Args:
        path: File of the scene or family.
        folder: Where to.
        settings: Size, samples, shutter; the seed is that of a family's first scene.
        scenes: How many scenes of a family; one if left out.
        overwrite: Replace files made with other settings.
        progress: Told after each file.

    Returns:
        All EXR files, in order.

    Raises:
        ConfigError: the file is neither, or a number of scenes is asked for of one scene.
        OutputError: files with other content are in the way, or the folder cannot be written to.
    """
    if is_family(path):
        return render_family(
            path, folder, settings, scenes=scenes or 1, overwrite=overwrite, progress=progress
        )
    if scenes is not None:
        raise ConfigError(f"`scenes` is a number of scenes of a family, and {path} is one scene")
    return render_sequence(path, folder, settings, overwrite=overwrite, progress=progress)


def render_family(
    path: Path,
    folder: Path,
    settings: RenderSettings,
    *,
    scenes: int,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Draw scenes of a family and render each to FOLDER/NAME-SEED, as `render_sequence` does.

    The scene itself is there, too, as NAME-SEED.yaml. What is done is kept.

    Args:
        path: File of the family; its stem is NAME.
        folder: Where to.
        settings: As for one scene; scene k has seed `settings.seed` + k, and so has its renderer.
        scenes: Number of scenes.
        overwrite: Replace files of other scenes or settings.
        progress: Told after each file.

    Returns:
        All EXR files, in order.

    Raises:
        ConfigError: the file is no family.
        OutputError: files with other content are in the way, or the folder cannot be written to.
    """
    family = load_family(path)
    if settings.of is not None and settings.at is None:
        settings = settings.model_copy(update={"at": "motion"})
    files: list[Path] = []
    for seed in range(settings.seed, settings.seed + scenes):
        name = drawn_name(path, seed)
        own = folder / name
        comment = f"Scene {seed} of {path.name}, as torchblur drew it."
        _write_scene(own / f"{name}.yaml", draw_scene(family, seed), comment, overwrite)
        files += render_sequence(
            own / f"{name}.yaml",
            own,
            settings.model_copy(update={"seed": seed}),
            overwrite=overwrite,
            progress=progress,
        )
    return files


def _write_scene(path: Path, scene: Scene, comment: str, overwrite: bool) -> None:
    if path.is_file() and not overwrite:
        if load_scene(path) == scene:
            return
        raise OutputError(
            f"{path} exists and is another scene; overwrite=True (--overwrite) replaces it"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    data = scene.model_dump(mode="json", exclude_defaults=True)
    save_yaml(path, data, comment=comment, overwrite=overwrite)
