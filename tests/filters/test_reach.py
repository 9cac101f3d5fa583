import warnings

import pytest
import torch

from torchblur.errors import ReachWarning
from torchblur.filters import get_filter
from torchblur.filters.parts import reach as reach_module
from torchblur.filters.parts.base import Values
from torchblur.filters.parts.moving import least_spread
from torchblur.filters.parts.reach import by_length, tap_counts
from torchblur.frame import Frame
from torchblur.ops import gather as gather_module
from torchblur.ops.pixels import PixelList
from torchblur.testing.frames import constant_motion, random_frame
from torchblur.testing.probes import box_blur

REACHING = (
    "guertin2014",
    "jimenez2014",
    "mcguire2012",
    "notes2025",
    "sousa2013",
    "tan2022",
    "torchblur",
)
POSITIONS = ("centered", "leading", "trailing")


def make(name, **params):
    blur = get_filter(name)(**params)
    if name == "tan2022":
        blur._told = {"normal", "object_id", "revealed"}
    return blur


def passing(speed=240.0, height=24, width=400):
    """A white bar, 40 px wide, that flies over a dark still ground."""
    inside = torch.zeros(1, 1, height, width, dtype=torch.bool)
    inside[..., 180:220] = True
    velocity = torch.zeros(1, 2, height, width)
    velocity[:, :1] = torch.where(inside, speed, 0.0)
    return Frame(
        color=inside.expand(1, 3, -1, -1).float(),
        velocity=velocity,
        depth=torch.where(inside, 1.0, 9.0),
    )


@pytest.mark.parametrize("position", POSITIONS)
@pytest.mark.parametrize("name", REACHING)
def test_uniform_motion_longer_than_a_tile_is_a_box_blur(name, position):
    frame = constant_motion((160.0, 0.0), 8, 400)
    blur = make(
        name,
        shutter_position=position,
        reach="frame",
        tile_size=10,
        tap_spacing=1.0,
        max_samples=1024,
        noise="none",
    )
    blurred = blur(frame).detach()
    shift = {"centered": 0.0, "leading": 40.0, "trailing": -40.0}[position]
    expected = box_blur(frame.color, 80.0, shift)
    inner = slice(120, -120)
    error = float((blurred - expected)[..., inner].abs().mean())
    unblurred = float((frame.color - expected)[..., inner].abs().mean())
    assert error < 0.25 * unblurred


@pytest.mark.parametrize("position", POSITIONS)
@pytest.mark.parametrize("name", REACHING)
def test_what_flies_past_reaches_as_far_as_it_moves(name, position):
    frame = passing()  # half spread 60 px; tiles of 10
    blur = make(name, shutter_position=position, tile_size=10, tap_spacing=4.0, noise="none")
    blurred = make(name, **(blur.config.model_dump() | {"reach": "frame"}))(frame).detach()
    row = (blurred[0, 0, 12] > 0.02).nonzero()[:, 0]
    center = {"centered": 0, "leading": 60, "trailing": -60}[position]
    assert abs(int(row.min()) - (180 - 60 + center)) <= 16
    assert abs(int(row.max()) - (219 + 60 + center)) <= 16
    with pytest.warns(ReachWarning):
        cut = make(name, **(blur.config.model_dump() | {"reach": "tile"}))(frame).detach()
    short = (cut[0, 0, 12] > 0.02).nonzero()[:, 0]
    assert int(short.max() - short.min()) <= 40 + 2 * 10 + 2


@pytest.mark.parametrize("name", REACHING)
def test_max_reach_cuts(name):
    frame = passing()
    blur = make(name, reach="frame", max_reach=30.0, tile_size=10, noise="none")
    with pytest.warns(ReachWarning, match=r"up to 60 px, .*raise `max_reach`, now 30 px"):
        blurred = blur(frame, shutter_position="centered").detach()
    row = (blurred[0, 0, 12] > 0.02).nonzero()[:, 0]
    assert 40 + 2 * 20 < int(row.max() - row.min()) <= 40 + 2 * 30 + 2


@pytest.mark.parametrize("name", REACHING)
def test_batch_of_slow_and_fast_frames_equals_single_runs(name):
    frames = [random_frame(40, 48, speed=speed, seed=seed) for seed, speed in enumerate((4, 120))]
    blur = make(name, reach="frame", tile_size=6, tap_spacing=3.0)
    single = torch.cat([blur(frame) for frame in frames])
    assert torch.allclose(blur(Frame.stack(frames)), single, atol=1e-5)


