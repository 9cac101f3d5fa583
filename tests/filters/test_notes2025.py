import pytest
import torch

from torchblur.filters.notes2025 import Notes2025Blur, notes2025
from torchblur.frame import Frame
from torchblur.testing.contract import FilterContract
from torchblur.testing.frames import moving_square, random_frame

ONE = {"directions": "one", "depth_level": 0.5, "direction_weights": False}
HALF = {"resolution": "half"}
GAPS = {"num_samples": 4, "shutter": 1.5}  # gaps of some pixels for the post-filter to fill
ALIKE = {"tile_size": 2, "shutter": 0.8, "directions": "one"}
SOFT = GAPS | {"post_acceptance": "soft"}


class TestNotes2025(FilterContract):
    filter_class = Notes2025Blur
    function = staticmethod(notes2025)
    plain = {"noise": "none", "mirror_filter": "strict"}
    acts_with = {
        "background_depth": {"background": "revealed"},
        "tile_jitter": {"tile_size": 8},
        "early_out": {"tile_size": 2},
        "relative_depth_range": {"depth_compare": "relative"},
        "seed": {"noise": "halton"},
        "direction_reduction": {"tile_size": 5},
        "secondary_exponent": {"tile_size": 8},
        "neighbor_culling": {"tile_size": 8},
        "min_angle": {"tile_size": 4},
        "tile_classes": ALIKE,
        "fast_ratio": ALIKE | {"tile_classes": True},
        "mirror_filter": {"velocity_encoding": "uint8"},  # the rules differ where speeds tie
        **{
            f"post_{name}": GAPS
            for name in ("filter", "samples", "radius", "alpha", "acceptance", "threshold")
        },
        "post_zero_alpha": GAPS,
        "post_edges": GAPS,
        "post_tau": SOFT,
        "post_center_weight": GAPS,
        "bilinear_min": {"tile_size": 2},
        "color_lookup": {"tile_size": 4},
        "downsample_depth_range": HALF,
        "upsample_depth_range": HALF,
        "upsample_depth_weights": HALF,
        "alpha_weighted_color": HALF,
        "corner_fallback": HALF | {"upsample_depth_range": 0.05},
        "alpha_fade": HALF,
        "fade_start": HALF,
        "fade_end": HALF,
        "fade_min_alpha": HALF,
    }


def two_layers(front=(0.0, 0.0), back=(0.0, 0.0), size=(40, 64), columns=(20, 30)):
    """A white bar at depth 1 before a dark background at depth 9; velocities in px/frame."""
    inside = torch.zeros(1, 1, *size, dtype=torch.bool)
    inside[..., columns[0] : columns[1]] = True
    motion = torch.where(
        inside, torch.tensor(front).view(1, 2, 1, 1), torch.tensor(back).view(1, 2, 1, 1)
    )
    noise = 0.1 * torch.rand(1, 3, *size)
    return Frame(
        color=torch.where(inside, 0.9 + noise, noise),
        velocity=motion,
        depth=torch.where(inside, 1.0, 9.0),
    )


def test_the_defaults_are_those_of_the_text():
    config = Notes2025Blur().config
    assert (config.num_samples, config.tile_size) == (6, 32)
    assert (config.direction_exponent, config.min_angle, config.depth_level) == (3.0, 5.0, 1.0)
    assert (config.area_slope, config.fade_start, config.fade_end) == (2.0, 1.0, 2.0)
    assert (config.fade_min_alpha, config.bilinear_min) == (0.5, 1.0)


# -- a sharp background keeps its resolution under a blurred foreground ----------------------------


