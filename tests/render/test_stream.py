"""Streams: closed forms at each pixel's own time, convergence, independence, seeds, bad input."""

import math

import pytest
import torch
from scipy.stats import kstest, norm

from torchblur.errors import ConfigError
from torchblur.frame import FrameSequence, Shutter
from torchblur.render import Renderer, load_scene, render_frame, render_reference, render_stream
from torchblur.render.trace import Tracer

PX = 4 / 32  # scene units per pixel at depth 4 and width 32
SIZE = (8, 32)
LAYERS = {"color", "velocity", "depth", "normal", "object_id", "time", "albedo"}
BLACK = {"sky": {"kind": "solid", "color": [0, 0, 0]}}
NOISE = {"kind": "noise", "size": 0.7, "color": [1, 0.5, 0.2], "background": [0.1, 0.1, 0.4]}


def bar(glow, speed, **others):
    """A white half plane whose edge is at the middle of the image at frame 0, speed in px."""
    wide = {"kind": "plane", "size": [40.0, 40.0], "position": [-20.0, 0, 0]}
    return wide | {"velocity": [speed * PX, 0, 0]} | glow(1, 1, 1) | others


def from_middle(size):
    """x and y of the pixel centers from the middle of the image, px, (H, W) each."""
    height, width = size
    y, x = torch.meshgrid(
        torch.arange(height) + 0.5 - height / 2, torch.arange(width) + 0.5 - width / 2,
        indexing="ij",
    )  # fmt: skip
    return x.double(), y.double()


# -- each sample, in closed form ---------------------------------------------------------------


@pytest.mark.parametrize("position", ["centered", "leading", "trailing"])
def test_every_sample_of_a_moving_edge_is_seen_at_its_time(make_scene, glow, position):
    shutter = Shutter(0.5, position)
    (frame,) = render_stream(
        make_scene(bar(glow, 16.0), **BLACK), SIZE, frame=0.25, shutter=shutter
    )
    assert set(frame.layers()) == LAYERS
    start, end = shutter.interval
    edge = 16 * (0.25 + start + (end - start) * frame.time[0, 0].double())
    covered = from_middle(SIZE)[0] < edge
    assert torch.equal(frame.color[0, 0] > 0.5, covered)
    assert torch.equal(frame.object_id[0, 0] == 1, covered)
    assert torch.equal(torch.isinf(frame.depth[0, 0]), ~covered)
    assert frame.velocity[0, 0][covered].allclose(torch.tensor(16.0))
    assert not frame.velocity[0, :, ~covered].any()


def test_a_sphere_is_where_it_is_at_each_time(make_scene):
    """Depth from the ray's equation, at twice a chunk's pixels; velocity from that depth."""
    size, focal = (258, 256), 256.0
    ball = {"kind": "sphere", "radius": 1.0, "position": [-0.2, 0.1, 0], "texture": NOISE}
    scene = make_scene(ball | {"velocity": [0.6, -0.3, 0]})
    (frame,) = render_stream(scene, size, frame=1.0)
    x, y = from_middle(size)
    time = 1.0 + frame.time[0, 0].double() - 0.5
    middle = torch.stack((-0.2 + 0.6 * time, 0.1 - 0.3 * time, torch.full_like(time, -4.0)))
    ray = torch.stack((x / focal, -y / focal, torch.full_like(x, -1.0)))
    half, square = (ray * middle).sum(0), ray.square().sum(0)
    root = half.square() - square * (middle.square().sum(0) - 1)
    hit = root > 1e-6
    assert torch.equal(frame.object_id[0, 0] == 1, root > 0)
    depth = (half - root.clamp(min=0).sqrt()) / square
    torch.testing.assert_close(frame.depth[0, 0][hit].double(), depth[hit], rtol=1e-6, atol=0)
    want = focal * torch.tensor([0.6, 0.3])[:, None] / depth[hit]
    torch.testing.assert_close(frame.velocity[0][:, hit].double(), want, rtol=1e-6, atol=0)
    normal = (ray * depth - middle)[:, hit]
    torch.testing.assert_close(frame.normal[0][:, hit].double(), normal, rtol=0, atol=1e-5)