@pytest.mark.parametrize("name", REACHING)
def test_only_the_moving_part_costs_and_counts(name):
    # A long blur in a corner of a wide still frame: as if all pixels were done.
    frame = passing(width=400)
    wide = Frame(
        **{
            key: torch.nn.functional.pad(
                plane.float(), (0, 1200, 0, 0), value=9.0 * (key == "depth")
            )
            for key, plane in frame.layers().items()
        }
    )
    blur = make(name, reach="frame", tile_size=10, shutter_position="centered", noise="none")
    with torch.no_grad():
        narrow, image = blur(frame), blur(wide)
    assert torch.allclose(image[..., :300], narrow[..., :300], atol=1e-5)
    assert torch.equal(image[..., 400:], wide.color[..., 400:])


# -- taps ------------------------------------------------------------------------------------------


def values(**changed):
    base = {"tap_spacing": 3.0, "num_samples": 16, "max_samples": 128}
    return Values(**(base | changed))


def test_neighboring_taps_are_as_close_as_promised():
    reach = torch.linspace(0, 300, 997).view(1, 1, 1, -1)
    counts = tap_counts(values(), reach, 16)
    assert float(counts.min()) == 16
    assert float(counts.max()) == 128
    gap = 2 * reach / counts
    assert float(gap[counts < 128].max()) <= 3.0 + 1e-4
    # No more than the next step of the square root of 2 beyond what is needed.
    needed = (2 * reach / 3.0).clamp(16, 128)
    assert float((counts / needed).max()) < 1.5


def test_sums_count_alike_whatever_their_taps():
    # Each tap adds 1 (and a mean is a mean), in three classes of pixels at once.
    frame = passing(height=4, width=30)
    pixels = PixelList.all(frame.color)
    reach = torch.linspace(1, 90, 120).view(1, 1, 1, -1)
    numbers = []

    def gather(count, lists, some):
        assert lists["reach"].shape[3] == some.count
        numbers.append(count)
        return (torch.full_like(lists["reach"], float(count)), lists["reach"])

    def means(count, lists, some):
        return (torch.ones_like(lists["reach"]), lists["reach"])

    lists = {"reach": reach, "gain": torch.tensor(2.0)}
    total, order = by_length(gather, values(), reach, lists, pixels, 16)
    assert len(set(numbers)) > 3
    assert torch.equal(total, torch.full_like(reach, 16.0))
    assert torch.allclose(order * tap_counts(values(), reach, 16) / 16, reach)
    mean, place = by_length(means, values(), reach, lists, pixels, 16, means=True)
    assert torch.equal(mean, torch.ones_like(reach))
    assert torch.equal(place, reach)  # back where they came from


def test_pairs_have_half_as_many():
    reach = torch.linspace(0, 300, 97).view(1, 1, 1, -1)
    counts = tap_counts(values(), reach, 8)
    assert float(counts.max()) == 64
    assert float((2 * reach / (2 * counts))[counts < 64].max()) <= 3.0 + 1e-4


@pytest.mark.parametrize("name", REACHING)
def test_only_long_paths_take_more_taps(monkeypatch, name):
    taken = []
    original = gather_module.sum_taps

    def counting(tap, options, num_samples, inputs, *args, lists, **kwargs):
        taken.append((num_samples, lists.num_pixels))
        return original(tap, options, num_samples, inputs, *args, lists=lists, **kwargs)

    monkeypatch.setattr(gather_module, "sum_taps", counting)
    settings = {"reach": "frame", "tile_size": 10, "num_samples": 8, "noise": "none"}
    slow, fast = passing(16.0), passing(240.0)
    with torch.no_grad():
        for spacing in (0.0, 2.0):
            make(name, tap_spacing=spacing, **settings)(slow)
            taken.append(None)
        middle = taken.index(None)
        assert taken[:middle] == taken[middle + 1 : -1]  # 4 px of path: the same work
        taken.clear()
        make(name, tap_spacing=2.0, **settings)(fast)
        assert max(number for number, _ in taken) >= 30


def test_half_resolution_takes_as_many_taps(monkeypatch):
    taken = {}
    original = gather_module.sum_taps

    def counting(tap, options, num_samples, inputs, *args, lists, **kwargs):
        taken[resolution] = max(taken.get(resolution, 0), num_samples)
        return original(tap, options, num_samples, inputs, *args, lists=lists, **kwargs)

    monkeypatch.setattr(gather_module, "sum_taps", counting)
    for resolution in ("full", "half"):
        blur = get_filter("notes2025")(
            reach="frame", tap_spacing=4.0, resolution=resolution, post_filter=False
        )
        with torch.no_grad():
            blur(passing(240.0))
    assert taken["half"] == taken["full"]


