"""The benchmark's table of moving areas, as a program on tiny frames."""

import json
import subprocess
import sys


def test_cost_by_moving_area(tmp_path):
    file = tmp_path / "figures.json"
    command = [sys.executable, "-m", "tuning.bench", "--only", "moving", "--size", "160x90"]
    command += ["--samples", "5", "--runs", "1", "--json", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = json.loads(file.read_text())["moving"]
    assert [(row["filter"], row["percent"]) for row in rows] == [
        (name, percent)
        for name in ("oberberger2022", "guertin2014")
        for percent in (0, 10, 50, 100)
    ]
    still, _, _, whole = rows[:4]
    assert whole["of_whole"] == 1
    assert still["of_whole"] == still["cpu"] / whole["cpu"] < 0.5
    assert whole["of_guertin"] == whole["cpu"] / rows[7]["cpu"]
    assert "of Guertin: over guertin2014 with N = 5" in done.stdout
