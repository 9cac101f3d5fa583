"""The hybrid filter of Tan 2022 against its slow twin."""

import numpy as np
import pytest
import torch
from twins.reconstruction import settings_of, within_tiles
from twins.tan2022 import DEFAULTS, edge_strength, tan2022, tap_weight

from torchblur.filters.tan2022 import Tan2022Blur
from torchblur.frame import Frame
from torchblur.ops.noise import noise_plane

ROWS, COLUMNS = 16, 22
CASES = [
    {},
    {"shutter_position": "trailing", "tile_size": 6, "num_samples": 8},
    {"shutter_position": "centered", "tile_size": 9, "num_samples": 7},
    {"shutter": 1.0, "mask_magnifier": 1.5, "foreground_magnifier": 4.0, "jitter": 0.4},
    {"soft_depth_extent": 0.5, "background_depth": 0.4, "edge_threshold": 0.5},
    {"depth_edge_gain": 0.2, "normal_edge_gain": 3.0, "edge_threshold": 0.95, "mask_samples": 7},
    {"color_lookup": "bilinear", "center_gain": 2.5, "depth_level": 0.5, "min_length": 0.8},
    {"noise": "none", "third_gain": 0.5, "foreground_gain": 2.0, "background_gain": 0.7},
    {
        "cone_slope": 0.8,
        "cone_exponent": 1.5,
        "cylinder_inner": 0.7,
        "tile_size": 4,
        "early_out": 0.6,
    },
]


def scene(rng, *, valid=False):
    """A block that moves right and down, one behind it, and a still ground; each pixel differs."""
    y, x = np.indices((ROWS, COLUMNS))
    near = (y > 3) & (y < 12) & (x > 5) & (x < 14)
    far = (y > 8) & (x > 11) & ~near
    velocity = 0.3 * rng.normal(size=(2, ROWS, COLUMNS))
    velocity += np.where(near, np.reshape((9.0, 3.0), (2, 1, 1)), 0)
    velocity += np.where(far, np.reshape((-4.0, 6.0), (2, 1, 1)), 0)
    depth = np.where(near, 2.0, np.where(far, 2.8, 4.0)) + rng.uniform(0, 0.1, near.shape)
    depth[:3, 15:] = np.inf
    normal = rng.normal(size=(3, ROWS, COLUMNS)) * 0.1 + np.where(near, 1, 0) - np.where(far, 1, 0)
    layer = {
        "color": rng.uniform(0, 2, (3, ROWS, COLUMNS)),
        "depth": 4.0 + rng.uniform(0, 0.1, (1, ROWS, COLUMNS)),
        "velocity": rng.normal(0, 3, (2, ROWS, COLUMNS)),
        "valid": rng.uniform(0, 1, (1, ROWS, COLUMNS)) < 0.9,
    }
    frame = {
        "color": rng.uniform(0, 2, (3, ROWS, COLUMNS)),
        "depth": depth[None],
        "velocity": velocity,
        "object_id": (near + 2 * far)[None].astype(np.int64),
        "normal": normal,
        "revealed": layer,
    }
    if valid:
        frame["valid"] = rng.uniform(0, 1, (1, ROWS, COLUMNS)) < 0.9
    return frame


def frame_of(planes):
    layers = {
        name: frame_of(plane) if name == "revealed" else torch.from_numpy(plane)[None]
        for name, plane in planes.items()
    }
    return Frame(**layers)


def both(planes, params):
    blur = Tan2022Blur(**params)
    settings = blur.config.model_dump()
    settings = {k: float(np.float32(v)) if isinstance(v, float) else v for k, v in settings.items()}
    frame = frame_of(planes)
    noise = noise_plane(settings["noise"], frame.color, 0, settings["seed"])[0, 0].numpy()
    return blur.layers(frame), tan2022(planes, tap_noise=noise, **settings)


def differences(layers, twin):
    """By name, the share of pixels that are not alike; sums of taps count where they are used."""
    shares = {}
    for name, plane in twin.items():
        if name == "moving":
            continue
        away = np.abs(layers[name].detach().numpy()[0] - plane)
        if name in ("foreground_weight", "background_weight"):
            away *= twin["moving"]
        shares[name] = float((away > 1e-7 * (1 + np.abs(plane))).any(0).mean())
    return {name: share for name, share in shares.items() if share > 0}


@pytest.mark.parametrize("valid", [False, True])
@pytest.mark.parametrize("params", CASES, ids=str)
def test_filter_equals_its_twin(params, valid):
    layers, twin = both(scene(np.random.default_rng(5), valid=valid), params)
    assert differences(layers, twin) == {}
    assert 0.02 < twin["hybrid"].mean() < twin["ray_mask"].mean()


@pytest.mark.filterwarnings("ignore:tan2022. no layer:UserWarning")
@pytest.mark.parametrize("missing", ["object_id", "normal", "revealed"])
def test_filter_equals_its_twin_without_a_layer(missing):
    planes = scene(np.random.default_rng(6))
    del planes[missing]
    layers, twin = both(planes, {"edge_threshold": 0.6})
    assert differences(layers, twin) == {}
    assert twin["ray_mask"].any()


def test_a_background_at_infinity():
    planes = scene(np.random.default_rng(7))
    planes["revealed"]["depth"][:] = np.inf
    layers, twin = both(planes, {"background_depth": 0.3})
    assert differences(layers, twin) == {}
    assert twin["background_weight"].any()


def test_the_twin_has_the_defaults_of_the_filter():
    assert within_tiles(Tan2022Blur().config.model_dump()) == DEFAULTS


def test_the_comparison_can_fail():
    planes = scene(np.random.default_rng(5))
    layers, _ = both(planes, {})
    for params, names in (
        ({"mask_magnifier": 3.1}, {"color"}),
        ({"foreground_magnifier": 29.0}, {"color", "background", "foreground_weight"}),
        ({"edge_threshold": 0.975}, {"edge_mask"}),
    ):
        assert names <= set(differences(layers, both(planes, params)[1]))


# -- the twin, by hand -------------------------------------------------------------------------


def test_weight_of_a_tap():
    """Eq. 5 to 10: s = 3, |v_s| = 6 and |v_t| = 4 over the exposure, half of them in the field."""
    settings = settings_of(DEFAULTS, {"soft_depth_extent": 1.0})
    vectors = (2.0, 0.0), (3.0, 0.0)  # the pixel's, the tap's
    level = tap_weight(3.0, (5.0, 5.0), vectors, settings)
    assert level == pytest.approx((1 - 3 / 6) + (1 - 3 / 4) + 2)
    behind = tap_weight(3.0, (5.0, 5.5), vectors, settings)
    assert behind == pytest.approx(0.5 * (1 - 3 / 6) + (1 - 3 / 4) + 2)
    in_front = tap_weight(5.0, (5.0, 3.5), vectors, settings)
    assert in_front == pytest.approx(30 * (1 - 5 / 6))


def test_edge_strength_of_a_step():
    """A step of depth from 1 to 2 between columns 4 and 5: 16 times slopes 1 + 2, over Z."""
    settings = settings_of(DEFAULTS, {})
    depth = np.ones((7, 10))
    depth[:, 5:] = 2.0
    row = edge_strength(depth, None, settings)[3]
    assert row[2:8] == pytest.approx([0, 16 / 17, 48 / 49, 24 / 25, 8 / 9, 0])
