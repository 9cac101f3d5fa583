"""A small filter with a memory, and sequences whose references are its own output."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, ClassVar

import torch
import torch.nn.functional as F

from torchblur.filters.parts.base import FilterConfig, History, TemporalBlur
from torchblur.filters.parts.registry import _REGISTRY
from torchblur.frame import Frame, FrameSequence, Shutter
from torchblur.io import write_frame, write_image
from torchblur.metrics import border_band
from torchblur.params import Param
from tuning.data.cases import SequenceCase

PLANTED_GAIN = 0.35


class RecallConfig(FilterConfig):
    """Parameters of the stand-in."""

    gain: Annotated[
        float,
        Param(grad="smooth", low=0.05, high=1.0, source="test", meaning="weight of the new frame"),
    ] = 0.8


class Recall(TemporalBlur):
    """The mean of the new frame and what was before: ``M_t = M_{t-1} + gain (C_t - M_{t-1})``."""

    name: ClassVar[str] = "recall"
    config_class: ClassVar[type[FilterConfig]] = RecallConfig
    needs: ClassVar[tuple[str, ...]] = ("time",)

    def advance(self, samples, history, values):
        color = torch.stack([frame.color for frame in samples]).mean(dim=0)
        for frame in samples:
            frame.require("time")
        if history is not None:
            before = history.planes["mean"]
            color = before + values.gain * (color - before)
        return {"color": color, "age": color[:, :1]}, History({"mean": color})


_REGISTRY.pop(Recall.name)  # other tests go through all filters; fixture `recall` puts it there


def moving_sequence(
    count: int, seed: int = 0, size: tuple[int, int] = (48, 64), cuts: tuple[int, ...] = ()
) -> FrameSequence:
    """Return frames of noise under a disk that moves by 3 px a frame."""
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    frames = []
    for index in range(count):
        radius = ((x - 16 - 3 * index) ** 2 + (y - height / 2) ** 2).sqrt()
        disk = (radius < height / 4)[None, None]
        coarse = torch.rand(1, 3, height // 4, width // 4, generator=generator)
        noise = F.interpolate(coarse, size=size, mode="nearest")
        velocity = torch.tensor([3.0, 0.0]).view(1, 2, 1, 1)
        frames.append(
            Frame(
                color=torch.where(disk, 0.2 + 0.3 * noise, 0.1 + 0.8 * noise),
                velocity=torch.where(disk, velocity, 0.0),
                depth=torch.where(disk, 4.0, 9.0),
                object_id=disk.to(torch.int64),
                time=torch.rand(1, 1, height, width, generator=generator),
                source=f"tiny {index}",
            )
        )
    return FrameSequence(tuple(frames), cuts)


def sequence_case(
    count: int = 5, seed: int = 0, *, split: str = "train", warm_up: int = 0, cuts=()
) -> SequenceCase:
    """Return a sequence whose references are the stand-in's own output at PLANTED_GAIN."""
    sequence, shutter = moving_sequence(count, seed, cuts=cuts), Shutter(1.0)
    with torch.no_grad():
        references = Recall().sequence(sequence, gain=torch.tensor(PLANTED_GAIN))
    return SequenceCase(
        name="tiny" if seed == 0 else f"tiny {seed}",
        split=split,
        samples=(sequence,),
        sharp=None,
        references=tuple(references),
        variances=None,
        bands=tuple(border_band(frame, shutter) for frame in sequence),
        shutter=shutter,
        labels=tuple(str(index) for index in range(count)),
        warm_up=warm_up,
        identities=tuple(f"{seed} {index}" for index in range(count)),
        origin=str(seed),
    )


def write_sequences(root: Path, count: int = 4) -> dict[str, Any]:
    """Write two planted sequences as EXR; return a configuration that fits the first."""
    for seed, name in ((1, "first"), (2, "second")):
        folder = root / name
        folder.mkdir(parents=True)
        case = sequence_case(count, seed)
        for number, frame in enumerate(case.samples[0], start=1):
            write_frame(folder / f"stream.{number:04d}.exr", frame, half=False)
            sharp = dataclasses.replace(frame, time=None)
            write_frame(folder / f"center.{number:04d}.exr", sharp, half=False)
            reference = case.references[number - 1]
            write_image(folder / f"reference.{number:04d}.exr", reference, half=False)
    items = [
        {"kind": "exr_stream", "path": name, "center": "center.####.exr"}
        for name in ("first", "second")
    ]
    return {
        "filter": {"kind": "recall", "free": ["gain"]},
        "data": {"root": str(root), "train": items[:1], "holdout": items[1:]},
        "objective": {"terms": {"l1": 1.0}, "color_space": "linear", "temporal": 0.5},
        "methods": [
            {"kind": "gradient", "steps": 40, "starts": 2, "learning_rate": 0.1, "unroll": 2},
            {"kind": "blackbox", "sampler": "tpe", "trials": 4},
        ],
        "seed": 5,
        "device": "cpu",
    }
