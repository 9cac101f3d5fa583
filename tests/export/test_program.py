"""Filters as graphs: saved, loaded again, and equal to the filter."""

import warnings

import pytest
import torch
from tiny_shots import moving_square

from torchblur.errors import ConfigError, FrameError, OutputError, ReachWarning
from torchblur.export import EXPORTABLE, export_program, save_program
from torchblur.filters import get_filter, list_filters
from torchblur.frame import Frame
from torchblur.ops.pixels import PixelList, all_pixels
from torchblur.presets import create_filter

SIZE = (32, 48)
CLOSE = {"rtol": 0, "atol": 1e-6}


@pytest.fixture
def frame():
    square = moving_square(size=SIZE)
    return Frame(color=square.color, velocity=square.velocity, depth=square.depth)


def other_frame():
    """A frame with other values: more than one motion, and a background at infinity."""
    generator = torch.Generator().manual_seed(5)
    velocity = torch.zeros(1, 2, *SIZE)
    velocity[..., 4:20, 8:30] = torch.tensor([9.0, -5.0]).view(1, 2, 1, 1)
    velocity[..., 18:30, 26:44] = torch.tensor([-3.0, 8.0]).view(1, 2, 1, 1)
    depth = torch.where((velocity != 0).any(1, keepdim=True), 2.0, torch.inf)
    return Frame(color=torch.rand(1, 3, *SIZE, generator=generator), velocity=velocity, depth=depth)


def planes(frame):
    return frame.color, frame.velocity, frame.depth


def through_a_file(program, tmp_path):
    save_program(tmp_path / "blur.pt2", program)
    return torch.export.load(tmp_path / "blur.pt2").module()


@torch.no_grad()
def blurred(blur, frame):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no revealed layer
        return blur(frame)


class TestEqual:
    @pytest.mark.parametrize(
        ("name", "params"),
        [
            ("line", {"num_samples": 4}),
            ("mcguire2012", {"num_samples": 5, "tile_size": 8}),
            ("mcguire2012", {"num_samples": 3, "tile_size": 8, "shutter_position": "leading"}),
            ("jimenez2014", {"num_samples": 4, "tile_size": 8, "fast_ratio": 0.5}),
            ("sousa2013", {"num_samples": 2, "tile_size": 8}),
        ],
    )
    def test_to_the_filter_on_a_frame_that_it_has_not_seen(self, tmp_path, frame, name, params):
        blur = create_filter(name, **params)
        program = through_a_file(export_program(blur, frame), tmp_path)
        for shown in (frame, other_frame()):
            want = blurred(blur, shown)
            assert float((want - shown.color).abs().max()) > 0.05
            torch.testing.assert_close(program(*planes(shown)), want, **CLOSE)

    def test_to_the_tuned_preset(self, tmp_path, frame, repository):
        path = repository / "configs" / "filters" / "guertin2014-tuned.yaml"
        blur = create_filter(path, num_samples=4, noise="halton", tile_size=8, tap_spacing=0.0)
        program = through_a_file(export_program(blur, frame), tmp_path)
        for shown in (frame, other_frame()):
            want = blurred(blur, shown)
            torch.testing.assert_close(program(*planes(shown)), want, **CLOSE)

    @pytest.mark.slow
    @pytest.mark.parametrize("name", ["notes2025", "tan2022", "torchblur"])
    def test_of_the_long_graphs(self, tmp_path, frame, name):
        blur = create_filter(name, num_samples=4, tile_size=8, tap_spacing=0.0)
        program = through_a_file(export_program(blur, frame), tmp_path)
        for shown in (frame, other_frame()):
            want = blurred(blur, shown)
            torch.testing.assert_close(program(*planes(shown)), want, **CLOSE)

    def test_a_reach_that_follows_the_frame_and_taps_that_cannot(self, tmp_path, frame):
        far = {"reach": "frame", "max_reach": 60.0, "tile_size": 4}
        blur = create_filter("mcguire2012", num_samples=3, **far)
        program = through_a_file(export_program(blur, frame), tmp_path)
        fast = other_frame().map(lambda t: 12 * t if t.shape[1] == 2 else t)
        torch.testing.assert_close(program(*planes(fast)), blurred(blur, fast), **CLOSE)
        blur = create_filter("mcguire2012", num_samples=3, tap_spacing=2.0)
        with pytest.warns(ReachWarning, match="has 3 taps on every path"):
            export_program(blur, frame)

    def test_of_a_batch_where_nothing_moves_in_the_example(self, tmp_path):
        shown = Frame.stack([other_frame(), other_frame().map(lambda t: t.flip(3))])
        still = Frame(
            color=shown.color * 0, velocity=shown.velocity * 0, depth=torch.ones_like(shown.depth)
        )
        blur = create_filter("mcguire2012", num_samples=3, tile_size=8)
        program = through_a_file(export_program(blur, still), tmp_path)
        torch.testing.assert_close(program(*planes(shown)), blurred(blur, shown), **CLOSE)


