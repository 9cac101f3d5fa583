"""Make the pictures of the README: ``python -m tuning.pictures [FOLDER]`` (docs/images)."""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from torchblur.filters import get_filter
from torchblur.metrics import display_encode
from torchblur.presets import create_filter
from torchblur.render import load_scene, render_frame, render_reference

__all__ = ["main", "picture_of"]

_ROOT = Path(__file__).resolve().parents[1]
_PRESET = _ROOT / "configs" / "filters" / "guertin2014-tuned.yaml"
_LABEL_PX = 22
_GAP_PX = 4


def main() -> None:
    """Render the scenes of the README and write one picture for each."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else _ROOT / "docs" / "images"
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("towards_viewer", "fence"):
        path = folder / f"{name}.webp"
        picture_of(name).save(path, quality=88, method=6)
        print(path)


def picture_of(scene_name: str, size: tuple[int, int] = (180, 320), spp: int = 256) -> Image.Image:
    """Return one scene as seen sharp, by three filters, and by the reference, side by side.

    Args:
        scene_name: A scene of configs/scenes, without its ending.
        size: Height and width of each image, px.
        spp: Samples per pixel of the reference.
    """
    scene = load_scene(_ROOT / "configs" / "scenes" / f"{scene_name}.yaml")
    frame = render_frame(scene, size)
    with torch.no_grad():
        images = {
            "sharp": frame.color,
            "line blur": get_filter("line")()(frame),
            "Guertin 2014, as published": get_filter("guertin2014")()(frame),
            "Guertin 2014, tuned": create_filter(_PRESET)(frame),
            "reference": render_reference(scene, size, spp=spp).mean,
        }
    return _side_by_side(images)


def _side_by_side(images: dict[str, Tensor]) -> Image.Image:
    height, width = next(iter(images.values())).shape[-2:]
    page = Image.new(
        "RGB", (len(images) * (width + _GAP_PX) - _GAP_PX, height + _LABEL_PX), "white"
    )
    draw = ImageDraw.Draw(page)
    for column, (label, image) in enumerate(images.items()):
        left = column * (width + _GAP_PX)
        pixels = (display_encode(image)[0].permute(1, 2, 0) * 255).round().byte().numpy()
        page.paste(Image.fromarray(pixels), (left, _LABEL_PX))
        draw.text((left + 2, 2), label, "black", ImageFont.load_default(15))
    return page


if __name__ == "__main__":
    main()
