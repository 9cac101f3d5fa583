"""The table of conventions at the head of `torchblur.frame`, executed."""

import pytest
import torch

from torchblur.filters import get_filter, list_filters
from torchblur.frame import Frame, Shutter
from torchblur.ops.gather import lookup
from torchblur.ops.velocity import half_velocity

# Filters of streams take no sharp frame: each pixel's time says where it is.
OF_SHARP_FRAMES = [name for name, kind in list_filters().items() if "time" not in kind.needs]

pytestmark = pytest.mark.filterwarnings("ignore:tan2022. no layer:UserWarning")


def dot_frame(velocity, x=20, y=10, height=21, width=41):
    """One bright pixel that moves alone; its velocity covers a small neighborhood."""
    color = torch.zeros(1, 3, height, width)
    color[..., y, x] = 1
    motion = torch.tensor(velocity).view(1, 2, 1, 1).expand(1, 2, height, width)
    return Frame(color=color, velocity=motion, depth=torch.ones(1, 1, height, width))


def center_of_light(image):
    light = image[0].sum(0)
    rows, columns = torch.meshgrid(*(torch.arange(n) + 0.5 for n in light.shape), indexing="ij")
    return float((light * columns).sum() / light.sum()), float((light * rows).sum() / light.sum())


@pytest.mark.parametrize("name", OF_SHARP_FRAMES)
def test_velocity_is_in_px_per_frame_x_right_y_down_forward_in_time(name):
    # A leading shutter opens at the frame: the light moves with the velocity, by half the open
    # time on average.
    for velocity in ((16.0, 0.0), (0.0, 12.0), (-16.0, 0.0), (9.0, -6.0)):
        blur = get_filter(name)(shutter=0.5, shutter_position="leading", num_samples=41)
        x, y = center_of_light(blur(dot_frame(velocity)).detach())
        assert x == pytest.approx(20.5 + velocity[0] / 4, abs=0.6)
        assert y == pytest.approx(10.5 + velocity[1] / 4, abs=0.6)


@pytest.mark.parametrize("name", OF_SHARP_FRAMES)
def test_centered_shutter_spreads_by_half_its_share_to_both_sides(name):
    blur = get_filter(name)(shutter=0.5, shutter_position="centered", num_samples=81)
    light = blur(dot_frame((32.0, 0.0))).detach()[0, 0, 10]
    lit = (light > 1e-4).nonzero().flatten()
    # V = 0.5 * 32 / 2 = 8 px to each side of the pixel at 20.
    assert abs(int(lit.min()) - 12) <= 1
    assert abs(int(lit.max()) - 28) <= 1


def test_half_spread():
    velocity = torch.tensor([32.0, -8.0]).view(1, 2, 1, 1)
    assert half_velocity(velocity, 0.5).flatten().tolist() == [8.0, -2.0]


def test_shutter_intervals():
    assert Shutter(0.5).interval == (-0.25, 0.25)
    assert Shutter(0.5, "leading").interval == (0.0, 0.5)
    assert Shutter(0.5, "trailing").interval == (-0.5, 0.0)
    assert Shutter.from_angle(180) == Shutter(0.5)


def test_pixel_centers_lie_at_one_half():
    texture = torch.arange(4.0).view(1, 1, 1, 4)
    zero = torch.zeros(1, 1, 1, 1)
    at = torch.tensor([0.0, 0.5, 3.0, 9.0, -2.0])
    read = [float(lookup(texture, zero + x, zero, "bilinear")) for x in at]
    # index 0 is the center of the first pixel, at x = 1/2; beyond the border it is replicated
    assert read == pytest.approx([0.0, 0.5, 3.0, 3.0, 0.0])


def test_larger_depth_is_farther():
    # A still far half lies before nothing: the near, fast half blurs over it, not the reverse.
    color = torch.zeros(1, 3, 9, 60)
    color[..., :30] = 1
    velocity = torch.zeros(1, 2, 9, 60)
    velocity[:, 0, :, :30] = 40
    depth = torch.full((1, 1, 9, 60), 10.0)
    depth[..., :30] = 1
    near = Frame(color=color, velocity=velocity, depth=depth)
    far = Frame(color=color, velocity=velocity, depth=11 - depth)
    for name in ("mcguire2012", "guertin2014"):
        blur = get_filter(name)(shutter=0.5, num_samples=41, noise="none", tile_size=20)
        spill = blur(near).detach()[0, 0, 4, 31:38].mean()
        hidden = blur(far).detach()[0, 0, 4, 31:38].mean()
        assert float(spill) > 0.15
        assert float(hidden) < 0.02


@pytest.mark.parametrize("background", [1e10, torch.inf])
@pytest.mark.parametrize("name", ["mcguire2012", "guertin2014"])
def test_background_is_a_large_depth_or_infinity(name, background):
    frame = dot_frame((16.0, 0.0))
    depth = torch.full_like(frame.require("depth"), background).requires_grad_()
    color = frame.color.clone().requires_grad_()
    blurred = get_filter(name)()(Frame(color=color, velocity=frame.velocity, depth=depth))
    blurred.square().sum().backward()
    assert bool(torch.isfinite(blurred).all())
    assert bool(torch.isfinite(color.grad).all())
    assert bool(torch.isfinite(depth.grad).all())
