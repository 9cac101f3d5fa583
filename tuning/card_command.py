"""The command `card`: what a run found, ready to be shipped."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tuning.console import results, show_progress
from tuning.options import Overwrite

__all__ = ["card"]


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
