"""Means over masks, and the band of moving borders."""

import math

import OpenEXR
import pytest
import torch

from torchblur.errors import FrameError
from torchblur.frame import Frame, Shutter
from torchblur.metrics import border_band, flip_ldr, masked_mean

HALF_OPEN = Shutter(0.5)


class TestMaskedMean:
    def test_by_hand(self):
        values = torch.arange(8.0).view(2, 1, 2, 2)
        mask = torch.tensor([[True, False], [True, True]]).expand(1, 1, 2, 2)
        torch.testing.assert_close(masked_mean(values), torch.tensor([1.5, 5.5]))
        torch.testing.assert_close(masked_mean(values, mask), torch.tensor([5 / 3, 17 / 3]))

    def test_counts_each_channel(self):
        values = torch.stack([torch.zeros(2, 2), torch.ones(2, 2)])[None]
        assert float(masked_mean(values, torch.ones(1, 1, 2, 2))) == 0.5

    def test_weights(self):
        values = torch.tensor([1.0, 3.0]).view(1, 1, 1, 2)
        weights = torch.tensor([3.0, 1.0]).view(1, 1, 1, 2)
        assert float(masked_mean(values, weights)) == 1.5

    def test_ignores_nan_outside(self):
        values = torch.tensor([1.0, math.nan]).view(1, 1, 1, 2).requires_grad_()
        mean = masked_mean(values, torch.tensor([True, False]).view(1, 1, 1, 2))
        mean.sum().backward()
        assert mean.tolist() == [1.0]
        assert values.grad.flatten().tolist() == [1.0, 0.0]

    def test_empty_mask_is_nan_with_zero_gradient(self):
        values = torch.ones(2, 1, 2, 2, requires_grad=True)
        mask = torch.zeros(2, 1, 2, 2, dtype=torch.bool)
        mask[1] = True
        mean = masked_mean(values, mask)
        assert math.isnan(mean[0].item())
        assert mean[1].item() == 1.0
        mean.sum().backward()
        assert values.grad[0].abs().max() == 0

    def test_gradient_to_the_weights(self):
        values = torch.tensor([1.0, 3.0]).view(1, 1, 1, 2).expand(2, 1, 1, 2)
        weights = torch.tensor([[0.5, 0.5], [0.0, 0.0]]).view(2, 1, 1, 2).requires_grad_()
        masked_mean(values, weights).sum().backward()
        assert weights.grad.flatten().tolist() == [-1.0, 1.0, 0.0, 0.0]

    def test_refuses_bad_masks(self):
        values = torch.ones(2, 3, 4, 5)
        with pytest.raises(FrameError, match=r"`mask` must have shape \(2, 1, 4, 5\).*\(3, 1, 4,"):
            masked_mean(values, torch.ones(3, 1, 4, 5))
        with pytest.raises(FrameError, match=r"`mask` must be bool or weights >= 0, got -1"):
            masked_mean(values, -torch.ones(2, 1, 4, 5))
        with pytest.raises(FrameError, match=r"`mask` must be bool or weights >= 0, got nan"):
            masked_mean(values, torch.full((2, 1, 4, 5), math.nan))


SQUARE = (slice(20, 30), slice(25, 40))  # rows, columns
SIZE = (50, 70)


def square_frame(velocity, background=(0.0, 0.0), ids=True, depth=None, **layers):
    """A near square before a far background, each with one velocity."""
    inside = torch.zeros(1, 1, *SIZE, dtype=torch.bool)
    inside[0, 0][SQUARE] = True
    motion = torch.where(
        inside, torch.tensor(velocity).view(1, 2, 1, 1), torch.tensor(background).view(1, 2, 1, 1)
    )
    return Frame(
        color=torch.zeros(1, 3, *SIZE),
        velocity=motion,
        object_id=inside.long() if ids else None,
        depth=torch.where(inside, 2.0, 10.0) if depth is None else depth,
        **layers,
    )


def rows_and_columns(band, row, column):
    """Columns of the band in a row, and rows of it in a column."""
    return band[0, 0, row].nonzero().flatten().tolist(), band[
        0, 0, :, column
    ].nonzero().flatten().tolist()


