"""The presets that are shipped: each has its evidence, a card, and a command that makes it."""

import re
import shlex
from pathlib import Path

from torchblur.presets import load_preset
from tuning.config.fit import load_tune_config


def _fitted(repository):
    """Return the presets that a fit made, by name."""
    ends = ("-tuned", "-low", "-medium", "-high", "-ultra")
    paths = sorted((repository / "configs" / "filters").glob("*.yaml"))
    return {path.stem: load_preset(path) for path in paths if path.stem.endswith(ends)}


def test_fitted_presets_have_evidence(repository):
    fitted = _fitted(repository)
    assert len(fitted) >= 3
    for name, preset in fitted.items():
        evidence, variant = preset.evidence, name.removeprefix(f"{preset.filter}-")
        program, command, config, option, run = shlex.split(evidence["command"])
        assert (program, command, option) == ("torchblur", "tune", "-o"), name
        assert run.removeprefix("runs/") == Path(config).stem, name
        assert (repository / config).is_file(), f"{name}: {config}"
        assert load_tune_config(repository / config).filter.kind == preset.filter
        assert evidence["seed"] == load_tune_config(repository / config).seed
        assert {"python", "torchblur", "torch"} <= set(evidence["versions"])
        assert not set(evidence["train"]) & set(evidence["holdout"])
        for split in ("train", "holdout"):
            assert set(evidence["figures"][split]) == {"default", variant}
            for figures in evidence["figures"][split].values():
                assert {"flip", "psnr", "ssim", "flip_band", "psnr_band"} <= set(figures)


def test_one_command_makes_all_of_them(repository):
    makefile = (repository / "Makefile").read_text(encoding="utf-8").replace("\\\n", " ")
    fits = re.search(r"^FITS := (.*)$", makefile, re.MULTILINE).group(1).split()
    assert set(fits) == {
        preset.evidence["command"].rpartition("runs/")[2] for preset in _fitted(repository).values()
    }


def test_fitted_presets_have_a_card_with_their_figures(repository):
    folder = repository / "docs" / "presets"
    fitted = _fitted(repository)
    for name, preset in fitted.items():
        text = (folder / f"{name}.md").read_text(encoding="utf-8")
        assert preset.evidence["command"] in text, name
        assert "## Where it is worse" in text
        for figures in preset.evidence["figures"].values():
            mine = figures[name.removeprefix(f"{preset.filter}-")]
            assert f"| `{name}` | {mine['flip']:.4f} | {mine['psnr']:.2f} |" in (
                text.replace("**", "")
            ), name
        for image in re.findall(r"\]\((\S+?\.webp)\)", text):
            assert 0 < (folder / image).stat().st_size <= 80_000, image
    assert {path.stem for path in folder.glob("*.md")} == set(fitted)