@pytest.mark.parametrize("given", [{}, ONE], ids=["two", "one"])
@pytest.mark.parametrize("resolution", ["full", "half"])
def test_still_background_is_not_replaced_where_a_foreground_blurs_over_it(given, resolution):
    frame = two_layers(front=(24.0, 0.0))
    layers = Notes2025Blur(resolution=resolution, post_filter=False, **given).layers(frame)
    beside = layers["output_alpha"][0, 0, 20, 32:34].detach()
    assert 0.05 < float(beside.min()) <= float(beside.max()) < 0.8
    # The slides' form of the spread weight gives still pixels a background: always replaced.
    slides = Notes2025Blur(
        resolution=resolution, post_filter=False, spread_compare="slides", **ONE
    ).layers(frame)
    assert float(slides["output_alpha"][0, 0, 20, 32:34].detach().min()) > 0.9


def test_half_resolution_keeps_what_is_sharp():
    frame = two_layers(back=(24.0, 0.0))
    blurred = Notes2025Blur(**HALF)(frame).detach()
    assert torch.equal(blurred[..., 20:30], frame.color[..., 20:30])
    assert float(blurred[..., 10:20].max()) < 0.11  # nothing of the bar leaks out
    leaks = Notes2025Blur(**HALF, upsample_depth_weights=False)(frame).detach()
    assert float((leaks[..., 29] - frame.color[..., 29]).abs().mean()) > 0.05
    leaks = Notes2025Blur(**HALF, alpha_weighted_color=False)(frame).detach()
    assert float(leaks[..., 30].max()) > 0.15


def test_fade_keeps_slow_motion_at_full_resolution():
    frame = random_frame(40, 40)
    slow = Frame(
        color=frame.color,
        velocity=torch.ones_like(frame.velocity) * torch.tensor([4.0, 0.0]).view(1, 2, 1, 1),
        depth=torch.full_like(frame.require("depth"), 4.0),
    )
    alphas = {
        fade: Notes2025Blur(**HALF, alpha_fade=fade).layers(slow)["output_alpha"].detach()
        for fade in (True, False)
    }
    assert torch.allclose(alphas[False], torch.ones(()))
    assert torch.allclose(alphas[True], torch.tensor(0.5))  # V = 1 px


# -- alpha -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [{}, ONE], ids=["two", "one"])
def test_alpha_is_right_where_the_tile_is_twice_as_fast(given):
    # A bar of 10 px whose half spread is 4 px covers a pixel at distance d from its edge for
    # (4 - d) / 8 of the time. One pixel far off makes the tile twice as fast.
    frame = two_layers(front=(16.0, 0.0))
    velocity = frame.velocity.clone()
    velocity[0, 0, 0, 0] = 32.0
    frame = Frame(color=frame.color, velocity=velocity, depth=frame.depth)
    expected = (4 - (torch.arange(30, 34) + 0.5 - 30)) / 8
    errors = {}
    for accurate in (True, False):
        layers = Notes2025Blur(
            num_samples=144, noise="none", accurate_alpha=accurate, mirror_filter="none", **given
        ).layers(frame)
        alpha = layers["alpha"][0, 0, 24, 30:34].detach()
        errors[accurate] = float((alpha - expected).abs().mean())
    assert errors[True] < 0.07
    assert errors[False] > 2 * errors[True]


def test_few_taps_have_the_right_alpha_with_half_a_tap_of_spread_offset():
    # A tap stands for half a tap to both sides. With the slides' whole tap a blur reaches too far,
    # which the accurate alpha then scales up where the tile is faster.
    frame = two_layers(front=(32.0, 0.0))
    velocity = frame.velocity.clone()
    velocity[0, 0, 0, 0] = 44.0
    frame = Frame(color=frame.color, velocity=velocity, depth=frame.depth)
    coverage = {}
    for offset in (0.5, 1.0):
        blur = Notes2025Blur(mirror_filter="none", post_filter=False, spread_offset=offset)
        alpha = blur.layers(frame)["alpha"][0, 0, 20:36, 30:45].detach()
        coverage[offset] = float(alpha.mean())
    # The bar of 10 px covers (8 - d) / 16 at a distance d < 8 px: 32 / 16 px a row.
    expected = 2.0 / 15
    assert abs(coverage[0.5] - expected) < 0.35 * abs(coverage[1.0] - expected)


