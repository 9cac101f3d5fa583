"""Windows that are chosen where the filter is wrong."""

import dataclasses

import pytest
import torch
from planted import FIXED, PLANTED, planted_case, tiny_frame
from planted_sequences import sequence_case

import tuning.objective.windows
from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.frame import Frame, Shutter
from torchblur.metrics import flip_ldr
from torchblur.params import build
from tuning.config.data import Crops
from tuning.objective.windows import error_map, make_samples

ERROR = Crops(size=16, per_frame=8, context=0, choose="error")


def blur():
    return get_filter("guertin2014")(**FIXED, **PLANTED)


def case_with_error(top, left, size=8):
    """Return a case whose reference the planted filter meets everywhere but in one square."""
    case = planted_case(1)
    reference = case.reference.clone()
    reference[..., top : top + size, left : left + size] += 5.0
    return dataclasses.replace(case, reference=reference)


def still_case(reference):
    """Return a case where nothing moves, so that windows by motion go anywhere."""
    frame = tiny_frame(1, reference.shape[-2:])
    frame = dataclasses.replace(frame, velocity=torch.zeros_like(frame.velocity))
    return dataclasses.replace(planted_case(1), frame=frame, reference=reference)


def difference(sample):
    """Return the reference less the sharp frame, in the scored part."""
    top, left, height, width = sample.inner
    return sample.reference - sample.frame.color[..., top : top + height, left : left + width]


class TestMap:
    def test_is_the_flip_of_the_filter_at_its_start(self):
        case = case_with_error(20, 40)
        with torch.no_grad():
            image = blur()(case.frame, shutter=case.shutter.open)
        want = flip_ldr(image, case.reference).double()
        torch.testing.assert_close(error_map(case, blur()), want)

    def test_without_a_filter_it_is_that_of_the_line_blur(self):
        case = planted_case(1)
        with torch.no_grad():
            image = get_filter("line")()(case.frame, shutter=case.shutter.open)
        torch.testing.assert_close(error_map(case), flip_ldr(image, case.reference).double())

    def test_shutter_of_the_data(self):
        case = planted_case(1)
        closed = dataclasses.replace(case, shutter=Shutter(0.0), reference=case.frame.color)
        assert float(error_map(closed, blur()).max()) < 0.02
        assert float(error_map(dataclasses.replace(closed, shutter=Shutter(1.0))).max()) > 0.2

    def test_what_is_not_finite_is_wrong(self, monkeypatch):
        case = planted_case(1)
        broken = case.reference.clone()
        broken[:, 1, 10, 20] = torch.nan
        monkeypatch.setattr(tuning.objective.windows, "blurred", lambda *_: broken)
        map = error_map(case, blur())
        assert bool(torch.isfinite(map).all())
        assert float(map[0, 0, 10, 20]) == 1
        assert float(map[..., 40:].max()) < 1e-6

    def test_of_a_sequence_the_scored_frames_count(self, recall):
        case = sequence_case(4, warm_up=2)
        wrong = list(case.references)
        wrong[0] = wrong[0] + 5.0
        other = dataclasses.replace(case, references=tuple(wrong))
        assert torch.equal(error_map(case), error_map(other))
        wrong[-1] = wrong[-1] + 5.0
        other = dataclasses.replace(case, references=tuple(wrong))
        assert float(error_map(other).mean()) > float(error_map(case).mean()) + 0.1


