import subprocess
import sys

import pytest
import torch

from torchblur.errors import ConfigError
from torchblur.ops.gather import lookup, pixel_grid
from torchblur.ops.taps import Lists, sum_taps


def tap(index, count, inputs, options):
    x, y = pixel_grid(inputs["image"])
    color = lookup(inputs["image"], x + index * inputs["step"], y, options)
    weight = torch.exp(-inputs["decay"] * index / count)
    return weight * color, weight.expand_as(color[:, :1])


def unrolled(inputs, num_samples, options):
    parts = [
        tap(
            torch.tensor(float(i), dtype=inputs["image"].dtype),
            torch.tensor(float(num_samples)),
            inputs,
            options,
        )
        for i in range(num_samples)
    ]
    return tuple(sum(p) for p in zip(*parts, strict=True))


def make_inputs(dtype=torch.float64):
    return {
        "image": torch.rand(2, 3, 5, 9, dtype=dtype),
        "step": torch.tensor(0.37, dtype=dtype),
        "decay": torch.rand(2, 1, 1, 1, dtype=dtype) + 0.5,
    }


@pytest.mark.parametrize("mode", ["nearest", "bilinear"])
def test_sum_equals_the_unrolled_sum_and_its_gradient(mode):
    inputs = make_inputs()
    results = []
    for run in (lambda i: sum_taps(tap, mode, 6, i), lambda i: unrolled(i, 6, mode)):
        leaves = {k: v.clone().requires_grad_() for k, v in inputs.items()}
        color, weight = run(leaves)
        (color / weight).square().sum().backward()
        grads = [v.grad if v.grad is not None else torch.zeros_like(v) for v in leaves.values()]
        results.append([color, weight, *grads])
    for ours, theirs in zip(*results, strict=True):
        assert torch.allclose(ours, theirs, atol=1e-10)


def test_only_what_needs_a_gradient_gets_one():
    inputs = make_inputs()
    inputs["decay"].requires_grad_()
    color, _ = sum_taps(tap, "nearest", 4, inputs)
    color.sum().backward()
    assert inputs["decay"].grad is not None
    assert inputs["image"].grad is None
    with torch.no_grad():
        assert not sum_taps(tap, "nearest", 4, inputs)[0].requires_grad


def test_unknown_engine():
    with pytest.raises(ConfigError, match="`engine` must be 'eager' or 'compiled', got 'fast'"):
        sum_taps(tap, "nearest", 4, make_inputs(), "fast")


_NO_COMPILER = """
import warnings, torch
import torch._inductor.compile_fx
from torch._inductor.exc import InductorError
import torchblur.ops.taps

def broken(*_, **__):
    def call(*_, **__):
        raise InductorError(RuntimeError("no C++ compiler"), None)
    return call

torch.compile = broken
from torchblur.filters import get_filter
from torchblur.testing.frames import moving_square
frame = moving_square()
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    blur = get_filter("line")(engine="compiled")
    images = [blur(frame) for _ in range(3)]
assert torch.equal(images[0], get_filter("line")()(frame))
texts = [str(w.message) for w in caught if "torch.compile does not work here" in str(w.message)]
assert len(texts) == 1, texts
"""


