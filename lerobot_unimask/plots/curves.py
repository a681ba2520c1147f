"""Records of experiments."""

from collections.abc import Mapping
from itertools import cycle
from typing import Any

from matplotlib.figure import Figure

from lerobot_unimask.plots.style import COLOURS, FAINT, SMALL, WIDTH


def learning_curves(record: Mapping[str, Any]) -> Figure:
    """Mean return against updates, one line for each run, with bars of one standard error.

    Args:
        record: one of `paper.learning_curve`.
    """
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    axes = figure.subplots()
    for run, colour, marker in zip(record["runs"], cycle(COLOURS), cycle("os^Dvx"), strict=False):
        points = run["checkpoints"]
        axes.errorbar(
            [point["updates"] for point in points],
            [point["mean_return"] for point in points],
            [point["standard_error"] for point in points],
            color=colour,
            marker=marker,
            markersize=4,
            linewidth=1.2,
            capsize=2,
            label=run["run"],
        )
    axes.set_xlabel("updates")
    axes.set_ylabel("mean return")
    axes.grid(color=FAINT)
    axes.legend(fontsize=SMALL)
    return figure


def cost_of_context(record: Mapping[str, Any]) -> Figure:
    """Return, cost of an update and latency against the context length, each with its standard error over seeds.

    Args:
        record: one of `paper.ablation`, of several context lengths.
    """
    figure = Figure(figsize=(WIDTH, 2.9), layout="constrained")
    panels: dict[str, dict[str, str | None]] = {
        "mean return": {"behavior_cloning": "imitation", "reward_conditioned": "reward-conditioned"},
        "processor time per update (ms)": {"ms_per_update": None},
        "time per action (ms)": {"latency_ms": None},
    }
    lengths = record["config"]["context_lengths"]
    for axes, (title, quantities) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        for variant in record["config"]["variants"]:
            for (quantity, label), marker in zip(quantities.items(), "os", strict=False):
                cells = [record["summary"][f"{variant}, K = {K}"][quantity] for K in lengths]
                many = len(record["config"]["variants"]) > 1
                axes.errorbar(
                    lengths,
                    [cell["mean"] for cell in cells],
                    [cell["standard_error"] for cell in cells],
                    color=COLOURS[list(quantities).index(quantity)],
                    marker=marker,
                    markersize=4,
                    linewidth=1.2,
                    capsize=2,
                    label=", ".join(filter(None, [variant if many else None, label])),
                )
        axes.set_xscale("log", base=2)
        axes.set_xticks(lengths, [str(K) for K in lengths])
        axes.set_xlabel("context length K")
        axes.set_title(title, fontsize=SMALL)
        if not title.startswith("mean"):
            axes.set_ylim(bottom=0)
        axes.grid(color=FAINT)
    figure.axes[0].legend(fontsize=SMALL)
    return figure


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
