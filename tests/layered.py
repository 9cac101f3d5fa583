"""A disk that moves over a background of two colors, with the layers that filters ask for."""

import dataclasses

import torch

from torchblur.frame import Frame, Shutter

ID, BACK, FRONT = 7, 6.0, 2.0


def disk_scene(position="centered", speed=24.0, size=(56, 88), flow=0.0):
    """A bright disk moves right by `speed` px/frame before a background of red and blue.

    The border between the two colors runs aslant behind the disk, so that what the disk lets
    through at a pixel is not what lies beside it. Object, colors and motion are known, so that
    the reference is a mean over times; `flow` moves the background, which has stripes then.

    Returns:
        The frame with normals, object numbers and the revealed layer, and the reference for a
        shutter of 1 frame.
    """
    height, width = size
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")

    def background(time):
        low = (y - height / 2 > 0.6 * (x - width / 2)).float()
        if flow:
            low = ((x - flow * time) / 8 + y / 16).floor().remainder(2)
        return torch.stack((0.8 - 0.7 * low, 0.1 + 0 * low, 0.1 + 0.7 * low))[None]

    def covered(time):
        inside = (x - width / 2 - speed * time) ** 2 + (y - height / 2) ** 2 < (height / 3) ** 2
        return inside[None, None]

    disk = torch.tensor([0.9, 0.9, 0.2]).view(1, 3, 1, 1)
    start, stop = Shutter(1.0, position).interval
    times = [start + (stop - start) * (i + 0.5) / 96 for i in range(96)]
    reference = sum(torch.where(covered(t), disk, background(t)) for t in times) / len(times)

    inside = covered(0.0)
    zeros = torch.zeros(1, 1, height, width)
    moving = torch.cat((zeros + flow, zeros), 1)
    behind = Frame(color=background(0.0), velocity=moving, depth=zeros + BACK)
    frame = dataclasses.replace(
        behind,
        color=torch.where(inside, disk, behind.color),
        velocity=torch.where(inside, torch.cat((zeros + speed, zeros), 1), moving),
        depth=torch.where(inside, FRONT, BACK),
        object_id=torch.where(inside, ID, 1),
        normal=torch.cat((zeros, zeros, zeros - 1), 1),
        revealed=behind,
    )
    return frame, reference
