import dataclasses

import pytest
import torch
from torch._inductor.utils import run_and_get_code

from torchblur.filters import get_filter
from torchblur.frame import Frame
from torchblur.ops import gather as gather_module
from torchblur.ops.tap_kernels import kernel_of
from torchblur.testing.frames import random_frame

FILTERS = ("guertin2014", "jimenez2014", "line", "mcguire2012", "notes2025", "sousa2013", "tan2022")


def partly_moving(batch_size=1, seed=0, dtype=torch.float32):
    frame = random_frame(48, 220, batch_size=batch_size, speed=60.0, seed=seed, dtype=dtype)
    velocity = frame.velocity.clone()
    velocity[:, :, :12] = 0
    velocity[..., 30:] = 0
    return dataclasses.replace(frame, velocity=velocity)


def make(name, **params):
    tiles = {} if name == "line" else {"tile_size": 10}
    return get_filter(name)(num_samples=7, **tiles, **params)


def without_notices(blur):
    # Tan 2022 says that it goes on without ids and without a revealed layer.
    blur._told = {"normal", "object_id", "revealed"}
    return blur


def work_of(monkeypatch, blur, frame):
    """Return the result and how many pixels went through each gather."""
    counts = []
    original = gather_module.sum_taps

    def counting(*args, lists, **kwargs):
        counts.append(lists.num_pixels)
        return original(*args, lists=lists, **kwargs)

    monkeypatch.setattr(gather_module, "sum_taps", counting)
    with torch.no_grad():
        image = blur(frame)
    monkeypatch.undo()
    return image, counts


@pytest.mark.parametrize("name", [n for n in FILTERS if n != "tan2022"])
def test_cost_follows_what_moves(monkeypatch, name):
    frame = partly_moving()
    pixels = frame.size[0] * frame.size[1]
    image, counts = work_of(monkeypatch, make(name), frame)
    assert counts
    assert max(counts) < 0.45 * pixels
    assert torch.equal(image[..., 60:], frame.color[..., 60:])
    assert not torch.allclose(image[..., :30], frame.color[..., :30])


@pytest.mark.parametrize("name", FILTERS)
def test_nothing_is_gathered_where_nothing_moves(monkeypatch, name):
    frame = partly_moving()
    still = dataclasses.replace(frame, velocity=torch.zeros_like(frame.velocity))
    image, counts = work_of(monkeypatch, without_notices(make(name)), still)
    if name != "tan2022":  # its ray mask looks at depths and ids
        assert not any(counts)
    assert torch.equal(image, frame.color)


@pytest.mark.parametrize("resolution", ["full", "half"])
def test_layers_of_a_still_frame_are_those_of_the_long_way(resolution):
    """The 2025 notes' filter does without all that comes after the tiles."""
    frame = random_frame(48, 90, speed=0.1)
    blur = get_filter("notes2025")(tile_size=10, resolution=resolution, early_out=0.5)
    whole = blur.layers(frame)
    assert whole["color"].requires_grad
    assert whole["primary"].any()
    with torch.no_grad():
        short = blur.layers(frame)
    assert not short["color"].requires_grad
    assert whole.keys() == short.keys()
    for name, plane in whole.items():
        assert plane.shape == short[name].shape, name
        assert torch.allclose(plane, short[name], atol=1e-6), name


@pytest.mark.parametrize("batch_size", [1, 2])
@pytest.mark.parametrize("name", FILTERS)
def test_what_moves_alone_gives_what_all_pixels_give(monkeypatch, name, batch_size):
    frame = partly_moving(batch_size, dtype=torch.float64)
    results = []
    for dense in (False, True):
        if dense:
            monkeypatch.setattr("torchblur.ops.pixels._DENSE", -1.0)
            monkeypatch.setattr("torchblur.ops.pixels._ALMOST_ALL", -1.0)
        blur = without_notices(make(name).double())
        leaf = frame.color.clone().requires_grad_()
        given = dataclasses.replace(frame, color=leaf)
        image = blur(given)
        image.square().sum().backward()
        grads = [p.grad for p in blur.parameters() if p.grad is not None]
        assert grads
        results.append([image.detach(), leaf.grad, *grads])
    for sparse, dense in zip(*results, strict=True):
        assert torch.allclose(sparse, dense, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["guertin2014", "jimenez2014", "notes2025", "torchblur"])
def test_pixels_that_stray_to_a_moving_tile_are_blurred(monkeypatch, name):
    frame = partly_moving(dtype=torch.float64)
    stray = {"tau": 2.0} if name == "guertin2014" else {"tile_jitter": 2.0}
    straying = make(name, noise="gradient", **stray).double()
    with torch.no_grad():
        sparse = straying(frame)
        monkeypatch.setattr("torchblur.ops.pixels._DENSE", -1.0)
        monkeypatch.setattr("torchblur.ops.pixels._ALMOST_ALL", -1.0)
        dense = straying(frame)
        straight = make(name, noise="gradient", **dict.fromkeys(stray, 0.0)).double()(frame)
    assert torch.allclose(sparse, dense, rtol=0, atol=1e-9)
    assert not torch.allclose(dense, straight, atol=1e-3)


