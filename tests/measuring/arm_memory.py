"""The picture of windows and memories in docs/arm.md, a panel for each task, from records.

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


def draw(axes: Axes, windows: Mapping[str, Mapping[int, Mapping[str, float]]], value: str) -> None:
    """A line for each window: a value against the steps that acting remembers, with its standard errors."""
    every = sorted({h for found in windows.values() for h in found})
    for i, (name, found) in enumerate(windows.items()):
        middle, errors = ([found[h][key] for h in sorted(found)] for key in (value, "standard_error"))
        where = [every.index(h) + 0.06 * (i - len(windows) / 2) for h in sorted(found)]
        axes.errorbar(where, middle, errors, color=COLOURS[i], marker="o", markersize=4, linewidth=1.2, label=name)
    axes.set_xticks(range(len(every)), map(str, every))
    axes.set_xlabel("steps that acting remembers, h")
    axes.grid(color=FAINT)
    axes.legend(fontsize=SMALL, frameon=False, loc="upper left", bbox_to_anchor=(0, -0.2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--arm", type=Path, required=True, help="a record of tests/measuring/arm_tasks.py --windows --remember"
    )
    parser.add_argument("--maze", type=Path, required=True, help="a record of tests/measuring/memory.py")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    tasks: dict[str, dict[str, Any]] = {}
    for run in [run for path in (arguments.arm, arguments.maze) for run in read_json(path)["runs"]]:
        remembers = {int(h): found for h, found in run["remembers"].items()}
        name = f"K = {run['context_length']}, {run['updates']:,} updates"
        tasks.setdefault(run["task"], {})[name] = {run["context_length"]: run} | remembers
    figure = Figure(figsize=(WIDTH, 3.9), layout="constrained")
    for axes, (task, windows) in zip(figure.subplots(1, len(tasks)), tasks.items(), strict=True):
        value = "mean_return" if task == "maze2d" else "success"
        draw(axes, windows, value)
        axes.set_title(task)
        axes.set_ylabel("return" if task == "maze2d" else value)
        axes.set_ylim(0, None if task == "maze2d" else 1.03)
    figure.savefig(arguments.output, dpi=120)


if __name__ == "__main__":
    main()
