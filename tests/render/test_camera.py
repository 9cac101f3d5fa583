"""Shift of the lens: where the view axis lies, and windows that are cameras of their own."""

import math

import pytest
import torch

from torchblur.errors import ConfigError
from torchblur.frame import Shutter
from torchblur.params import build
from torchblur.render import Scene, render_frame, render_reference, render_revealed, render_stream

WHOLE = (54, 96)
BOXES = [(5, 61, 24, 31), (30, 0, 24, 40), (0, 0, 54, 96)]
RED = {"texture": {"kind": "solid", "color": [0.8, 0.2, 0.1]}}
CHECKER = {"texture": {"kind": "checker", "size": 0.3, "color": [1, 1, 1], "background": [0, 0, 0]}}
MOVING = {
    "position": [0.2, 0.1, 5], "rotation": [-4, 8, 2], "velocity": [0.1, 0, -0.2], "spin": 2.0,
}  # fmt: skip
CAMERAS = {
    "angle": MOVING | {"fov": 60},
    "focal length": MOVING | {"focal": 0.8},
    "default, shifted": MOVING | {"shift": [0.12, -0.07]},
    "looks at a point": {"position": [1, 2, 5], "look_at": [0, 0, 0], "velocity": [0.3, 0, 0]},
}


def scene_of(camera, skin=CHECKER):
    bodies = [
        {"kind": "sphere", "radius": 0.9, "position": [1.2, 0.6, 0], "velocity": [0.2, 0.1, 0.3]},
        {"kind": "box", "size": [1, 2, 1], "position": [-1.5, -0.3, 0.5], "spin": 20.0},
    ]
    return build(Scene, {"camera": camera, "bodies": [body | skin for body in bodies]})


def assert_is_part(frame, whole, box, leave_out=()):
    layers = whole.crop(*box).layers()
    assert frame.layers().keys() == layers.keys()
    for name, layer in frame.layers().items():
        if name not in leave_out:
            torch.testing.assert_close(
                layer, layers[name], rtol=1e-5, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}"
            )


@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize("camera", list(CAMERAS))
def test_a_window_has_the_pixels_of_the_whole(camera, box):
    scene = scene_of(CAMERAS[camera])
    whole = render_frame(scene, WHOLE, frame=0.5, color_spp=1)
    window = render_frame(scene.window(of=WHOLE, box=box), box[2:], frame=0.5, color_spp=1)
    assert float(window.velocity.norm(dim=1).max()) > 1
    assert len(window.object_id.unique()) > 1
    assert_is_part(window, whole, box, leave_out=("color",))
    wrong = (window.color - whole.crop(*box).color).abs().amax(1) > 1e-3
    assert wrong.float().mean() < 0.005  # float32 rays may see the next field of a checker


def test_a_window_of_a_window_is_a_window():
    camera = scene_of(CAMERAS["default, shifted"]).camera
    outer = camera.window(of=WHOLE, box=(10, 20, 40, 60))
    inner = outer.window(of=(40, 60), box=(3, 7, 11, 13))
    direct = camera.window(of=WHOLE, box=(13, 27, 11, 13))
    assert inner.focal == pytest.approx(direct.focal, rel=1e-12)
    assert inner.shift == pytest.approx(direct.shift, rel=1e-12)
    whole = camera.window(of=WHOLE, box=(0, 0, *WHOLE))
    assert whole.focal_over_width == pytest.approx(camera.focal_over_width, rel=1e-12)
    assert whole.shift == pytest.approx(camera.shift, rel=1e-12)


def test_the_image_lies_right_of_and_below_the_axis():
    """What the camera looks at appears as far to the left and above, in widths."""
    camera = {"position": [0, 0, 5], "focal": 1.0, "shift": [0.25, 0.125]}
    ball = {"kind": "sphere", "radius": 0.1} | RED
    frame = render_frame(build(Scene, {"camera": camera, "bodies": [ball]}), (64, 80), color_spp=1)
    rows, columns = (frame.object_id[0, 0] == 1).nonzero().double().add(0.5).mean(0)
    assert float(columns) == pytest.approx(40 - 0.25 * 80, abs=0.01)
    assert float(rows) == pytest.approx(32 - 0.125 * 80, abs=0.01)


def test_streams_and_revealed_layers_of_a_window():
    scene, box = scene_of(CAMERAS["angle"]), BOXES[0]
    window = scene.window(of=WHOLE, box=box)
    whole, part = (
        render_stream(s, size, frame=0.5, shutter=Shutter(0.0))[0]
        for s, size in ((scene, WHOLE), (window, box[2:]))
    )
    assert_is_part(part, whole, box, leave_out=("time",))
    whole, part = (
        render_revealed(s, size, frame=0.5, color_spp=1).frame
        for s, size in ((scene, WHOLE), (window, box[2:]))
    )
    assert bool(part.valid.any())
    assert_is_part(part, whole, box, leave_out=("color",))


def test_the_reference_of_a_window():
    scene, box = scene_of(CAMERAS["angle"], RED), BOXES[0]
    window = scene.window(of=WHOLE, box=box)
    whole = render_reference(scene, WHOLE, spp=64, shutter=Shutter(1.0)).mean
    part = render_reference(window, box[2:], spp=64, shutter=Shutter(1.0)).mean
    wanted = whole[..., box[0] : box[0] + box[2], box[1] : box[1] + box[3]]
    assert float((part - wanted).abs().mean()) < 0.004  # noise of 64 samples
    assert float((part - wanted.roll(1, -1)).abs().mean()) > 0.008


def test_scenes_without_a_shift_are_known_as_before():
    """A hash of another value would render again what users have in their caches."""
    ball = {"kind": "sphere", "radius": 1.0, "texture": {"kind": "solid", "color": [1, 1, 1]}}
    data = {"camera": {"position": [0, 0, 5]}, "bodies": [ball]}
    scene = build(Scene, data)
    assert scene.fingerprint() == "0fb0ba15a81f4a3be641b4e94924d2ce"
    shifted = build(Scene, data | {"camera": {"position": [0, 0, 5], "shift": [0, 0.1]}})
    assert shifted.fingerprint() != scene.fingerprint()
    assert build(Scene, shifted.model_dump(mode="json")) == shifted
    assert build(Scene, shifted.model_dump(mode="json", exclude_defaults=True)) == shifted


def test_what_is_no_window_is_refused():
    camera = scene_of(CAMERAS["angle"]).camera
    with pytest.raises(ConfigError, match=r"at least 1 px, got `of` \(54, 96\) and `box`"):
        camera.window(of=WHOLE, box=(0, 0, 10, 0))
    beyond = camera.window(of=WHOLE, box=(-27, -48, 108, 192))
    assert beyond.focal_over_width == pytest.approx(0.25 / math.tan(math.radians(30)))
    assert beyond.shift == pytest.approx((0, 0))