def test_a_streak_of_a_bright_point_has_no_beads():
    frame = passing()
    point = torch.zeros(1, 1, 24, 400, dtype=torch.bool)
    point[..., 11:14, 199:202] = True
    velocity = torch.zeros(1, 2, 24, 400)
    velocity[:, :1] = torch.where(point, 200.0, 0.0)
    frame = Frame(
        color=torch.where(point, 50.0, 0.1).expand(1, 3, -1, -1),
        velocity=velocity,
        depth=torch.where(point, 1.0, 9.0),
    )
    blurred = get_filter("torchblur")()(frame).detach()[0, 0, 12, 160:241]
    sparse = get_filter("torchblur")(tap_spacing=0.0)(frame).detach()[0, 0, 12, 160:241]
    # The exact streak has 3 px of 50 over 100 px, and the ground.
    exact = 0.1 + (50 - 0.1) * 3 / 100
    assert float((blurred - exact).abs().mean()) < 0.4 * exact
    assert float(blurred.std()) < 0.5 * float(sparse.std())


# -- the warning -----------------------------------------------------------------------------------


def test_a_cut_is_told_once_with_its_figures():
    frame = passing()  # 10 % of the pixels move, 60 px to each side
    blur = get_filter("guertin2014")(tile_size=20)
    with pytest.warns(ReachWarning) as told:
        blur(frame)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        blur(frame)
    assert len(told) == 1
    assert str(told[0].message) == (
        "guertin2014: 10% of the pixels move farther than the 20 px to each side that it blurs, up "
        'to 60 px, and are cut there; give reach="frame", or a larger `tile_size`, now 20 px'
    )
    assert told[0].filename == __file__


@pytest.mark.parametrize("params", [{"reach": "frame"}, {"tile_size": 60}, {"shutter": 0.1}])
def test_what_is_not_cut_is_not_told(params):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        get_filter("guertin2014")(**({"tile_size": 20} | params))(passing())


def test_cut_counts_pixels_at_the_shutter_of_the_call():
    blur = get_filter("mcguire2012")(tile_size=20)
    frame = passing()
    assert blur.cut(frame).share == pytest.approx(0.1)
    assert blur.cut(frame)[1:] == pytest.approx((60.0, 20.0))
    assert blur.cut(frame, shutter=0.1).share == 0.0
    two = blur.cut(frame, shutter=torch.tensor([0.1, 0.5]).view(2, 1, 1, 1))
    assert two.share == pytest.approx(0.05)
    # With a shutter that is not centered the taps reach twice as far, so the limit is half a tile.
    assert blur.cut(frame, shutter_position="leading").reach == 10.0


def test_few_pixels_are_not_worth_a_warning(monkeypatch):
    monkeypatch.setattr(reach_module, "_WORTH_NAMING", 0.11)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        get_filter("guertin2014")(tile_size=20)(passing())


def test_a_cut_is_told_at_the_place_of_the_call_of_any_method():
    with pytest.warns(ReachWarning) as told:
        get_filter("guertin2014")(tile_size=20).layers(passing())
    assert told[0].filename == __file__


def test_vectors_too_long_for_their_type_are_cut():
    frame = passing(speed=600.0)
    half = frame.map(lambda t: t.half())
    assert get_filter("mcguire2012")().cut(half).share == pytest.approx(0.1, abs=1e-3)


def test_8_bits_reach_as_far_as_they_are_asked_to():
    frame = passing(speed=40.0)  # half spread 10 px, steps of 60 / 127 px
    exact, coarse = (
        get_filter("guertin2014")(
            reach="frame", max_reach=60.0, tile_size=8, velocity_encoding=kind
        )(frame).detach()
        for kind in ("float", "uint8")
    )
    assert float((exact - coarse).abs().mean()) < 0.01
    fast = passing(speed=200.0)  # half spread 50 px, six tiles
    blurred = get_filter("guertin2014")(
        reach="frame", max_reach=60.0, tile_size=8, velocity_encoding="uint8", tap_spacing=4.0
    )(fast).detach()
    row = (blurred[0, 0, 12] > 0.02).nonzero()[:, 0]
    assert int(row.max() - row.min()) > 40 + 80


