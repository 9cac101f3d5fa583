import dataclasses

import pytest
import torch
from torch.utils.data import DataLoader, default_collate

import torchblur
from torchblur.errors import FrameError
from torchblur.testing.frames import moving_square, random_frame

COLLATES = pytest.mark.parametrize("collate", [torchblur.collate, default_collate])


@pytest.mark.parametrize("workers", [0, 1])
def test_a_loader_makes_batches_of_frames(workers):
    frames = [moving_square(), random_frame(*moving_square().size)]
    names = set(frames[0].layers()) & set(frames[1].layers())
    frames = [frame.only(*names) for frame in frames]
    items = [(frame, {"reference": frame.color[0], "number": i}) for i, frame in enumerate(frames)]
    (batch,) = DataLoader(items, batch_size=2, num_workers=workers)
    frame, beside = batch
    assert isinstance(frame, torchblur.Frame)
    assert torch.equal(frame.color, torch.cat([f.color for f in frames]))
    assert torch.equal(frame.color, beside["reference"])
    assert beside["number"].tolist() == [0, 1]
    (same,) = DataLoader(items, batch_size=2, collate_fn=torchblur.collate)
    assert torch.equal(same[0].velocity, frame.velocity)
    assert torch.equal(same[1]["reference"], beside["reference"])


@COLLATES
def test_the_revealed_layer_comes_along(collate):
    frame = moving_square()
    with_behind = dataclasses.replace(frame, revealed=frame.only("depth"))
    assert collate([with_behind, with_behind]).revealed.batch_size == 2
    flat = dataclasses.replace(frame, revealed=frame.only())
    with pytest.raises(FrameError, match=r"frame 0 has `revealed\.depth`, frame 1 has not"):
        collate([with_behind, flat])


@COLLATES
def test_frames_that_do_not_go_together(collate):
    frame = moving_square()
    with pytest.raises(FrameError, match="must have the same layers: frame 0 has `depth`, frame 2"):
        collate([frame, frame, dataclasses.replace(frame, depth=None)])
    with pytest.raises(FrameError, match="frame 1 has `depth`, frame 0 has not"):
        collate([dataclasses.replace(frame, depth=None), frame])
    height, width = frame.size
    small = frame.crop(0, 0, height - 2, width)
    with pytest.raises(FrameError, match=rf"one size, got {width}x{height - 2}, {width}x{height}"):
        collate([frame, small])