@pytest.mark.parametrize("given", [{}, ONE, ONE | {"separate_sums": False}])
def test_weights_and_alphas_lie_between_zero_and_one(given):
    for frame in (random_frame(), moving_square()):
        layers = Notes2025Blur(**given).layers(frame)
        for key in ("weight", "alpha", "output_alpha"):
            assert float(layers[key].detach().min()) >= 0
            assert float(layers[key].detach().max()) <= 1 + 1e-5
        assert float(layers["weight"].detach().max()) > 0.5


def test_separate_sums_keep_a_blurred_background_up_to_a_sharp_foreground():
    # Beside the still bar one sum goes back to the sharp color; two sums stay blurred.
    frame = two_layers(back=(24.0, 0.0))
    stripes = (torch.arange(64) // 2 % 2).float().view(1, 1, 1, 64).expand_as(frame.color)
    color = torch.where(frame.require("depth") < 2, frame.color, stripes)
    frame = Frame(color=color, velocity=frame.velocity, depth=frame.depth)
    beside = (..., slice(17, 20))
    remaining = {}
    for separate in (True, False):
        blurred = Notes2025Blur(**ONE, separate_sums=separate, num_samples=24)(frame).detach()
        remaining[separate] = float((blurred[beside] - 0.5).abs().mean())
    assert remaining[True] < 0.6 * remaining[False]


# -- directions ------------------------------------------------------------------------------------


def test_second_direction_blurs_a_background_that_moves_across():
    frame = two_layers(front=(0.0, 40.0), back=(24.0, 0.0), columns=(28, 36))
    reference = Frame(
        color=frame.color,
        velocity=torch.tensor([24.0, 0.0]).view(1, 2, 1, 1).expand_as(frame.velocity),
        depth=frame.depth,
    )
    stripes = (torch.arange(64) // 4 % 2).float().view(1, 1, 1, 64).expand_as(frame.color)
    color = torch.where(frame.require("depth") < 2, frame.color, stripes)
    frame, reference = (
        Frame(color=color, velocity=f.velocity, depth=f.depth) for f in (frame, reference)
    )
    away = (..., slice(8, 18))  # the tile of the bar, which is faster
    wanted = Notes2025Blur(noise="none")(reference).detach()[away]
    error = {
        name: float(
            (Notes2025Blur(noise="none", **given)(frame).detach()[away] - wanted).abs().mean()
        )
        for name, given in {"two": {}, "one": {"directions": "one"}}.items()
    }
    assert error["two"] < 0.3 * error["one"]


def test_a_skipped_second_direction_is_no_second_direction():
    frame = moving_square()
    skipped = Notes2025Blur(min_angle=90.0)(frame)
    assert torch.equal(skipped, Notes2025Blur(directions="one")(frame))
    assert not torch.allclose(skipped, Notes2025Blur()(frame), atol=1e-3)


def test_max_of_alphas_is_at_least_their_mean():
    frame = moving_square()
    largest, mean = (
        Notes2025Blur(alpha_combination=kind).layers(frame)["alpha"] for kind in ("max", "mean")
    )
    assert bool((largest >= mean - 1e-6).all())
    assert float((largest - mean).detach().mean()) > 0.01


# -- lookups and the post-filter -------------------------------------------------------------------


def test_opportunistic_is_bilinear_where_all_moves_and_nearest_where_not():
    moving, mixed = random_frame(speed=0.0), two_layers(front=(24.0, 0.0))
    moving = Frame(color=moving.color, velocity=moving.velocity + 20, depth=moving.depth)
    for frame, kind in ((moving, "bilinear"), (mixed, "nearest")):
        doubled = kind == "nearest"
        given = ONE | {"post_filter": False}
        expected = Notes2025Blur(
            color_lookup=kind, double_samples=False, num_samples=12 if doubled else 6, **given
        )
        assert torch.allclose(Notes2025Blur(**given)(frame), expected(frame), atol=1e-6)


def test_post_filter_fills_the_gaps():
    frame = two_layers(back=(60.0, 0.0), columns=(0, 1), size=(24, 120))
    speckled = (torch.rand(1, 1, 24, 120) < 0.1).float().expand_as(frame.color) * 20
    frame = Frame(color=speckled, velocity=frame.velocity, depth=frame.depth)
    inner = (..., slice(40, 80))
    exact = Notes2025Blur(num_samples=200, post_filter=False, **ONE)(frame).detach()[inner]
    error = {
        on: float(
            (Notes2025Blur(post_filter=on, **ONE)(frame).detach()[inner] - exact).abs().mean()
        )
        for on in (True, False)
    }
    assert error[True] < 0.8 * error[False]


def test_edge_handling_softens_the_outer_edge_of_a_blur():
    frame = two_layers(front=(56.0, 0.0))
    given = ONE | {"num_samples": 4, "double_samples": False, "noise": "none"}
    without = Notes2025Blur(post_filter=False, **given).layers(frame)
    outside = (without["alpha"] == 0) & (frame.require("depth") > 2)
    change = {}
    for edges in (True, False):
        difference = Notes2025Blur(post_edges=edges, **given)(frame) - without["color"]
        change[edges] = float(difference.detach().abs().amax(1, keepdim=True)[outside].mean())
    # Without it, samples that have an alpha count alone; with it, those that have none, too.
    assert 0 < change[True] < 0.8 * change[False]


def test_hard_thresholds_have_gradients_in_their_soft_form():
    frame = moving_square(dtype=torch.float64)
    blur = Notes2025Blur(**SOFT)
    value = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda v: blur(frame, post_zero_alpha=v), (value,), eps=1e-7, atol=1e-5, fast_mode=True
    )
    (grad,) = torch.autograd.grad(blur(frame, post_zero_alpha=value).square().mean(), value)
    assert float(grad.abs()) > 1e-6


def test_layers_for_debug_views():
    frame = moving_square()
    layers = Notes2025Blur(tile_size=8).layers(frame)
    assert layers["primary"].shape == layers["secondary"].shape == (1, 2, 3, 4)
    assert layers["alpha"].shape == layers["influence"].shape == (1, 1, 21, 27)
    half = Notes2025Blur(tile_size=8, **HALF).layers(frame)
    assert half["half_color"].shape == (1, 3, 11, 14)
    assert half["half_alpha"].shape == half["alpha"].shape == (1, 1, 11, 14)
    assert half["output_alpha"].shape == (1, 1, 21, 27)
    assert half["primary"].shape == (1, 2, 3, 4)


class TestHalfResolution:
    """What of the contract must hold at half resolution, too."""

    def test_constant_and_range(self):
        frame = random_frame(speed=30.0)
        blurred = Notes2025Blur(**HALF)(frame).detach()
        assert float(blurred.min()) >= float(frame.color.min()) - 1e-6
        assert float(blurred.max()) <= float(frame.color.max()) + 1e-6
        color = torch.full_like(frame.color, 3.0)
        frame = Frame(color=color, velocity=frame.velocity, depth=frame.depth)
        assert torch.allclose(Notes2025Blur(**HALF)(frame), color, rtol=1e-5)

    def test_no_motion_is_the_identity(self):
        frame = random_frame(speed=0.0)
        still = frame.map(lambda t: t * 0 if t.shape[1] == 2 else t)
        assert torch.equal(Notes2025Blur(**HALF)(still), still.color)

    @pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (13, 41)])
    def test_any_size(self, size):
        frame = random_frame(*size)
        assert Notes2025Blur(**HALF)(frame).shape == frame.color.shape

    def test_invalid_pixels_lend_no_color(self):
        frame = moving_square()
        valid = torch.ones_like(frame.color[:, :1], dtype=torch.bool)
        valid[..., 8:13, 8:13] = False
        masked = Frame(
            color=valid.expand_as(frame.color).float(),
            velocity=frame.velocity,
            depth=frame.depth,
            valid=valid,
        )
        for given in (HALF, HALF | ONE, {"separate_sums": False}):
            blurred = Notes2025Blur(**given)(masked)
            assert torch.allclose(blurred[valid.expand_as(blurred)], torch.ones(()), atol=1e-5)

    def test_gradcheck_of_the_layers(self):
        frame = moving_square(8, 10, dtype=torch.float64)
        blur = Notes2025Blur(noise="none", tile_size=10, **HALF)
        leaves = (frame.color, frame.velocity, frame.require("depth"))
        assert torch.autograd.gradcheck(
            lambda c, v, d: blur(Frame(color=c, velocity=v, depth=d)),
            [t.clone().requires_grad_() for t in leaves],
            eps=1e-7,
            atol=1e-5,
            rtol=1e-4,
            fast_mode=True,
        )


