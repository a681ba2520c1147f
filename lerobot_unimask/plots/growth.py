"""What an update costs as one thing grows."""

from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure

from lerobot_unimask.plots.style import COLOURS, FAINT, SMALL, WIDTH


def cost_of_growth(record: Mapping[str, Any]) -> Figure:
    """Time and peak memory of an update against context length, width, batch size and episodes, all else as it was.

    Args:
        record: one of `bench.measuring.bench`.
    """
    names = {
        "context_length": "context length K",
        "width": "width",
        "batch_size": "windows in a batch",
        "episodes": "episodes in the dataset",
    }
    figure = Figure(figsize=(WIDTH, 4.4), layout="constrained")
    grid = figure.subplots(2, len(names), sharex="col", sharey="row")
    for (what, name), (time, memory) in zip(names.items(), grid.T, strict=True):
        points = record["growth"][what]
        values = [point[what] for point in points]
        low, high = zip(*(point["step_ms"]["quartiles"] for point in points), strict=True)
        line = {"markersize": 4, "linewidth": 1.2}
        time.fill_between(values, low, high, color=COLOURS[0], alpha=0.2, linewidth=0)
        time.plot(values, [point["step_ms"]["median"] for point in points], color=COLOURS[0], marker="o", **line)
        memory.plot(values, [point["peak_memory_mib"] for point in points], color=COLOURS[1], marker="s", **line)
        memory.axhline(record["imports"]["peak_memory_mib"], color=COLOURS[-1], linewidth=0.8, linestyle=":")
        for axes in (time, memory):
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xticks(values, [f"{value:,}" for value in values], rotation=45)
            axes.xaxis.minorticks_off()
            axes.grid(color=FAINT)
        memory.set_xlabel(name)
    grid[0, 0].set_ylabel("time of an update (ms)")
    grid[1, 0].set_ylabel("peak memory (MiB)\ndotted: imports", fontsize=SMALL)
    return figure
