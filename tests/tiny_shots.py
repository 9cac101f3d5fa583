"""Small frames on disk, for the tests of the command line: a square that moves to the right."""

from pathlib import Path

import numpy as np
import torch

from torchblur.frame import Frame
from torchblur.io import write_exr, write_frame, write_image

HEIGHT, WIDTH = 48, 64


def moving_square(shift: int = 0, speed: float = 12.0, size: tuple[int, int] = (HEIGHT, WIDTH)):
    """Return a frame of a bright square, 12 px wide, before a still gradient."""
    height, width = size
    x = torch.linspace(0.1, 0.6, width).expand(1, 3, height, width).clone()
    inside = torch.zeros(1, 1, height, width, dtype=torch.bool)
    inside[..., 16:28, 20 + shift : 32 + shift] = True
    velocity = torch.zeros(1, 2, height, width)
    velocity[:, :1][inside] = speed
    return Frame(
        color=torch.where(inside, torch.tensor([1.2, 0.4, 0.1]).view(1, 3, 1, 1), x),
        velocity=velocity,
        depth=torch.where(inside, 2.0, 9.0),
        object_id=inside.long(),
    )


def write_shot(folder: Path, count: int = 3, name: str = "sharp") -> list[Path]:
    """Write NAME.####.exr and reference.####.exr, numbered from 1."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number in range(1, count + 1):
        frame = moving_square(shift=number)
        path = folder / f"{name}.{number:04d}.exr"
        write_frame(path, frame)
        write_image(folder / f"reference.{number:04d}.exr", box_blur(frame))
        paths.append(path)
    return paths


def box_blur(frame: Frame, steps: int = 13):
    """Return the mean of the square over half a frame of its motion: its true motion blur."""
    inside = frame.velocity[:, :1] != 0
    speed = float(frame.velocity.max())
    back = torch.where(inside, frame.color.roll(16, -1), frame.color)
    shifts = [round(s) for s in torch.linspace(-speed / 4, speed / 4, steps).tolist()]
    images = [torch.where(inside.roll(s, -1), frame.color.roll(s, -1), back) for s in shifts]
    return torch.stack(images).mean(0)


def write_channels(path: Path, **changes) -> Path:
    """Write a frame in our layout with channels replaced (an array) or left out (None)."""
    frame = moving_square()
    color, velocity = frame.color[0].numpy(), frame.velocity[0].numpy()
    channels = dict(zip("RGB", color, strict=True))
    channels |= {"velocity.X": velocity[0], "velocity.Y": velocity[1]}
    channels["Z"] = frame.depth[0, 0].numpy()
    channels |= {name.replace("_", "."): value for name, value in changes.items()}
    write_exr(path, {k: np.asarray(v, np.float32) for k, v in channels.items() if v is not None})
    return path


def with_nan_velocity(path: Path) -> Path:
    """Write a frame whose velocity is NaN at x=5, y=3."""
    bad = moving_square().velocity[0, 0].numpy().copy()
    bad[3, 5] = np.nan
    return write_channels(path, velocity_X=bad)


def truncate(path: Path) -> Path:
    """Cut a file in half."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    return path
