"""Patterns at points where their definition tells the color, and the shares they cover."""

import math

import pytest
import torch

from torchblur.params import Config, build
from torchblur.render import render_frame
from torchblur.render.textures import TABLE_WIDTH, Texture, _hash


class Holder(Config):
    texture: Texture


FRONT, BACK = [1.0, 0.5, 0.25], [0.0, 0.1, 0.2]


def paint(point, kind, **fields):
    """Whether the front color is at points (N, 3), or the colors if they are neither."""
    data = {"kind": kind, "color": FRONT, "background": BACK} | fields
    texture = build(Holder, {"texture": data}).texture
    row = [torch.tensor(v, dtype=torch.float64) for v in texture.row()]
    assert len(row) <= TABLE_WIDTH
    row += [torch.zeros((), dtype=torch.float64)] * (TABLE_WIDTH - len(row))
    return torch.stack(texture.paint(torch.as_tensor(point).double().unbind(1), row), 1)


def is_front(point, kind, **fields):
    color = paint(point, kind, **fields)
    front = (color == torch.tensor(FRONT, dtype=torch.float64)).all(1)
    back = (color == torch.tensor(BACK, dtype=torch.float64)).all(1)
    assert bool((front ^ back).all())
    return front.tolist()


def test_solid_is_its_color():
    texture = build(Holder, {"texture": {"kind": "solid", "color": [1, 2, 3]}}).texture
    assert texture.row() == [1, 2, 3]


def test_cells_are_centered_on_the_origin_and_alternate():
    points = [
        [0, 0, 0],
        [0.24, -0.24, 0],
        [0.26, 0, 0],
        [0.5, 0.5, 0],
        [0.5, 0.5, 0.5],
        [-0.5, 0, 0],
    ]
    expected = [True, True, False, True, False, False]
    assert is_front(points, "checker", size=0.5) == expected
    shifted = [[x + 0.1, y + 0.2, z - 7] for x, y, z in points]
    assert is_front(shifted, "checker", size=0.5, offset=[0.1, 0.2, -7]) == expected


def test_stripes_run_across_their_direction():
    points = [[0, 9, 9], [0.9, 0, 0], [1.1, 0, 0], [3.1, 5, 0], [-1.1, 0, 0]]
    expected = [True, True, False, True, False]
    assert is_front(points, "stripes", size=2.0, direction=[5, 0, 0]) == expected


def test_dots_are_balls_in_a_lattice():
    points = [[0, 0, 0], [0.9, 0, 0], [1.1, 0, 0], [4, 8, -4], [2, 2, 2], [4, 0.8, 0.8]]
    assert is_front(points, "dots", spacing=4.0, radius=0.25) == [
        True,
        True,
        False,
        True,
        False,
        False,
    ]
    some = torch.rand(20_000, 3) * 4
    share = sum(is_front(some, "dots", spacing=4.0, radius=0.25)) / 20_000
    assert share == pytest.approx(4 / 3 * math.pi * 0.25**3, abs=0.01)


def test_crosses_are_three_bars():
    points = [
        [0, 0, 0],
        [2.9, 0.4, 0.4],
        [3.1, 0, 0],
        [0, 2.9, 0],
        [0, 0, -2.9],
        [1, 1, 0],
        [10, 0, 2],
    ]
    expected = [True, True, False, True, True, False, True]
    assert is_front(points, "crosses", spacing=10.0, length=0.6, width=0.1) == expected


def test_bricks_lie_in_running_bond():
    # Bricks of 2 by 1 with joints of 0.1 at their left and lower edges.
    points = [
        [1, 0.5, 0],
        [0.05, 0.5, 0],
        [1, 0.05, 0],
        [1.05, 1.5, 0],
        [0.05, 1.5, 0],
        [0, 0.5, 1],
    ]
    expected = [True, False, False, False, True, True]
    assert is_front(points, "brick", size=[2, 1], mortar=0.1) == expected


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_spokes_are_equal_sectors_about_their_axis(axis):
    angle = (torch.arange(3600) + 0.5) * math.tau / 3600
    plane = [torch.cos(angle), torch.sin(angle)]
    plane.insert("xyz".index(axis), torch.full_like(angle, 0.7))
    front = torch.tensor(is_front(torch.stack(plane, 1), "spokes", count=3, axis=axis))
    assert int((front != front.roll(1)).sum()) == 6
    assert float(front.double().mean()) == pytest.approx(0.5, abs=0.002)


def test_noise_is_smooth_varied_and_within_its_colors():
    line = torch.zeros(4000, 3)
    line[:, 0] = torch.linspace(0, 40, 4000)
    colors = paint(line, "noise", size=1.0)[:, 0]
    assert 0 <= colors.min() < 0.1
    assert 0.9 < colors.max() <= 1
    assert colors.diff().abs().max() < 0.2
    assert paint(line, "noise", size=1.0, contrast=0.1)[:, 0].std() < 0.05


def test_variation_darkens_cells_by_at_most_its_share():
    some = torch.rand(5000, 3) * 50
    plain, varied = (paint(some, "checker", size=1.0, variation=v) for v in (0.0, 0.4))
    ratio = (varied / plain)[plain[:, 0] > 0, 0]
    assert 0.6 <= ratio.min() < 0.65
    assert 0.95 < ratio.max() <= 1.0


def test_cell_numbers_are_uniform_and_exact_in_float32():
    cell = torch.randint(-5000, 5000, (3, 100_000))
    single, double = (_hash(*cell.to(t).unbind(0)) for t in (torch.float32, torch.float64))
    torch.testing.assert_close(single.double(), double, atol=1e-7, rtol=0)
    counts = torch.histc(double, 17, 0, 1)
    chi_square = float(((counts - 1e5 / 17) ** 2 / (1e5 / 17)).sum())
    assert chi_square < 60  # 16 degrees of freedom
    neighbors = torch.corrcoef(torch.stack((double, _hash(*(cell + 1).double().unbind(0)))))
    assert abs(float(neighbors[0, 1])) < 0.02


def test_face_on_the_border_of_cells_has_one_color(make_scene):
    """A face that lies where two layers meet shows the one below it, not a mix by rounding."""
    layers = {"kind": "stripes", "size": 1 / 3, "direction": [0, 0, 1], "color": FRONT}
    body = {"kind": "box", "size": [1.0] * 3, "rotation": [0, 10, 3], "position": [0.1, 0.2, 0.3]}
    texture = layers | {"background": BACK}
    frame = render_frame(make_scene(body | {"texture": texture, "emissive": True}), (60, 80))
    face = frame.color[0, :, 22:30, 38:46]
    assert torch.equal(face, face[:, :1, :1].expand_as(face))
    assert face[0, 0, 0] == 0.0, "the layer below the surface is the second one"