def test_without_a_compiler_there_is_one_notice_and_the_eager_result():
    done = subprocess.run(
        [sys.executable, "-c", _NO_COMPILER], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def peak_tap(index, count, inputs, options):
    x, y = pixel_grid(inputs["image"])
    color = lookup(inputs["image"], x + index * inputs["step"], y, options)
    return color, color * inputs["decay"]


@pytest.mark.parametrize("num_maxima", [0, 1, 2])
def test_the_last_accumulators_can_be_maxima(num_maxima):
    inputs = make_inputs() | {"step": torch.tensor(1.0, dtype=torch.float64)}
    results = []
    for by_engine in (True, False):
        leaves = {k: v.clone().requires_grad_() for k, v in inputs.items()}
        if by_engine:
            totals = sum_taps(peak_tap, "nearest", 6, leaves, num_maxima=num_maxima)
        else:
            parts = [
                peak_tap(torch.tensor(float(i)).double(), None, leaves, "nearest") for i in range(6)
            ]
            stacked = [torch.stack(p) for p in zip(*parts, strict=True)]
            totals = [s.sum(0) if i < 2 - num_maxima else s.amax(0) for i, s in enumerate(stacked)]
        # Border pixels are met more than once: how amax divides a tie is not our affair.
        sum(t[..., :4].square().sum() for t in totals).backward()
        results.append([*totals, leaves["image"].grad, leaves["decay"].grad])
    for ours, theirs in zip(*results, strict=True):
        assert torch.allclose(ours, theirs, atol=1e-10)


def test_a_tied_maximum_gives_its_gradient_to_one_tap():
    image = torch.ones(1, 1, 2, 3, dtype=torch.float64)
    leaves = {"image": image, "step": image.new_tensor(1.0)}
    leaves["decay"] = image.new_tensor(2.0).requires_grad_()
    _, peak = sum_taps(peak_tap, "nearest", 5, leaves, num_maxima=1)
    peak.sum().backward()
    assert float(leaves["decay"].grad) == 6.0


def list_tap(index, count, inputs, options):
    weight = torch.exp(-inputs["decay"] * (index + 1) * inputs["planes"][:, :1])
    value = (inputs["texture"][0, 0, :1] * inputs["planes"][:, 1:]).sin()
    return weight * value, weight, (weight * value).detach() * 0 + weight


def list_inputs(sets, pixels):
    generator = torch.Generator().manual_seed(3)
    return {
        "planes": torch.rand(1, 2, 1, pixels, generator=generator, dtype=torch.float64),
        "decay": torch.rand(sets, 1, 1, 1, generator=generator, dtype=torch.float64),
        "texture": torch.rand(1, 1, 4, generator=generator, dtype=torch.float64),
    }


@pytest.mark.parametrize("with_texture", [False, True])
@pytest.mark.parametrize("sets", [1, 3])
def test_parts_and_groups_of_taps_change_nothing(monkeypatch, sets, with_texture):
    inputs = list_inputs(sets, 103)
    results = []
    for part, taps in ((1 << 16, 1), (40, 1), (1 << 16, 4), (30, 3)):
        monkeypatch.setattr("torchblur.ops.taps._PART", {"eager": part})
        monkeypatch.setattr("torchblur.ops.taps._LEAST_PART", 8)
        monkeypatch.setattr("torchblur.ops.taps._TAPS_PER_CALL", {"cpu": taps})
        leaves = {k: v.clone() for k, v in inputs.items()}
        wanted = [leaves[k] for k in inputs if with_texture or k != "texture"]
        for leaf in wanted:
            leaf.requires_grad_()
        color, weight, peak = sum_taps(list_tap, None, 10, leaves, num_maxima=1, lists=Lists(103))
        (color.square().sum() + (weight * peak).sum()).backward()
        results.append([color, weight, peak, *(leaf.grad for leaf in wanted)])
    for other in results[1:]:
        for ours, theirs in zip(other, results[0], strict=True):
            assert ours.shape == theirs.shape
            assert torch.allclose(ours, theirs, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("sets", [1, 3])
def test_no_part_is_larger_than_it_may_be(monkeypatch, sets):
    seen = []

    def watching(index, count, inputs, options):
        added = inputs["planes"] * inputs["decay"]
        kept = [t for t in (*inputs.values(), added) if t.shape[-1] == added.shape[-1]]
        seen.append((added.shape[-1], sum(t.numel() for t in kept), sum(t.shape[1] for t in kept)))
        return (added,)

    monkeypatch.setattr("torchblur.ops.taps._PART", {"eager": 60})
    monkeypatch.setattr("torchblur.ops.taps._LEAST_PART", 8)
    sum_taps(watching, None, 2, list_inputs(sets, 103), lists=Lists(103))
    parts = [part for part in seen if part[0] != 103]  # the first call finds out what it returns
    assert parts
    for size, numbers, planes in parts:  # the mean number of sets over all planes counts
        assert numbers <= 60 * planes * (size + 1) / size
    assert sum(size for size, _, _ in parts) == 2 * 103


@pytest.mark.slow
def test_groups_of_taps_compiled(monkeypatch):
    monkeypatch.setattr("torchblur.ops.taps._TAPS_PER_CALL", {"cpu": 4})
    inputs = {k: v.float() for k, v in list_inputs(1, 103).items()}
    results = []
    for engine in ("eager", "compiled"):
        leaves = {k: v.clone().requires_grad_(k != "texture") for k, v in inputs.items()}
        color, weight, peak = sum_taps(
            list_tap, None, 10, leaves, engine, num_maxima=1, lists=Lists(103)
        )
        (color.square().sum() + (weight * peak).sum()).backward()
        results.append([color, weight, peak, leaves["planes"].grad, leaves["decay"].grad])
    for ours, theirs in zip(*results, strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-4, atol=1e-5)


def test_no_pixels_need_no_taps_and_have_a_graph():
    calls = []

    def counting(index, count, inputs, options):
        calls.append(index)
        return list_tap(index, count, inputs, options)

    leaves = {k: v.clone().requires_grad_() for k, v in list_inputs(2, 0).items()}
    sums = sum_taps(counting, None, 10, leaves, "compiled", num_maxima=1, lists=Lists(0))
    assert [plane.shape for plane in sums] == [(2, 1, 1, 0)] * 3
    sum(plane.sum() for plane in sums).backward()
    assert len(calls) == 1  # the one that finds out what it returns
    assert all(leaf.grad is not None and not leaf.grad.any() for leaf in leaves.values())
