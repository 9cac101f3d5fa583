import pytest
import torch

from torchblur.errors import FrameError
from torchblur.frame import Frame, Shutter
from torchblur.testing.frames import random_frame


def parts(height=4, width=6):
    return {"color": torch.rand(1, 3, height, width), "velocity": torch.zeros(1, 2, height, width)}


def test_three_dimensions_get_a_batch():
    frame = Frame(color=torch.rand(3, 4, 6), velocity=torch.zeros(2, 4, 6))
    assert frame.batch_size == 1
    assert frame.size == (4, 6)
    assert set(frame.layers()) == {"color", "velocity"}


@pytest.mark.parametrize(
    ("layer", "shape"),
    [("color", (1, 4, 4, 6)), ("depth", (1, 2, 4, 6)), ("velocity", (4, 6)), ("normal", (1, 3))],
)
def test_wrong_shape(layer, shape):
    with pytest.raises(FrameError, match=rf"`{layer}` must have shape .*\({shape[0]}"):
        Frame(**(parts() | {layer: torch.zeros(shape)}))


def test_mixed_sizes_and_types():
    with pytest.raises(FrameError, match=r"one batch and size: `color` has \(1, 4, 6\), `depth`"):
        Frame(**parts(), depth=torch.ones(1, 1, 4, 5))
    with pytest.raises(FrameError, match=r"one type: `color` has torch.float32, `depth` has"):
        Frame(**parts(), depth=torch.ones(1, 1, 4, 6, dtype=torch.float64))
    with pytest.raises(FrameError, match=r"`depth` must be floating point, got torch.int64"):
        Frame(**parts(), depth=torch.ones(1, 1, 4, 6, dtype=torch.int64))
    with pytest.raises(FrameError, match="`color` must be a tensor, got list"):
        Frame(color=[1], velocity=torch.zeros(1, 2, 4, 6))
    with pytest.raises(FrameError, match="`revealed` must have the size"):
        Frame(**parts(), revealed=Frame(**parts(5, 6)))


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_depth_must_be_positive(value):
    depth = torch.ones(1, 1, 4, 6)
    depth[0, 0, 2, 3] = value
    with pytest.raises(FrameError, match=r"`depth` must be a positive.*x=3, y=2 .*\(a\.exr\)"):
        Frame(**parts(), depth=depth, source="a.exr")


def test_invalid_values_name_layer_count_and_place():
    given = parts()
    given["color"][0, 1, 2, 3] = torch.inf
    given["color"][0, 2, 3, 3] = torch.nan
    with pytest.raises(
        FrameError, match=r"`color` must be finite, got 2 .*inf in channel 1 at x=3"
    ):
        Frame(**given)


def test_invalid_values_can_be_masked():
    given = parts()
    given["velocity"][0, 1, 2, 3] = torch.nan
    depth = torch.ones(1, 1, 4, 6)
    depth[..., 0, 0] = -1
    with pytest.warns(UserWarning, match="replaced by") as caught:
        frame = Frame(**given, depth=depth, on_invalid="mask")
    assert len(caught) == 2
    assert int((~frame.require("valid")).sum()) == 2
    assert float(frame.velocity[0, 1, 2, 3]) == 0
    assert torch.isinf(frame.require("depth")[0, 0, 0, 0])
    with pytest.raises(FrameError, match="`on_invalid` must be 'raise' or 'mask', got 'skip'"):
        Frame(**parts(), on_invalid="skip")


def test_missing_layer_lists_those_present():
    with pytest.raises(FrameError, match="`depth` is needed and is missing; present: color, vel"):
        Frame(**parts()).require("depth")


def test_crop_stack_expand_and_move():
    frame = random_frame(8, 9)
    window = frame.crop(2, 3, 4, 5)
    assert torch.equal(window.color, frame.color[..., 2:6, 3:8])
    assert torch.equal(window.require("depth"), frame.require("depth")[..., 2:6, 3:8])
    with pytest.raises(FrameError, match=r"within the frame of 9x8, got 5x4 at \(5, 2\)"):
        frame.crop(2, 5, 4, 5)
    both = Frame.stack([frame, random_frame(8, 9, seed=1)])
    assert both.batch_size == 2
    with pytest.raises(FrameError, match="one size, got 9x7, 9x8"):
        Frame.stack([frame, random_frame(7, 9)])
    with pytest.raises(FrameError, match="at least one frame"):
        Frame.stack([])
    assert frame.expand(3).color.shape == (3, 3, 8, 9)
    with pytest.raises(FrameError, match="a batch of 2 cannot be expanded to 3"):
        both.expand(3)
    assert frame.to(dtype=torch.float64).require("depth").dtype == torch.float64


def test_optional_layers_travel_together():
    revealed = random_frame(8, 9, seed=3)
    ids = torch.arange(72).view(1, 1, 8, 9)
    base = random_frame(8, 9)
    frame = Frame(
        color=base.color, velocity=base.velocity, depth=base.depth, object_id=ids, revealed=revealed
    )
    window = frame.crop(1, 1, 3, 3)
    assert window.revealed is not None
    assert window.revealed.size == (3, 3)
    assert torch.equal(window.require("object_id"), ids[..., 1:4, 1:4])
    assert frame.to(dtype=torch.float64).require("object_id").dtype == torch.int64


@pytest.mark.parametrize("open_time", [-0.1, 8.5, float("nan")])
def test_shutter_range(open_time):
    with pytest.raises(FrameError, match=rf"`open` must lie in \[0, 8\] frames, got {open_time}"):
        Shutter(open_time)
    with pytest.raises(FrameError, match=r"`position` must be .*got 'middle'"):
        Shutter(0.5, "middle")


def test_shutter_from_exposure():
    assert Shutter.from_exposure(1 / 60, 300, "trailing") == Shutter(5.0, "trailing")
    assert Shutter.from_exposure(1 / 48, 24) == Shutter(0.5)
    assert Shutter.from_exposure(0, 24).interval == (0, 0)


@pytest.mark.parametrize(
    ("exposure", "rate", "message"),
    [
        (-0.1, 24, r"`exposure` must be at least 0 seconds, got -0.1"),
        (float("inf"), 24, r"`exposure` must be at least 0 seconds, got inf"),
        (0.1, 0, r"`frame_rate` must be above 0 frames per second, got 0"),
        (0.1, float("nan"), r"`frame_rate` must be above 0.*got nan"),
        (0.1, 100, r"at most 8 frames, got 10: 0.1 s at 100 frames per second"),
    ],
)
def test_bad_exposure_is_refused(exposure, rate, message):
    with pytest.raises(FrameError, match=message):
        Shutter.from_exposure(exposure, rate)
