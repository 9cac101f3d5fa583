"""Batch runs on a cluster: the same files, errors and order as one process makes."""

import os
import signal
import warnings

import pytest
import torch
from clusters import threads_cluster
from planted_sequences import moving_sequence
from tiny_shots import moving_square, truncate, with_nan_velocity, write_shot
from typer.testing import CliRunner

import tuning.batch.cluster
from torchblur.io import read_image, save_yaml, write_frame
from torchblur.presets import Preset, save_preset
from tuning.batch.cluster import _collect, _make, _Order, _Told
from tuning.batch.run import BatchConfig, plan_batch, run_batch
from tuning.batch.threads import Task
from tuning.cli.app import app
from tuning.files.outputs import Job
from tuning.parallel.cluster import ClusterError, Lost, open_cluster


@pytest.fixture(scope="module")
def cluster():
    with threads_cluster() as found:
        yield found


def config_for(folder, output, **changes):
    settings = {"filter": "guertin2014", "params": {"num_samples": 5}, "root": str(folder)}
    return BatchConfig(**(settings | {"inputs": ["sharp.####.exr"], "output": output} | changes))


def outcome(result):
    return (
        [path.name for path in result.written],
        [(failure.job.source, failure.reason) for failure in result.failures],
        result.skipped,
        result.interrupted,
    )


def assert_same_images(one, two):
    names = sorted(path.name for path in one.glob("*"))
    assert names == sorted(path.name for path in two.glob("*"))  # nothing beside the results
    assert names
    for name in names:
        assert torch.equal(read_image(one / name), read_image(two / name))


def test_as_in_one_process(cluster, tmp_path, monkeypatch):
    shot = write_shot(tmp_path, 6)
    truncate(shot[1])
    with_nan_velocity(tmp_path / "bad.exr").replace(shot[3])
    here = run_batch(plan_batch(config_for(tmp_path, "one/")))
    monkeypatch.chdir(tmp_path)  # relative paths and a preset mean the driver's folder
    save_preset("own.yaml", Preset(filter="guertin2014", params={"num_samples": 5}))
    config = config_for(".", "two/", filter="own.yaml", params={})
    events = []
    there = run_batch(plan_batch(config), events.append, cluster)
    found = outcome(there)
    found[1][:] = [(path.absolute(), why) for path, why in found[1]]
    assert found == outcome(here)
    assert len(here.failures) == 2
    assert [event.done for event in events] == list(range(7))
    assert_same_images(tmp_path / "one", tmp_path / "two")
    assert plan_batch(config).count("done") == 4
    assert outcome(run_batch(plan_batch(config), None, cluster))[2] == 4


def test_warnings_come_back(cluster, tmp_path):
    shot = write_shot(tmp_path, 2)
    with_nan_velocity(tmp_path / "bad.exr").replace(shot[0])
    with pytest.warns(UserWarning, match="replaced") as caught:
        result = run_batch(
            plan_batch(config_for(tmp_path, "out/", on_invalid="mask")), None, cluster
        )
    assert len(caught) == 1
    assert not result.failures


def test_a_cut_is_told_once_whichever_worker_sees_it(cluster, tmp_path):
    for number, speed in enumerate((40.0, 60.0, 80.0), start=1):
        write_frame(tmp_path / f"sharp.{number:04d}.exr", moving_square(speed=speed))
    job = {"filter": "guertin2014", "params": {"num_samples": 5, "tile_size": 4}}
    save_yaml(
        tmp_path / "job.yaml", job | {"inputs": ["sharp.####.exr"], "output": "out/", "workers": 3}
    )
    for where in ([], ["--scheduler", cluster.client.scheduler.address]):
        command = ["batch", str(tmp_path / "job.yaml"), "--overwrite", *where]
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            done = CliRunner().invoke(app, command)
        assert done.exit_code == 0, done.output
        told = [line for line in done.stderr.splitlines() if line.startswith("warning")]
        assert len(told) == 1
        assert "guertin2014: 5% of the pixels move farther than the 4 px" in told[0]


