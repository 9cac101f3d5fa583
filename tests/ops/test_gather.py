import pytest
import torch

from torchblur.ops import tap_kernels, taps
from torchblur.ops.gather import gather, lookup, pixel_grid, read, stored_as, weighted
from torchblur.ops.pixels import PixelList


@pytest.mark.parametrize("mode", ["nearest", "bilinear"])
def test_lookup_replicates_the_border(mode):
    texture = torch.arange(12.0).view(1, 1, 3, 4)
    x = torch.tensor([-5.0, 0, 3, 9]).view(1, 1, 1, 4)
    y = torch.tensor([-2.0, 1, 7]).view(1, 1, 3, 1)
    read = lookup(texture, x, y, mode)[0, 0]
    assert torch.allclose(read, torch.tensor([[0.0, 0, 3, 3], [4, 4, 7, 7], [8, 8, 11, 11]]))


def test_lookup_of_a_batch_with_positions_of_one():
    texture = torch.rand(3, 2, 4, 5)
    x, y = pixel_grid(texture)
    assert torch.equal(lookup(texture, x, y), texture)


def tap(index, count, inputs, options):
    x, y = inputs["x"] + index * inputs["step"] + 0.11, inputs["y"] + 0.3 * index + 0.07
    weight = torch.exp(-inputs["decay"] * index / count)
    return weighted(weight, read(inputs, x, y, options)), weight + 0 * x


def split_tap(index, count, inputs, options):
    """Read the channels of the texture in two places."""
    x, y = inputs["x"] + index * inputs["step"], inputs["y"] + 0.3 * index
    first = read(inputs, x, y, options, slice(0, 1))
    rest = read(inputs, x + 1, y, options, slice(1, 3))
    return weighted(index + inputs["decay"], (*first, *rest)), inputs["decay"] + 0 * x


def make_inputs(batch_size=1, sets=1, dtype=torch.float64):
    generator = torch.Generator().manual_seed(3)
    image = torch.rand(batch_size, 3, 5, 9, dtype=dtype, generator=generator)
    x, y = pixel_grid(image)
    return {
        "texture": image,
        "x": x,
        "y": y,
        "step": torch.tensor(0.37, dtype=dtype),
        "decay": torch.rand(max(sets, batch_size), 1, 1, 1, dtype=dtype, generator=generator),
    }


def expected(inputs, num_samples, mode):
    color = weight = 0.0
    for i in range(num_samples):
        w = torch.exp(-inputs["decay"] * i / num_samples)
        x, y = inputs["x"] + i * inputs["step"] + 0.11, inputs["y"] + 0.3 * i + 0.07
        color = color + w * lookup(inputs["texture"], x, y, mode)
        weight = weight + w.expand(-1, -1, 5, 9)
    return color, weight


@pytest.mark.parametrize("mode", ["nearest", "bilinear"])
@pytest.mark.parametrize(("batch_size", "sets"), [(1, 1), (3, 1), (1, 4)])
@pytest.mark.parametrize("share", [None, 0.0, 0.3, 1.0])
def test_lists_of_pixels_give_what_images_give(mode, batch_size, sets, share):
    inputs = make_inputs(batch_size, sets)
    active = pixels = None
    if share is not None:
        active = torch.rand(batch_size, 1, 5, 9, generator=torch.Generator().manual_seed(1)) < share
        pixels = PixelList.where(active)
    results = []
    for run in (lambda i: gather(tap, mode, 6, i, active=pixels), lambda i: expected(i, 6, mode)):
        leaves = {k: v.clone().requires_grad_() for k, v in inputs.items()}
        wanted = 1.0 if active is None else active.double()
        color, weight = (plane * wanted for plane in run(leaves))
        (color.square().sum() + (weight.sin() * color).sum()).backward()
        grads = [v.grad if v.grad is not None else torch.zeros_like(v) for v in leaves.values()]
        results.append([color, weight, *grads])
    for ours, theirs in zip(*results, strict=True):
        assert torch.allclose(ours, theirs, atol=1e-10)


@pytest.mark.parametrize(("strided", "apart"), [(False, True), (True, True), (True, False)])
def test_compiled_gradient_of_a_texture_in_any_layout(monkeypatch, strided, apart):
    """Also in the way of a GPU, whose kernels add it themselves."""
    left, scatter = [], taps.scatter

    def seen(totals, room):
        left.append(bool(room.joined))
        scatter(totals, room)

    monkeypatch.setattr(taps, "scatter", seen)
    if not apart:
        monkeypatch.setattr(tap_kernels, "_APART", ())
    grads = []
    for engine in ("eager", "compiled"):
        inputs = make_inputs(dtype=torch.float32)
        leaf = inputs["texture"].clone().requires_grad_()
        given = leaf.transpose(2, 3).contiguous().transpose(2, 3) if strided else leaf
        color, _ = gather(split_tap, "nearest", 3, inputs | {"texture": given}, engine)
        color.square().sum().backward()
        grads.append(leaf.grad)
    assert grads[0].any()
    assert torch.allclose(*grads, rtol=1e-4, atol=1e-5)
    assert any(left) == apart


