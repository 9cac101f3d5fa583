"""One scene at three heights: beside a line blur, nothing gets worse on a large frame."""

from pathlib import Path

import pytest
import torch

from torchblur.filters import TemporalBlur, get_filter, list_filters
from torchblur.frame import Shutter
from torchblur.metrics import evaluate
from torchblur.presets import create_filter
from torchblur.render import load_scene, render_frame, render_reference

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:tan2022. no layer:UserWarning")]

CONFIGS = Path(__file__).parents[1] / "configs"
SHUTTER = 0.3  # half spreads of 17 px at 270 lines, 69 px at 1080
HEIGHTS = (270, 540, 1080)
FORMS = [name for name in list_filters() if not issubclass(get_filter(name), TemporalBlur)]
PRESETS = sorted(
    path
    for path in (CONFIGS / "filters").glob("*-*.yaml")
    if not path.stem.startswith(("oberberger2022", "notes2025-full", "notes2025-half"))
)


@pytest.fixture(scope="module")
def windows():
    """The middle third of the image, sharp and blurred, for each height."""
    scene = load_scene(CONFIGS / "scenes" / "crossing_spheres.yaml")
    found = {}
    for lines in HEIGHTS:
        whole = lines, lines * 16 // 9
        height, width = (edge // 3 for edge in whole)
        part = scene.window(of=whole, box=(height, width, height, width))
        shutter = Shutter(SHUTTER)
        reference = render_reference(part, (height, width), spp=64, shutter=shutter, seed=1).mean
        found[lines] = render_frame(part, (height, width), color_spp=16), reference
    return found


def ratios(blur, windows):
    """FLIP over that of the line blur, by height."""
    line, found = get_filter("line")(), []
    with torch.no_grad():
        for frame, reference in windows.values():
            given = {"shutter": SHUTTER, "shutter_position": "centered"}
            own, plain = (
                float(evaluate(one(frame, **given), reference)["flip"]) for one in (blur, line)
            )
            found.append(own / plain)
    return found


@pytest.mark.parametrize("name", FORMS)
def test_a_filter_keeps_its_place_on_large_frames(windows, name):
    # Papers cut at their tile; their forms are looked at without that.
    free = {"reach": "frame"} if "reach" in get_filter(name).config_class.model_fields else {}
    found = ratios(create_filter(name, **free), windows)
    assert found[-1] <= 1.25 * found[0], found


@pytest.mark.parametrize("path", PRESETS, ids=lambda path: path.stem)
def test_a_preset_keeps_its_place_on_large_frames(windows, path):
    found = ratios(create_filter(path), windows)
    assert found[-1] <= 1.25 * found[0], found


def test_the_default_beats_the_line_blur_by_as_much_at_1080_lines(windows):
    found = ratios(create_filter(), windows)
    assert found[-1] <= 1.1 * found[0], found
    assert found[-1] <= 0.55, found


def test_without_reach_the_default_would_fail(windows):
    cut = create_filter(reach="tile", tile_size=20)
    found = ratios(cut, windows)
    assert found[-1] > 1.25 * found[0], found
