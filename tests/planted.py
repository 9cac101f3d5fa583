"""Small frames, and cases whose reference is the filter's own output at known parameters."""

from pathlib import Path

import torch

from torchblur.filters import get_filter
from torchblur.frame import Frame, Shutter
from torchblur.io import write_frame, write_image
from torchblur.metrics import border_band
from tuning.data.cases import Case

PLANTED = {"kappa": 3.0, "third_gain": 5.0, "direction_exponent": 2.5}
FIXED = {"num_samples": 11, "tile_size": 12}


def tiny_frame(seed: int, size: tuple[int, int] = (48, 64)) -> Frame:
    """Return a textured disk that crosses a textured background, both moving."""
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    radius = ((x - width * (0.35 + 0.1 * seed)) ** 2 + (y - height / 2) ** 2).sqrt()
    disk = (radius < height / 4)[None, None]
    coarse = torch.rand(1, 6, height // 4, width // 4, generator=generator)
    noise = torch.nn.functional.interpolate(coarse, size=size, mode="nearest")
    angle = torch.rand((), generator=generator) * 3
    near = torch.stack([9 * angle.cos(), 9 * angle.sin()]).view(1, 2, 1, 1)
    far = torch.tensor([5.0, 3.0]).view(1, 2, 1, 1)
    return Frame(
        color=torch.where(disk, noise[:, :3], noise[:, 3:] * 0.7),
        velocity=torch.where(disk, near, far).expand(1, 2, height, width).contiguous(),
        depth=torch.where(disk, 4.0, 9.0),
        object_id=disk.to(torch.int64),
        source=f"tiny {seed}",
    )


def planted_case(seed: int, split: str = "train", filter_name: str = "guertin2014") -> Case:
    """Return a case whose reference is the filter's own output."""
    frame, shutter = tiny_frame(seed), Shutter(1.0)
    blur = get_filter(filter_name)(**FIXED, **PLANTED)
    with torch.no_grad():
        reference = blur(frame, shutter=shutter.open)
    return Case(
        name=f"tiny {seed}",
        split=split,
        frame=frame,
        reference=reference,
        variance=None,
        band=border_band(frame, shutter),
        shutter=shutter,
        identity=str(seed),
        origin=str(seed),
    )


def write_planted(root: Path) -> dict:
    """Write two planted cases as EXR; return the data of a configuration that fits them."""
    for seed, name in ((1, "first"), (2, "second")):
        folder = root / name
        folder.mkdir(parents=True)
        case = planted_case(seed)
        write_frame(folder / "sharp.exr", case.frame, half=False)
        write_image(folder / "reference.exr", case.reference, half=False)
    return {
        "filter": {"kind": "guertin2014", "params": dict(FIXED), "free": list(PLANTED)},
        "data": {
            "root": str(root),
            "train": [{"kind": "exr", "path": "first", "shutter": 1.0}],
            "holdout": [{"kind": "exr", "path": "second", "shutter": 1.0}],
        },
        "objective": {"terms": {"mse": 1.0}, "color_space": "linear"},
        "methods": [
            {"kind": "gradient", "steps": 4, "starts": 2},
            {"kind": "blackbox", "sampler": "tpe", "trials": 5},
        ],
        "seed": 5,
        "device": "cpu",
    }
