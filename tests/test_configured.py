"""What a Module of declared parameters does beside its call: state, `repr`, checks of classes."""

import copy
import io
import pickle
from typing import Annotated

import pytest
import torch

import torchblur
from torchblur import FilterConfig, Param, Shutter
from torchblur.configured import ConfiguredModule
from torchblur.errors import ConfigError
from torchblur.filters import TwoPassBlur, get_filter
from torchblur.params import Config
from torchblur.post.bloom import Bloom
from torchblur.post.fxaa import Fxaa
from torchblur.testing.frames import moving_square

SET = {"num_samples": 9, "tile_size": 12, "luma": "true", "kappa": 12.5}


def guertin(**params):
    return torchblur.create_filter("guertin2014", **params)


def saved(state):
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


class TestState:
    def test_switches_and_counts_come_back(self):
        blur, frame = guertin(**SET), moving_square()
        other = guertin(num_samples=3, color_lookup="bilinear")
        other.load_state_dict(saved(blur.state_dict()))
        assert other.current_config() == blur.current_config()
        assert torch.equal(other(frame), blur(frame))

    def test_inside_of_another_module(self):
        model = torch.nn.Sequential(guertin(**SET), torch.nn.Identity())
        other = torch.nn.Sequential(guertin(), torch.nn.Identity())
        other.load_state_dict(saved(model.state_dict()))
        assert repr(other) == repr(model)

    def test_it_is_plain_data(self):
        state = guertin(**SET).state_dict()["_extra_state"]
        assert state["name"] == "guertin2014"
        assert "kappa" not in state["config"]  # that is a tensor
        assert {type(value) for value in state["config"].values()} <= {str, int, float, bool}

    @pytest.mark.parametrize("twin_of", [copy.deepcopy, lambda b: pickle.loads(pickle.dumps(b))])
    def test_copies(self, twin_of):
        blur = guertin(**SET)
        with torch.no_grad():
            blur.kappa.fill_(17.0)
        assert repr(twin_of(blur)) == repr(blur)

    def test_another_filter_is_refused_before_anything_changes(self):
        blur = get_filter("line")()
        before = repr(blur)
        with pytest.raises(ConfigError, match="saved from, `mcguire2012`, got `line`"):
            blur.load_state_dict(torchblur.create_filter("mcguire2012", shutter=1.0).state_dict())
        assert repr(blur) == before
        with pytest.raises(ConfigError, match="saved from, `bloom`, got `fxaa`"):
            Fxaa().load_state_dict(Bloom().state_dict())

    def test_an_unknown_switch_is_refused(self):
        state = guertin().state_dict()
        state["_extra_state"]["config"]["tile_sise"] = 3
        with pytest.raises(
            ConfigError, match=r"`tile_sise` \(did you mean `tile_size`.*state of gu"
        ):
            guertin().load_state_dict(state)

    @pytest.mark.parametrize("wrap", [lambda b: b, torch.nn.Sequential])
    def test_a_state_of_numbers_alone_loads_and_says_what_stays(self, wrap):
        state = wrap(guertin(kappa=12.5, num_samples=5)).state_dict()
        old = {name: value for name, value in state.items() if "_extra_state" not in name}
        blur = guertin(num_samples=9)
        with pytest.warns(UserWarning, match=r"`guertin2014` without switches.*num_samples=9"):
            wrap(blur).load_state_dict(old)
        assert repr(blur) == "Guertin2014Blur(num_samples=9, kappa=12.5)"

    def test_an_empty_state_is_as_incomplete_as_ever(self):
        with pytest.raises(RuntimeError, match=r"Missing key.*kappa"):
            guertin().load_state_dict({})


class TestRepr:
    def test_it_shows_what_holds_now(self):
        blur = guertin(num_samples=15, kappa=30.0)
        assert repr(blur) == "Guertin2014Blur(num_samples=15, kappa=30.0)"
        with torch.no_grad():
            blur.kappa.fill_(31.3)
            blur.gamma.fill_(2.0)
            blur.shutter.fill_(0.7)
        assert repr(blur) == ("Guertin2014Blur(shutter=0.7, num_samples=15, kappa=31.3, gamma=2.0)")
        assert blur.shutter_setting == Shutter(0.7)
        with torch.no_grad():
            blur.kappa.fill_(40.0)
            blur.gamma.fill_(float("nan"))  # a fit that went wrong must not break a print
        assert "kappa" not in repr(blur)
        assert "gamma=nan" in repr(blur)

    def test_numbers_are_as_short_as_they_may_be(self):
        for kind in (torch.float16, torch.float32, torch.float64):
            blur = guertin(third_gain=1.1).to(kind)
            assert repr(blur) == "Guertin2014Blur(third_gain=1.1)"
            with torch.no_grad():
                blur.third_gain.fill_(1.3)
            assert repr(blur) == "Guertin2014Blur(third_gain=1.3)"