def test_a_shot_of_a_filter_with_a_memory_is_one_task(cluster, tmp_path, recall):
    for number, frame in enumerate(moving_sequence(4), start=1):
        write_frame(tmp_path / f"sharp.{number:04d}.exr", frame, half=False)
    config = {"filter": "recall", "params": {"gain": 0.4}, "cuts": [3]}
    run_batch(plan_batch(config_for(tmp_path, "one/", **config)))
    plan = plan_batch(config_for(tmp_path, "two/", **config))
    result = run_batch(plan, None, cluster)
    assert [path.name for path in result.written] == [f"sharp.{n:04d}.exr" for n in range(1, 5)]
    assert_same_images(tmp_path / "one", tmp_path / "two")


def test_ctrl_c_finishes_what_is_in_flight(cluster, tmp_path):
    write_shot(tmp_path, 12)
    config = config_for(tmp_path, "out/")

    def stop_after_two(event):
        if event.done == 2 and "stopping" not in event.message:
            raise KeyboardInterrupt

    result = run_batch(plan_batch(config), stop_after_two, cluster)
    assert result.interrupted
    assert 2 <= len(result.written) <= 5
    assert {path.name for path in result.written} <= {p.name for p in (tmp_path / "out").iterdir()}
    assert not run_batch(plan_batch(config), None, cluster).interrupted
    assert plan_batch(config).count("done") == 12


class TestOtherDisks:
    def test_a_worker_that_does_not_see_the_results_folder_writes_nothing(
        self, tmp_path, monkeypatch
    ):
        monkeypatch.setattr(tuning.batch.cluster, "here", lambda: "tcp://far:1")
        monkeypatch.setattr(tuning.batch.cluster, "share_cores", lambda: None)
        shot = write_shot(tmp_path, 1)
        job = Job(shot[0], tmp_path / "out.exr")
        settings = '{"filter": "line"}'
        order = _Order(settings, "eager", {}, prefetch=0, probe=tmp_path / "no.probe")
        told = _make(order, Task([job], [job]))
        assert told == _Told({}, "tcp://far:1", (tmp_path / "no.probe",))
        assert not job.output.exists()

    def test_is_one_clear_error(self, tmp_path):
        path = tmp_path / "seen_here_alone.exr"
        path.touch()
        told = _Told({0: "no such file"}, "tcp://far:1", (path,))
        task = Task([Job(path, tmp_path / "out.exr")], [])
        with pytest.raises(ClusterError, match=r"tcp://far:1 does not see .*seen_here_alone\.exr"):
            _collect([(0, told)], [task], None, {})


@pytest.mark.slow
def test_killed_workers_cost_their_tasks_only(tmp_path):
    shot = write_shot(tmp_path, 8)
    run_batch(plan_batch(config_for(tmp_path, "one/")))
    with open_cluster(workers=2) as cluster:
        pids = list(cluster.client.run(os.getpid).values())
        assert os.getpid() not in pids

        def kill(event):
            if event.done == 2:
                os.kill(pids[0], signal.SIGKILL)

        result = run_batch(plan_batch(config_for(tmp_path, "two/")), kill, cluster)
        assert [path.name for path in result.written] == [path.name for path in shot]
        assert_same_images(tmp_path / "one", tmp_path / "two")
        assert pids[0] not in cluster.client.run(os.getpid).values()

        command = ["batch", str(tmp_path / "batch.yaml"), "--scheduler", cluster.address]
        config = config_for(tmp_path, "three/").model_dump(mode="json", exclude_unset=True)
        save_yaml(tmp_path / "batch.yaml", config)
        said = CliRunner().invoke(app, command)
        assert said.exit_code == 0, said.stderr
        assert "8 of 8 frames written" in said.stdout

        # What takes down whoever touches it is given up; the others are done.
        cluster.client.run_on_scheduler(allow_no_failure)
        ends = dict(cluster.start(os._exit, [1]))
        assert isinstance(ends[0], Lost)
        assert "1 workers died of it" in ends[0].reason
        assert cluster.map(abs, [-1]) == [1]


def allow_no_failure(dask_scheduler):
    dask_scheduler.allowed_failures = 0