def alternating_tap(index, count, inputs, options):
    """Read two channels by turns, in different places."""
    x, y = inputs["x"] + index, inputs["y"]
    reads = [read(inputs, x + i, y, channels=slice(i % 2, i % 2 + 1))[0] for i in range(4)]
    return tuple((i + 1) * plane for i, plane in enumerate(reads)), 0 * x


def test_compiled_gradients_of_lookups_that_take_turns():
    grads = []
    for engine in ("eager", "compiled"):
        inputs = make_inputs(dtype=torch.float32)
        leaf = inputs["texture"].requires_grad_()
        gather(alternating_tap, None, 3, inputs, engine)[0].square().sum().backward()
        grads.append(leaf.grad)
    assert grads[0].any()
    assert torch.allclose(*grads, rtol=1e-5)


def partly_linear_tap(index, count, inputs, options):
    x, y = inputs["x"] + 0.4 * index, inputs["y"] + 0.3 * index
    return read(inputs, x, y, "bilinear", linear=inputs["linear"] > 0), 0 * x


@pytest.mark.parametrize("engine", ["eager", "compiled"])
def test_a_lookup_is_bilinear_only_where_it_is_asked_for(engine):
    inputs = make_inputs(dtype=torch.float32)
    inputs["linear"] = torch.arange(45.0).view(1, 1, 5, 9) % 2
    linear = inputs["linear"] > 0
    ours, theirs = (inputs["texture"].clone().requires_grad_() for _ in range(2))
    color, _ = gather(partly_linear_tap, None, 3, inputs | {"texture": ours}, engine)
    places = [(inputs["x"] + 0.4 * i, inputs["y"] + 0.3 * i) for i in range(3)]
    fine, near = (
        sum(lookup(theirs, *place, m) for place in places) for m in ("bilinear", "nearest")
    )
    expected = torch.where(linear, fine, near)
    assert torch.equal(torch.where(linear, 0, color), torch.where(linear, 0, expected))
    assert torch.allclose(color, expected, atol=1e-5)
    for image in (color, expected):
        image.square().sum().backward()
    assert torch.allclose(ours.grad, theirs.grad, rtol=1e-4, atol=1e-5)


def parameters_tap(index, count, inputs, options):
    x = inputs["x"] + index
    weight = inputs["gain"] * torch.exp(-inputs["decay"] * index / count)
    return weighted(weight, read(inputs, x, inputs["y"])), weight * inputs["list"] + 0 * x


@pytest.mark.parametrize(("sets", "unused"), [(1, 1), (3, 1), (3, 3), (1, 3)])
def test_compiled_gradients_of_parameters_of_any_shape(sets, unused):
    results = []
    for engine in ("eager", "compiled"):
        inputs = make_inputs(sets=sets, dtype=torch.float32)
        inputs |= {"gain": torch.tensor(0.7), "unused": torch.ones(unused, 1, 1, 1)}
        inputs["list"] = torch.linspace(0, 1, 45).view(1, 1, 5, 9)
        leaves = {name: tensor.requires_grad_() for name, tensor in inputs.items()}
        color, weight = gather(parameters_tap, None, 4, leaves, engine)
        (color.square().sum() + (weight * color).sum()).backward()
        results.append([leaves[name].grad for name in ("gain", "decay", "list", "unused")])
    for eager, compiled in zip(*results, strict=True):
        assert (eager is None) == (compiled is None)
        assert eager is None or torch.allclose(compiled, eager, rtol=1e-5)
    assert results[0][0] != 0