def test_velocity_is_that_of_the_pixels_own_time(make_scene):
    """A plane that comes nearer moves ever faster on the screen: x times speed over distance."""
    scene = make_scene({"kind": "plane", "velocity": [0, 0, 2.0], "texture": NOISE})
    (frame,) = render_stream(scene, SIZE, shutter=Shutter(1.0))
    distance = 4 - 2 * (frame.time[0, 0].double() - 0.5)
    torch.testing.assert_close(frame.depth[0, 0].double(), distance, rtol=1e-6, atol=0)
    want = torch.stack(from_middle(SIZE)) * 2 / distance
    torch.testing.assert_close(frame.velocity[0].double(), want, rtol=1e-5, atol=0)


@pytest.mark.parametrize("motion", [{"velocity": [0.5, 0.25, 0]}, {"spin": 9.0}])
def test_velocity_carries_a_sample_to_another_time(make_scene, motion):
    """The texture at (x, y) at time t is at (x, y) + shutter velocity (s - t) at time s."""
    slope = {"kind": "noise", "size": 3.0, "color": [1, 0.5, 0], "background": [0, 0.2, 1]}
    plane = {"kind": "plane", "texture": slope | {"contrast": 1.0}, "emissive": True}
    scene, shutter, size = make_scene(plane | motion), Shutter(0.8), (60, 64)
    (frame,) = render_stream(scene, size, shutter=shutter)
    for s in (0.0, 0.5, 1.0):
        sharp = render_frame(scene, size, frame=0.8 * (s - 0.5), color_spp=1)
        errors = {}
        for sign in (1, 0, -1):
            moved = sign * 0.8 * frame.velocity * (s - frame.time)
            there = (torch.stack(from_middle(size)) + moved[0]).float()
            grid = torch.stack((there[0] / size[1], there[1] / size[0]), -1)[None] * 2
            seen = torch.nn.functional.grid_sample(sharp.color, grid, align_corners=False)
            inside = (grid.abs() < 0.95).all(-1)[0]
            errors[sign] = float((seen - frame.color)[0][:, inside].abs().mean())
        assert errors[1] < 0.003
        assert min(errors[0], errors[-1]) > 5 * errors[1]


def test_color_is_albedo_in_the_light_of_its_normal(make_scene):
    light = {"direction": [1.0, 2.0, 2.0], "ambient": 0.25}
    ball = {"kind": "sphere", "radius": 1.0, "spin": 40.0, "texture": NOISE}
    lamp = {"kind": "sphere", "radius": 0.5, "position": [1.3, 0, 0], "emissive": True}
    scene = make_scene(ball, lamp | {"texture": NOISE}, light=light, sky=NOISE)
    (frame,) = render_stream(scene, (24, 32))
    lit = frame.object_id == 1
    assert 100 < lit.sum() < 24 * 32
    cosine = torch.einsum("bchw,c->bhw", frame.normal, torch.tensor([1.0, 2, 2]) / 3).clamp(min=0)
    factor = torch.where(lit, 0.25 + 0.75 * cosine[:, None], 1.0)
    torch.testing.assert_close(frame.color, frame.albedo * factor, rtol=1e-5, atol=1e-6)
    assert frame.albedo[0, 0][lit[0, 0]].std() > 0.05
    assert (frame.albedo != frame.color).any()


# -- what it converges to ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def crossing(repository):
    return Renderer(load_scene(repository / "configs/scenes/crossing_spheres.yaml"))


@pytest.mark.parametrize(("jitter", "pixel", "other"), [(False, "center", "box"),
                                                        (True, "box", "center")])  # fmt: skip