@pytest.mark.parametrize("level", [1.0, 0.5])
@pytest.mark.parametrize("directions", ["one", "two"])
def test_fast_tiles_are_the_full_ones_where_all_moves_alike(directions, level):
    # An optimization: at one depth and with one motion all weights are what the fast class takes.
    torch.manual_seed(3)
    color = torch.rand(1, 3, 40, 60)
    velocity = torch.tensor((13.0, -6.0)).view(1, 2, 1, 1).expand(1, 2, 40, 60)
    frame = Frame(color=color, velocity=velocity, depth=torch.full((1, 1, 40, 60), 5.0))
    params = {"directions": directions, "depth_level": level, "noise": "none"}
    full = Notes2025Blur(**params).layers(frame)
    fast = Notes2025Blur(**params, tile_classes=True).layers(frame)
    for key in ("color", "alpha", "output_alpha", "weight", "influence"):
        assert torch.allclose(fast[key], full[key], atol=1e-6), key
    # Alpha is the share of the foreground: the color is the same mean at any depths.
    apart = frame.replaced(depth=1 + 50 * torch.rand(1, 1, 40, 60))
    params["post_filter"] = False
    full, fast = (Notes2025Blur(**params, tile_classes=on).layers(apart) for on in (False, True))
    assert torch.allclose(fast["color"], full["color"], atol=1e-6)
    assert not torch.allclose(fast["alpha"], full["alpha"], atol=1e-2)


