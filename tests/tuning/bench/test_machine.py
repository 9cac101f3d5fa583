"""What else uses the machine, from planted counters, and what machine it is."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch

from tuning.bench.machine import (
    CpuTicks,
    busy_warning,
    describe_machine,
    other_cores,
    read_ticks,
    watch,
)
from tuning.parallel.cores import count_cores

TICK = 1 / os.sysconf("SC_CLK_TCK")


def stat(path, *numbers):
    cores = "cpu0 1 2 3 4 5 6 7 8 0 0\n"
    path.write_text(f"cpu  {' '.join(str(n) for n in numbers)} 0 0\n{cores}intr 17\n")
    return path


class TestTicks:
    def test_count_work_and_not_idling(self, tmp_path):
        # user nice system idle iowait irq softirq steal
        ticks = read_ticks(stat(tmp_path / "stat", 100, 10, 20, 5000, 700, 1, 2, 4))
        assert ticks.busy == pytest.approx(137 * TICK)

    @pytest.mark.parametrize("text", ["", "cpu  1 2\n", "cpu a b c d e f g h\n"])
    def test_of_another_system_are_none(self, tmp_path, text):
        (tmp_path / "stat").write_text(text)
        assert read_ticks(tmp_path / "stat") is None
        assert read_ticks(tmp_path / "missing") is None


class TestOthers:
    def test_are_what_is_not_our_own(self):
        before, after = CpuTicks(100, 10), CpuTicks(107, 14)
        assert other_cores(before, after, 3.0) == pytest.approx(1.0)
        assert other_cores(before, after, 8.0) == 0

    def test_are_not_known_of_a_moment_or_without_counters(self):
        before = CpuTicks(100, 10)
        assert other_cores(before, CpuTicks(101, 10.1), 0) is None
        assert other_cores(None, before, 0) is None
        assert other_cores(before, None, 0) is None

    def test_busy_machine_is_warned_of(self):
        assert "use 1.0 of" in busy_warning(1.0)
        assert busy_warning(0.1) is None
        assert busy_warning(None) is None

    def test_watching_finds_a_program_that_works(self):
        if read_ticks() is None:
            pytest.skip("no counters")
        code = "import time\nwhile True: time.perf_counter()"

        busy = subprocess.Popen([sys.executable, "-c", code])
        try:
            assert watch(1.0) > 0.15
        finally:
            busy.kill()
            busy.wait()


def test_machine_is_described():
    machine = describe_machine("cpu", 1)
    assert machine["cores"] == count_cores() >= 1
    assert machine["threads"] == 1
    assert machine["processor"]
    assert machine["torch"]
    assert machine["memory_gib"] > 0
    assert "gpu" not in machine
    assert machine["commit"] is None or len(machine["commit"].rstrip("+")) == 12


def test_gpu_is_described(monkeypatch):
    properties = SimpleNamespace(
        name="G", total_memory=80 * 2**30, major=9, minor=0, multi_processor_count=132
    )
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: properties)
    gpu = describe_machine("cuda", 1)["gpu"]
    assert (gpu["name"], gpu["memory_gib"], gpu["capability"]) == ("G", 80.0, "9.0")