def test_mean_of_many_streams_is_the_reference(crossing, jitter, pixel, other):
    size, count, shutter = (18, 32), 256, Shutter(0.8)
    frames = crossing.stream(size, shutter=shutter, spp=count, seed=3, jitter=jitter)
    color = torch.cat([frame.color for frame in frames])

    def largest_z(reference):
        deviation = (color.var(0) / count + reference.variance[0]).sqrt()
        # A pixel that another surface covers for 1 % of the time may be seen never: 0.005.
        return ((color.mean(0) - reference.mean[0]).abs() / (deviation + 5e-3)).max()

    limit = norm.isf((1 - (1 - 0.01) ** (1 / color[0].numel())) / 2)  # Sidak: 1 % for all together
    good, wrong = (
        crossing.reference(size, spp=1024, shutter=shutter, seed=9, pixel=p) for p in (pixel, other)
    )
    assert largest_z(good) < limit
    assert largest_z(wrong) > limit, "the test tells the two references apart"
    longer = crossing.reference(size, spp=1024, shutter=Shutter(1.0), seed=9, pixel=pixel)
    assert largest_z(longer) > limit, "the test sees another shutter"


def test_a_moving_edge_is_a_ramp(make_scene, glow):
    scene = make_scene(bar(glow, 16.0), **BLACK)
    want = ((8 - from_middle(SIZE)[0]) / 16).clamp(0, 1).float()
    frames = render_stream(scene, SIZE, spp=512)
    mean = torch.cat([frame.color[:, 1] for frame in frames]).mean(0)
    deviation = (want * (1 - want) / 512).sqrt()
    assert ((mean - want).abs() <= 5 * deviation + 1e-6).all()
    reference = render_reference(scene, SIZE, spp=50, shutter=Shutter(1.0), pixel="center")
    error = reference.mean[0, 0] - want
    assert error.abs().max() <= 1 / 50 + 1e-6  # the stratum in which the edge passes
    assert error.mean().abs() < 2e-3


def test_closed_shutter_at_the_center_is_the_sharp_frame_without_variance(crossing):
    reference = crossing.reference((18, 32), spp=4, shutter=Shutter(0), frame=0.5, pixel="center")
    sharp = crossing.frame((18, 32), frame=0.5, color_spp=1)
    assert ((reference.mean - sharp.color).abs() > 1e-4).double().mean() < 0.01
    assert reference.variance.max() < 1e-10
    (stream,) = crossing.stream((18, 32), shutter=Shutter(0), frame=0.5)
    for name in LAYERS - {"time", "albedo"}:
        assert torch.equal(stream.layers()[name], sharp.layers()[name]), name


def test_4096_samples_know_their_error(crossing):
    size = (9, 16)
    first, second = (
        crossing.reference(size, spp=4096, shutter=Shutter(1.0), seed=seed, pixel="center")
        for seed in (1, 2)
    )
    assert first.spp == 4096
    assert 0 < first.variance.mean().sqrt() < 1e-3
    deviation = (first.variance + second.variance).sqrt() + 1e-5
    assert ((first.mean - second.mean).abs() / deviation).max() < 5


# -- random numbers ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def times():
    """Times of three frames of an empty scene, (3, H, W)."""
    from torchblur.params import build
    from torchblur.render import Scene

    body = {"kind": "sphere", "radius": 1.0, "texture": {"kind": "solid", "color": [1, 1, 1]}}
    scene = build(Scene, {"camera": {"position": [0, 0, 4]}, "bodies": [body]})
    frames = [render_stream(scene, (90, 160), frame=f, seed=5)[0] for f in (-1, 0, 1)]
    return torch.cat([frame.time[:, 0] for frame in frames]).double()


def test_times_are_uniform(times):
    assert times.min() >= 0
    assert times.max() < 1
    for time in times:
        assert kstest(time.flatten().numpy(), "uniform").pvalue > 0.005


