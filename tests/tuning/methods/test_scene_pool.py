"""Scenes that are replaced while a gradient method goes on, and where its CPU-seconds go."""

import json
from pathlib import Path

import pytest
import torch
from planted import planted_case
from planted_sequences import sequence_case

import tuning.objective.cpu_time
from torchblur.errors import ConfigError
from torchblur.params import build
from torchblur.render import draw_scene, load_family
from tuning.config.fit import TuneConfig, resolve
from tuning.config.objective import ObjectiveSpec
from tuning.experiments.race.config import load_race_config
from tuning.fit.run import run_fit
from tuning.methods.scene_pool import Pool
from tuning.objective.batches import FrameGroup, SequenceGroup, join
from tuning.objective.cpu_time import Meter
from tuning.objective.prepare import prepare
from tuning.objective.windows import make_samples
from tuning.parallel.sharded_problem import ShardedProblem

CONFIGS = Path(__file__).parents[3] / "configs"
TINY = {"size": "48x28", "spp": 4, "color_spp": 2}
FAMILY = {"kind": "family", "path": "families/everyday.yaml", "scenes": 3, "seed": 7} | TINY
SCENE = {"kind": "scene", "path": "scenes/crossing_spheres.yaml"} | TINY
REFRESH = {"every": 2, "scenes": 2, "spp": 2}


def config_of(train=(FAMILY, SCENE), refresh=REFRESH, **more):
    method = {"kind": "gradient", "steps": 7, "starts": 2, "batch": 3, "refresh": refresh}
    data = {
        "filter": {"kind": "guertin2014", "params": {"num_samples": 5, "tile_size": 12},
                   "free": ["kappa"]},
        "data": {"root": str(CONFIGS), "train": list(train)} | more,
        "methods": [method], "seed": 3, "device": "cpu",
    }  # fmt: skip
    return resolve(build(TuneConfig, data))


def pool_of(config, seed=5):
    problem = prepare(config).problem
    return problem, Pool(problem, config.data, config.methods[0].refresh, seed)


def origins(problem):
    return [sample.origin for sample in problem.samples]


