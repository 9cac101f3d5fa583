"""Tasks on a Dask cluster: their order, their errors, and workers that are not there."""

import functools
import re
import sys
import time

import pytest
from clusters import threads_cluster
from typer.testing import CliRunner

import tuning.parallel.cluster
from torchblur.errors import ConfigError
from tuning.cli.app import app
from tuning.parallel.cluster import ClusterError, open_cluster


@pytest.fixture(scope="module")
def cluster():
    with threads_cluster() as found:
        yield found


def later(delay, number):
    time.sleep(delay * (5 - number))
    return number


def refused(number):
    raise ConfigError(f"`x` must be even, got {number}")


def broken(number):
    raise KeyError(number)


def lacking(number):
    raise ModuleNotFoundError("No module named 'optuna'", name="optuna")


class TestTasks:
    def test_results_are_in_the_order_of_the_items(self, cluster):
        ends = [p for p, _ in cluster.start(functools.partial(later, 0.05), range(6))]
        assert ends != sorted(ends)  # the first takes longest
        assert cluster.map(functools.partial(later, 0.05), range(6)) == list(range(6))

    def test_few_are_sent_at_a_time_and_the_others_can_be_kept_back(self, cluster):
        flight = cluster.start(functools.partial(later, 0.01), range(5))
        next(flight)
        assert flight.stop() <= 2
        assert len(list(flight)) <= 2

    def test_what_torchblur_refuses_is_said_as_it_is(self, cluster):
        with pytest.raises(ConfigError, match="`x` must be even, got 3"):
            cluster.map(refused, [3])

    def test_other_errors_name_their_type(self, cluster):
        with pytest.raises(ClusterError, match="failed on a worker: KeyError: 7"):
            cluster.map(broken, [7])

    def test_packages_that_a_worker_lacks(self, cluster):
        with pytest.raises(ClusterError, match="a worker lacks the package `optuna`"):
            cluster.map(lacking, [0])


class TestConnecting:
    def test_without_dask(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "distributed", None)
        with (
            pytest.raises(ClusterError, match=re.escape("pip install 'torchblur[cluster]'")),
            open_cluster("tcp://127.0.0.1:8786"),
        ):
            pass

    def test_no_scheduler(self, monkeypatch):
        monkeypatch.setattr(tuning.parallel.cluster, "_CONNECT", 0.5)
        with (
            pytest.raises(ClusterError, match=r"no Dask scheduler answers at 'tcp://127.0.0.1:9'"),
            open_cluster("tcp://127.0.0.1:9"),
        ):
            pass

    def test_an_address_without_a_port(self):
        with pytest.raises(ClusterError, match=r"'farm'.*missing port"), open_cluster("farm"):
            pass

    def test_no_workers(self):
        with threads_cluster(workers=0, patience=0.2) as empty:
            with pytest.raises(ClusterError, match=r"no worker has joined .* for 0.2 s"):
                empty.wait_for_workers()
            with pytest.raises(ClusterError, match="no worker has joined"):
                empty.map(later, [1])

    def test_address_or_number(self):
        with pytest.raises(ClusterError, match=r"both: tcp://a:1 and 2"):
            with open_cluster("tcp://a:1", workers=2):
                pass

    def test_the_command_line_says_the_same(self, monkeypatch, tmp_path):
        monkeypatch.setitem(sys.modules, "distributed", None)
        config = "configs/tune/minimal.yaml"
        result = CliRunner().invoke(app, ["tune", config, "-o", str(tmp_path), "--workers", "2"])
        assert result.exit_code == 2
        assert "torchblur[cluster]" in result.stderr


def test_a_scheduler_that_goes_away():
    with threads_cluster() as cluster:
        flight = cluster.start(functools.partial(later, 0.05), range(5))
        next(flight)
        cluster.client.close()
        with pytest.raises(ClusterError, match="is gone"):
            list(flight)