def test_times_are_independent_of_neighbors_and_other_frames(times):
    pairs = [
        (times[0], times[1]), (times[1], times[2]), (times[0], times[2]),
        (times[0][:, 1:], times[0][:, :-1]), (times[0][1:], times[0][:-1]),
        (times[0][:, 1:], times[1][:, :-1]),
    ]  # fmt: skip
    for a, b in pairs:
        correlation = torch.corrcoef(torch.stack((a.flatten(), b.flatten())))[0, 1]
        assert abs(correlation) < 4 / math.sqrt(a.numel())


def test_same_seed_same_frame_and_every_other_number_another(crossing):
    size = (6, 10)
    alone = crossing.stream(size, frame=7, seed=2)[0]
    for frame in (5, 6):
        crossing.stream(size, frame=frame, seed=2)
    again = crossing.stream(size, frame=7, seed=2)[0]
    for name, layer in alone.layers().items():
        assert torch.equal(layer, again.layers()[name]), name
    others = [
        crossing.stream(size, frame=f, seed=s)[0].time
        for f, s in ((7, 3), (6, 2), (-7, 2), (7.5, 2), (2, 7), (7, -2))
    ]
    for other in others:
        assert not (other == alone.time).any()
    assert torch.equal(crossing.stream(size, frame=-0.0)[0].time, crossing.stream(size)[0].time)


def test_more_samples_begin_with_the_same(crossing):
    one, three = (crossing.stream((6, 10), spp=n, seed=4) for n in (1, 3))
    assert (len(one), len(three)) == (1, 3)
    assert torch.equal(one[0].color, three[0].color)
    assert not (three[0].time == three[1].time).any()
    assert not (three[1].time == three[2].time).any()
    third = crossing.stream_sample((6, 10), 2, seed=4)
    assert torch.equal(third.color, three[2].color)
    assert torch.equal(third.time, three[2].time)
    jittered = crossing.stream((6, 10), seed=4, jitter=True)[0]
    assert torch.equal(jittered.time, one[0].time)
    assert not torch.equal(jittered.depth, one[0].depth)


def test_frames_make_a_sequence(crossing):
    sequence = FrameSequence(tuple(crossing.stream((6, 10), frame=f)[0] for f in range(3)))
    assert len(sequence) == 3
    assert set(sequence[2].layers()) == LAYERS


def test_many_images_are_worth_compiling(crossing, monkeypatch):
    asked = []

    def tracer(*args, compiled=False, **others):
        asked.append(compiled)
        return Tracer(*args, **others)

    monkeypatch.setattr("torchblur.render.renderer.Tracer", tracer)
    crossing.stream((90, 160))
    Renderer(crossing.scene, images=2000).stream((90, 160))
    Renderer(crossing.scene, images=2000, engine="eager").stream((90, 160))
    assert asked == [False, True, False]


@pytest.mark.slow
def test_compiled_streams_are_the_same(crossing):
    eager, compiled = (
        Renderer(crossing.scene, engine=engine).stream((36, 64))[0]
        for engine in ("eager", "compiled")
    )
    for name, layer in eager.layers().items():
        torch.testing.assert_close(compiled.layers()[name], layer, msg=name)


# -- bad input ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"spp": 0}, "`spp` must be an integer of at least 1, got 0"),
        ({"size": (0, 4)}, r"`size` must be \(height, width\).*got \(0, 4\)"),
        ({"frame": math.inf}, "`frame` must be a finite number, got inf"),
    ],
)
def test_bad_arguments_are_refused(make_scene, glow, arguments, message):
    with pytest.raises(ConfigError, match=message):
        render_stream(make_scene(bar(glow, 1.0)), **({"size": SIZE} | arguments))


def test_samples_are_counted_from_0(crossing):
    with pytest.raises(ConfigError, match=r"`sample` must be an integer of at least 0, got -1"):
        crossing.stream_sample((6, 10), -1)


def test_unknown_pixel_filter_is_refused(make_scene, glow):
    with pytest.raises(ConfigError, match=r"`pixel` must be 'box' or 'center', got 'gauss'"):
        render_reference(make_scene(bar(glow, 1.0)), SIZE, spp=2, pixel="gauss")