class TestPool:
    def test_the_oldest_scenes_are_replaced(self):
        problem, pool = pool_of(config_of())
        assert pool.at(0) is pool.at(1) is problem
        expected = {2: (0, 1, None), 4: (3, 1, 2), 6: (3, 4, 5), 8: (6, 7, 5)}
        for step, numbers in expected.items():
            assert pool.numbers(step) == pool.numbers(step + 1) == numbers
        before = problem
        for step in (2, 4, 6):
            now = pool.at(step)
            assert pool.at(step + 1) is now
            replaced = [a is not b for a, b in zip(now.samples, before.samples, strict=True)]
            others = zip(pool.numbers(step), pool.numbers(step - 2), strict=True)
            assert replaced == [*(a != b for a, b in others), False]
            before = now
        family = load_family(CONFIGS / "families/everyday.yaml")
        drawn = [draw_scene(family, pool.scene_seed(number)).fingerprint() for number in (3, 4, 5)]
        assert origins(before)[:3] == drawn

    def test_a_step_is_the_same_wherever_one_begins(self):
        _, pool = pool_of(config_of())
        for step in (2, 4, 6):
            on_the_way = pool.at(step)
        _, anew = pool_of(config_of())
        at_once = anew.at(6)
        for one, other in zip(on_the_way.samples, at_once.samples, strict=True):
            assert torch.equal(one.reference, other.reference)
            assert torch.equal(one.frame.color, other.frame.color)
            assert one.weight == other.weight
        _, other = pool_of(config_of(), seed=6)
        assert set(origins(other.at(6))[:3]).isdisjoint(origins(at_once)[:3])

    def test_new_references_have_the_samples_that_are_asked_for(self, monkeypatch):
        asked = []
        render = __import__("tuning.data.loading", fromlist=["render_reference"]).render_reference

        def seen(*args, spp, **more):
            asked.append(spp)
            return render(*args, spp=spp, **more)

        _, pool = pool_of(config_of(refresh=REFRESH | {"spp": 3}), seed=77)
        monkeypatch.setattr("tuning.data.loading.render_reference", seen)
        pool.at(2)
        assert asked == [3, 3]
        pool.at(2)
        assert asked == [3, 3]

    def test_new_seeds_are_none_of_the_data(self):
        config = config_of()
        _, pool = pool_of(config)
        seed = pool.scene_seed(4)
        held = FAMILY | {"seed": seed - 2, "scenes": 5}
        taken = config.data.model_copy(
            update={"holdout": build(type(config.data), {"train": [held]}).train}
        )
        again = Pool(prepare(config).problem, taken, config.methods[0].refresh, 5)
        assert again.scene_seed(4) == seed + 3
        assert len({pool.scene_seed(number) for number in range(200)}) == 200

    def test_scenes_keep_their_weight(self):
        """Whatever their windows weigh: several frames of a scene, and windows of these."""
        crops = {"size": 16, "per_frame": 2, "context": 4, "unbiased": True}
        train = (FAMILY | {"weight": 3, "frames": [0, 1]}, SCENE | {"weight": 1})
        problem, pool = pool_of(config_of(train, crops=crops))
        assert len(problem.samples) == 3 * 4 + 2
        now = pool.at(6)
        assert len({sample.origin for sample in now.samples} - set(origins(problem))) == 3
        for first in (0, 4, 8):
            want, found = (sum(s.weight for s in p.samples[first : first + 4])
                           for p in (problem, now))  # fmt: skip
            assert found == pytest.approx(want)
        assert now.samples[12:] == problem.samples[12:]

    def test_sequences_of_a_family(self, recall):
        item = {
            "kind": "family_stream", "path": "families/everyday.yaml", "scenes": 2, "size": "48x28",
            "spp": 2, "color_spp": 1, "frames": [0, 1],
        }  # fmt: skip
        config = config_of([item], REFRESH | {"scenes": 1})
        config = config.model_copy(update={"filter": config.filter.model_copy(
            update={"kind": "recall", "params": {}, "free": {"gain": config.filter.free["kappa"]}}
        )})  # fmt: skip
        problem, pool = pool_of(config)
        now = pool.at(2)
        assert now.samples[0] is not problem.samples[0]
        assert len(now.samples[0].references) == 2
        assert now.samples[1] is problem.samples[1]

    def test_nothing_to_draw_from(self):
        message = r"`refresh` replaces scenes of families.*only scene \(methods\.0\.refresh\)"
        with pytest.raises(ConfigError, match=message):
            config_of([SCENE])

    def test_not_with_torchrun(self):
        config = config_of()
        sharded = ShardedProblem(prepare(config).problem, None)
        with pytest.raises(ConfigError, match=r"`refresh` draws scenes in one process"):
            Pool(sharded, config.data, config.methods[0].refresh, 1)