def span(first, last):
    return list(range(first, last + 1))


class TestBorderBand:
    @pytest.mark.parametrize("ids", [True, False])
    @pytest.mark.parametrize("margin", [0, 2])
    @pytest.mark.parametrize("speed", [16.0, 15.0])
    def test_moving_square_by_hand(self, ids, margin, speed):
        # 16 px/frame and a shutter of half a frame: the vertical edges sweep 4 px to both sides.
        # A border is two pixels wide, one on each side, before it moves. 3.75 px round to 4.
        band = border_band(square_frame((speed, 0.0), ids=ids), HALF_OPEN, margin=margin)
        columns, rows = rows_and_columns(band, 25, 32)
        reach = 4 + margin
        assert columns == span(24 - reach, 25 + reach) + span(39 - reach, 40 + reach)
        assert rows == span(19 - margin, 20 + margin) + span(29 - margin, 30 + margin)

    def test_leading_shutter_lies_ahead(self):
        frame = square_frame((16.0, 0.0))
        columns, _ = rows_and_columns(border_band(frame, Shutter(0.5, "leading"), margin=0), 25, 32)
        assert columns == span(24, 25 + 8) + span(39, 40 + 8)

    def test_vertical_motion_is_the_transpose(self):
        _, rows = rows_and_columns(
            border_band(square_frame((0.0, -16.0)), HALF_OPEN, margin=0), 25, 32
        )
        # 10 rows: the sweeps of both edges meet.
        assert rows == span(19 - 4, 30 + 4)

    def test_moving_background_of_a_still_square(self):
        band = border_band(square_frame((0.0, 0.0), (16.0, 0.0)), HALF_OPEN, margin=0)
        columns, _ = rows_and_columns(band, 25, 32)
        assert columns == span(24 - 4, 25 + 4) + span(39 - 4, 40 + 4)

    def test_diagonal_motion_sweeps_a_line_not_a_box(self):
        band = border_band(square_frame((16.0, 16.0)), HALF_OPEN, margin=0)
        assert band[0, 0, 20 - 4, 25 - 4]
        assert not band[0, 0, 30 + 3, 25 - 3]  # beside the lower left corner

    def test_acceleration_bends_the_path(self):
        acceleration = torch.zeros(1, 2, *SIZE)
        acceleration[:, 1] = 64.0  # 64 * 0.25² / 2 = 2 px down at both ends
        straight = border_band(square_frame((16.0, 0.0)), HALF_OPEN, margin=0)
        bent = border_band(
            square_frame((16.0, 0.0), acceleration=acceleration), HALF_OPEN, margin=0
        )
        assert bent[0, 0, 29 + 2, 40 + 4]
        assert not straight[0, 0, 29 + 2, 40 + 4]
        assert rows_and_columns(bent, 25, 32)[1] == span(19, 20 + 2) + span(29, 30 + 2)

    @pytest.mark.parametrize("ids", [True, False])
    def test_nothing_moves(self, ids):
        assert not border_band(square_frame((0.0, 0.0), ids=ids), HALF_OPEN).any()
        assert not border_band(square_frame((0.9, 0.0), ids=ids), HALF_OPEN).any()  # 0.45 px
        assert not border_band(square_frame((16.0, 0.0), ids=ids), Shutter(0.0), min_blur=0.0).any()

    def test_velocity_jump_without_depth(self):
        frame = square_frame((16.0, 0.0), ids=False)
        bare = Frame(color=frame.color, velocity=frame.velocity)
        expected = border_band(square_frame((16.0, 0.0)), HALF_OPEN)
        assert torch.equal(border_band(bare, HALF_OPEN), expected)

    def test_equal_depth_and_velocity_is_no_border(self):
        frame = square_frame(
            (16.0, 0.0), (16.0, 0.0), ids=False, depth=torch.full((1, 1, *SIZE), 2.0)
        )
        assert not border_band(frame, HALF_OPEN).any()

    def test_grazing_plane_is_no_border_but_for_its_horizon(self):
        # 1/z of a floor is linear in the row: next to the horizon, neighbors differ by half.
        inverse = (torch.arange(SIZE[0]) - 9.0).clamp_min(0).view(1, 1, -1, 1).expand(1, 1, *SIZE)
        depth = torch.where(inverse > 0, 20 / inverse, math.inf)
        moving = {"velocity": (16.0, 0.0), "background": (16.0, 0.0), "ids": False}
        band = border_band(square_frame(**moving, depth=depth), HALF_OPEN, margin=0)
        assert rows_and_columns(band, 40, 33) == ([], [9, 10])  # the horizon against the sky
        pole = depth.clone()
        pole[..., 33] = 0.3  # one pixel wide, before the floor
        band = border_band(square_frame(**moving, depth=pole), HALF_OPEN, margin=0)
        columns, _ = rows_and_columns(band, 40, 33)
        assert columns == span(32 - 4, 34 + 4)

    def test_batch_equals_single_runs(self):
        frames = [square_frame((16.0, 0.0)), square_frame((0.0, 5.0), (3.0, 0.0))]
        together = border_band(Frame.stack(frames), HALF_OPEN)
        assert torch.equal(together, torch.cat([border_band(f, HALF_OPEN) for f in frames]))

    def test_sweeps_stop_at_the_image(self):
        frame = square_frame((400.0, 0.0))
        columns, _ = rows_and_columns(border_band(frame, HALF_OPEN), 25, 32)
        assert columns == span(0, SIZE[1] - 1)

    def test_sweeps_do_not_enter_on_the_other_side(self):
        band = border_band(square_frame((0.0, -60.0)), Shutter(0.5, "leading"), margin=0)
        assert rows_and_columns(band, 25, 32)[1] == span(0, 30)

    def test_one_pixel_frame(self):
        frame = Frame(color=torch.zeros(1, 3, 1, 1), velocity=torch.ones(1, 2, 1, 1) * 9)
        assert not border_band(frame, HALF_OPEN).any()

    def test_refusals(self):
        frame = square_frame((16.0, 0.0))
        with pytest.raises(FrameError, match=r"`margin` must lie in \[0, 256\] px, got -1"):
            border_band(frame, HALF_OPEN, margin=-1)
        with pytest.raises(FrameError, match=r"`min_blur` must be at least 0 px, got -2"):
            border_band(frame, HALF_OPEN, min_blur=-2)
        with pytest.raises(FrameError, match=r"`depth_jump` must be above 0, got 0"):
            border_band(frame, HALF_OPEN, depth_jump=0)


