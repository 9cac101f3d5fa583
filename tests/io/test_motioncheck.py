"""Blur that is there already, and signs that are wrong: on made-up images and on real frames."""

import pytest
import torch
import torch.nn.functional as F

from torchblur.frame import Shutter
from torchblur.io.frames import read_frame, read_image
from torchblur.io.motioncheck import check_blur, compare_signs
from torchblur.io.sequences import find_frames


def texture(height=96, width=128):
    """Blocks and stripes of random color: edges in both directions."""
    coarse = F.interpolate(torch.rand(1, 3, height // 8, width // 8), size=(height, width))
    return 0.5 * coarse + 0.5 * torch.rand(1, 3, 1, width // 4).repeat_interleave(4, dim=3)


def moving(color, x, y):
    return torch.tensor([float(x), float(y)])[None, :, None, None].expand(1, 2, *color.shape[2:])


def box_blur(color, x, y, start=-0.25, end=0.25, taps=33):
    """Blur by whole and half pixels along (x, y), with plain shifts of a periodic image."""
    total = torch.zeros_like(color)
    for i in range(taps):
        t = start + (i + 0.5) / taps * (end - start)
        total += torch.roll(color, (round(y * t), round(x * t)), dims=(2, 3))
    return total / taps


@pytest.mark.parametrize(("x", "y"), [(32, 0), (0, 32), (24, -24)])
def test_blur_is_told_from_sharp_in_any_direction(x, y):
    color = texture()
    assert check_blur(color, moving(color, x, y)).blurred is False
    assert check_blur(box_blur(color, x, y), moving(color, x, y)).blurred is True


def test_a_soft_lens_is_no_motion_blur():
    color = F.avg_pool2d(F.pad(texture(), (4, 4, 4, 4), mode="replicate"), 9, stride=1)
    assert check_blur(color, moving(color, 30, 0)).blurred is False


def test_stripes_along_the_motion_are_no_motion_blur():
    stripes = torch.rand(1, 3, 24, 1).repeat_interleave(4, dim=2).expand(1, 3, 96, 128)
    assert check_blur(stripes, moving(stripes, 30, 0)).blurred is not True


def test_antialiased_edges_before_fine_stripes_are_no_motion_blur():
    """Smoother along the motion than across, but not so smooth as a blur."""
    blocks = torch.rand(1, 3, 96, 16).repeat_interleave(8, dim=3)
    color = F.avg_pool2d(blocks, (1, 2), stride=1)
    check = check_blur(color, moving(color, 30, 0))
    assert check.along < 0.3 * check.across
    assert check.blurred is False


def test_no_verdict_without_fast_motion_or_texture():
    color = texture()
    assert check_blur(color, moving(color, 8, 0)).blurred is None
    flat = torch.full_like(color, 0.3)
    assert check_blur(flat, moving(flat, 40, 0)).blurred is None


@pytest.mark.parametrize("shutter", [Shutter(0.5), Shutter(0.5, "trailing")])
def test_the_right_signs_win(shutter):
    color = texture()
    start, end = shutter.interval
    reference = box_blur(color, 24, -12, start, end)
    right = moving(color, 24, -12)
    for change, velocity in {
        "as read": right,
        "y negated": right * torch.tensor([1.0, -1.0])[:, None, None],
        "x and y swapped": right.flip(1),
    }.items():
        matches = compare_signs(color, velocity, reference, shutter)
        psnr = {match.change: match.psnr for match in matches}
        assert len(psnr) == 9
        assert psnr[change] == pytest.approx(matches[0].psnr, abs=1e-3)
        assert psnr[change] > psnr["not blurred"] + 3
    alike = [m.change for m in compare_signs(color, right, reference, shutter)[:2]]
    psnr = {m.change: m.psnr for m in compare_signs(color, right, reference, shutter)}
    if shutter.position == "centered":
        assert set(alike) == {"as read", "x and y negated"}
        assert psnr["as read"] == pytest.approx(psnr["x and y negated"], abs=1e-3)
    else:
        assert alike[0] == "as read"
        assert psnr["as read"] > psnr["x and y negated"] + 1


@pytest.mark.shared
def test_blur_check_on_frames_of_another_renderer(shared_data):
    """All sharp frames pass, all references in their place are caught: 27 of 27 each."""
    pairs = []
    for case in ("vase", "fan", "weapon", "cars", "approach"):
        frame = read_frame(shared_data / case)
        pairs += [(frame, p) for p in sorted((shared_data / case).glob("reference*.exr"))]
    for place in ("walk_sequence", "walk_stream/center.####.exr"):
        pairs += [(read_frame(f), f.reference) for f in find_frames(shared_data / place)]
    assert len(pairs) == 27
    alarms = [check_blur(frame.color, frame.velocity).blurred for frame, _ in pairs]
    hits = [check_blur(read_image(path), frame.velocity).blurred for frame, path in pairs]
    assert alarms == [False] * 27
    assert hits == [True] * 27


@pytest.mark.shared
def test_the_beachball_is_blurred_along_its_vectors_and_not_across(shared_data):
    frame = read_frame(shared_data / "beachball" / "multipart.0001.exr")
    window = frame.crop(245, 654, 876, 877)
    assert check_blur(window.color, window.velocity).blurred is True
    flipped = window.velocity * torch.tensor([1.0, -1.0])[:, None, None]
    check = check_blur(window.color, flipped)
    assert check.blurred is False
    assert check.along > 1.2 * check.across
