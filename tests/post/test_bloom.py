import copy

import pytest
import torch
from post.effects import check_gradient, inside, numbers

from torchblur.errors import ConfigError, FrameError
from torchblur.ops.color import luma
from torchblur.params import choices, declared
from torchblur.post.bloom import Bloom, BloomConfig, bloom, downsample13, upsample_tent


def noise(height=22, width=30, batch_size=1, dtype=torch.float64, seed=3):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch_size, 3, height, width, generator=generator, dtype=dtype)


def spot(size=64, value=1e4, dtype=torch.float64):
    color = torch.full((1, 3, size, size), 0.1, dtype=dtype)
    color[..., size // 2, size // 2] = value
    return color


# -- the filters -----------------------------------------------------------------------------------


def test_downsampling_has_the_published_weights():
    """Lattice {-2, 0, 2}²: middle 1/8, sides 1/16, corners 1/32; {-1, 1}²: 1/8; each bilinear."""
    kernel = torch.zeros(6, 6, dtype=torch.float64)
    taps = {(2, 2): 1 / 8}
    taps |= {(y, x): 1 / 8 for y in (1, 3) for x in (1, 3)}
    taps |= dict.fromkeys(((0, 2), (2, 0), (4, 2), (2, 4)), 1 / 16)
    taps |= {(y, x): 1 / 32 for y in (0, 4) for x in (0, 4)}
    for (y, x), weight in taps.items():
        kernel[y : y + 2, x : x + 2] += weight / 4
    assert float(kernel.sum()) == 1
    color = noise()
    padded = torch.nn.functional.pad(color, (2, 2, 2, 2), mode="replicate")
    weights = kernel.expand(3, 1, 6, 6)
    expected = torch.nn.functional.conv2d(padded, weights, stride=2, groups=3)
    assert torch.allclose(downsample13(color), expected)


def test_fireflies_are_weighed_down_within_each_box():
    color = noise(8, 8) * 5
    taps = torch.nn.functional.avg_pool2d(
        torch.nn.functional.pad(color, (2, 2, 2, 2), mode="replicate"), 2, 1
    )
    y, x = 2 * 1, 2 * 2  # the pixel (1, 2) of the result, at the corner of its 5x5 taps
    total = torch.zeros(3, dtype=torch.float64)
    for top, left, share in (
        (1, 1, 0.5),
        (0, 0, 0.125),
        (0, 2, 0.125),
        (2, 0, 0.125),
        (2, 2, 0.125),
    ):
        box = taps[..., y + top : y + top + 3 : 2, x + left : x + left + 3 : 2]
        weight = 1 / (1 + luma(box) / 0.7)
        total += share * ((box * weight).sum((0, 2, 3)) / weight.sum())
    assert torch.allclose(downsample13(color, 0.5, 0.7)[0, :, 1, 2], total)


def test_upsampling_is_a_tent_of_bilinear_taps():
    image = noise(7, 9)
    up = upsample_tent(image, (14, 18))
    x = (torch.arange(18, dtype=torch.float64) + 0.5) / 2 - 0.5
    y = (torch.arange(14, dtype=torch.float64) + 0.5) / 2 - 0.5
    expected = torch.zeros_like(up)
    for dy, wy in ((-1, 0.25), (0, 0.5), (1, 0.25)):
        for dx, wx in ((-1, 0.25), (0, 0.5), (1, 0.25)):
            grid = torch.stack(
                torch.broadcast_tensors(
                    (2 * (x + dx)[None] + 1) / 9 - 1, (2 * (y + dy)[:, None] + 1) / 7 - 1
                ),
                -1,
            )[None]
            expected += (
                wy
                * wx
                * torch.nn.functional.grid_sample(
                    image, grid, padding_mode="border", align_corners=False
                )
            )
    inner = (..., slice(2, -2), slice(2, -2))
    assert torch.allclose(up[inner], expected[inner])


@pytest.mark.parametrize("size", [(22, 30), (23, 31), (1, 1), (1, 9), (37, 2)])
def test_constant_image_stays_constant(size):
    color = torch.tensor([0.2, 3.0, 4e4], dtype=torch.float64).view(1, 3, 1, 1).expand(1, 3, *size)
    for params in ({}, {"intensity": 1.0, "num_levels": 12}, {"firefly_suppression": False}):
        out = bloom(color, **params)
        assert out.shape == color.shape
        assert torch.allclose(out, color, rtol=1e-12)


# -- the effect ------------------------------------------------------------------------------------


def test_light_is_moved_and_not_made():
    color = spot(256, value=100.0)
    params = {"intensity": 0.3, "num_levels": 4, "firefly_suppression": False}
    out = bloom(color, **params).detach()
    assert torch.allclose(out.sum(), color.sum())
    assert float(out[0, 0, 128, 128]) < 75
    middle = out[0, 0, 128, 129:190]
    assert bool((middle.diff() <= 1e-12).all())
    assert float(middle[0]) > 0.11
    assert torch.allclose(out[..., 0, 0], color[..., 0, 0])


def test_a_firefly_is_suppressed():
    plain, weighted = (
        Bloom(firefly_suppression=on).layers(spot())["bloom"].detach().amax()
        for on in (False, True)
    )
    # A box with the spot among four taps keeps about its dark taps' color, and at most twice 1.
    assert float(plain) > 30
    assert float(weighted) < 4
    dim = 0.1 + 0.01 * noise()
    on, off = (bloom(dim, firefly_suppression=s) for s in (True, False))
    assert torch.allclose(on, off, atol=1e-4)


def test_only_the_first_downsampling_weighs_fireflies_down():
    color = 4 * noise()
    twice = downsample13(downsample13(color, 0.5, 1.0))
    expected = upsample_tent(upsample_tent(twice, (11, 15)), (22, 30))
    assert torch.allclose(bloom(color, num_levels=2, scatter=1.0, intensity=1.0), expected)
    half = downsample13(color)
    once = upsample_tent(downsample13(half, 0.5, 1.0), (11, 15))
    out = bloom(color, half, num_levels=2, scatter=1.0, intensity=1.0)
    assert torch.allclose(out, upsample_tent(once, (22, 30)))


def test_more_scatter_and_more_levels_reach_further():
    def reach(**params):
        glow = Bloom(firefly_suppression=False, **params).layers(spot(96))["bloom"][0, 0].detach()
        y = torch.arange(96.0).double() - 48
        light = (glow - 0.1).clamp_min(0)
        return float(((light.sum(0) * y * y).sum() / light.sum()).sqrt())

    assert reach(scatter=0.2) < reach(scatter=0.7) < reach(scatter=0.95)
    assert reach(num_levels=2) < reach(num_levels=4)
    zero = bloom(noise(), intensity=0.0)
    assert torch.equal(zero, noise())


def test_half_resolution_input_replaces_the_first_downsampling():
    color = noise(23, 31)
    half = downsample13(color)
    plain = {"firefly_suppression": False, "intensity": 0.5}
    assert torch.allclose(bloom(color, half, **plain), bloom(color, **plain))
    other = bloom(color, half + 1, **plain)
    assert torch.allclose(other, bloom(color, **plain) + 0.5)
    spotty = spot(32)
    assert float(bloom(color=noise(64, 64), half_color=spotty, intensity=1.0).detach().max()) < (
        float(bloom(noise(64, 64), spotty, intensity=1.0, firefly_suppression=False).detach().max())
    )


@pytest.mark.parametrize("kind", ["mirror_x", "mirror_y", "transpose"])
def test_symmetry(kind):
    def moved(plane):
        if kind == "transpose":
            return plane.transpose(2, 3)
        return plane.flip(3 if kind == "mirror_x" else 2)

    color = noise(32, 64)  # odd sizes are padded on one side
    assert torch.allclose(bloom(moved(color)), moved(bloom(color)))


# -- gradients, one source, batches ----------------------------------------------------------------


def test_gradcheck():
    color, half = (noise(9, 7).requires_grad_(), noise(5, 4).requires_grad_())
    effect = Bloom(intensity=0.4)
    assert torch.autograd.gradcheck(effect, (color, half), fast_mode=True)
    assert torch.autograd.gradcheck(effect, (color,), fast_mode=True)
    for name, spec in numbers(Bloom, "smooth").items():
        value = inside(spec, getattr(effect.config, name))
        check_gradient(lambda v, n=name: effect(3 * noise(), **{n: v}), value)
    black = torch.zeros(1, 3, 5, 6, requires_grad=True)
    effect(black).sum().backward()
    assert bool(torch.isfinite(black.grad).all())


def other_values():
    for name, spec in declared(BloomConfig).items():
        default = BloomConfig.model_fields[name].default
        if spec.low is None:
            yield from ((name, c) for c in choices(BloomConfig, name) if c != default)
        elif isinstance(default, int):
            yield name, 2
        else:
            yield name, round(float(inside(spec, default, 0.2)), 6)


def test_module_equals_function_and_every_parameter_acts():
    color = 3 * noise()
    for name, value in other_values():
        out = Bloom(**{name: value})(color)
        assert torch.equal(bloom(color, **{name: value}), out), name
        assert torch.equal(bloom(color, config=BloomConfig(**{name: value})), out), name
        assert not torch.allclose(out, Bloom()(color), atol=1e-6), name
        again = eval(repr(Bloom(**{name: value})), {"Bloom": Bloom})
        assert again.config == BloomConfig(**{name: value})


def test_batches_types_and_state():
    colors = noise(batch_size=3)
    single = torch.cat([bloom(c[None]) for c in colors])
    assert torch.allclose(bloom(colors), single)
    values = torch.tensor([0.1, 0.4, 0.9], dtype=torch.float64)
    together = Bloom()(colors[:1], scatter=values.view(3, 1, 1, 1))
    single = [Bloom(scatter=float(v))(colors[:1]) for v in values]
    assert torch.allclose(together, torch.cat(single), atol=1e-6)
    assert bloom(colors.float()).dtype == torch.float32
    strided = colors.transpose(2, 3).contiguous().transpose(2, 3)
    before = strided.clone()
    assert torch.allclose(bloom(strided), bloom(colors))
    assert torch.equal(strided, before)
    effect, other = Bloom(scatter=0.2, intensity=0.5), Bloom()
    other.load_state_dict(effect.state_dict())
    for same in (copy.deepcopy(effect), other):
        assert torch.equal(same(colors), effect(colors))


def test_errors():
    color = noise()
    with pytest.raises(ConfigError, match=r"unknown key `intensty` \(did you mean `intensity`"):
        Bloom(intensty=1.0)
    with pytest.raises(ConfigError, match=r"`num_levels` must lie in \[1, 12\] levels, got 0"):
        Bloom(num_levels=0)
    with pytest.raises(
        FrameError, match=r"`half_color` must have half.*\(11, 15\), got \(22, 30\)"
    ):
        bloom(color, color)
    with pytest.raises(FrameError, match=r"`half_color`.*float64, got 1 of torch.float32"):
        bloom(color, noise(11, 15).float())
    with pytest.raises(ConfigError, match=r"`scatter` of the bloom.*\(1, 1, 22, 30\)"):
        Bloom()(color, scatter=torch.full((1, 1, 22, 30), 0.5))
