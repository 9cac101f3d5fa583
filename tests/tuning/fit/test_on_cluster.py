"""Searches on a cluster: the study of one process, whatever becomes of workers and driver."""

import functools
import json
import os
import signal

import pytest
from clusters import threads_cluster
from planted import write_planted

import tuning.parallel.cluster_problem
from torchblur.params import build
from tuning.config.fit import TuneConfig
from tuning.fit.run import run_fit
from tuning.objective.prepare import prepare
from tuning.parallel.cluster import ClusterError, open_cluster
from tuning.parallel.cluster_problem import ClusterProblem

METHODS = [
    {
        "kind": "blackbox",
        "sampler": "tpe",
        "trials": 9,
        "population": 4,
        "polish": {"steps": 1, "quantile": 0.4},
    },
    {
        "kind": "blackbox",
        "sampler": "random",
        "trials": 6,
        "population": 3,
        "pruning": {"first": 0.5, "startup": 1},
    },
]


class StoppedError(Exception):
    """Stands for a kill of the driver between two rounds."""


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("frames")
    data = write_planted(root / "frames") | {"methods": METHODS}
    second = {"kind": "exr", "path": "second", "shutter": 1.0}
    data["data"] |= {"train": [*data["data"]["train"], second], "holdout": []}
    return data


@pytest.fixture(scope="module")
def config(data):
    return build(TuneConfig, data)


@pytest.fixture(scope="module")
def one_process(config, tmp_path_factory):
    folder = tmp_path_factory.mktemp("one") / "run"
    return run_fit(config, folder), losses(folder)


@pytest.fixture(scope="module")
def cluster():
    with threads_cluster() as found:
        yield found


def losses(folder):
    lines = (folder / "log.jsonl").read_text().splitlines()
    records = [json.loads(line) for line in lines]
    return [(r["method"], r["step"], r["loss"], r["params"]) for r in records if "loss" in r]


def assert_same(result, folder, one_process):
    want, trials = one_process
    assert losses(folder) == trials
    assert (result.objective, result.params) == (want.objective, want.params)


def test_driver_stopped_in_the_middle(config, cluster, tmp_path, one_process, monkeypatch):
    built = []
    monkeypatch.setattr(
        tuning.parallel.cluster_problem, "prepare", lambda given: built.append(1) or prepare(given)
    )

    def stop(event):
        if (event.stage, event.done) == ("tpe", 5):
            raise StoppedError

    with pytest.raises(StoppedError):
        run_fit(config, tmp_path / "run", progress=stop, cluster=cluster)
    assert 0 < len(losses(tmp_path / "run")) < len(one_process[1])
    result = run_fit(config, tmp_path / "run", resume=True, cluster=cluster)
    assert_same(result, tmp_path / "run", one_process)
    assert built == [1]  # a worker makes the objective once


@pytest.mark.slow
def test_killed_workers_cost_their_tasks_only(config, tmp_path, one_process):
    with open_cluster(workers=2) as cluster:
        pids = list(cluster.client.run(os.getpid).values())

        def kill(event):
            if (event.stage, event.done) == ("tpe", 5):
                # Once the next round is under way.
                delayed = functools.partial(os.kill, pids[0], signal.SIGKILL)
                cluster.client.loop.add_callback(cluster.client.loop.call_later, 0.2, delayed)

        result = run_fit(config, tmp_path / "run", progress=kill, cluster=cluster)
        assert pids[0] not in cluster.client.run(os.getpid).values()
    assert_same(result, tmp_path / "run", one_process)


class TestWorkersData:
    def test_missing(self, cluster, config):
        problem = prepare(config).problem
        plain = config.data.model_copy(update={"root": "/nowhere"})
        shared = ClusterProblem(cluster, config.model_copy(update={"data": plain}), problem)
        with pytest.raises(ClusterError, match=r"worker at .* cannot load .*/nowhere/first"):
            shared.map(mean_of, [{"kappa": 3.0}])

    def test_other(self, cluster, config):
        few = prepare(config.model_copy(update={"seed": 6})).problem.subset([0])
        shared = ClusterProblem(cluster, config, few)
        with pytest.raises(ClusterError, match=r"worker at .* has other data under .*frames"):
            shared.map(mean_of, [{"kappa": 3.0}])

    def test_a_subset_is_of_the_same_windows(self, cluster, config):
        problem = prepare(config).problem
        shared = ClusterProblem(cluster, config, problem).subset([1, 0]).subset([0])
        values = {"kappa": 3.0}
        assert shared.map(mean_of, [values]) == [float(problem.subset([1]).mean(values))]
        assert float(shared.mean(values)) == float(problem.subset([1]).mean(values))


def mean_of(problem, values):
    return float(problem.mean(values))
