"""What lies behind: against the same scene without the object in front."""

import pytest
import torch

from torchblur.errors import ConfigError
from torchblur.render import render_frame, render_revealed

SIZE = (36, 48)
LAYERS = ("color", "depth", "velocity", "normal", "object_id")
NOISE = {"kind": "noise", "size": 0.8, "color": [1, 0.5, 0.2], "background": [0, 0.1, 0.3]}
BALL = {"kind": "sphere", "radius": 0.8, "velocity": [0.3, 0, 0], "texture": NOISE}
WALL = {"kind": "plane", "position": [0, 0, -2], "velocity": [-0.2, 0.1, 0], "texture": NOISE}


def test_behind_a_sphere_is_the_scene_without_it(make_scene):
    camera = {"position": [0, 0, 4], "focal": 1.0, "spin": 3.0, "axis": [0, 1, 0]}
    scene = make_scene(BALL, WALL | {"object_id": 7}, camera=camera)
    bare = make_scene(WALL | {"object_id": 7}, camera=camera)
    front = render_frame(scene, SIZE, frame=0.5)
    is_ball = front.object_id == 1
    assert 200 < is_ball.sum() < 1000
    revealed = render_revealed(scene, SIZE, frame=0.5, color_spp=1)
    want = render_frame(bare, SIZE, frame=0.5, color_spp=1)
    assert torch.equal(revealed.hit, torch.ones_like(is_ball))  # behind the wall is the sky
    pixels = is_ball.expand(-1, 3, -1, -1)
    for name in ("color", "depth", "velocity", "normal", "object_id"):
        got, expected = getattr(revealed.frame, name), getattr(want, name)
        where = pixels[:, : got.shape[1]]
        torch.testing.assert_close(got[where], expected[where], atol=1e-5, rtol=1e-5)
    assert (revealed.frame.object_id[~is_ball] == 0).all()
    assert (revealed.layers[is_ball] == 2).all(), "the far side, then the wall"
    assert (revealed.layers[~is_ball] == 1).all()
    assert revealed.rays == SIZE[0] * SIZE[1] + int(revealed.layers.sum())
    assert revealed.color_rays == 0


def test_color_is_the_mean_over_the_pixel(make_scene):
    checker = {"kind": "checker", "size": 0.3, "color": [1, 1, 1], "background": [0, 0, 0]}
    wall = WALL | {"texture": checker, "rotation": [10, 20, 30]}
    scene, bare = make_scene(BALL, wall), make_scene(wall)
    is_ball = render_frame(scene, SIZE).object_id == 1
    revealed = render_revealed(scene, SIZE, mask=is_ball, color_spp=64, seed=5)
    want = render_frame(bare, SIZE, color_spp=64, seed=11).color
    where = is_ball.expand(-1, 3, -1, -1)
    error = (revealed.frame.color - want)[where]
    point = (render_frame(bare, SIZE, color_spp=1).color - want)[where]
    assert error.abs().mean() < 0.1 * point.abs().mean()
    assert error.abs().max() < 0.1
    inner = int(is_ball.sum())
    assert revealed.color_rays == pytest.approx(64 * 3 * inner, rel=0.03)  # fewer at the rim


def test_rays_only_where_the_mask_asks(make_scene):
    scene = make_scene(BALL, WALL)
    front = render_frame(scene, SIZE, color_spp=4, seed=3)
    mask = torch.zeros(1, 1, *SIZE, dtype=torch.bool)
    mask[..., 10:20, 15:30] = True
    revealed = render_revealed(scene, SIZE, mask=mask, color_spp=4, seed=3)
    assert torch.equal(revealed.hit, mask)
    assert revealed.rays == int(mask.sum()) + int(revealed.layers[mask].sum())
    assert not revealed.layers[~mask].any()
    for name in LAYERS:
        outside = ~mask.expand_as(getattr(front, name))
        assert torch.equal(getattr(revealed.frame, name)[outside], getattr(front, name)[outside])
    whole = render_revealed(scene, SIZE, color_spp=4, seed=3).frame.color
    inside = mask.expand(-1, 3, -1, -1)
    assert torch.equal(revealed.frame.color[inside], whole[inside]), "a mask changes no sample"
    nothing = render_revealed(scene, SIZE, mask=torch.zeros_like(mask), color_spp=4, seed=3)
    assert (nothing.rays, nothing.color_rays) == (0, 0)
    assert torch.equal(nothing.frame.color, front.color)


