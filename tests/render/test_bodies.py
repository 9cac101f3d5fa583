"""Intersections against signed distances, which are written here from the bodies' definitions."""

import math

import pytest
import torch

from torchblur.render.trace import Tracer

PAINT = {"kind": "solid", "color": [1.0, 1.0, 1.0]}
CASES = {
    "sphere": {"kind": "sphere", "radius": 0.8},
    "box": {"kind": "box", "size": [1.0, 1.6, 0.7]},
    "cylinder": {"kind": "cylinder", "radius": 0.6, "length": 1.3},
    "capsule": {"kind": "capsule", "radius": 0.5, "length": 1.1},
}


def signed_distance(kind, p):
    """Distance of points (N, 3) to the surface, negative inside."""
    if kind == "sphere":
        return p.norm(dim=1) - 0.8
    if kind == "box":
        q = p.abs() - torch.tensor([0.5, 0.8, 0.35], dtype=p.dtype)
    elif kind == "cylinder":
        q = torch.stack((p[:, [0, 2]].norm(dim=1) - 0.6, p[:, 1].abs() - 0.65), 1)
    else:
        axis = torch.zeros_like(p)
        axis[:, 1] = p[:, 1].clamp(-0.55, 0.55)
        return (p - axis).norm(dim=1) - 0.5
    return q.clamp(min=0).norm(dim=1) + q.amax(dim=1).clamp(max=0)


def rays(count, is_inside):
    start = torch.randn(3, count, dtype=torch.float64)
    start = start / start.norm(dim=0) * (0.3 if is_inside else 3.0)
    target = torch.rand(3, count, dtype=torch.float64) * 2 - 1
    return start, (target - start) * 0.7


def march(kind, start, direction):
    """Walk along the rays by the distance to the surface; inf where nothing comes."""
    t = torch.zeros(start.shape[1], dtype=torch.float64)
    length = direction.norm(dim=0)
    for _ in range(3000):
        gap = signed_distance(kind, (start + t * direction).T).abs()
        t = t + torch.where(gap > 1e-9, gap / length, 0)
    gap = signed_distance(kind, (start + t * direction).T).abs()
    return torch.where((gap < 1e-6) & (t < 20), t, math.inf)


@pytest.mark.parametrize("is_inside", [False, True])
@pytest.mark.parametrize("kind", list(CASES))
def test_hit_is_where_a_march_along_the_ray_ends(make_scene, kind, is_inside):
    tracer = Tracer(make_scene(CASES[kind] | {"texture": PAINT}), dtype=torch.float64)
    start, direction = rays(500, is_inside)
    hit = tracer.closest_hit(start, direction, torch.zeros(500, dtype=torch.float64))
    expected = march(kind, start, direction)
    is_hit = torch.isfinite(hit.distance)
    agrees = is_hit == torch.isfinite(expected)
    assert agrees.double().mean() > 0.99  # a march does not settle rays that graze
    both = is_hit & torch.isfinite(expected)
    assert both.sum() > (400 if is_inside else 100)
    torch.testing.assert_close(hit.distance[both], expected[both], atol=1e-5, rtol=0)
    assert torch.equal(hit.body[is_hit], torch.zeros_like(hit.body[is_hit]))
    assert torch.equal(hit.body[~is_hit], torch.ones_like(hit.body[~is_hit]))


@pytest.mark.parametrize("is_inside", [False, True])
@pytest.mark.parametrize("kind", list(CASES))
def test_normal_is_the_gradient_of_the_distance(make_scene, kind, is_inside):
    tracer = Tracer(make_scene(CASES[kind] | {"texture": PAINT}), dtype=torch.float64)
    start, direction = rays(500, is_inside)
    hit = tracer.closest_hit(start, direction, torch.zeros(500, dtype=torch.float64))
    is_hit = torch.isfinite(hit.distance)
    point = (start + hit.distance * direction)[:, is_hit].T
    point = (point + 1e-4 * (point - 0)).requires_grad_()  # just outside, where it is smooth
    (gradient,) = torch.autograd.grad(signed_distance(kind, point).sum(), point)
    normal = hit.normal[:, is_hit].T
    cosine = (gradient * normal).sum(1) * (-1 if is_inside else 1)
    assert (cosine > 0.999).double().mean() > 0.99
    assert bool(((normal * direction[:, is_hit].T).sum(1) <= 0).all()), "it faces the ray"


def test_rectangle_ends_at_its_size_and_is_seen_from_behind(make_scene):
    body = {"kind": "plane", "size": [2.0, 1.0], "texture": PAINT}
    tracer = Tracer(make_scene(body), dtype=torch.float64)
    x = torch.tensor([0.0, 0.99, 1.01, 0.0, 0.0], dtype=torch.float64)
    y = torch.tensor([0.0, 0.0, 0.0, 0.49, 0.51], dtype=torch.float64)
    for side in (1.0, -1.0):
        origin = torch.stack((x, y, torch.full_like(x, 2 * side)))
        direction = torch.tensor([[0.0], [0.0], [-side]], dtype=torch.float64).expand(3, 5)
        hit = tracer.closest_hit(origin, direction, torch.zeros_like(x))
        assert hit.distance.tolist() == [2.0, 2.0, math.inf, 2.0, math.inf]
        assert hit.normal[2].tolist() == [side, side, 0.0, side, 0.0]


def test_each_ray_meets_the_scene_at_its_own_time(make_scene):
    body = {"kind": "sphere", "radius": 0.5, "velocity": [0, 0, 2.0], "texture": PAINT}
    tracer = Tracer(make_scene(body), 10.0, dtype=torch.float64)
    times = torch.linspace(-1, 1, 7, dtype=torch.float64)
    origin = torch.tensor([[0.0], [0.0], [50.0]], dtype=torch.float64).expand(3, 7)
    direction = torch.tensor([[0.0], [0.0], [-1.0]], dtype=torch.float64).expand(3, 7)
    distance = tracer.closest_hit(origin, direction, times).distance
    torch.testing.assert_close(distance, 50 - (20 + 2 * times) - 0.5)


def test_chunks_do_not_change_a_hit(make_scene, monkeypatch):
    tracer = Tracer(make_scene(CASES["box"] | {"texture": PAINT, "spin": 30.0}))
    start, direction = (v.float() for v in rays(1000, False))
    times = torch.rand(1000)
    whole = tracer.closest_hit(start, direction, times)
    monkeypatch.setattr("torchblur.render.trace.CHUNK", 137)
    for a, b in zip(whole, tracer.closest_hit(start, direction, times), strict=True):
        torch.testing.assert_close(a, b)
