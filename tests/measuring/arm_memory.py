"""The picture of windows and memories in docs/arm.md, from records.

    uv run python tests/measuring/arm_memory.py --arm=docs/results/arm_windows.json \
        --maze=docs/results/arm_maze_memory.json --output=docs/arm_memory.png
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lerobot_unimask.plots.style import COLOURS, FAINT, SMALL, WIDTH
from lerobot_unimask.records import read_json


def draw(axes: Axes, windows: Mapping[int, Mapping[int, Mapping[str, float]]], value: str) -> None:
    """A line for each length of window: a value against the steps that acting remembers, with its standard errors."""
    every = sorted({h for found in windows.values() for h in found})
    for i, (K, found) in enumerate(sorted(windows.items())):
        middle, errors = ([found[h][key] for h in sorted(found)] for key in (value, "standard_error"))
        where = [every.index(h) + 0.06 * (i - len(windows) / 2) for h in sorted(found)]
        axes.errorbar(
            where, middle, errors, color=COLOURS[i], marker="o", markersize=4, linewidth=1.2, label=f"K = {K}"
        )
    axes.set_xticks(range(len(every)), map(str, every))
    axes.set_xlabel("steps that acting remembers, h")
    axes.grid(color=FAINT)
    axes.legend(fontsize=SMALL, frameon=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--arm", type=Path, required=True, help="a record of tests/measuring/arm_tasks.py --windows --remember"
    )
    parser.add_argument("--maze", type=Path, required=True, help="a record of memory.py")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    tasks: dict[str, dict[int, Any]] = {}
    for run in read_json(arguments.arm)["runs"]:
        remembers = {int(h): found for h, found in run.get("remembers", {}).items()}
        tasks.setdefault(run["task"], {})[run["context_length"]] = remembers | {run["context_length"]: run}
    maze = read_json(arguments.maze)
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    *arm, last = figure.subplots(1, len(tasks) + 1)
    for axes, (task, windows) in zip(arm, tasks.items(), strict=True):
        draw(axes, windows, "success")
        axes.set_title(task)
        axes.set_ylabel("success")
        axes.set_ylim(0, 1.03)
    remembers = {int(h): found for h, found in maze["remembers"].items()}
    draw(last, {maze["policy"]["context_length"]: remembers}, "mean_return")
    last.set_title("Maze2D")
    last.set_ylabel("return")
    last.set_ylim(0)
    figure.savefig(arguments.output, dpi=120)


if __name__ == "__main__":
    main()