class TestHalfStorage:
    @pytest.mark.parametrize("mode", ["nearest", "bilinear"])
    @pytest.mark.parametrize("engine", ["eager", "compiled"])
    def test_is_a_texture_rounded_before(self, mode, engine):
        results = []
        for storage in ("half", "full"):
            inputs = make_inputs(2, dtype=torch.float32)
            if storage == "full":
                inputs["texture"] = inputs["texture"].half().float()
            leaves = {k: v.clone().requires_grad_() for k, v in inputs.items()}
            with stored_as(storage):
                color, weight = gather(tap, mode, 3, leaves, engine)
            ((1e-5 * color.square()).sum() + weight.sum()).backward()  # half has nothing so small
            results.append(
                [color, weight, *(v.grad for v in leaves.values() if v.grad is not None)]
            )
        for half, full in zip(*results, strict=True):
            assert half.dtype == torch.float32
            assert torch.allclose(half, full, rtol=1e-4, atol=1e-9)

    def test_error_is_that_of_rounding(self):
        inputs = make_inputs(dtype=torch.float32)
        whole, _ = gather(tap, "nearest", 3, inputs)
        with stored_as("half"):
            half, _ = gather(tap, "nearest", 3, inputs)
        error = (half / whole - 1).abs().max()
        assert 1e-5 < error < 2**-11

    def test_infinite_depth_becomes_a_large_one(self):
        inputs = make_inputs(dtype=torch.float32)
        inputs["texture"] = torch.full_like(inputs["texture"], torch.inf)
        with stored_as("half"):
            color, weight = gather(tap, "nearest", 3, inputs)
        assert torch.allclose(color, 65504 * weight)


def test_many_rows_are_interpolated_from_their_corners(monkeypatch):
    inputs = make_inputs(3)
    whole = gather(tap, "bilinear", 6, inputs)
    monkeypatch.setattr("torchblur.ops.gather._MOST_ROWS", 0)
    for ours, theirs in zip(gather(tap, "bilinear", 6, inputs), whole, strict=True):
        assert torch.allclose(ours, theirs, atol=1e-12)


def test_what_is_not_active_is_zero_and_not_computed():
    seen = []

    def counting(index, count, inputs, options):
        seen.append(inputs["x"].shape[-1])
        return read(inputs, inputs["x"], inputs["y"]), inputs["x"]

    inputs = make_inputs()
    active = torch.zeros(1, 1, 5, 9, dtype=torch.bool)
    active[..., 2, 4:7] = True
    color, _ = gather(counting, None, 2, inputs, active=PixelList.where(active))
    assert set(seen) == {3}
    assert torch.equal(color[..., 2, 4:7], 2 * inputs["texture"][..., 2, 4:7])
    assert not color[..., 0, :].any()


def test_layouts_and_parts_compile_nothing_anew(monkeypatch):
    # Strides of dimensions of one, offsets and bases of views are all guarded by the compiler.
    def run(inputs):
        inputs = dict(inputs)
        inputs["texture"] = inputs["texture"].clone().requires_grad_()
        sums = gather(tap, "nearest", 3, inputs, "compiled")
        sum(plane.square().sum() for plane in sums).backward()
        return [plane.detach() for plane in sums], inputs["texture"].grad

    inputs = make_inputs(dtype=torch.float32)
    expected, slope = run(inputs)
    before = torch._dynamo.utils.counters["stats"]["unique_graphs"]
    x, y = (inputs[name].expand(1, 1, 5, 9) for name in "xy")
    views = dict(zip("xy", torch.cat((x, y), 1).split(1, 1), strict=True))
    assert views["y"].storage_offset()
    assert views["y"].stride()[0] == 2 * 45
    monkeypatch.setitem(taps._PART, "compiled", 20)
    monkeypatch.setattr(taps, "_LEAST_PART", 1)
    for given in (inputs, inputs | views):
        sums, grad = run(given)
        assert all(map(torch.allclose, sums, expected))
        assert torch.allclose(grad, slope)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == before


def test_one_kernel_serves_all_sizes_batches_and_shares_of_active_pixels():
    inputs = make_inputs(dtype=torch.float32)
    gather(tap, "nearest", 3, inputs, "compiled")
    before = torch._dynamo.utils.counters["stats"]["unique_graphs"]
    few = torch.zeros(1, 1, 5, 9, dtype=torch.bool)
    few[..., 1:3, 2:6] = True
    some = PixelList.where(few)
    for given, active in ((inputs, some), (make_inputs(1, dtype=torch.float32), None)):
        result = gather(tap, "nearest", 5, given, "compiled", active=active)
        assert torch.allclose(result[0], gather(tap, "nearest", 5, given, active=active)[0])
    batch = make_inputs(3, dtype=torch.float32) | {"decay": torch.tensor(0.4)}
    one = make_inputs(dtype=torch.float32) | {"decay": torch.tensor(0.4)}
    gather(tap, "nearest", 3, one, "compiled")
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == before
    result = gather(tap, "nearest", 3, batch, "compiled")
    assert torch.allclose(result[0], gather(tap, "nearest", 3, batch)[0])
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == before
