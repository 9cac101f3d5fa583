"""A pinhole camera that moves: rays out, world points back to pixels.

The world is right-handed. A camera that is not turned looks along -z with +y up; images have
x to the right and y down, and pixel (x, y) has its center at (x + 1/2, y + 1/2).
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import torch
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator
from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.render.motion import Level, Number, Placed, Triple, into, place, turn
from torchblur.render.vectors import Vec

__all__ = ["Camera", "camera_rays", "lens", "project"]


class Camera(Placed):
    """Where the camera is, where it looks, and how it moves (`velocity`, `spin`, `axis`, `pivot`).

    To pan to the right by 2 degrees a frame, give ``spin: -2, axis: [0, 1, 0]``.
    """

    axis: Triple = Field(
        (0.0, 1.0, 0.0), description="axis of the spin, in the world; any length but 0"
    )
    look_at: Triple | None = Field(
        None,
        description="world point in the middle of the image (without `shift`) at frame 0; instead "
        "of `rotation`",
    )
    up: Triple = Field((0.0, 1.0, 0.0), description="what is up in the image, with `look_at`")
    fov: Annotated[Number, Field(gt=0, lt=180)] | None = Field(
        None, description="horizontal field of view, degrees; left out, with `focal`: 50"
    )
    focal: Annotated[Number, Field(gt=0)] | None = Field(
        None, description="focal length over the image's width; instead of `fov`"
    )
    shift: tuple[Number, Number] = Field(
        (0.0, 0.0),
        description="how far the image's middle lies to the right of and below the view axis, "
        "over the image's width; perspective stays. Blender's Shift X, and its Shift Y with the "
        "other sign, where the image is not higher than wide",
    )

    @model_validator(mode="after")
    def _is_determined(self) -> Camera:
        if self.fov is not None and self.focal is not None:
            raise ValueError("give `fov` or `focal`, not both")
        if self.look_at is None:
            return self
        if any(self.rotation):
            raise ValueError("give `look_at` or `rotation`, not both")
        away = _vector(self.position) - _vector(self.look_at)
        if float(torch.linalg.cross(away, _vector(self.up)).norm()) < 1e-9:
            raise ValueError(
                f"`look_at` {list(self.look_at)} must differ from `position`, and lie not along "
                f"`up` {list(self.up)}"
            )
        return self

    @model_serializer(mode="wrap")
    def _without_no_shift(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out a shift of 0: scenes are known by this, and were so before it was there."""
        data: dict[str, Any] = handler(self)
        if not any(self.shift):
            data.pop("shift", None)
        return data

    @property
    def focal_over_width(self) -> float:
        """Focal length over the image's width."""
        if self.focal is not None:
            return self.focal
        return 0.5 / math.tan(math.radians(50.0 if self.fov is None else self.fov) / 2)

    def window(self, *, of: tuple[int, int], box: tuple[int, int, int, int]) -> Camera:
        """Return the camera whose image is a window of this one's: equal pixels, in their place.

        Args:
            of: Height and width of this camera's image, px, each at least 1.
            box: Top, left, height and width of the window, px; the last two at least 1. It may
                reach beyond the image.

        Raises:
            ConfigError: a size below 1.
        """
        top, left, height, width = box
        if min(*of, height, width) < 1:
            raise ConfigError(f"sizes must be at least 1 px, got `of` {of} and `box` {box}")
        across, down, focal = lens(self, of).tolist()
        shift = ((width / 2 - (across - left)) / width, (height / 2 - (down - top)) / width)
        return self.model_copy(update={"fov": None, "focal": focal / width, "shift": shift})

    def level(self) -> Level:
        """Return the motion from camera space (looking along -z) to the world."""
        level = super().level()
        if self.look_at is None:
            return level
        back = _vector(self.position) - _vector(self.look_at)
        back = back / back.norm()
        right = torch.linalg.cross(_vector(self.up), back)
        right = right / right.norm()
        return level._replace(rest=torch.stack((right, torch.linalg.cross(back, right), back), 1))


def lens(camera: Camera, size: tuple[int, int]) -> Tensor:
    """Return x and y of the view axis in the image, and focal length, px, float64, (3,).

    Args:
        camera: The camera; pixels are square, and its field of view is that of the width.
        size: Height and width in px.
    """
    height, width = size
    right, down = (width * share for share in camera.shift)
    numbers = (width / 2 - right, height / 2 - down, camera.focal_over_width * width)
    return torch.tensor(numbers, dtype=torch.float64)


def camera_rays(
    levels: Tensor, lens: Tensor, x: Tensor, y: Tensor, time: Tensor
) -> tuple[Vec, Vec]:
    """Return the rays through points of the image, each at its own time.

    Args:
        levels: Table of the camera's motion, (levels, 22).
        lens: From `lens`, (3,).
        x: Position in the image, px, (N,).
        y: Position in the image, px down, (N,).
        time: Frames after the table's frame, (N,).

    Returns:
        Origins and directions. A direction is 1 long along the view axis, so that the parameter
        of a hit is its depth.
    """
    across, down, focal = lens.unbind(0)
    zero = torch.zeros_like(x)
    direction = ((x - across) / focal, (down - y) / focal, zero - 1)
    return place(levels, time, (zero, zero, zero)), turn(levels, time, direction)


def project(
    levels: Tensor, lens: Tensor, time: Tensor, point: Vec, direction: Vec, is_sky: Tensor
) -> tuple[Tensor, Tensor]:
    """Return where world points appear in the image, each at its own time.

    Args:
        levels: Table of the camera's motion, (levels, 22).
        lens: From `lens`, (3,).
        time: Frames after the table's frame, (N,).
        point: World points, N.
        direction: World directions, N: what the sky shows, at no distance.
        is_sky: Where the direction counts and not the point, bool, (N,).

    Returns:
        x and y in px, (N,) each. Differentiable: in time, point and direction.
    """
    across, down, focal = lens.unbind(0)
    near, far = into(levels, time, point, direction)
    x, y, z = (torch.where(is_sky, b, a) for a, b in zip(near, far, strict=True))
    return across - focal * x / z, down + focal * y / z


def _vector(values: Triple) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
