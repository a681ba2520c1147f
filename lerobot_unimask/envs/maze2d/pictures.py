"""Maze2D: where the model thinks the mass is, over the maze's walls."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch

from lerobot_unimask.asking.answers import Answer, ContinuousDistribution
from lerobot_unimask.data.window import Window
from lerobot_unimask.envs.maze2d.maze import BODY_OFFSET, WALL_OFFSET, parse_maze
from lerobot_unimask.plots.style import (
    BLUE,
    FAINT,
    GREEN,
    NORMAL,
    PURPLE,
    SMALL,
    VERMILLION,
    WALL,
    WIDTH,
    shown_handle,
    square,
)

MARGIN = 0.75  # cells around what the close view shows


def draw_maze(axes: Axes, maze: str = "medium") -> None:
    """The walls from above, x to the right and y upwards, in joint positions: a cell's middle is 0.2 below its number,
    see `envs.maze2d`."""
    rows = parse_maze(maze).rows
    offset = WALL_OFFSET - BODY_OFFSET
    for x, row in enumerate(rows):
        for y, cell in enumerate(row):
            if cell == "#":
                square(axes, x + offset, y + offset, facecolor=WALL, edgecolor=WALL, linewidth=0.5, zorder=0)
    axes.set(xlim=(offset - 0.5, len(rows) + offset - 0.5), ylim=(offset - 0.5, len(rows[0]) + offset - 0.5))
    axes.set(aspect="equal", xlabel="x (cells)", ylabel="y (cells)")
    axes.tick_params(labelsize=SMALL)
    axes.set_facecolor("white")


def draw_ways(states: np.ndarray, maze: str = "medium") -> Figure:
    """Episodes from above, (N, T, 4) states of N episodes, each from a dot towards a star."""
    figure = Figure(figsize=(0.6 * WIDTH, 0.6 * WIDTH), layout="constrained")
    axes = figure.subplots()
    draw_maze(axes, maze)
    for way in states:
        (line,) = axes.plot(way[:, 0], way[:, 1], linewidth=1.2)
        axes.plot(*way[0, :2], marker=".", color=line.get_color())
        axes.plot(*way[0, 2:], marker="*", markersize=9, color=line.get_color())
    axes.set_title("from the dot towards the star")
    return figure


def maze_trajectories(answer: Answer, truth: Window | None = None, *, maze: str = "medium") -> Figure:
    """Predicted positions with their uncertainty, the whole maze and a close view.

    An ellipse reaches two scales to each side of a mean; a model with an L2 head has no scales, and no ellipses.

    Args:
        answer: one to a question about `s` of a Maze2D model.
        truth: recorded windows, to draw beside it.
        maze: name or text of the maze.
    """
    (state,) = (part for part in answer["s"] if isinstance(part, ContinuousDistribution))
    mean = state.most_likely[0].numpy(force=True)  # (K, 4): x, y, goal x, goal y
    weights, means = (part[0].numpy(force=True) for part in (state.weights, state.means))  # (K, n), (K, n, 4)
    scales = np.zeros_like(means) if state.scales is None else state.scales[0].numpy(force=True)
    scale = None if state.scale is None else state.scale[0].numpy(force=True)
    shown = answer.mask.shown["s"][0].numpy(force=True)  # (K,)
    recorded = None if truth is None else truth.values["s"][0][truth.valid[0]].numpy(force=True)
    goal = mean[~np.isnan(mean[:, 2])][0, 2:] if recorded is None else recorded[0, 2:]
    figure = Figure(figsize=(WIDTH, 4.4), layout="constrained")
    whole, close = figure.subplots(1, 2)
    for axes in (whole, close):
        draw_maze(axes, maze)
        if recorded is not None:
            axes.plot(*recorded[:, :2].T, color=VERMILLION, linewidth=1.2, zorder=2)
        axes.plot(*mean[:, :2].T, color=BLUE, marker="o", markersize=2.5, linewidth=0.9, zorder=3)
        axes.scatter(
            *mean[shown, :2].T, s=42, marker="s", facecolors="none", edgecolors=PURPLE, linewidths=1.8, zorder=4
        )
        axes.scatter(*goal, marker="*", s=130, color=GREEN, edgecolors="white", linewidths=0.6, zorder=5)
        for step, i in np.ndindex(weights.shape):
            wide = scales[step, i, :2]
            if not np.isnan(wide).any() and wide.any():  # a Gaussian of more weight is darker
                faint = 0.16 * weights[step, i] ** 0.5
                x, y = means[step, i, :2]
                axes.add_patch(Ellipse((x, y), *(4 * wide), color=BLUE, alpha=faint, linewidth=0, zorder=1))
    _zoom(close, mean, scale, recorded)
    whole.set_title("the maze", fontsize=NORMAL)
    close.set_title("closer", fontsize=NORMAL)
    close.set_axisbelow(True)
    close.grid(color=FAINT)
    handles = [
        Patch(facecolor=WALL, label="wall"),
        Line2D([], [], marker="*", linestyle="none", markersize=10, color=GREEN, label="goal"),
        Line2D([], [], marker="o", markersize=3, linewidth=1, color=BLUE, label="most likely"),
    ]
    if scale is not None:
        handles.append(Patch(facecolor=BLUE, alpha=0.25, label="two scales around it"))
    handles.append(shown_handle())
    if recorded is not None:
        handles.append(Line2D([], [], color=VERMILLION, linewidth=1.2, label="recorded"))
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=SMALL + 1, frameon=False)
    return figure


def _zoom(axes: Axes, mean: np.ndarray, scale: np.ndarray | None, recorded: np.ndarray | None) -> None:
    """A square view around all that is drawn of the way."""
    parts = [mean[:, :2]] + ([] if recorded is None else [recorded[:, :2]])
    if scale is not None:
        parts += [mean[:, :2] - 2 * scale[:, :2], mean[:, :2] + 2 * scale[:, :2]]
    points = np.concatenate(parts)
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    middle, half = (low + high) / 2, (high - low).max() / 2 + 0.15 * (high - low).max() + 0.05
    half = max(half, MARGIN / 4)
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