def test_plain_taps_know_what_lies_beyond_the_neighboring_tiles():
    # All pixels of the 3x3 tiles around the middle move alike, those that its taps meet do not.
    frame = passing(speed=200.0)
    velocity = torch.zeros_like(frame.velocity)
    velocity[..., 140:260] = torch.tensor([200.0, 0.0]).view(1, 2, 1, 1)
    frame = frame.replaced(velocity=velocity)
    blur = get_filter("jimenez2014")(reach="frame", tile_size=10, noise="none", tile_jitter=0.0)
    classes = blur.layers(frame)["tile_class"][0, 0, 12]
    assert [int(classes[x]) for x in (200, 165)] == [1, 2]  # 60 px and 25 px from the edge


def test_half_resolution_reaches_as_far():
    frame = passing(speed=200.0)
    ends = []
    for resolution in ("full", "half"):
        blurred = get_filter("notes2025")(
            reach="frame", tile_size=16, resolution=resolution, max_reach=40.0, post_filter=False
        )(frame)
        row = (blurred.detach()[0, 0, 12] > 0.02).nonzero()[:, 0]
        ends.append((int(row.min()), int(row.max())))
    assert abs(ends[0][0] - ends[1][0]) <= 4
    assert abs(ends[0][1] - ends[1][1]) <= 4


def test_post_filter_of_the_notes_closes_the_gaps_that_long_paths_have():
    # 12 taps at most 6 px apart are 24 on this path: as if 24 had been asked for.
    frame = constant_motion((240.0, 0.0), 6, 400)
    shared = {"reach": "frame", "tile_size": 10, "center_weight": 0.0, "noise": "none"}
    shared |= {"post_alpha": "output"}  # 1 everywhere: all samples count
    denser = make("notes2025", num_samples=12, tap_spacing=6.0, **shared)(frame)
    asked = make("notes2025", num_samples=24, **shared)(frame)
    assert torch.allclose(denser, asked, atol=1e-5)
    assert not torch.allclose(denser, make("notes2025", num_samples=12, **shared)(frame), atol=1e-2)


@pytest.mark.parametrize("acceptance", ["hard", "soft"])
def test_its_threshold_is_that_of_the_taps_that_long_paths_have(acceptance):
    # Alphas differ along the ends of the blur, so that the threshold decides.
    shared = {"reach": "frame", "tile_size": 10, "center_weight": 0.0, "noise": "none"}
    shared |= {"post_acceptance": acceptance, "post_radius": 2.0}
    denser = make("notes2025", num_samples=12, tap_spacing=6.0, **shared)(passing())
    asked = make("notes2025", num_samples=24, **shared)(passing())
    assert torch.allclose(denser, asked, atol=1e-5)


def test_the_default_keeps_its_spacing_up_to_its_longest_reach():
    config = get_filter("torchblur")().config
    assert 2 * config.max_reach / config.tap_spacing <= config.max_samples


def test_second_pass_of_sousa_closes_the_gaps_that_long_paths_have():
    # Taps of the first pass are 12 px apart, with tap_spacing 6: the second spreads no farther.
    frame = constant_motion((240.0, 0.0), 4, 400)
    color = torch.zeros_like(frame.color)
    color[..., 200] = 1.0
    blur = make("sousa2013", reach="frame", tile_size=10, tap_spacing=6.0, color_lookup="bilinear")
    layers = blur.layers(frame.replaced(color=color))
    first, last = ((layers[key][0, 0, 2] > 1e-4).nonzero() for key in ("first_pass", "color"))
    assert 0 < int(first.min() - last.min()) <= 4
    assert 0 < int(last.max() - first.max()) <= 4


@pytest.mark.parametrize("reach", ["tile", "frame"])
def test_what_lies_along_the_second_direction_counts_as_within_reach(reach):
    # All moves, but for a still patch that only the second direction's taps meet.
    least = torch.ones(1, 1, 40, 40)
    least[..., 32:, 16:24] = 0.0
    sideways, down = torch.zeros(2, 1, 2, 5, 5)
    sideways[:, 0], down[:, 1] = 8.0, 24.0
    given = Values(
        tile_size=8, reach=reach, max_reach=64.0, tap_spacing=0.0, shutter_position="centered"
    )
    one, two = (
        least_spread(least, along, given)[0, 0, 1, 2] for along in ((sideways,), (sideways, down))
    )
    assert float(one) == 1.0
    assert float(two) == (0.0 if reach == "frame" else 1.0)
