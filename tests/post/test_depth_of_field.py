import copy
import math

import pytest
import torch
from post.effects import check_gradient, inside, numbers, slopes
from twins.depth_of_field import depth_of_field as twin

from torchblur.errors import ConfigError, FrameError
from torchblur.params import choices, declared
from torchblur.post.depth_of_field import (
    DepthOfField,
    DepthOfFieldConfig,
    circle_of_confusion,
    depth_of_field,
)

FOCUS = 10.0
RAMPS = {"model": "ramps", "focus_distance": FOCUS, "max_radius": 8}


def noise(height=15, width=19, batch_size=1, dtype=torch.float64, seed=3):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch_size, 3, height, width, generator=generator, dtype=dtype)


def depths(height=15, width=19, dtype=torch.float64, seed=1):
    """Blocks of depth before, in and behind the focus, the sky in a corner."""
    generator = torch.Generator().manual_seed(seed)
    coarse = 4 + 16 * torch.rand(1, 1, 3, 4, generator=generator, dtype=dtype)
    coarse[..., 1, 1] = FOCUS
    fine = torch.nn.functional.interpolate(coarse, (height, width), mode="nearest")
    fine = fine + 0.3 * torch.rand(fine.shape, generator=generator, dtype=dtype)
    fine[..., :2, :3] = torch.inf
    return fine