def test_fast_tiles_need_one_direction_of_motion():
    torch.manual_seed(3)
    velocity = torch.zeros(1, 2, 40, 60)
    velocity[:, 0, ::2], velocity[:, 1, 1::2] = 12.0, 12.0
    depth = torch.full((1, 1, 40, 60), 5.0)
    frame = Frame(color=torch.rand(1, 3, 40, 60), velocity=velocity, depth=depth)
    assert torch.equal(Notes2025Blur(tile_classes=True)(frame), Notes2025Blur()(frame))
    one = {"directions": "one"}
    assert not torch.allclose(
        Notes2025Blur(**one, tile_classes=True)(frame), Notes2025Blur(**one)(frame), atol=1e-3
    )


def test_directions_and_classes_cost_only_where_they_are_used(monkeypatch):
    from torchblur.ops import gather as gathers

    done = []
    plain = gathers.gather_lists

    def counted(tap, options, num_samples, lists, pixels, *args, **kwargs):
        done.append((tap.__name__, pixels.count))
        return plain(tap, options, num_samples, lists, pixels, *args, **kwargs)

    monkeypatch.setattr(gathers, "gather_lists", counted)
    frame = moving_square(40, 60)
    frame = frame.replaced(velocity=torch.full_like(frame.velocity, 9.0))
    with torch.no_grad():
        Notes2025Blur(post_filter=False)(frame)
        assert done == [("_pair", 2400), ("_pair", 0)]
        done.clear()
        Notes2025Blur(post_filter=False, tile_classes=True)(frame)
        assert done == [("_pair", 0), ("_plain_pair", 2400), ("_pair", 0)]