class TestShutter:
    @pytest.mark.parametrize("position", ["centered", "leading", "trailing"])
    def test_a_shutter_stands_for_two_parameters(self, position):
        frame, shutter = moving_square(), Shutter(0.75, position)
        blur = guertin(shutter=shutter)
        assert blur.shutter_setting == shutter
        want = guertin(shutter=0.75, shutter_position=position)(frame)
        assert torch.equal(blur(frame), want)
        for other in (guertin(), guertin(shutter_position="leading", shutter=2.0)):
            assert torch.equal(other(frame, shutter=shutter), want)
        assert torch.equal(guertin().layers(frame, shutter=shutter)["color"], want)

    def test_in_two_passes_and_in_functions(self):
        frame, shutter = moving_square(), Shutter(1, "leading")
        line = get_filter("line")
        plain = {"shutter": 1.0, "shutter_position": "leading"}
        two = TwoPassBlur(line(num_samples=4))
        assert torch.equal(two(frame, shutter=shutter), two(frame, **plain))
        own = line(line.config_class(shutter_position="trailing"), shutter=shutter)
        assert own.shutter_setting == shutter

    def test_over_a_preset(self, tmp_path):
        path = tmp_path / "p.yaml"
        torchblur.save_preset(path, guertin(shutter=Shutter(1.0, "trailing")))
        shutter = Shutter(0.25, "leading")
        assert torchblur.create_filter(path, shutter=shutter).shutter_setting == shutter

    def test_a_contradiction_is_refused(self):
        shutter = Shutter(0.5, "leading")
        guertin(shutter=shutter, shutter_position="leading")
        pattern = r"`shutter_position` must be that of the `shutter`, 'leading', got 'trailing'; "
        with pytest.raises(ConfigError, match=pattern):
            guertin(shutter=shutter, shutter_position="trailing")
        with pytest.raises(ConfigError, match=pattern):
            guertin()(moving_square(), shutter=shutter, shutter_position="trailing")


class TestDeclarations:
    def test_a_class_needs_its_config(self):
        with pytest.raises(
            ConfigError, match=r"Mine` must have a `config_class`, .*`FilterConfig`"
        ):

            class Mine(torchblur.BlurFilter):
                name = "mine of a test"

        class Own(Config):
            pass

        with pytest.raises(ConfigError, match=r"of `FilterConfig`, got <class .*Own"):

            class Other(torchblur.BlurFilter):
                name = "mine of a test"
                config_class = Own

        assert "mine of a test" not in torchblur.list_filters()

    @pytest.mark.parametrize(
        ("kind", "default", "message"),
        [
            (float, 1.0, r"gain` must be declared with a `Param`: `Annotated"),
            (
                Annotated[float, Param(meaning="m", grad="smooth", source="s")],
                1.0,
                "gain` is a number, and its `Param` must have `low` and `high`",
            ),
            (
                Annotated[float, Param(meaning="m", grad="smooth", source="s", low=0, high=1)],
                ...,
                "gain` must have a default",
            ),
        ],
    )
    @pytest.mark.parametrize("base", [torchblur.BlurFilter, ConfiguredModule])
    def test_every_field_is_a_parameter(self, kind, default, message, base):
        namespace = {"__annotations__": {"gain": kind}, "__module__": __name__}
        namespace |= {} if default is ... else {"gain": default}
        model = type(FilterConfig)("OwnConfig", (FilterConfig,), namespace)
        with pytest.raises(ConfigError, match=rf"`Mine`: `OwnConfig\.{message}"):
            type("Mine", (base,), {"config_class": model})

    def test_sets_of_differing_sizes(self):
        frame, blur = moving_square(), guertin(num_samples=3)
        four, three = torch.full((4, 1, 1, 1), 2.0), torch.full((3, 1, 1, 1), 2.0)
        with pytest.raises(
            ConfigError, match=r"got 3 of `third_gain`, 4 of `kappa` \(guertin2014\)"
        ):
            blur(frame, third_gain=three, kappa=four)
        plane = torch.full((1, 1, *frame.size), 2.0)
        assert blur(frame, kappa=four, third_gain=four, gamma=plane).shape[0] == 4
