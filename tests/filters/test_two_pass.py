import pytest
import torch

from torchblur.errors import ConfigError
from torchblur.filters import FilterConfig, TwoPassBlur, get_filter, list_filters
from torchblur.filters.line import LineBlur
from torchblur.frame import Frame
from torchblur.testing.frames import constant_motion, moving_square, random_frame

FILTERS = ("line", "mcguire2012", "guertin2014", "jimenez2014")


class Tapless(LineBlur):
    """A filter that has no taps to count (not registered: it has no name of its own)."""

    config_class = FilterConfig


def make(name, **params):
    """A filter without noise whose tiles reach far enough."""
    if name != "line":
        params = {"tile_size": 40, "noise": "none", **params}
    return get_filter(name)(**params)


@pytest.mark.parametrize("position", ["centered", "leading", "trailing"])
@pytest.mark.parametrize("name", FILTERS)
def test_taps_multiply_under_uniform_motion(name, position):
    # ±18 px: 6 + 6 taps come nearer to very many than 12 taps do.
    frame = constant_motion((72.0, 0.0), 6, 200)

    def run(blur):
        return blur(frame).detach()[..., 60:-60]

    many = run(make(name, num_samples=241, shutter_position=position))
    single = run(make(name, num_samples=12, shutter_position=position))
    double = run(TwoPassBlur(make(name, num_samples=6, shutter_position=position)))
    errors = [float((image - many).abs().mean()) for image in (single, double)]
    assert errors[1] < 0.8 * errors[0]


@pytest.mark.parametrize("name", FILTERS)
def test_a_second_pass_of_no_spread_changes_nothing(name):
    frame = moving_square()
    blur = get_filter(name)()
    layers = TwoPassBlur(blur, spread=0.0).layers(frame)
    assert torch.allclose(layers["color"], blur(frame), atol=1e-6)
    assert torch.equal(layers["first_pass"], blur(frame))


def test_the_second_pass_is_the_filter_on_the_result_of_the_first():
    frame = random_frame(speed=40.0)
    blur = get_filter("guertin2014")(num_samples=5, shutter=0.8, shutter_position="leading", seed=3)
    first = blur(frame)
    again = Frame(color=first, velocity=frame.velocity, depth=frame.depth)
    expected = blur(again, shutter=0.8 / 5, shutter_position="centered", seed=4)
    assert torch.allclose(TwoPassBlur(blur)(frame), expected, atol=1e-6)
    assert not torch.allclose(expected, first, atol=1e-2)
    halves = TwoPassBlur(blur, spread=0.5)(frame)
    expected = blur(again, shutter=0.4, shutter_position="centered", seed=4)
    assert torch.allclose(halves, expected, atol=1e-6)


@pytest.mark.filterwarnings("ignore:tan2022. no layer:UserWarning")
@pytest.mark.parametrize("name", [n for n, f in list_filters().items() if not f.needs])
def test_every_filter_of_plain_frames_can_be_wrapped(name):
    frame = random_frame()
    still = frame.map(lambda t: torch.zeros_like(t) if t.shape[1] == 2 else t)
    blur = TwoPassBlur(get_filter(name)(), spread=0.2)
    assert torch.allclose(blur(still), frame.color, atol=1e-5)
    flat = frame.map(lambda t: torch.full_like(t, 2.5) if t.shape[1] == 3 else t)
    assert torch.allclose(blur(flat), flat.color, atol=1e-4)


def test_gradients_reach_the_inner_parameters_through_both_passes():
    frame = moving_square(dtype=torch.float64)
    inner = get_filter("guertin2014")(num_samples=5, noise="none")
    blur = TwoPassBlur(inner, spread=0.6)
    grads = []
    for module in (inner, blur):
        module(frame).square().mean().backward()
        grads.append(float(inner.kappa.grad))
        inner.zero_grad()
    assert grads[0] != 0
    assert abs(grads[1] / grads[0] - 1) > 0.05  # both passes, not the first alone
    kappa = torch.tensor(30.0, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda value: blur(frame, kappa=value), (kappa,), eps=1e-6, atol=1e-6, fast_mode=True
    )
    assert {name for name, _ in blur.named_parameters()} >= {"blur.kappa", "blur.third_gain"}


def test_overrides_hold_in_both_passes():
    frame = moving_square()
    blur = TwoPassBlur(get_filter("mcguire2012")(num_samples=4))
    fixed = TwoPassBlur(get_filter("mcguire2012")(num_samples=7, shutter=0.9, third_gain=5.0))
    given = blur(frame, num_samples=7, shutter=0.9, third_gain=5.0)
    assert torch.allclose(given, fixed(frame), atol=1e-6)
    gains = torch.tensor([1.0, 5.0]).view(2, 1, 1, 1)
    batch = blur(frame, third_gain=gains, shutter=torch.full((2, 1, 1, 1), 0.9), num_samples=7)
    assert torch.allclose(batch[1:], given, atol=1e-5)


def test_the_seed_after_the_last_is_the_first():
    frame = moving_square()
    last = TwoPassBlur(get_filter("guertin2014")(seed=2**31 - 1, num_samples=4))
    assert last(frame).shape == frame.color.shape


def test_spreads():
    blur = get_filter("line")(num_samples=8)
    assert TwoPassBlur(blur).ratio == 0.125
    assert TwoPassBlur(blur, spread=0.3).ratio == 0.3
    assert "spread=0.3" in repr(TwoPassBlur(blur, spread=0.3))
    with pytest.raises(ConfigError, match="`spread` is needed: `line` has no `num_samples`"):
        TwoPassBlur(Tapless())
    for spread in (-0.1, 1.5, float("nan")):
        with pytest.raises(ConfigError, match=f"`spread` must lie in .*got {spread:g}"):
            TwoPassBlur(blur, spread=spread)


def test_a_filter_with_a_memory_is_refused():
    with pytest.raises(ConfigError, match="single frames, got `oberberger2022`, which has a memo"):
        TwoPassBlur(get_filter("oberberger2022")(), spread=0.1)
