"""How a call is measured: runs, memory that really shows, places of waits."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import torchblur
from tuning.bench.measure import find_sync, graph_ms, place_of, repeat

LINE = str(Path(torchblur.__file__).parent / "filters" / "line.py")
CPU = torch.device("cpu")

MEMORY = """
import torch
from tuning.bench.measure import exact_allocation, peak_mib

torch.set_num_threads(1)
kept = []

def call():
    large = torch.ones(40 * 2**18)  # 40 MiB, gone at the end
    small = torch.ones(8 * 2**18)
    del small
    return large.sum()

def keep():
    kept.append(torch.ones(8 * 2**18))

used = [torch.ones(30 * 2**18) for _ in range(4)]
del used  # the allocator may keep it, and hide the call's memory in it
call()
assert exact_allocation()
for function in (call, keep, lambda: None):
    print(peak_mib(function, torch.device("cpu")))
"""


class TestRepeat:
    def test_runs_as_often_as_asked(self):
        calls = []
        times = repeat(lambda: calls.append(1), CPU, runs=7, seconds=60)
        assert len(calls) == times.runs == 7
        assert times.device is None

    def test_stops_after_three_if_time_is_up(self):
        calls = []
        assert repeat(lambda: calls.append(1), CPU, runs=7, seconds=0).runs == 3
        assert len(calls) == 3

    def test_sees_that_the_process_waits(self):
        times = repeat(lambda: time.sleep(0.05), CPU, runs=3, seconds=60)
        assert times.waited
        assert times.wall >= 0.05 > times.cpu

    def test_medians_do_not_mind_one_slow_run(self):
        naps = iter((0.0, 1.0, 0.0, 0.0, 0.0))
        times = repeat(lambda: time.sleep(next(naps)), CPU, runs=5, seconds=60)
        assert times.wall < 0.15  # their mean is 0.2
        assert times.spread > 1


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_memory_of_tensors_shows():
    done = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    call, keep, nothing = (float(line) for line in done.stdout.split())
    assert call == pytest.approx(48, abs=2)
    assert keep == pytest.approx(8, abs=2)
    assert nothing == pytest.approx(0, abs=1)


class TestPlaceOfAWait:
    def raised(self, filename, message):
        code = "def resolve():\n\n    raise RuntimeError(message)\n\nresolve()"
        try:
            exec(compile(code, filename, "exec"), {"message": message})
        except RuntimeError as error:
            return place_of(error)

    def test_is_the_line_of_the_source(self):
        message = "called a synchronizing CUDA operation"
        found = self.raised(LINE, message)
        assert found == "line.py:3 resolve"

    def test_is_the_message_if_it_is_another_error(self):
        found = self.raised(LINE, "out of memory\nmore")
        assert found == "out of memory"
        assert self.raised("/usr/lib/a.py", "a synchronizing call") == "a synchronizing call"


class TestLookingForWaits:
    """With a stand-in for the driver's debug mode."""

    @pytest.fixture
    def modes(self, monkeypatch):
        seen = []
        monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: 0)
        monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", seen.append)
        monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
        return seen

    def test_is_on_during_the_call_alone(self, modes):
        during = []
        assert find_sync(lambda: during.append(list(modes))) == "no"
        assert during == [["error"]]
        assert modes == ["error", 0]

    def test_ends_with_a_call_that_waits(self, modes):
        def call():
            raise RuntimeError("called a synchronizing CUDA operation")

        assert find_sync(call) == "called a synchronizing CUDA operation"
        assert modes == ["error", 0]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
class TestOnAGpu:
    def test_waits_are_found(self):
        plane = torch.rand(100, 100, device="cuda")
        assert find_sync(lambda: plane * 2) == "no"
        assert find_sync(lambda: plane.sum().item()) != "no"
        assert torch.cuda.get_sync_debug_mode() == 0

    def test_graphs_are_replayed(self):
        plane = torch.rand(1000, 1000, device="cuda")
        assert graph_ms(lambda: plane.sin().cos(), runs=5) > 0
        with pytest.raises(RuntimeError):
            graph_ms(lambda: plane.sum().item(), runs=5)

    def test_events_and_memory(self):
        from tuning.bench.measure import peak_mib

        plane = torch.rand(1024, 1024, device="cuda")
        device = torch.device("cuda")
        times = repeat(lambda: plane + 1, device, runs=3, seconds=10)
        assert times.device > 0
        assert not times.waited
        assert peak_mib(lambda: plane + 1, device) == pytest.approx(4, abs=0.1)