def two_planes(front, back, size=41, radius=9):
    """Depth of a disk before a wall, and where the disk is."""
    y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    disk = (x - size // 2) ** 2 + (y - size // 2) ** 2 <= radius**2
    return torch.where(disk, front, back).double()[None, None], disk


def painted(disk, front, back):
    colors = [torch.tensor(c, dtype=torch.float64).view(1, 3, 1, 1) for c in (front, back)]
    return torch.where(disk, *colors)


RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


# -- the circle ----------------------------------------------------------------------------------


def test_circle_of_a_lens():
    depth = torch.tensor([2.0, 5.0, 10.0, 20.0, torch.inf]).view(1, 1, 1, 5)
    config = DepthOfFieldConfig(focus_distance=10.0, infinity_radius=6.0, max_radius=16)
    circle = circle_of_confusion(depth, config)[0, 0, 0]
    assert torch.allclose(circle, torch.tensor([-16.0, -6, 0, 3, 6]))


def test_circle_by_ramps():
    depth = torch.tensor([1.0, 5.0, 9.0, 10.9, 13.0, torch.inf]).view(1, 1, 1, 6)
    config = DepthOfFieldConfig(
        model="ramps", focus_distance=10.0, focus_range=1.0, near_ramp=8.0, far_ramp=4.0
    )
    circle = circle_of_confusion(depth, config)[0, 0, 0]
    assert torch.allclose(circle, torch.tensor([-8.0, -4, 0, 0, 4, 8]))


# -- what it does ----------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["lens", "ramps"])
@pytest.mark.parametrize("taps", ["disc", "all"])
def test_constant_image_stays_constant(model, taps):
    color = (
        torch.tensor([0.2, 3.0, 40.0], dtype=torch.float64).view(1, 3, 1, 1).expand(1, 3, 15, 19)
    )
    out = depth_of_field(color, depths(), model=model, taps=taps, max_radius=5)
    assert torch.allclose(out, color, rtol=1e-12)


@pytest.mark.parametrize("taps", ["disc", "all"])
def test_sharp_pixels_are_untouched_where_no_near_field_reaches(taps):
    color = noise(41, 41)
    depth, disk = two_planes(FOCUS, 30.0)
    out = depth_of_field(color, depth, focus_distance=FOCUS, taps=taps, max_radius=8).detach()
    assert torch.equal(out[..., disk], color[..., disk])
    assert float((out - color)[..., ~disk].abs().mean()) > 0.1


@pytest.mark.parametrize("taps", ["disc", "all"])
def test_far_field_neither_takes_sharp_color_nor_gives_any(taps):
    depth, disk = two_planes(FOCUS, 1000.0)
    color = painted(disk, RED, BLUE)
    out = depth_of_field(color, depth, focus_distance=FOCUS, taps=taps, max_radius=8).detach()
    assert torch.allclose(out, color, atol=1e-12)


@pytest.mark.parametrize(("taps", "tolerance"), [("disc", 0.12), ("all", 0.02)])
def test_near_field_spills_over_what_is_sharp(taps, tolerance):
    depth, disk = two_planes(5.0, FOCUS, size=61, radius=12)
    color = painted(disk, RED, BLUE)
    layers = DepthOfField(
        focus_distance=FOCUS, infinity_radius=6.0, taps=taps, max_radius=8
    ).layers(color, depth)
    out, alpha = layers["color"].detach(), layers["near_alpha"].detach()
    middle = alpha[0, 0, 30]
    assert float((middle[24:37] - 1).abs().max()) < 1.5 * tolerance
    assert 0.3 < float(middle[30 + 12]) < 0.6  # at the silhouette; 1/2 for a straight one
    assert float(middle[30 + 20]) == 0  # radius 12 and circle 6
    if taps == "all":
        assert bool((middle[30:].diff() <= 1e-9).all())
    assert math.isclose(float(alpha.sum()), int(disk.sum()), rel_tol=tolerance)
    # Red over blue by that opacity, before and behind the silhouette alike; nothing else.
    assert torch.allclose(out[:, 0], alpha[:, 0], atol=2e-3)
    assert torch.allclose(out[:, 0] + out[:, 2], torch.ones(61, 61).double(), atol=1e-9)


def test_near_coverage_closes_the_edge():
    depth, _ = two_planes(5.0, FOCUS)
    thin, thick = (
        DepthOfField(focus_distance=FOCUS, near_coverage=gain).layers(noise(41, 41), depth)
        for gain in (1.0, 1.5)
    )
    rim = (thin["near_alpha"] > 0.05) & (thin["near_alpha"] < 0.6)
    assert torch.allclose(thick["near_alpha"][rim], 1.5 * thin["near_alpha"][rim])


def test_a_bright_far_point_becomes_a_disc():
    color = torch.zeros(1, 3, 31, 31, dtype=torch.float64)
    color[..., 15, 15] = 100.0
    depth = torch.full((1, 1, 31, 31), torch.inf, dtype=torch.float64)
    out = depth_of_field(color, depth, infinity_radius=6.0, max_radius=8, taps="all")
    out = out.detach()
    disc = out[0, 0] > 0.4
    assert abs(int(disc.sum()) - math.pi * 36) < 0.15 * math.pi * 36
    assert math.isclose(float(out[0, 0].sum()), 100.0, rel_tol=1e-3)
    y, x = disc.nonzero().double().sub(15).unbind(1)
    assert 5.5 < float((x * x + y * y).sqrt().max()) < 6.3


@pytest.mark.parametrize("kind", ["mirror_x", "mirror_y", "transpose"])
def test_symmetry(kind):
    def moved(plane):
        if kind == "transpose":
            return plane.transpose(2, 3)
        return plane.flip(3 if kind == "mirror_x" else 2)

    effect = DepthOfField(taps="all", max_radius=4)
    out = effect(noise(), depths())
    assert torch.allclose(effect(moved(noise()), moved(depths())), moved(out))


@pytest.mark.parametrize(
    "params",
    [
        {},
        {"infinity_radius": 2.5, "edge": 2.4, "near_coverage": 1.7},
        RAMPS | {"near_radius": 2.0, "far_radius": 6.0, "max_radius": 4},
    ],
    ids=str,
)
def test_agrees_with_its_twin(params):
    color, depth = noise(), depths()
    effect = DepthOfField(**({"max_radius": 4, "taps": "all"} | params))
    layers = effect.layers(color, depth)
    config = effect.config
    expected, alpha = twin(
        color[0].numpy(),
        layers["circle"][0, 0].detach().numpy(),
        max_radius=config.max_radius,
        edge=float(effect.edge.detach()),
        near_coverage=float(effect.near_coverage),
    )
    assert torch.allclose(layers["color"][0], torch.from_numpy(expected), atol=1e-6)
    assert torch.allclose(layers["near_alpha"][0, 0], torch.from_numpy(alpha), atol=1e-6)
    assert float((layers["color"] - color).abs().mean()) > 0.05
    assert 0.05 < float((layers["near_alpha"] > 0.5).double().mean()) < 0.8


def test_spiral_comes_close_to_all_taps():
    color = torch.nn.functional.avg_pool2d(noise(32, 40), 3, 1, 1)
    depth = depths(32, 40)
    with torch.no_grad():
        exact = depth_of_field(color, depth, taps="all", max_radius=8)
        errors = [
            float((depth_of_field(color, depth, num_samples=n, max_radius=8) - exact).abs().mean())
            for n in (16, 64, 200)
        ]
    effect = float((exact - color).abs().mean())
    assert errors[0] > errors[1] > errors[2]
    assert errors[1] < 0.25 * effect


# -- gradients -------------------------------------------------------------------------------------


def test_gradcheck_of_color_and_depth():
    depth = depths(7, 8).clamp(max=30.0)
    for params in ({"taps": "all", "max_radius": 2}, RAMPS | {"taps": "all", "max_radius": 2}):
        leaves = [t.clone().requires_grad_() for t in (noise(7, 8), depth)]
        effect = DepthOfField(**params)
        assert torch.autograd.gradcheck(effect, leaves, eps=1e-7, atol=1e-5, fast_mode=True)
        for leaf in leaves:
            (grad,) = torch.autograd.grad(effect(*leaves).square().sum(), leaf)
            assert float(grad.abs().sum()) > 1e-3


@pytest.mark.parametrize("name", list(numbers(DepthOfField, "smooth")))
def test_smooth_parameters(name):
    ramps = name in ("focus_range", "near_ramp", "far_ramp", "near_radius", "far_radius")
    effect = DepthOfField(model="ramps" if ramps else "lens", taps="all", max_radius=6)
    starts = {"focus_range": 1.0, "focus_distance": 9.0, "near_radius": 3.2, "far_radius": 3.3}
    starts |= {"near_ramp": 7.0, "far_ramp": 6.0, "infinity_radius": 3.0}
    value = torch.tensor(starts.get(name, getattr(effect.config, name)), dtype=torch.float64)
    check_gradient(lambda v: effect(noise(), depths(), **{name: v}), value)


def test_weak_parameters_act_where_autograd_is_wrong():
    effect = DepthOfField(num_samples=16)
    for name, spec in numbers(DepthOfField, "weak").items():
        slope, difference = slopes(
            lambda v, n=name: effect(noise(), depths(), **{n: v}),
            spec,
            getattr(effect.config, name),
        )
        assert difference != 0, f"{name} does nothing"
        assert abs(slope - difference) > 0.05 * abs(difference), name


@pytest.mark.parametrize("taps", ["disc", "all"])
def test_gradients_are_finite_at_the_focus_and_the_sky(taps):
    for value in (FOCUS, 1e-3, torch.inf):
        color = noise(6, 7, dtype=torch.float32).requires_grad_()
        depth = torch.full((1, 1, 6, 7), value).requires_grad_()
        effect = DepthOfField(taps=taps, max_radius=3)
        effect(color, depth).square().sum().backward()
        for leaf in (color, depth, *effect.parameters()):
            assert leaf.grad is None or bool(torch.isfinite(leaf.grad).all())
        assert float(color.grad.abs().sum()) > 0


# -- one source, batches, types --------------------------------------------------------------------


def other_values():
    for name, spec in declared(DepthOfFieldConfig).items():
        default = DepthOfFieldConfig.model_fields[name].default
        if spec.low is None:
            yield from ((name, c) for c in choices(DepthOfFieldConfig, name) if c != default)
        elif isinstance(default, int):
            yield name, max(default // 4, 1) if default else 4
        else:
            yield name, round(float(inside(spec, default, 0.2)), 6)


def test_module_equals_function_and_every_parameter_acts():
    color, depth = noise(), depths()
    for name, value in other_values():
        ramps = name in ("focus_range", "near_ramp", "far_ramp", "near_radius", "far_radius")
        given = {"max_radius": 6, "model": "ramps" if ramps else "lens"}
        plain = DepthOfField(**given)(color, depth)
        given |= {name: value}
        out = DepthOfField(**given)(color, depth)
        assert torch.equal(depth_of_field(color, depth, **given), out), name
        assert torch.equal(depth_of_field(color, depth, DepthOfFieldConfig(**given)), out), name
        assert not torch.equal(out, plain), name
        again = eval(repr(DepthOfField(**given)), {"DepthOfField": DepthOfField})
        assert again.config == DepthOfFieldConfig(**given)


def test_batches_of_pictures_and_of_parameters():
    colors, depth = noise(batch_size=3), torch.cat([depths(seed=s) for s in range(3)])
    effect = DepthOfField(max_radius=6)
    single = [effect(c[None], d[None]) for c, d in zip(colors, depth, strict=True)]
    assert torch.allclose(effect(colors, depth), torch.cat(single), atol=1e-9)
    values = torch.tensor([6.0, 9.0, 12.0], dtype=torch.float64)
    together = effect(colors[:1], depth[:1], focus_distance=values.view(3, 1, 1, 1))
    single = [effect(colors[:1], depth[:1], focus_distance=float(v)) for v in values]
    assert torch.allclose(together, torch.cat(single), atol=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (13, 41)])
def test_any_size(size):
    out = depth_of_field(noise(*size), torch.full((1, 1, *size), 3.0, dtype=torch.float64))
    assert out.shape == (1, 3, *size)


def test_types_strides_and_state():
    color, depth = noise(), depths()
    strided = color.transpose(2, 3).contiguous().transpose(2, 3)
    before = strided.clone()
    assert torch.equal(depth_of_field(strided, depth), depth_of_field(color, depth))
    assert torch.equal(strided, before)
    effect = DepthOfField(focus_distance=7.0, taps="all", max_radius=4)
    single = effect(color.float(), depth.float())
    assert single.dtype == torch.float32
    assert torch.allclose(single.double(), effect(color, depth), atol=1e-4)
    other = DepthOfField(taps="all", max_radius=4)
    other.load_state_dict(effect.state_dict())
    for same in (copy.deepcopy(effect), other):
        assert torch.equal(same(color, depth), effect(color, depth))


@pytest.mark.slow
def test_compiled_equals_eager():
    color, depth = noise(dtype=torch.float32), depths(dtype=torch.float32)
    results = []
    for engine in ("eager", "compiled"):
        leaf = color.clone().requires_grad_()
        out = DepthOfField(engine=engine, num_samples=9)(leaf, depth)
        out.square().sum().backward()
        results.append((out, leaf.grad))
    for eager, compiled in zip(*results, strict=True):
        assert torch.allclose(eager, compiled, atol=1e-4)


def test_errors():
    color, depth = noise(), depths()
    with pytest.raises(ConfigError, match=r"unknown key `focus` \(did you mean `focus_range`"):
        DepthOfField(focus=3.0)
    with pytest.raises(ConfigError, match=r"`max_radius` must lie in \[1, 64\] px, got 100"):
        DepthOfField(max_radius=100)
    with pytest.raises(ConfigError, match=r"`focus_distance` must lie in .*, got -1"):
        DepthOfField()(color, depth, focus_distance=-1.0)
    with pytest.raises(FrameError, match=r"`depth` must have shape \(B, 1, H, W\), got \(1, 3"):
        depth_of_field(color, color)
    with pytest.raises(FrameError, match=r"`depth` must have the batch and size of `color`"):
        depth_of_field(color, depth[..., 1:])
