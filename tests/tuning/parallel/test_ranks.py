"""Processes of one fit: torchrun's two end where one does, killed ones start again."""

import json
import os
import signal
import socket
import subprocess
import sys
import time

import psutil
import pytest
import torch
import torch.distributed as dist
from planted import planted_case, write_planted

from torchblur.io import save_yaml, write_frame, write_image
from torchblur.presets import load_preset
from tuning.config.fit import load_tune_config
from tuning.fit.run import run_fit
from tuning.objective.prepare import fingerprint, prepare
from tuning.parallel.cluster import Cluster, ClusterError
from tuning.parallel.ranks import Ranks, rank_here
from tuning.parallel.sharded_problem import Shard

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """Three windows for two ranks, a gradient fit and a search."""
    root = tmp_path_factory.mktemp("ranks")
    data = write_planted(root / "frames")
    third = root / "frames/third"
    third.mkdir()
    case = planted_case(3)
    write_frame(third / "sharp.exr", case.frame, half=False)
    write_image(third / "reference.exr", case.reference, half=False)
    data["data"]["train"].append({"kind": "exr", "path": "third", "shutter": 1.0})
    data["data"]["train"].append({"kind": "exr", "path": "second", "shutter": 1.0})
    data["data"]["holdout"] = []
    data["methods"] = [
        {"kind": "gradient", "steps": 4, "starts": 2, "batch": 3},
        {"kind": "blackbox", "sampler": "random", "trials": 3},
    ]
    save_yaml(root / "fit.yaml", data)
    return root / "fit.yaml"


def started(config, folder, *launcher, **more):
    """Start the command line; its lines of the log tell how far it is."""
    command = [*launcher, "-m", "tuning", "tune", str(config), "-o", str(folder)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"} | more
    return subprocess.Popen(
        command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def ended(process):
    out, err = process.communicate(timeout=240)
    return process.returncode, out, err


def records(folder):
    path = folder / "log.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    return [json.loads(line) for line in lines if '"loss"' in line]


def wait_for(condition):
    end = time.monotonic() + 240
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def losses(folder):
    return torch.tensor([loss for record in records(folder) for loss in record["loss"]])


@pytest.fixture(scope="module")
def one_process(config, tmp_path_factory):
    folder = tmp_path_factory.mktemp("one") / "run"
    run_fit(load_tune_config(config), folder)
    return folder


@pytest.mark.slow
def test_two_ranks_end_where_one_process_does_even_if_one_is_killed(config, one_process, tmp_path):
    folder = tmp_path / "two"
    process = started(config, folder, *TORCHRUN, "--max-restarts", "1")
    wait_for(lambda: len(records(folder)) >= 2)
    os.kill(rank_process(process.pid, 1), signal.SIGKILL)
    code, out, err = ended(process)
    assert code == 0, err
    assert out.count("preset:") == 1  # rank 0 alone prints
    torch.testing.assert_close(losses(folder), losses(one_process), rtol=1e-6, atol=0)
    found, want = (load_preset(f / "preset.yaml").params for f in (folder, one_process))
    for name, value in want.items():
        assert found[name] == pytest.approx(value, rel=1e-5)


@pytest.mark.slow
def test_a_rank_that_dies_ends_the_other(config, tmp_path):
    port = free_port()
    ranks = []
    for rank in range(2):
        where = {"RANK": rank, "WORLD_SIZE": 2, "LOCAL_RANK": rank, "LOCAL_WORLD_SIZE": 2}
        where |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        strings = {name: str(value) for name, value in where.items()}
        ranks.append(started(config, tmp_path / "run", sys.executable, **strings))
    wait_for(lambda: len(records(tmp_path / "run")) >= 2)
    ranks[0].kill()
    ended(ranks[0])
    code, _, err = ended(ranks[1])
    assert code == 2
    assert "error: another rank is gone" in err
    assert "--resume" in err


class TestOneRank:
    """What needs no second process: a group of one."""

    @pytest.fixture
    def ranks(self):
        dist.init_process_group("gloo", store=dist.HashStore(), rank=0, world_size=1)
        yield Ranks(torch.device("cpu"))
        dist.destroy_process_group()

    def test_shares_and_sums(self, config, ranks):
        settings = load_tune_config(config)
        ready = prepare(settings)
        shared = ranks.share(settings, ready.problem)
        start = ready.space.start()
        torch.testing.assert_close(shared.mean(start), ready.problem.mean(start), rtol=1e-6, atol=0)

    def test_an_error_in_a_share_is_told(self, config, ranks, monkeypatch):
        settings = load_tune_config(config)
        shared = ranks.share(settings, prepare(settings).problem)

        def out_of_memory(*_):
            raise MemoryError("no 3 GiB left")

        monkeypatch.setattr(Shard, "answer", out_of_memory)
        with pytest.raises(ClusterError, match="rank 0: MemoryError: no 3 GiB left"):
            shared.mean({"kappa": 3.0})

    def test_data_that_a_rank_lacks_or_has_otherwise(self, config, ranks):
        settings = load_tune_config(config)
        windows = fingerprint(prepare(settings).problem)
        plain = settings.model_dump(mode="json")
        gone = plain | {"data": plain["data"] | {"root": "/nowhere"}}
        with pytest.raises(ClusterError, match=r"rank 0: .*/nowhere.* does not exist.*same files"):
            ranks._prepare(json.dumps(gone), windows)
        other = [(height, width, mean * 1.01) for height, width, mean in windows]
        with pytest.raises(ClusterError, match="rank 0: other data under"):
            ranks._prepare(json.dumps(plain), other)


def test_not_both_ways_at_once(config, tmp_path, monkeypatch):
    for name, value in {"RANK": 0, "WORLD_SIZE": 1, "MASTER_PORT": free_port()}.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")
    assert rank_here() == 0
    with pytest.raises(ClusterError, match="not both"):
        run_fit(load_tune_config(config), tmp_path / "run", cluster=Cluster(None))


def rank_process(launcher, rank):
    """Return the process of a rank."""
    children = psutil.Process(launcher).children()
    return next(c.pid for c in children if c.environ().get("RANK") == str(rank))


def free_port():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        return unused.getsockname()[1]