class TestFit:
    def test_killed_and_resumed(self, tmp_path):
        config = config_of()

        class StoppedError(Exception):
            pass

        def stop(event, at):
            if (event.stage, event.done) == ("gradient", at):
                raise StoppedError

        whole = run_fit(config, tmp_path / "whole")
        for at in (1, 3, 4, 6):
            with pytest.raises(StoppedError):
                run_fit(config, tmp_path / "parts", True, lambda e, at=at: stop(e, at))
        resumed = run_fit(config, tmp_path / "parts", resume=True)
        timeless = {"seconds", "cpu_seconds", "spent"}
        found, want = (r.methods[0].model_dump(exclude=timeless) for r in (resumed, whole))
        assert found == want
        logs = [
            [json.loads(line) for line in (tmp_path / name / "log.jsonl").read_text().splitlines()]
            for name in ("whole", "parts")
        ]
        steps = [
            [(line["step"], line["loss"], line["params"], line["passes"])
             for line in log if "loss" in line]
            for log in logs
        ]  # fmt: skip
        assert steps[0] == steps[1]
        assert [step[3] for step in steps[0]] == [2 * 3 / 4] * 7
        spent = whole.methods[0].spent
        assert spent["render"] > 0
        assert spent["filter"] > spent["metric"] > 0
        assert sum(spent.values()) == pytest.approx(whole.methods[0].cpu_seconds, rel=0.2)
        renders = [line["spent"]["render"] for line in logs[0] if "loss" in line]
        grows = [b > a for a, b in zip([0, *renders], renders, strict=False)]
        assert grows == [False, False, True, False, True, False, True]

    def test_other_scenes_lead_elsewhere(self, tmp_path):
        """They are seen: another end than without them, judged by the same windows."""
        config = config_of()
        method = config.methods[0].model_copy(update={"refresh": None})
        without = config.model_copy(update={"methods": (method,)})
        found = [run_fit(c, tmp_path / str(i)) for i, c in enumerate((config, without))]
        assert found[0].methods[0].params != found[1].methods[0].params
        assert found[0].start_objective == found[1].start_objective
        problem = prepare(config).problem
        assert found[0].methods[0].objective == float(problem.mean(found[0].methods[0].params))

    def test_not_in_a_race_with_planted_values(self, tmp_path):
        (tmp_path / "race.yaml").write_text(
            json.dumps(
                {
                    "problems": [
                        {
                            "name": "planted",
                            "filter": {"kind": "guertin2014", "free": ["kappa"]},
                            "data": {"root": str(CONFIGS), "train": [FAMILY], "holdout": [SCENE]},
                            "planted": {"kappa": 9.0},
                        }
                    ],
                    "entrants": [
                        {"name": "fresh", "methods": [{"kind": "gradient", "refresh": REFRESH}]}
                    ],
                }
            )
        )
        with pytest.raises(
            ConfigError, match=r"`refresh` of 'fresh' renders.*problems\.0\.planted"
        ):
            load_race_config(tmp_path / "race.yaml")


class _Ticks(torch.autograd.Function):
    """Takes so long forwards, and so long backwards."""

    clock = 0.0

    @staticmethod
    def forward(ctx, image, forwards, backwards):
        ctx.backwards = backwards
        _Ticks.clock += forwards
        return image.clone()

    @staticmethod
    def backward(ctx, grad):
        _Ticks.clock += ctx.backwards
        return grad, None, None


@pytest.mark.parametrize("kind", ["frame", "sequence"])
def test_what_is_counted_where(monkeypatch, kind):
    """The filter takes 1 s and 10 s back, the metric 100 s and 1000 s back, for each frame."""
    monkeypatch.setattr(tuning.objective.cpu_time.time, "process_time", lambda: _Ticks.clock)
    case, frames = (planted_case(1), 1) if kind == "frame" else (sequence_case(3), 3)
    (sample,) = make_samples([case], None, tile_size=12, seed=0)
    group = join([sample], ObjectiveSpec(terms={"mse": 1.0}))
    assert isinstance(group, FrameGroup if kind == "frame" else SequenceGroup)
    gain = torch.ones((), requires_grad=True)

    def slow_filter(*args):
        return _Ticks.apply(sample_color * gain, 1.0, 10.0)

    sample_color = (sample.frame if kind == "frame" else sample.steps[0][0]).color
    monkeypatch.setattr("tuning.objective.batches.blurred", slow_filter)
    monkeypatch.setattr(
        "tuning.objective.batches.blurred_sequence",
        lambda *args, **more: (slow_filter() for _ in range(frames)),
    )
    call = type(group.objective if kind == "frame" else group.objectives[0]).__call__
    monkeypatch.setattr(
        "tuning.objective.terms.PreparedObjective.__call__",
        lambda self, image: call(self, _Ticks.apply(image, 100.0, 1000.0)),
    )
    meter = Meter()
    with meter.running():
        _Ticks.clock += 7.0
        values = {} if kind == "frame" else {"gain": 1.0}
        for part in group.parts(None, values, (), None, meter):
            part.sum().backward()
        meter.enter("render")
        _Ticks.clock += 5.0
    _Ticks.clock += 1e6  # not running
    meter.enter("filter")
    expected = {"filter": 11.0 * frames, "metric": 1100.0 * frames, "render": 5.0, "other": 7.0}
    assert meter.seconds == pytest.approx(expected)
    assert float(gain.grad) != 0