class TestWindows:
    @pytest.mark.parametrize(("top", "left"), [(4, 6), (30, 50)])
    def test_lie_where_a_planted_error_is(self, top, left):
        case = case_with_error(top, left)
        samples = make_samples([case], ERROR, tile_size=1, seed=3, blur=blur())
        # The others have a part of its edge, which FLIP sees a few pixels off.
        assert sum(float(sample.reference.max()) > 4 for sample in samples) >= 6

    def test_chance_is_in_proportion_to_the_error(self):
        """Of two squares one is wrong by more; windows at it come more often, by that much."""
        case = still_case(tiny_frame(1).color)
        reference = case.reference.clone()
        reference[..., 4:12, 4:12] += 0.05
        reference[..., 36:44, 52:60] += 0.6
        columns = torch.arange(1.0, 65.0).expand(1, 1, 48, 64).contiguous()
        frame = dataclasses.replace(case.frame, depth=columns)
        case = dataclasses.replace(case, frame=frame, reference=reference)
        map = error_map(case, get_filter("line")())
        left = float(map[..., :32].sum() / map.sum())
        crops = ERROR.model_copy(update={"per_frame": 1})
        hits = 0
        for seed in range(200):
            (one,) = make_samples([case], crops, tile_size=1, seed=seed, blur=get_filter("line")())
            hits += int(one.frame.depth[0, 0, 0, one.inner[1]] < 24)
        assert 0.02 < left < 0.4
        assert hits / 200 == pytest.approx(left, abs=0.08)

    def test_motion_does_not_look_at_the_error(self):
        crops = ERROR.model_copy(update={"choose": "motion"})
        one, other = (
            make_samples([case], crops, tile_size=1, seed=3, blur=blur())
            for case in (case_with_error(4, 6), case_with_error(30, 50))
        )
        for a, b in zip(one, other, strict=True):
            assert torch.equal(a.frame.color, b.frame.color)

    def test_same_seed_same_windows(self):
        def corners(seed):
            cases = [case_with_error(20, 30), case_with_error(4, 6)]
            samples = make_samples(cases, ERROR, tile_size=1, seed=seed, blur=blur())
            return [float(s.frame.color.sum()) for s in samples]

        assert corners(1) == corners(1)
        assert corners(1) != corners(2)

    def test_a_filter_without_error_gets_windows_anywhere(self):
        case = still_case(tiny_frame(1).color)
        assert len(make_samples([case], ERROR, tile_size=1, seed=0, blur=get_filter("line")())) == 8

    def test_parameters_keep_no_gradient(self):
        filter_ = blur()
        make_samples([case_with_error(4, 6)], ERROR, tile_size=1, seed=0, blur=filter_)
        assert all(p.grad is None for p in filter_.parameters())

    def test_of_a_sequence(self, recall):
        samples = make_samples(
            [sequence_case(4, warm_up=2)], ERROR, tile_size=1, seed=0, blur=recall()
        )
        assert len(samples) == 8


class TestUnbiased:
    def frame(self):
        """Return a case with an error that rises from left to right, large against a window."""
        generator = torch.Generator().manual_seed(0)
        color = torch.rand(1, 3, 96, 256, generator=generator) * 0.5
        frame = Frame(
            color=color, velocity=torch.zeros(1, 2, 96, 256), depth=torch.ones(1, 1, 96, 256)
        )
        rise = torch.linspace(0.02, 0.4, 256)
        return dataclasses.replace(
            planted_case(1),
            frame=frame,
            reference=color + rise,
            band=torch.zeros(1, 1, 96, 256, dtype=torch.bool),
        )

    @pytest.mark.parametrize("unbiased", [False, True])
    def test_mean_over_windows_is_that_over_the_frame(self, unbiased):
        case, line = self.frame(), get_filter("line")()
        crops = Crops(size=16, per_frame=60, context=0, choose="error", unbiased=unbiased)
        means = []
        for seed in range(10):
            samples = make_samples([case], crops, tile_size=1, seed=seed, blur=line)
            parts = [s.weight * difference(s).mean() for s in samples]
            means.append(torch.stack(parts).mean())
            assert sum(s.weight for s in samples) / len(samples) == pytest.approx(1)
        found = float(torch.stack(means).mean())
        want = float((case.reference - case.frame.color).mean())
        if unbiased:
            assert found == pytest.approx(want, rel=0.06)
        else:
            assert found > 1.15 * want

    def test_each_case_counts_as_before(self):
        crops = Crops(size=16, per_frame=6, context=0, choose="error", unbiased=True)
        cases = [case_with_error(4, 6), dataclasses.replace(case_with_error(20, 30), item="b")]
        samples = make_samples(cases, crops, tile_size=1, seed=0, blur=blur())
        sums = [sum(s.weight for s in samples[:6]), sum(s.weight for s in samples[6:])]
        assert sums == pytest.approx([6, 6])
        cases[1] = dataclasses.replace(cases[1], weight=3.0)
        samples = make_samples(cases, crops, tile_size=1, seed=0, blur=blur())
        sums = [sum(s.weight for s in samples[:6]), sum(s.weight for s in samples[6:])]
        assert sums == pytest.approx([3, 9])


def test_another_choice_is_refused():
    with pytest.raises(ConfigError, match=r"`choose`: .*'motion' or 'error', got 'flip'"):
        build(Crops, {"choose": "flip"})
