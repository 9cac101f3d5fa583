"""What filters and presets cost at four heights: ``python -m tools.costs [FILE]``.

One scene, the whole image, CPU-seconds of one call on one thread; eager.
"""

from __future__ import annotations

import statistics
import sys
import time
import warnings
from pathlib import Path

import torch

from torchblur.filters import TemporalBlur
from torchblur.frame import Frame
from torchblur.presets import create_filter
from torchblur.render import load_scene, render_frame

__all__ = ["cpu_seconds", "main", "table"]

_ROOT = Path(__file__).resolve().parents[1]
_HEIGHTS = (270, 540, 1080, 2160)
_SHUTTERS = {"long": 0.3, "short": 0.03}
"""Half spreads of up to 17 px at 270 lines and 138 px at 2160; a tenth of that."""
_RUNS = 3
_LARGE = 1080  # lines from which one call is enough


def main() -> None:
    """Measure the default, the line blur and all presets, and write the table."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else _ROOT / "docs" / "costs.md"
    torch.set_num_threads(1)
    scene = load_scene(_ROOT / "configs" / "scenes" / "crossing_spheres.yaml")
    frames = {
        lines: render_frame(scene, (lines, lines * 16 // 9), color_spp=1) for lines in _HEIGHTS
    }
    presets = sorted((_ROOT / "configs" / "filters").glob("*-*.yaml"))
    names = ["line", "torchblur", *map(str, presets)]
    costs: dict[str, list[list[float]]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what Tan 2022 goes without
        for name in names:
            if isinstance(create_filter(name), TemporalBlur):
                continue
            costs[Path(name).stem] = [
                [cpu_seconds(name, frame, shutter) for shutter in _SHUTTERS.values()]
                for frame in frames.values()
            ]
            path.write_text(table(costs))
    print(path)


@torch.no_grad()
def cpu_seconds(name: str, frame: Frame, shutter: float) -> float:
    """Return the median CPU time of one call.

    Args:
        name: A filter, or the path of a preset.
        frame: What it blurs.
        shutter: Open time in frames.
    """
    blur, taken = create_filter(name, engine="eager"), []
    for _ in range(_RUNS if frame.size[0] < _LARGE else 1):
        start = time.process_time()
        blur(frame, shutter=shutter, shutter_position="centered")
        taken.append(time.process_time() - start)
    return statistics.median(taken)


def table(costs: dict[str, list[list[float]]]) -> str:
    """Return the page.

    Args:
        costs: CPU-seconds by name, height and shutter.
    """
    lines = [
        "# Cost at four heights",
        "",
        "Made by `python -m tools.costs`: CPU-seconds of one eager call on one thread, median of",
        f"{_RUNS} (of one from {_LARGE} lines on); the whole image of crossing_spheres. Long and",
        "short: half spreads of up to 17 px at 270 lines, 35, 69 and 138 px at the others; and a",
        "tenth of that.",
        "",
        "| | " + " | ".join(f"{h} lines" for h in _HEIGHTS) + " |",
        "|---|" + "---|" * len(_HEIGHTS),
    ]
    for name, rows in costs.items():
        cells = " | ".join(" / ".join(f"{c:.2f}" for c in row) for row in rows)
        lines.append(f"| `{name}` | {cells} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
