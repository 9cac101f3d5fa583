import copy

import pytest
import torch
from post.effects import check_gradient, inside, numbers, slopes
from twins.fxaa import fxaa as fxaa_twin

from torchblur.errors import ConfigError, FrameError
from torchblur.ops.noise import checkerboard
from torchblur.params import choices, declared
from torchblur.post.fxaa import SEARCH_STEPS, Fxaa, FxaaConfig, fxaa, perceptual_luma


def noise(height=13, width=17, batch_size=1, dtype=torch.float64, seed=3):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch_size, 3, height, width, generator=generator, dtype=dtype)


def slanted(height=32, width=48, slope=6.0, dtype=torch.float64):
    """A hard edge that climbs one pixel in `slope`, dark above and bright below."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    below = y + 0.5 > height / 3 + (x + 0.5) / slope
    return torch.where(below, 0.9, 0.1).to(dtype).expand(1, 3, height, width)


def coverage(height=32, width=48, slope=6.0):
    """The same edge, each pixel by the share of it that lies below (64 samples a side)."""
    sub = (torch.arange(64) + 0.5) / 64
    y = torch.arange(height).view(-1, 1, 1, 1) + sub.view(1, 1, -1, 1)
    x = torch.arange(width).view(1, -1, 1, 1) + sub
    share = (y > height / 3 + x / slope).double().mean((2, 3))
    return (0.1 + 0.8 * share).expand(1, 3, height, width)


# -- what it does ------------------------------------------------------------------------------


@pytest.mark.parametrize(("subpix", "share"), [(0.75, 0.4115), (1.0, 0.5487)])
@pytest.mark.parametrize("quality", [10, 12, 39])
def test_checkerboard_of_luma_is_a_fixed_blur(subpix, share, quality):
    """Range 1, equal gradients, |lowpass - middle| = 2/3: smoothstep(2/3)² = 0.5487."""
    color = noise(20, 30)
    out = fxaa(color, checkerboard(color).double(), subpix=subpix, quality=quality)
    expected = (1 - share) * color[..., 1:, :] + share * color[..., :-1, :]
    inner = (..., slice(1, -1), slice(1, -1))  # the border replicates luma, not the board
    assert torch.allclose(out[..., 1:, :][inner], expected[inner], atol=5e-5)


@pytest.mark.parametrize("turn", [False, True], ids=["near a row", "near a column"])
def test_slanted_edge_comes_closer_to_its_coverage(turn):
    hard, exact = slanted(), coverage()
    if turn:
        hard, exact = hard.transpose(2, 3), exact.transpose(2, 3)
    smooth = fxaa(hard).detach()
    inner = (..., slice(4, -4), slice(4, -4))
    before = (hard - exact)[inner].square().mean().sqrt()
    after = (smooth - exact)[inner].square().mean().sqrt()
    assert float(after) < 0.6 * float(before)
    # Along the rows that the edge crosses, values now climb in steps smaller than the edge's.
    along = smooth.diff(dim=-2 if turn else -1)[inner].abs().amax()
    assert float(along) < 0.75 * 0.8


def test_straight_edge_and_flat_regions_are_untouched():
    flat = slanted(slope=1e9)
    assert torch.equal(fxaa(flat, subpix=0.0), flat)
    edge = slanted()
    out = fxaa(edge)
    far = torch.ones(32, 48, dtype=torch.bool)
    for x in range(48):
        far[int(32 / 3 + x / 6) - 2 : int(32 / 3 + x / 6) + 4, x] = False
    assert torch.equal(out[..., far], edge[..., far])
    assert not torch.equal(out, edge)


def test_contrast_below_the_threshold_is_untouched():
    color = 0.5 + 0.02 * noise()
    assert torch.equal(fxaa(color), color)
    assert not torch.equal(fxaa(color, threshold=0.0, threshold_min=0.0), color)


def test_luma_alone_decides_and_color_is_read_once():
    color, luma = noise(), perceptual_luma(noise(seed=8))
    both = fxaa(color, luma) + 3 * fxaa(color.flip(1), luma)
    assert torch.allclose(fxaa(color + 3 * color.flip(1), luma), both)  # linear in the color
    assert torch.equal(fxaa(color, torch.full_like(luma, 0.3)), color)
    assert torch.equal(fxaa(color), fxaa(color, perceptual_luma(color)))


def clear(luma):
    """Pixels whose edge is clearly along a row or clearly along a column."""
    second = torch.tensor([1.0, -2, 1], dtype=luma.dtype).view(1, 1, 3, 1)
    around = torch.nn.functional.pad(luma, (1, 1, 1, 1), mode="replicate")
    weights = torch.tensor([1.0, 2, 1], dtype=luma.dtype).view(1, 1, 1, 3)
    row, column = (
        torch.nn.functional.conv2d(torch.nn.functional.conv2d(plane, second).abs(), weights)
        for plane in (around, around.transpose(2, 3))
    )
    return (row - column.transpose(2, 3)).abs() > 1e-4


@pytest.mark.parametrize("kind", ["mirror_x", "mirror_y", "transpose"])
def test_symmetry(kind):
    """Under mirrors, and where row and column do not tie under the transpose (ties: the row)."""

    def moved(plane):
        if kind == "transpose":
            return plane.transpose(2, 3)
        return plane.flip(3 if kind == "mirror_x" else 2)

    color, luma = noise(24, 24), perceptual_luma(noise(24, 24, seed=5))
    for quality in (12, 39):
        out = fxaa(color, luma, quality=quality)
        same = ((fxaa(moved(color), moved(luma), quality=quality) - moved(out)).abs() < 1e-9).all(1)
        unclear = ~moved(clear(luma))[:, 0]
        assert bool(same.all() if kind != "transpose" else (same | unclear).all())
        assert float(unclear.double().mean()) < 0.2
    board = checkerboard(color).double()
    tied = fxaa(moved(color), moved(board))
    assert torch.allclose(tied, moved(fxaa(color, board))) is False


@pytest.mark.parametrize(
    "params",
    [
        {},
        {"subpix": 1.0, "threshold": 0.063},
        {"subpix": 0.0, "threshold_min": 0.3, "span_end": 0.5},
        {"quality": 39},
        {"search_steps": (2.0, 2.0, 2.0)},
        {"search_steps": (1.0,)},
        {"search_steps": (0.5, 1.0), "span_end": 0.6},
    ],
    ids=str,
)
@pytest.mark.parametrize("picture", ["noise", "slanted", "lines"])
def test_agrees_with_its_twin(params, picture):
    color = {"noise": noise(), "slanted": slanted(16, 20), "lines": slanted(16, 20, 1.3)}[picture]
    color = color + 0.05 * noise(*color.shape[2:])
    luma = perceptual_luma(color)
    steps = params.get("search_steps") or SEARCH_STEPS[params.get("quality", 12)]
    plain = {k: v for k, v in params.items() if k not in ("quality", "search_steps")}
    expected = fxaa_twin(color[0].numpy(), luma[0, 0].numpy(), steps=steps, **plain)
    out = fxaa(color, luma, **params)[0]
    assert torch.allclose(out, torch.from_numpy(expected), atol=1e-7)  # float32 parameters
    if "threshold_min" not in params:
        assert not torch.allclose(out, color[0], atol=0.02)


# -- gradients ---------------------------------------------------------------------------------


def test_gradcheck_of_color_and_luma():
    color, luma = noise(7, 8), perceptual_luma(noise(7, 8, seed=6))
    blur = Fxaa(softness=0.3)
    leaves = (color.clone().requires_grad_(), luma.clone().requires_grad_())
    assert torch.autograd.gradcheck(blur, leaves, eps=1e-7, atol=1e-5, fast_mode=True)
    for leaf in leaves:
        (grad,) = torch.autograd.grad(blur(*leaves).square().sum(), leaf)
        assert float(grad.abs().sum()) > 0.1


def test_smooth_parameters_and_thresholds_in_their_soft_form():
    color = noise()
    for name, spec in numbers(Fxaa, "smooth").items():
        check_gradient(lambda v, n=name: Fxaa()(color, **{n: v}), inside(spec, 0.75))
    for name in ("threshold", "threshold_min", "softness"):
        start = {"threshold": 0.3, "threshold_min": 0.25, "softness": 0.3}
        if name == "threshold_min":
            start["threshold"] = 0.0
        value = torch.tensor(start.pop(name), dtype=torch.float64)
        check_gradient(lambda v, n=name, s=start: Fxaa(**s)(color, **{n: v}), value)


def test_weak_parameters_act_where_autograd_is_wrong():
    color = noise(40, 40)
    for name, spec in numbers(Fxaa, "weak").items():
        start = {"threshold": 0.0} if name == "threshold_min" else {}
        start |= {"subpix": 0.0} if name == "span_end" else {}
        effect = Fxaa(**start)
        slope, difference = slopes(
            lambda v, n=name, e=effect: e(color, **{n: v}), spec, getattr(effect.config, name)
        )
        if name == "softness":  # right where it is on; off at its default, where nothing fades
            continue
        assert difference != 0, f"{name} does nothing"
        assert abs(slope - difference) > 0.05 * abs(difference), name


def test_gradients_are_finite_on_flat_and_black_pictures():
    for value in (0.0, 0.5, 1.0):
        color = torch.full((1, 3, 6, 7), value, requires_grad=True)
        effect = Fxaa(threshold=0.0, threshold_min=0.0, softness=0.1)
        out = effect(color)
        out.sum().backward()
        assert torch.equal(out, color)
        assert bool(torch.isfinite(color.grad).all())
        assert bool(torch.isfinite(effect.subpix.grad).all())


# -- one source, batches, types ----------------------------------------------------------------


def other_values():
    for name, spec in declared(FxaaConfig).items():
        default = FxaaConfig.model_fields[name].default
        if name == "search_steps":
            yield name, (1.0, 3.0)
        elif spec.low is None:
            yield from ((name, c) for c in choices(FxaaConfig, name) if c != default)
        else:
            yield name, round(float(inside(spec, default, 0.2)), 6)


def test_module_equals_function_and_every_parameter_acts():
    color = slanted(24, 60, 20.0) + 0.3 * noise(24, 60)
    for name, value in other_values():
        given = {"threshold": 0.0, "subpix": 0.1} if name != "threshold" else {}
        plain = Fxaa(**given)(color)
        given |= {name: value}
        assert torch.equal(fxaa(color, **given), Fxaa(**given)(color)), name
        assert torch.equal(fxaa(color, config=FxaaConfig(**given)), Fxaa(**given)(color)), name
        if name != "quality":
            assert not torch.equal(Fxaa(**given)(color), plain), name
        again = eval(repr(Fxaa(**given)), {"Fxaa": Fxaa})
        assert again.config == FxaaConfig(**given)
    lengths = {sum(SEARCH_STEPS[q]) for q in choices(FxaaConfig, "quality")}
    assert len(lengths) > 8
    assert set(SEARCH_STEPS) == set(choices(FxaaConfig, "quality"))
    assert not torch.equal(fxaa(slanted(slope=20.0), quality=10), fxaa(slanted(slope=20.0)))


def test_batches_of_pictures_and_of_parameters():
    colors = noise(batch_size=3)
    single = torch.cat([fxaa(color[None]) for color in colors])
    assert torch.equal(fxaa(colors), single)
    subpix = torch.tensor([0.1, 0.5, 1.0], dtype=torch.float64)
    together = Fxaa()(colors[:1], subpix=subpix.view(3, 1, 1, 1))
    single = [Fxaa(subpix=float(s))(colors[:1]) for s in subpix]
    assert torch.allclose(together, torch.cat(single), atol=1e-6)
    plane = torch.full((1, 1, 13, 17), 0.5, dtype=torch.float64)
    assert torch.allclose(Fxaa()(colors, subpix=plane), Fxaa(subpix=0.5)(colors))


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (13, 41)])
def test_any_size(size):
    assert fxaa(noise(*size)).shape == (1, 3, *size)


def test_types_strides_and_state():
    color = noise()
    strided = color.transpose(2, 3).contiguous().transpose(2, 3)
    before = strided.clone()
    assert torch.equal(fxaa(strided), fxaa(color))
    assert torch.equal(strided, before)
    assert fxaa(color.float()).dtype == torch.float32
    assert torch.allclose(fxaa(color.float()).double(), fxaa(color), atol=1e-5)
    effect = Fxaa(subpix=0.3, threshold=0.05)
    other = Fxaa()
    other.load_state_dict(effect.state_dict())
    for twin in (copy.deepcopy(effect), other):
        assert torch.equal(twin(color), effect(color))
    with torch.no_grad():
        other.subpix.fill_(1.7)
    assert other.project_().current_config().subpix == 1.0


# -- errors ------------------------------------------------------------------------------------


def test_errors():
    color = noise()
    with pytest.raises(ConfigError, match=r"unknown key `subpixel` \(did you mean `subpix`"):
        Fxaa(subpixel=1.0)
    with pytest.raises(ConfigError, match=r"unknown parameter `subpixel` \(did you mean `subpix`"):
        Fxaa()(color, subpixel=1.0)
    with pytest.raises(ConfigError, match=r"`threshold` must lie in \[0, 1\], got 3"):
        Fxaa(threshold=3.0)
    with pytest.raises(ConfigError, match=r"`quality`.*got 16"):
        Fxaa(quality=16)
    with pytest.raises(ConfigError, match=r"`search_steps`: must hold.*got \(1.0, -2.0\)"):
        Fxaa(search_steps=(1.0, -2.0))
    with pytest.raises(ConfigError, match=r"`subpix` must broadcast.*\(5,\)"):
        Fxaa()(color, subpix=torch.full((5,), 0.5))
    with pytest.raises(FrameError, match=r"`luma` must have shape \(B, 1, H, W\), got \(1, 3"):
        fxaa(color, color)
    with pytest.raises(FrameError, match=r"`luma` must have the batch and size.*\(1, 13, 16\)"):
        fxaa(color, color[:, :1, :, 1:])
    with pytest.raises(FrameError, match=r"type and device.*float64.*got torch.float32"):
        fxaa(color, color[:, :1].float())
    with pytest.raises(FrameError, match=r"`color` must be floating point, got torch.uint8"):
        fxaa(color.to(torch.uint8))
