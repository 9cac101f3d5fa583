"""Workers share the cores, and end with the process that started them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from tuning.parallel.cores import count_cores
from tuning.parallel.processes import worker_pool

DRIVER = """
import os, time
from tuning.parallel.cores import count_cores
from tuning.parallel.processes import worker_pool

if __name__ == "__main__":
    with worker_pool(2) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        list(pool.map(time.sleep, [600, 600]))
"""


def is_running(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{process}/stat")  # one that ended may wait for a parent to notice
    return not (status.is_file() and status.read_text().rpartition(")")[2].split()[0] == "Z")


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs signals of POSIX")
def test_a_killed_driver_leaves_no_workers(tmp_path):
    script = tmp_path / "driver.py"
    script.write_text(DRIVER)
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as driver:
        worker = int(driver.stdout.readline())
        assert is_running(worker)
        driver.kill()
    end = time.monotonic() + 60
    while is_running(worker) and time.monotonic() < end:
        time.sleep(0.1)
    assert not is_running(worker)


@pytest.mark.slow
def test_workers_share_the_cores():
    with worker_pool(2) as pool:
        assert pool.submit(torch.get_num_threads).result() == max(1, count_cores() // 2)