def test_layers_are_counted_and_end(make_scene, glow):
    """Three balls of one object behind each other have six surfaces; the wall is behind them."""
    balls = [
        {"kind": "sphere", "radius": 0.3, "position": [0, 0, z]} | glow(1, 0, 0) for z in (1, 0, -1)
    ]
    wall = {"kind": "plane", "position": [0, 0, -3], "object_id": 9} | glow(0, 0, 1)
    scene = make_scene({"kind": "group", "object_id": 4, "bodies": balls}, wall)
    middle = (..., SIZE[0] // 2, SIZE[1] // 2)
    for most in (1, 5, 6, 9):
        revealed = render_revealed(scene, SIZE, max_layers=most, color_spp=1)
        assert bool(revealed.hit[middle]) is (most >= 6)
        assert int(revealed.layers[middle]) == min(most, 6)
        assert int(revealed.frame.object_id[middle]) == (9 if most >= 6 else 4)
        if most < 6:  # nothing found: the frame itself
            assert revealed.frame.color[0, :, SIZE[0] // 2, SIZE[1] // 2].tolist() == [1, 0, 0]


def test_luminance_stops_where_the_color_changes(make_scene, glow):
    ball = {"kind": "sphere", "radius": 0.5} | glow(0.5, 0.5, 0.5)
    wall = {"kind": "plane", "position": [0, 0, -2], "object_id": 9} | glow(0.2, 0.2, 0.2)
    middle = (..., SIZE[0] // 2, SIZE[1] // 2)
    scene = make_scene(ball, wall)
    revealed = render_revealed(scene, SIZE, by="luminance", color_spp=4)
    assert bool(revealed.hit[middle])
    assert int(revealed.frame.object_id[middle]) == 9
    assert revealed.frame.color[0, :, SIZE[0] // 2, SIZE[1] // 2].tolist() == pytest.approx(
        [0.2] * 3
    )
    strict = render_revealed(scene, SIZE, by="luminance", threshold=0.4, color_spp=1)
    assert not bool(strict.hit[middle])


def test_luminance_does_not_see_an_object_of_equal_luminance(make_scene, glow):
    """The limitation that the paper names itself (section 5.3)."""
    green = 0.2126 / 0.7152
    ball = {"kind": "sphere", "radius": 0.5} | glow(1, 0, 0)
    wall = {"kind": "plane", "position": [0, 0, -2], "object_id": 9} | glow(0, green, 0)
    scene = make_scene(ball, wall, sky={"kind": "solid", "color": [0, 0, 0]})
    middle = (..., SIZE[0] // 2, SIZE[1] // 2)
    by_luminance = render_revealed(scene, SIZE, by="luminance", color_spp=1)
    assert int(by_luminance.frame.object_id[middle]) == 0, "it went through the wall to the sky"
    by_id = render_revealed(scene, SIZE, color_spp=1)
    assert int(by_id.frame.object_id[middle]) == 9


def test_luminance_stops_at_the_far_side_of_a_lit_object(make_scene):
    ball = {"kind": "sphere", "radius": 0.8, "texture": NOISE}
    revealed = render_revealed(make_scene(ball, WALL), SIZE, by="luminance", color_spp=1)
    middle = (..., SIZE[0] // 2, SIZE[1] // 2)
    assert bool(revealed.hit[middle])
    assert int(revealed.frame.object_id[middle]) == 1
    assert int(revealed.layers[middle]) == 1


def test_nothing_is_behind_the_sky(make_scene, glow):
    scene = make_scene({"kind": "sphere", "radius": 0.5} | glow(1, 1, 1))
    revealed = render_revealed(scene, SIZE, color_spp=1)
    front = render_frame(scene, SIZE, color_spp=1)
    assert torch.equal(revealed.hit, front.object_id == 1)
    assert torch.isinf(revealed.frame.depth).all()
    assert not revealed.layers[front.object_id == 0].any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mask": torch.ones(1, 1, *SIZE)}, "`mask` must be of type bool, got torch.float32"),
        (
            {"mask": torch.ones(1, 1, 4, 4).bool()},
            r"`mask` must have shape \(1, 1, 36, 48\).*got \(1, 1, 4, 4\)",
        ),
        ({"by": "depth"}, "`by` must be 'id' or 'luminance', got 'depth'"),
        ({"threshold": -1.0}, "`threshold` must be at least 0, got -1.0"),
        ({"max_layers": 0}, "`max_layers` must be an integer of at least 1, got 0"),
        ({"color_spp": 0}, "`color_spp` must be an integer of at least 1, got 0"),
        ({"frame": float("nan")}, "`frame` must be a finite number, got nan"),
    ],
)
def test_bad_arguments_are_refused(make_scene, glow, arguments, message):
    scene = make_scene({"kind": "sphere", "radius": 0.5} | glow(1, 1, 1))
    with pytest.raises(ConfigError, match=message):
        render_revealed(scene, SIZE, **arguments)
