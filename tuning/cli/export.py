"""The commands that hand on what a fit found: `export` and `card`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tuning.cli.console import results, show_progress
from tuning.cli.options import Overwrite, Set

if TYPE_CHECKING:
    from torchblur.presets import Preset

__all__ = ["card", "export"]

_ENDINGS = {
    ".json": "json",
    ".hlsl": "hlsl",
    ".hlsli": "hlsl",
    ".fxh": "hlsl",
    ".glsl": "glsl",
    ".glslinc": "glsl",
    ".pt2": "pt2",
}
_FORMATS = ("json", "hlsl", "glsl", "pt2")


def export(  # noqa: PLR0913 - each argument is an option
    preset: Annotated[
        str, typer.Argument(metavar="PRESET", help="Path of a preset, or the name of a filter.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="Where to.")],
    file_format: Annotated[
        str | None,
        typer.Option(
            "--format", metavar="NAME", help="json, hlsl, glsl or pt2. Default: by FILE's ending."
        ),
    ] = None,
    set_: Set = None,
    prefix: Annotated[
        str, typer.Option(metavar="TEXT", help="Before each name in HLSL and GLSL.")
    ] = "blur_",
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Size of a pt2 program's frames in px.")
    ] = "1920x1080",
    batch: Annotated[
        int, typer.Option(metavar="N", min=1, help="Frames that a pt2 program takes at a time.")
    ] = 1,
    overwrite: Overwrite = False,
) -> None:
    """Write a preset for other programs: its constants, or the filter as a graph.

    json, hlsl, glsl: all parameters with meaning, unit, range, source and evidence, for every
    filter. pt2: the filter as a `torch.export` program that takes color, velocity and depth, for
    the filters whose work does not depend on the frame's values. Keys for --set are parameters.
    """
    from torchblur.errors import ConfigError, nearest_name

    chosen = file_format or _ENDINGS.get(output.suffix.lower())
    if chosen is None:
        raise ConfigError(
            f"the ending of {output.name} names no format; --format {'|'.join(_FORMATS)} does"
        )
    if chosen not in _FORMATS:
        hint = nearest_name(chosen, _FORMATS)
        raise ConfigError(f"unknown format `{chosen}`{hint}; formats: {', '.join(_FORMATS)}")
    loaded, name = _loaded(preset, set_ or [])
    if chosen == "pt2":
        _write_program(output, loaded, name, size=size, batch=batch, overwrite=overwrite)
    else:
        from torchblur.export import write_constants

        write_constants(
            output,
            loaded,
            chosen,  # type: ignore[arg-type]
            prefix=prefix,
            name=name,
            overwrite=overwrite,
        )
    results.print(f"wrote {output}", soft_wrap=True)


def _loaded(preset: str, changes: list[str]) -> tuple[Preset, str]:
    """Return a preset and the name of its file, which is empty for a filter as published."""
    from torchblur.filters import get_filter, list_filters
    from torchblur.params import build
    from torchblur.presets import Preset, load_preset
    from tuning.config.overrides import apply_overrides

    path = Path(preset)
    if preset not in list_filters() and (path.suffix or path.exists()):
        loaded, name = load_preset(path), path.name
    else:
        loaded, name = Preset(filter=get_filter(preset).name), ""
    if not changes:
        return loaded, name
    params = apply_overrides(loaded.params, changes)
    config_class = get_filter(loaded.filter).config_class
    build(config_class, params, "--set")
    # What was measured does not hold for other parameters.
    changed = f"{name or 'as published'}, changed: {' '.join(changes)}"
    return Preset(filter=loaded.filter, params=params), changed


def _write_program(
    output: Path, preset: Preset, name: str, *, size: str, batch: int, overwrite: bool
) -> None:
    import torch

    from torchblur.export import constants_text, export_program, save_program
    from torchblur.filters import get_filter
    from torchblur.frame import Frame
    from tuning.files.outputs import refuse_existing
    from tuning.render.scene import settings_of

    refuse_existing([output], overwrite=overwrite)  # before the minute that the graph takes
    settings = settings_of(size)
    height, width = settings.height, settings.width
    frame = Frame(
        color=torch.zeros(batch, 3, height, width),
        velocity=torch.zeros(batch, 2, height, width),
        depth=torch.ones(batch, 1, height, width),
    )
    blur = get_filter(preset.filter)(None, engine="eager", **preset.params)
    notes = {"torchblur.json": constants_text(preset, "json", name=name)}
    save_program(output, export_program(blur, frame), notes=notes, overwrite=overwrite)


def card(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN", help="Folders of finished fits.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the cards.")
    ] = Path("cards"),
    presets: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Put the presets there too, as FILTER-tuned.yaml …"),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a card for each preset of a fit: before and after, and where it is worse.

    A card is a Markdown file with a picture. A run with quality levels gives one for each level.
    """
    from tuning.cards.write import write_cards

    for run in runs:
        with show_progress() as progress:
            files = write_cards(
                run, output, presets_dir=presets, overwrite=overwrite, progress=progress
            )
        for file in files:
            results.print(f"wrote {file}", soft_wrap=True)