class TestProgram:
    def test_parameters_are_its_state_and_the_filter_keeps_its_own(self, frame):
        blur = create_filter("mcguire2012", num_samples=3, tile_size=8)
        program = export_program(blur, frame)
        assert blur.third_gain.requires_grad
        module = program.module()
        before = module(*planes(frame))
        module.state_dict()["blur.third_gain"].fill_(0.0)
        want = blurred(
            create_filter("mcguire2012", num_samples=3, tile_size=8, third_gain=0.0), frame
        )
        assert float((want - before).abs().max()) > 1e-3
        torch.testing.assert_close(module(*planes(frame)), want, **CLOSE)
        assert float(blur.third_gain) == 2.0

    def test_has_no_gradient(self, frame):
        program = export_program(create_filter("line", num_samples=2), frame).module()
        color = frame.color.clone().requires_grad_(True)
        assert not program(color, frame.velocity, frame.depth).requires_grad

    def test_names_no_path_of_this_machine(self, tmp_path, frame, repository):
        path = tmp_path / "line.pt2"
        save_program(path, export_program(create_filter("line", num_samples=2), frame))
        content = path.read_bytes()
        assert str(repository).encode() not in content
        assert b"ops/gather.py" not in content

    def test_keeps_notes_and_refuses_to_replace(self, tmp_path, frame):
        path = tmp_path / "line.pt2"
        program = export_program(create_filter("line", num_samples=2), frame)
        save_program(path, program, notes={"preset.json": "{}"})
        found = {"preset.json": ""}
        torch.export.load(path, extra_files=found)
        assert found["preset.json"] in ("{}", b"{}")
        with pytest.raises(OutputError, match=r"line\.pt2 exists"):
            save_program(path, program)
        assert [entry.name for entry in tmp_path.iterdir()] == ["line.pt2"]


class TestRefused:
    @pytest.mark.parametrize("name", sorted(set(list_filters()) - set(EXPORTABLE)))
    def test_filters_that_decide_by_values(self, frame, name):
        with pytest.raises(ConfigError, match=rf"`{name}` cannot be exported.*guertin2014, jimen"):
            export_program(get_filter(name)(), frame)

    def test_the_revealed_layer(self, frame):
        blur = create_filter("mcguire2012", background="revealed")
        with pytest.raises(ConfigError, match=r"`background` must be 'guessed'.*got 'revealed'"):
            export_program(blur, frame)

    def test_no_depth(self, frame):
        with pytest.raises(FrameError, match="`depth` is needed"):
            export_program(create_filter("line"), frame.only())


class TestAllPixels:
    def test_lists_are_whole_inside_alone(self):
        wanted = torch.zeros(1, 1, 4, 6, dtype=torch.bool)
        with all_pixels():
            assert PixelList.where(wanted).count == 24
            assert PixelList.in_tiles(wanted, wanted, 1).count == 24
        assert PixelList.where(wanted).count == 0

    def test_ends_with_an_error(self):
        wanted = torch.zeros(1, 1, 4, 6, dtype=torch.bool)
        with pytest.raises(ZeroDivisionError), all_pixels():
            1 / 0  # noqa: B018
        assert PixelList.where(wanted).count == 0
