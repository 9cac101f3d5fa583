"""What is shipped of a run: presets with their evidence, and a card with a picture for each."""

from __future__ import annotations

import io
from pathlib import Path

from PIL import Image

from torchblur.errors import ConfigError
from torchblur.io.paths import output_file
from torchblur.presets import load_preset, save_preset
from tuning.cards.picture import card_picture
from tuning.cards.text import Card, card_text
from tuning.config.fit import load_tune_config
from tuning.data.cases import AnyCase
from tuning.data.loading import load_cases
from tuning.files.outputs import make_folders, refuse_existing
from tuning.progress import Progress, Stage
from tuning.report.front import preset_names
from tuning.results.fit import FitResult

__all__ = ["write_cards"]


def write_cards(
    run: str | Path,
    output_dir: str | Path,
    *,
    presets_dir: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Write a card for the preset of a finished run, or for each quality level of its front.

    A card is `NAME.md` with its picture, `NAME.webp`; the name is that of the filter and "tuned",
    or of the filter and the level. Figures are those of the run's `result.json`; the pictures are
    made anew of the run's data.

    Args:
        run: The folder of a run.
        output_dir: Where the cards go; it is made if it does not exist.
        presets_dir: Where the presets go too, as `NAME.yaml`, if anywhere.
        overwrite: Replace files that are there.
        progress: Is told of each card.

    Returns:
        The cards' files.

    Raises:
        ConfigError: no finished run in the folder.
        OutputError: a file exists, or cannot be written.
        TorchblurError: data that is missing or cannot be read.
    """
    run, cards_dir = Path(run), Path(output_dir)
    if not (run / "result.json").is_file():
        raise ConfigError(f"{run} has no result.json: a folder of a finished fit is needed")
    cards = _cards(run)
    places = [(cards_dir, ".md"), (cards_dir, ".webp")]
    places += [] if presets_dir is None else [(Path(presets_dir), ".yaml")]
    files = [folder / f"{card.name}{end}" for card in cards for folder, end in places]
    make_folders(files)
    refuse_existing(files, overwrite=overwrite)
    cases = load_cases(cards[0].config.data)
    plot = _write_plot(run, cards[0], cards_dir)
    stage = Stage("cards", len(cards), progress)
    written = []
    for done, card in enumerate(cards):
        written.append(_write(card, cases, cards_dir, presets_dir, plot))
        stage.step(done + 1, message=card.name)
    return written


def _cards(run: Path) -> list[Card]:
    config, result = load_tune_config(run / "config.yaml"), FitResult.load(run / "result.json")
    names = {level: run / "presets" / f"{level}.yaml" for level in preset_names(result)}
    return [
        Card(
            name=f"{result.filter}-{variant}",
            preset=load_preset(path),
            config=config,
            result=result,
            variant=variant,
        )
        for variant, path in (names or {"tuned": run / "preset.yaml"}).items()
    ]


def _write(
    card: Card, cases: list[AnyCase], folder: Path, presets: str | Path | None, plot: str | None
) -> Path:
    picture, path = card_picture(card, cases), folder / f"{card.name}.md"
    used = f"{card.name}.yaml" if presets is None else str(Path(presets) / f"{card.name}.yaml")
    with output_file(folder / f"{card.name}.webp", overwrite=True) as temporary:
        temporary.write_bytes(picture.content)
    text = card_text(card, used, f"{card.name}.webp", picture.caption, plot)
    with output_file(path, overwrite=True) as temporary:
        temporary.write_text(text, encoding="utf-8")
    if presets is not None:
        comment = (
            f"{card.preset.filter}, {card.variant}; made by `{card.result.command}`.\n"
            f"The evidence stands below; {path} shows it, and where it is worse.\n"
            f"Use it: torchblur filter {used} INPUT.exr -o OUTPUT.exr"
        )
        save_preset(used, card.preset, comment=comment, overwrite=True)
    return path


def _write_plot(run: Path, card: Card, folder: Path) -> str | None:
    """Write the plot of a front as WebP; return its name, or None if there is none."""
    plot = run / "pareto.png"
    if card.variant == "tuned" or not plot.is_file():
        return None
    buffer = io.BytesIO()
    with Image.open(plot) as image:
        image.convert("RGB").save(buffer, format="WEBP", quality=85, method=6)
    name = f"{card.preset.filter}-levels.webp"
    with output_file(folder / name, overwrite=True) as temporary:
        temporary.write_bytes(buffer.getvalue())
    return name
