"""Make the pictures of the README: ``python -m tools.readme_images [FOLDER]`` (docs/images)."""

from __future__ import annotations

import dataclasses
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from torchblur.filters import TemporalBlur, get_filter
from torchblur.frame import FrameSequence, Shutter
from torchblur.metrics import display_encode
from torchblur.presets import create_filter
from torchblur.render import (
    Renderer,
    Scene,
    load_scene,
    render_frame,
    render_reference,
    render_revealed,
)

__all__ = ["main", "one_sample_per_pixel", "tuned_beside_published", "what_lies_behind"]

_ROOT = Path(__file__).resolve().parents[1]
_FILTERS = _ROOT / "configs" / "filters"
_LABEL_PX = 22
_GAP_PX = 4


def main() -> None:
    """Render the scenes of the README and write one picture for each."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else _ROOT / "docs" / "images"
    folder.mkdir(parents=True, exist_ok=True)
    pictures: dict[str, Callable[[], Image.Image]] = {
        "towards_viewer": lambda: tuned_beside_published("towards_viewer"),
        "fence": lambda: tuned_beside_published("fence"),
        "vase_cushion": what_lies_behind,
        "crossing_spheres": one_sample_per_pixel,
    }
    for name, make in pictures.items():
        path = folder / f"{name}.webp"
        make().save(path, quality=88, method=6)
        print(path)


@torch.no_grad()
def tuned_beside_published(
    scene_name: str, size: tuple[int, int] = (180, 320), spp: int = 256
) -> Image.Image:
    """Return one scene as seen sharp, by four filters, and by the reference, side by side.

    Args:
        scene_name: A scene of configs/scenes, without its ending.
        size: Height and width of each image, px.
        spp: Samples per pixel of the reference.
    """
    scene = _scene(scene_name)
    frame = render_frame(scene, size)
    return _side_by_side(
        {
            "sharp": frame.color,
            "line blur": get_filter("line")()(frame),
            "Guertin 2014, as published": get_filter("guertin2014")()(frame),
            "Guertin 2014, tuned": create_filter(_FILTERS / "guertin2014-tuned.yaml")(frame),
            "torchblur": get_filter("torchblur")()(frame),
            "reference": render_reference(scene, size, spp=spp).mean,
        }
    )


@torch.no_grad()
def what_lies_behind(size: tuple[int, int] = (180, 320), spp: int = 256) -> Image.Image:
    """Return a vase that moves before a cushion, its background guessed and traced.

    Args:
        size: Height and width of each image, px.
        spp: Samples per pixel of the reference.
    """
    scene, shutter = _scene("vase_cushion"), Shutter(0.5, "leading")
    frame = render_frame(scene, size)
    ask = {"shutter": shutter.open, "shutter_position": shutter.position}
    hybrid, jimenez = get_filter("tan2022")(), get_filter("jimenez2014")()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no revealed layer yet
        guessed = hybrid.layers(frame, **ask)
    traced = render_revealed(scene, size, mask=guessed["ray_mask"] > 0.5)
    known = dataclasses.replace(frame, revealed=traced.frame)
    return _side_by_side(
        {
            "Tan 2022 without rays": guessed["color"],
            "Tan 2022": hybrid(known, **ask),
            "Jimenez 2014": jimenez(frame, **ask),
            "Jimenez 2014, traced background": jimenez(known, background="revealed", **ask),
            "reference": render_reference(scene, size, spp=spp, shutter=shutter).mean,
        }
    )


@torch.no_grad()
def one_sample_per_pixel(
    size: tuple[int, int] = (180, 320), spp: int = 256, frames: int = 5
) -> Image.Image:
    """Return a stream of one sample per pixel, and what is made of it after some frames.

    Args:
        size: Height and width of each image, px.
        spp: Samples per pixel of the reference.
        frames: Frames of the sequence; the last one is shown.
    """
    scene, shutter = _scene("crossing_spheres_long"), Shutter(1.0)
    renderer = Renderer(scene, images=frames)
    stream = FrameSequence(tuple(renderer.stream(size, frame=i)[0] for i in range(frames)))
    last = frames - 1
    presets: dict[str, str | Path] = {
        "Oberberger 2022, as published": "oberberger2022",
        "Oberberger 2022, tuned": _FILTERS / "oberberger2022-tuned.yaml",
    }
    images = {"one sample per pixel": stream[last].color}
    for label, preset in presets.items():
        blur = create_filter(preset, shutter=shutter.open)
        assert isinstance(blur, TemporalBlur)
        images[label] = blur.sequence(stream)[last]
    mean = renderer.reference(size, spp=spp, shutter=shutter, frame=last, pixel="center").mean
    return _side_by_side(images | {"reference": mean})


def _scene(name: str) -> Scene:
    return load_scene(_ROOT / "configs" / "scenes" / f"{name}.yaml")


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
