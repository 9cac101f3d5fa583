"""What is called: frames with a given moving share, batches and the same one by one, steps."""

import pytest
import torch

from torchblur.errors import ConfigError
from torchblur.filters import get_filter, list_filters
from tuning.bench.calls import bench_frame, make_call, make_filter, sets_of
from tuning.bench.cases import Case
from tuning.bench.fit_step import METRIC_PARTS, STEP_PARTS, Step, median_parts, render_parts

SMALL = Case(filter="guertin2014", width=48, height=32, num_samples=5)


class TestFrames:
    @pytest.mark.parametrize("percent", [0, 10, 50, 100])
    def test_have_the_share_that_moves(self, percent):
        frame = bench_frame(Case(width=400, height=300, moving=percent))
        speed = torch.linalg.vector_norm(frame.velocity, dim=1)
        assert (speed > 0).float().mean().item() == pytest.approx(percent / 100, abs=0.003)
        moving = speed[speed > 0]
        if percent:
            assert moving.min() >= 20 * 0.999
            assert moving.max() <= 80 * 1.001

    def test_move_in_the_middle(self):
        moves = bench_frame(Case(width=41, height=31, moving=25)).velocity.abs().sum(1)[0] > 0
        assert torch.equal(moves, moves.flip(0)) or torch.equal(moves[:-1], moves[:-1].flip(0))
        assert moves[15, 20]
        assert not moves[0].any()
        assert not moves[:, 0].any()

    def test_are_the_same_for_the_same_seed(self):
        case = SMALL.but(batch=2)
        first, again, other = bench_frame(case), bench_frame(case), bench_frame(case, seed=1)
        assert torch.equal(first.color, again.color)
        assert not torch.equal(first.color, other.color)
        assert not torch.equal(first.color[0], first.color[1])


class TestCalls:
    @pytest.mark.parametrize("name", ["guertin2014", "oberberger2022", "line"])
    @pytest.mark.parametrize("many", [{"batch": 3}, {"sets": 3}])
    def test_one_by_one_is_the_same_work(self, name, many):
        case = SMALL.but(filter=name, num_samples=None, **many)
        one = make_call(case)()
        apart = make_call(case.but(apart=True))()
        assert len(apart) == 3
        assert one.shape == (3, 3, 32, 48)
        torch.testing.assert_close(torch.cat(apart), one, atol=1e-4, rtol=1e-4)

    @pytest.mark.parametrize("name", sorted(list_filters()))
    def test_each_filter_has_the_layers_it_needs(self, name):
        image = make_call(SMALL.but(filter=name, num_samples=None))()
        assert image.shape == (1, 3, 32, 48)
        assert image.isfinite().all()

    def test_half_storage_rounds(self):
        full, half = (make_call(SMALL.but(storage=kind))() for kind in ("full", "half"))
        assert 0 < (full - half).abs().max() < 1e-2

    def test_sets_differ(self):
        one = make_call(SMALL.but(sets=2))()
        assert not torch.equal(one[0], one[1])

    def test_take_taps_and_parameters(self):
        blur = make_filter(SMALL.but(params={"kappa": 7.0}))
        assert blur.config.num_samples == 5
        assert float(blur.kappa) == 7

    def test_backward_reaches_color_and_parameters(self, monkeypatch):
        made = {}

        def watched(case):
            made["blur"] = make_filter(case)
            return made["blur"]

        def framed(case):
            made["frame"] = bench_frame(case)
            return made["frame"]

        monkeypatch.setattr("tuning.bench.calls.make_filter", watched)
        monkeypatch.setattr("tuning.bench.calls.bench_frame", framed)
        grads = {}
        for what in ("forward", "backward", "parameters"):
            make_call(SMALL.but(what=what))()
            grads[what] = (made["frame"].color.grad, made["blur"].kappa.grad)
        assert grads["forward"] == (None, None)
        assert grads["backward"][0].abs().sum() > 0
        assert grads["backward"][1].abs() > 0
        assert grads["parameters"][0] is None
        torch.testing.assert_close(grads["parameters"][1], grads["backward"][1])

    def test_copies_move_the_bytes_of_the_planes(self):
        target = make_call(Case(kind="copy", width=40, height=20))()
        assert 2 * target.numel() == (6 + 3) * 40 * 20

    def test_filters_of_streams_have_a_history(self, monkeypatch):
        given = []
        kind = get_filter("oberberger2022")
        step = kind.step

        def spied(self, frame, history=None, **overrides):
            given.append(history)
            return step(self, frame, history, **overrides)

        monkeypatch.setattr(kind, "step", spied)
        make_call(SMALL.but(filter="oberberger2022", num_samples=None))()
        assert given[0] is None
        assert given[1] is not None

    def test_refuse_what_a_filter_does_not_have(self):
        with pytest.raises(ConfigError, match="num_samples"):
            make_call(SMALL.but(filter="oberberger2022"))


class TestSets:
    def test_lie_around_the_defaults_and_leave_fast_paths_alone(self):
        blur = get_filter("guertin2014")()
        sets = sets_of(blur, 5, torch.zeros(1))
        assert "kappa" in sets
        assert "direction_exponent" not in sets  # 1: its power is left out
        assert "softness" not in sets  # 0: hard
        for name, values in sets.items():
            assert values.shape == (5, 1, 1, 1)
            assert float(values[2]) == pytest.approx(getattr(blur.config, name))
        fewer = sets_of(blur, 5, torch.zeros(1), shared=("kappa",))
        assert set(sets) - set(fewer) == {"kappa"}

    def test_are_of_the_shutter_if_there_is_nothing_else(self):
        assert list(sets_of(get_filter("line")(), 3, torch.zeros(1))) == ["shutter"]


class TestSteps:
    CASE = SMALL.but(kind="step", batch=2)

    def test_in_parts_does_what_a_step_in_one_piece_does(self):
        parts, whole = Step(self.CASE), Step(self.CASE)
        before = float(whole.blur.kappa)
        seconds = parts.parts()
        whole.whole()
        assert tuple(seconds) == STEP_PARTS
        assert set(METRIC_PARTS) < set(STEP_PARTS)
        assert all(value > 0 for value in seconds.values())
        assert float(whole.blur.kappa) != before
        for name, value in parts.blur.named_parameters():
            torch.testing.assert_close(value, whole.blur.get_parameter(name))

    def test_work_without_smooth_parameters_and_with_a_memory(self):
        for name in ("line", "oberberger2022"):
            step = Step(self.CASE.but(filter=name, num_samples=None))
            assert tuple(step.parts()) == STEP_PARTS

    def test_medians_of_parts(self):
        runs = iter(({"a": 1.0}, {"a": 9.0}, {"a": 2.0}))
        assert median_parts(lambda: next(runs), 3, 60) == {"a": 2.0}

    def test_a_crop_is_rendered(self):
        found = render_parts(Case(kind="render", width=8, height=8), spp=2)
        assert list(found) == ["sharp frame, 16 spp", "reference, 2 spp"]
        assert all(value > 0 for value in found.values())