@pytest.mark.shared
def test_band_of_a_real_frame_holds_the_blur_of_the_vase(shared_data):
    frame, reference = read_vase(shared_data / "vase")
    band = border_band(frame, HALF_OPEN)
    error = flip_ldr(frame.color, reference)
    assert 0.03 < float(band.float().mean()) < 0.08  # a silhouette, not the frame
    assert float(masked_mean(error, band)) > 15 * float(masked_mean(error, ~band))
    bare = Frame(color=frame.color, velocity=frame.velocity, depth=frame.depth)
    from_depth = border_band(bare, HALF_OPEN)
    overlap = float((band & from_depth).sum()) / float((band | from_depth).sum())
    assert overlap > 0.95


def read_vase(folder):
    sharp, passes, blurred = (
        read_channels(folder / f"{name}.exr") for name in ("sharp", "gbuffer", "reference")
    )
    frame = Frame(
        color=torch.stack([sharp[f"Combined.{c}"] for c in "RGB"])[None],
        velocity=torch.stack([-passes["Vector.Z"], passes["Vector.W"]])[None],
        depth=passes["Depth.Z"][None, None],
        object_id=passes["IndexOB.X"][None, None].long(),
    )
    return frame, torch.stack([blurred[c] for c in "RGB"])[None]


def read_channels(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {
            name.removeprefix("ViewLayer."): torch.from_numpy(channel.pixels).float()
            for name, channel in file.channels().items()
        }