@pytest.mark.parametrize("lookup", ["nearest", "bilinear"])
@pytest.mark.parametrize("batch_size", [1, 2])
@pytest.mark.parametrize("name", ["guertin2014", "jimenez2014", "mcguire2012"])
def test_textures_without_what_no_tap_reaches(monkeypatch, name, batch_size, lookup):
    """Odd windows, taps on edges of pixels, a layer behind, a parameter per pixel."""
    double = {"batch_size": batch_size, "dtype": torch.float64}
    frame = random_frame(61, 143, **double)
    layer = random_frame(61, 143, speed=0.0, seed=1, **double)
    layer = dataclasses.replace(layer, depth=layer.depth + 3)
    velocity = torch.zeros_like(frame.velocity)
    velocity[0, :, 26:31, 72:77] = torch.tensor([8.0, 6.0], dtype=torch.float64).view(2, 1, 1)
    velocity[-1, :, 31:36, 102:107] = torch.tensor([-3.0, 0.0], dtype=torch.float64).view(2, 1, 1)
    frame = dataclasses.replace(frame, velocity=velocity, revealed=layer)
    options = {"background": "revealed", "color_lookup": lookup, "noise": "none"}
    blur = get_filter(name)(tile_size=5, num_samples=8, **options).double()
    shutter = torch.linspace(0.4, 1, 143).expand(1, 1, 61, 143)
    textures, original = [], gather_module.sum_taps
    monkeypatch.setattr(
        gather_module,
        "sum_taps",
        lambda *a, **k: textures.append(a[3]["texture"].shape) or original(*a, **k),
    )
    results = []
    for dense in (False, True):
        if dense:
            monkeypatch.setattr("torchblur.ops.pixels._DENSE", -1.0)
            monkeypatch.setattr("torchblur.ops.pixels._ALMOST_ALL", -1.0)
        leaf = frame.color.clone().requires_grad_()
        textures.clear()
        image = blur(dataclasses.replace(frame, color=leaf), shutter=shutter)
        image.square().sum().backward()
        results.append([image.detach(), leaf.grad])
        smaller = [shape[1] < 61 * batch_size and shape[2] < 100 for shape in textures]
        assert not any(smaller) if dense else all(smaller)
    for sparse, dense in zip(*results, strict=True):
        assert torch.allclose(sparse, dense, rtol=0, atol=1e-9)
    assert not torch.equal(results[0][0], frame.color)


@pytest.mark.parametrize("kind", ["per image", "per pixel", "sets"])
@pytest.mark.parametrize("name", ["guertin2014", "jimenez2014", "mcguire2012", "notes2025"])
def test_parameters_of_all_shapes(monkeypatch, name, kind):
    frame = partly_moving(2 if kind == "per image" else 1)
    parameter = "depth_level"
    value = torch.tensor([0.3, 0.8]).view(2, 1, 1, 1)
    if kind == "per pixel":
        value = torch.linspace(0.2, 0.9, 220).expand(1, 1, 48, 220)
    with torch.no_grad():
        image = make(name)(frame, **{parameter: value})
        monkeypatch.setattr("torchblur.ops.pixels._DENSE", -1.0)
        monkeypatch.setattr("torchblur.ops.pixels._ALMOST_ALL", -1.0)
        whole = make(name)(frame, **{parameter: value})
        for i in range(2) if kind != "per pixel" else ():
            single = frame.map(lambda t, i=i: t[i : i + 1]) if kind == "per image" else frame
            alone = make(name)(single, **{parameter: float(value[i])})
            assert torch.allclose(image[i : i + 1], alone, atol=1e-5)
    assert torch.allclose(image, whole, atol=1e-6)


def test_the_fast_class_averages_plainly():
    frame = random_frame(40, 80, speed=0.0)
    uniform = torch.zeros_like(frame.velocity)
    uniform[:, 0] = 8.0
    frame = Frame(color=frame.color, velocity=uniform, depth=frame.depth)
    layers = make("jimenez2014", noise="none").layers(frame)
    assert (layers["tile_class"] == 1).all()
    steps = (torch.arange(4) + 0.5) / 4 * 2.0
    columns = torch.arange(80.0)
    expected = sum(
        frame.color[..., (columns + side * step).round().clamp(0, 79).long()]
        for step in steps
        for side in (1, -1)
    )
    assert torch.allclose(layers["color"], expected / 8, atol=1e-6)


@pytest.mark.parametrize("name", [n for n in FILTERS if n != "line"] + ["torchblur"])
@pytest.mark.parametrize("wanted", ["color", "velocity", "depth", "shutter"])
def test_texture_gradients_are_of_the_color_alone_if_nothing_else_wants_one(
    monkeypatch, name, wanted
):
    # A compiled backward leaves out the channels before `color_from`; an eager one has them all.
    first = []
    original = gather_module.sum_taps

    def noting(tap, *args, lists, **kwargs):
        first.append(lists.color_from)
        return original(tap, *args, lists=lists, **kwargs)

    monkeypatch.setattr(gather_module, "sum_taps", noting)
    frame, given = random_frame(24, 32, speed=30.0), {}
    leaf = torch.tensor(0.5) if wanted == "shutter" else getattr(frame, wanted).clone()
    leaf.requires_grad_()
    if wanted == "shutter":
        given["shutter"] = leaf
    else:
        frame = dataclasses.replace(frame, **{wanted: leaf})
    without_notices(make(name))(frame, **given).sum().backward()
    assert max(first) == (4 if wanted == "color" else 0)
    assert leaf.grad is not None


@pytest.mark.parametrize("name", ["guertin2014", "mcguire2012", "sousa2013"])
@pytest.mark.parametrize("color", [True, False])
def test_each_compiled_pass_is_one_loop_over_the_pixels(name, color):
    # What lies between two loops goes through memory, which takes longer than what they compute.
    frame = random_frame(24, 32, speed=30.0)
    if color:
        frame = dataclasses.replace(frame, color=frame.color.clone().requires_grad_())
    kernel_of.cache_clear()
    torch._dynamo.reset()
    blur = make(name, engine="compiled", shutter=0.5)
    _, codes = run_and_get_code(lambda: blur(frame).sum().backward())
    assert len(codes) >= 2
    assert {code.count("for(int64_t x0=") for code in codes} == {1}
