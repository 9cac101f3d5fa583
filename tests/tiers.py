"""Which tests take long: those that a measured run found, beside those that are marked by hand.

`make test` leaves them out, `make test-all` runs everything, `make test-times` measures anew and
writes the list. With TORCHBLUR_TEST_TIMES set, a test that is not on it and takes long fails.
"""

import functools
import os
import time
from pathlib import Path

import pytest
import torch

LIST = Path(__file__).with_name("slow.txt")
LONG = 2.0  # seconds, on the machine on which the list is made
TOO_LONG = 3.0  # where a test must be on the list, times how much slower this machine is
CALIBRATION = 0.033  # seconds that `_loop` takes there


def pytest_collection_modifyitems(items):
    listed = set(LIST.read_text().splitlines()) if LIST.is_file() else set()
    for item in items:
        path = item.nodeid.split("::")[0]
        if path.startswith("tests/twins/"):
            item.add_marker(pytest.mark.twin)
        if path in listed or item.nodeid in listed:
            item.add_marker(pytest.mark.slow)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    report = (yield).get_result()
    if "TORCHBLUR_TEST_TIMES" not in os.environ or call.when != "call" or not report.passed:
        return
    limit = TOO_LONG * max(1.0, slowness())
    if call.duration > limit and not any(map(item.get_closest_marker, ("slow", "twin"))):
        report.outcome = "failed"
        report.longrepr = (
            f"took {call.duration:.1f} s, more than {limit:.1f} s, and is no slow test: make it "
            f"quicker, or add it to {LIST.name} (make test-times)"
        )


def pytest_terminal_summary(terminalreporter, config):
    stats = terminalreporter.stats
    if path := os.environ.get("TORCHBLUR_WRITE_TIMES"):
        Path(path).write_text("\n".join(long_ones(stats.get("passed", []))) + "\n")
    ran = sum(report.when == "call" for report in stats.get("passed", []))
    left = config.getoption("markexpr")
    rest = "; the rest: make test-all" if left else ""
    terminalreporter.write_line(f"ran {ran} tests ({left or 'all tiers'}){rest}")


def long_ones(reports):
    """Return what takes long: single tests, and files whose fixtures do."""
    files = {r.nodeid.split("::")[0] for r in _phase(reports, "setup")}
    tests = {r.nodeid for r in _phase(reports, "call")}
    return sorted(files) + sorted(t for t in tests if t.split("::")[0] not in files)


def _phase(reports, name):
    return (r for r in reports if r.when == name and r.duration > LONG)


@functools.cache
def slowness():
    """How many times longer than there a fixed piece of work takes here."""
    return min(_loop() for _ in range(3)) / CALIBRATION


def _loop():
    began = time.perf_counter()
    plane = torch.rand(256, 256)
    for _ in range(300):
        plane = (plane * 1.01).sin() + plane.mean()
    return time.perf_counter() - began
