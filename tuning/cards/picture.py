"""The picture of a card: crops of two frames, where the preset helps most and least."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from torchblur.filters import get_filter
from torchblur.metrics import display_encode, flip_ldr
from tuning.cards.text import Card
from tuning.data.cases import AnyCase, Case
from tuning.data.variants import Variant, shown_image, shown_reference

__all__ = ["CardPicture", "card_picture"]

_EDGE_PX = 240  # of a crop as it is shown
_CROP_PX = 120
_LABEL_PX, _GAP_PX = 20, 4
_LIMIT = 60_000  # bytes
_QUALITIES = (90, 85, 80, 75, 70, 60, 50, 40, 30, 20)


@dataclass(frozen=True, kw_only=True)
class CardPicture:
    """A picture and what it shows.

    Args:
        content: A WebP file.
        caption: One or two sentences.
    """

    content: bytes
    caption: str


@torch.no_grad()
def card_picture(card: Card, cases: Sequence[AnyCase]) -> CardPicture:
    """Return crops of two frames: sharp, line blur, the defaults, the preset, the reference.

    The frames are those of the hold-out (of the training, if there is none) where FLIP is best and
    worst over that of the filter with its defaults or of the line blur, whichever is better; the
    crops lie where that difference is greatest.

    Args:
        card: The preset, and the figures of all frames.
        cases: The frames of its run.
    """
    split = "holdout" if any(case.split == "holdout" for case in cases) else "train"
    known = {case.name: case for case in cases if case.split == split}
    ratios = {name: ratio for name in known if (ratio := _ratio(card, name)) is not None}
    chosen = sorted(ratios, key=lambda name: ratios[name])
    chosen = [chosen[0]] if len(chosen) == 1 else [chosen[0], chosen[-1]]
    rows = [_row(card, known[name], best=name == chosen[0]) for name in chosen]
    kind = {"holdout": "frames that the fit never saw", "train": "training frames"}[split]
    words = ("where it helps most", "where it helps least")
    captions = [
        f"{name}, {word}: FLIP {_flips(card, name)}"
        for name, word in zip(chosen, words, strict=False)
    ]
    caption = f"Of the {kind}, from top to bottom: {'; '.join(captions)}."
    return CardPicture(content=_webp(_page(rows)), caption=caption)


# -- which frames ----------------------------------------------------------------------------------


def _flip(card: Card, case: str, variant: str) -> float | None:
    return next(
        (s.scores["flip"] for s in card.result.scores if (s.case, s.variant) == (case, variant)),
        None,
    )


def _ratio(card: Card, case: str) -> float | None:
    rivals = [v for name in ("default", "line") if (v := _flip(card, case, name)) is not None]
    mine = _flip(card, case, card.variant)
    if mine is None or not rivals:
        return None
    return mine / max(min(rivals), 1e-6)


def _flips(card: Card, case: str) -> str:
    names = {"line": "line blur", "default": card.rival, card.variant: card.variant}
    values = [(label, _flip(card, case, name)) for name, label in names.items()]
    return ", ".join(f"{label} {value:.4f}" for label, value in values if value is not None)


# -- pixels ----------------------------------------------------------------------------------------


def _row(card: Card, case: AnyCase, *, best: bool) -> dict[str, Tensor]:
    """Return label and crop of each image, display values (3, h, w) in [0, 1]."""
    kind, params = card.preset.filter, card.preset.params
    free = tuple(parameter.name for parameter in card.result.parameters)
    values = {name: params[name] for name in free if name in params}
    variants = {
        "sharp": Variant(name="sharp"),
        "line blur": Variant(name="line", blur=get_filter("line")()),
        card.rival: Variant(name="default", blur=get_filter(kind)()),
        card.variant: Variant(
            name="mine", blur=get_filter(kind)(**params), values=values, free=free
        ),
    }
    if not isinstance(case, Case) and case.sharp is None:
        variants["sharp"] = Variant(name="input", stream=True)
    images = {label: shown_image(variant, case).cpu() for label, variant in variants.items()}
    images["reference"] = shown_reference(case).cpu()
    place = _place(images, card, best=best)
    return {label: _crop(display_encode(image)[0], place) for label, image in images.items()}


def _place(images: Mapping[str, Tensor], card: Card, *, best: bool) -> tuple[int, int]:
    """Return top and left of the crop where a preset's gain, or its loss, is greatest."""
    reference = images["reference"]
    mine, rivals = card.variant, (card.rival, "line blur")
    errors = {label: flip_ldr(images[label], reference) for label in (*rivals, mine)}
    rival = min(rivals, key=lambda label: float(errors[label].mean()))
    change = errors[rival] - errors[mine] if best else errors[mine] - errors[rival]
    height, width = reference.shape[-2:]
    edge = (min(_CROP_PX, height), min(_CROP_PX, width))
    sums = torch.nn.functional.avg_pool2d(change.float().reshape(1, 1, height, width), edge, 1)
    return divmod(int(sums.flatten().argmax()), sums.shape[-1])


def _crop(image: Tensor, place: tuple[int, int]) -> Tensor:
    top, left = place
    return image[:, top : top + _CROP_PX, left : left + _CROP_PX]


def _page(rows: Sequence[Mapping[str, Tensor]]) -> Image.Image:
    columns = len(rows[0])
    height, width = rows[0]["sharp"].shape[-2:]
    scale = max(1, round(_EDGE_PX / max(height, width)))
    height, width = height * scale, width * scale
    size = (columns * (width + _GAP_PX) - _GAP_PX, len(rows) * (height + _GAP_PX) - _GAP_PX)
    page = Image.new("RGB", (size[0], size[1] + _LABEL_PX), "white")
    draw = ImageDraw.Draw(page)
    for index, row in enumerate(rows):
        for column, (label, image) in enumerate(row.items()):
            left, top = column * (width + _GAP_PX), _LABEL_PX + index * (height + _GAP_PX)
            pixels = (image.permute(1, 2, 0) * 255).round().byte().numpy()
            tile = Image.fromarray(pixels).resize((width, height), Image.Resampling.NEAREST)
            page.paste(tile, (left, top))
            if index == 0:
                draw.text((left + 2, 2), label, "black", ImageFont.load_default(14))
    return page


def _webp(page: Image.Image) -> bytes:
    """Return the page as WebP, as good as the limit of a card lets it be."""
    for quality in _QUALITIES:
        buffer = io.BytesIO()
        page.save(buffer, format="WEBP", quality=quality, method=6)
        if buffer.tell() <= _LIMIT:
            break
    return buffer.getvalue()
