"""The forward warp against its slow twin."""

import dataclasses

import pytest
import torch
from twins.warp import warp

from torchblur.filters.warp import WarpBlur
from torchblur.frame import Frame
from torchblur.testing.frames import moving_square, random_frame

CASES = [
    {},
    {"shutter_position": "leading", "depth_extent": 0.2},
    {"shutter_position": "trailing", "depth_slope": 0.3, "depth_gap": 0.03},
    {"shutter": 1.2, "coverage_gain": 0.7, "own_weight": 0.3},
    {"supersampling": 2, "footprint": 0.6, "stretch": 1.7},
    {"sharpening": 1.6, "curved": False, "edge_radius": 0},
    {"background": "none", "stretch": 0.0, "sharpening": 0.0},
    {"background": "revealed", "depth_extent": 0.1},
    {"background_reach": 2, "edge_radius": 1, "depth_gap": 0.02},
]


def with_acceleration(frame):
    generator = torch.Generator().manual_seed(3)
    bend = torch.randn(frame.velocity.shape, generator=generator, dtype=frame.dtype)
    return dataclasses.replace(frame, acceleration=12 * bend)


def partly_valid(frame):
    """A frame some of whose pixels are not valid, nor are some of what lies behind."""
    valid = torch.ones(1, 1, *frame.size, dtype=torch.bool)
    valid[..., 2:4, 5:8] = False
    behind = frame.revealed
    if behind is not None:
        behind = dataclasses.replace(behind, valid=valid.flip(3))
    return dataclasses.replace(frame, valid=valid, revealed=behind)


def arrays(frame):
    behind = frame.revealed
    layers = {
        "acceleration": frame.acceleration[0].numpy(),
        "valid": None if frame.valid is None else frame.valid[0].numpy(),
    }
    if behind is not None:
        valid = None if behind.valid is None else behind.valid[0].numpy()
        planes = (behind.color, behind.depth, behind.velocity)
        layers["revealed"] = (*(plane[0].numpy() for plane in planes), valid)
    return [t[0].numpy() for t in (frame.color, frame.depth, frame.velocity)], layers


def both(frame, params):
    blur = WarpBlur(**({"num_samples": 3} | params)).double()
    planes, layers = arrays(frame)
    # The parameters as the filter holds them, which is in single precision.
    settings = blur.config.model_dump()
    numbers = [*blur.named_parameters(), *blur.named_buffers()]
    settings |= {name: float(value) for name, value in numbers}
    with torch.no_grad():
        return blur.layers(frame), warp(*planes, **layers, **settings)


@pytest.mark.parametrize("params", CASES, ids=str)
@pytest.mark.parametrize("kind", ["square", "random", "masked"])
def test_filter_equals_its_twin(params, kind):
    if kind == "random" and params.get("background") == "revealed":
        pytest.skip("a random frame has no revealed layer")
    make = random_frame if kind == "random" else moving_square
    frame = with_acceleration(make(10, 13, dtype=torch.float64))
    frame = partly_valid(frame) if kind == "masked" else frame
    layers, twin = both(frame, params)
    for name in ("color", "coverage"):
        expected = torch.from_numpy(twin[name])[None]
        assert torch.allclose(layers[name], expected, atol=1e-6), name
    assert not torch.allclose(layers["color"], frame.color, atol=0.01)


def test_a_still_part_is_no_special_case():
    frame = moving_square(10, 13, dtype=torch.float64)
    velocity = frame.velocity.clone()
    velocity[..., :9] = 0
    depth = frame.depth.clone()
    depth[..., 0, 0] = torch.inf
    frame = Frame(color=frame.color, depth=depth, velocity=velocity)
    layers, twin = both(with_acceleration(frame), {"curved": False})
    # The twin lets through exp(−gap / extent) of the guess even where nothing moves.
    assert torch.allclose(layers["color"], torch.from_numpy(twin["color"])[None], atol=2e-4)


def test_the_comparison_can_fail():
    frame = with_acceleration(moving_square(10, 13, dtype=torch.float64))
    layers, _ = both(frame, {})
    for other in ({"coverage_gain": 1.3}, {"depth_extent": 0.03}, {"sharpening": 0.9}):
        _, twin = both(frame, other)
        difference = (layers["color"] - torch.from_numpy(twin["color"])[None]).abs().amax(1)
        assert float((difference > 1e-6).double().mean()) > 0.02, other
