"""What part of a camera's image is rendered: its size, the whole image's size, and where it is."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Collection
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import PydanticCustomError

from torchblur.params import Config

__all__ = ["Framed", "read_size", "refusal", "without_none"]


def refusal(text: str) -> PydanticCustomError:
    """Return the error of a validator whose message is shown as it is."""
    return PydanticCustomError("nested", "{text}", {"text": text})


def read_size(text: str, key: str) -> tuple[int, int]:
    """Return height and width of "WIDTHxHEIGHT".

    Args:
        text: What the user gave.
        key: Its key, for the message.

    Raises:
        PydanticCustomError: it is no size.
    """
    match = re.fullmatch(r"0*([1-9][0-9]*)x0*([1-9][0-9]*)", text)
    if match is None:
        raise refusal(f"`{key}` must be WIDTHxHEIGHT in px, got {text!r}")
    return int(match[2]), int(match[1])


def without_none(data: dict[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Return data without what is not given: runs and files that know of no such key stay valid.

    Args:
        data: What a model is written as.
        names: Keys that are left out where they are None.
    """
    return {key: value for key, value in data.items() if value is not None or key not in names}


def _place(value: Any) -> Any:
    """Turn [x, y] or "x,y" into a pair; leave "motion" and None."""
    if value is None or value == "motion":
        return value
    parts = value.split(",") if isinstance(value, str) else value
    try:
        x, y = (float(part) for part in parts)
    except (TypeError, ValueError):
        x = y = -1.0
    if not (0 <= x <= 1 and 0 <= y <= 1):
        raise refusal(f"`at` must be [x, y], shares from 0 to 1, or motion; got {value!r}")
    return x, y


class Framed(Config):
    """A rendered image that may be a window of a larger one."""

    of: str | None = Field(
        None,
        description="WIDTHxHEIGHT in px of the camera's whole image, of which a window is "
        "rendered; left out: the window is all of it",
    )
    at: Annotated[tuple[float, float] | Literal["motion"] | None, BeforeValidator(_place)] = Field(
        None,
        description="middle of the window, [x, y] in shares of the whole image, moved inwards "
        "where the window would leave it; or motion: where most pixels move, and borders of "
        "what moves are. Left out: the middle, or, of a family, motion",
    )

    @field_validator("of")
    @classmethod
    def _is_size_of_whole(cls, value: str | None) -> str | None:
        if value is not None:
            read_size(value, "of")
        return value

    @model_validator(mode="after")
    def _is_window(self) -> Framed:
        if self.whole is None:
            if self.at is not None:
                raise refusal("`at` is a place in a larger image: give its size, `of`, too")
            return self
        (height, width), (rows, columns) = self.height_width, self.whole
        if height > rows or width > columns:
            raise refusal(f"a window of {width}x{height} px does not fit in `of` {self.of}")
        return self

    @model_serializer(mode="wrap")
    def _without_none(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return without_none(handler(self), ("of", "at"))

    @property
    @abstractmethod
    def height_width(self) -> tuple[int, int]:
        """Height and width of what is rendered, px."""

    @property
    def whole(self) -> tuple[int, int] | None:
        """Height and width of the whole image, px, if a window of one is rendered."""
        return None if self.of is None else read_size(self.of, "of")

    @property
    def lines(self) -> int | None:
        """Height of the whole image, px, if a window of one is rendered."""
        return None if self.whole is None else self.whole[0]

    @property
    def suffix(self) -> str:
        """What names of windows end with: " (1080p)"."""
        return "" if self.whole is None else f" ({self.whole[0]}p)"
