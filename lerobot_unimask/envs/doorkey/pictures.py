"""DoorKey: rooms, trajectories and predicted states, one square for each cell."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.path import Path

from lerobot_unimask.asking.answers import Answer, DiscreteDistribution
from lerobot_unimask.envs.doorkey.panels import Panel, given_states
from lerobot_unimask.envs.doorkey.rules import CELLS, DOOR, GOAL, coordinates
from lerobot_unimask.plots.style import (
    BLACK,
    FAINT,
    GREEN,
    LEAST,
    MONOSPACE,
    NORMAL,
    ORANGE,
    PURPLE,
    SMALL,
    TIME,
    VERMILLION,
    WALL,
    WIDTH,
    shown_handle,
    square,
    time_colours,
)

FEW = 5  # trajectories that fit into a cell side by side


def draw_grid(axes: Axes) -> None:
    """DoorKey's rooms, seen from above: walls, the locked door, the goal, and the cells' numbers along both sides."""
    x, y = coordinates(CELLS)
    wall = (x == coordinates(DOOR)[0]) & (CELLS != DOOR)
    for cell_x, cell_y, solid in zip(x, y, wall, strict=True):
        square(axes, cell_x, cell_y, facecolor=WALL if solid else "white", edgecolor=FAINT, linewidth=0.6, zorder=0)
    square(axes, *coordinates(GOAL), facecolor=GREEN, alpha=0.45, linewidth=0, zorder=0.2)
    door_x, door_y = coordinates(DOOR)
    square(axes, door_x, door_y, facecolor=VERMILLION, alpha=0.18, linewidth=0, zorder=0.2)
    axes.plot([door_x - 0.46] * 2, [door_y - 0.46, door_y + 0.46], color=VERMILLION, linewidth=3, zorder=0.4)
    axes.set(xlim=(0.5, x.max() + 0.5), ylim=(y.max() + 0.5, 0.5), aspect="equal")
    axes.set_xticks(np.unique(x))
    axes.set_yticks(np.unique(y))
    axes.tick_params(length=0, labelsize=SMALL, colors=WALL, pad=2)
    axes.spines[:].set(color=WALL, linewidth=2.5)


def _key_marker() -> Path:
    """A key: ring, shaft and two teeth."""
    turn = np.linspace(0, 2 * np.pi, 25)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    corners = [(-0.2, 0.16), (1.9, 0.16), (1.9, -0.6), (1.55, -0.6), (1.55, -0.16)]
    corners += [(1.2, -0.16), (1.2, -0.5), (0.85, -0.5), (0.85, -0.16), (-0.2, -0.16), (-0.2, 0.16)]
    parts = [0.75 * circle - (0.95, 0), 0.36 * circle[::-1] - (0.95, 0), np.array(corners[::-1])]
    return Path.make_compound_path(*(Path(part, closed=True) for part in parts))


KEY = _key_marker()


def draw_panels(panels: Sequence[Panel]) -> Figure:
    """Trajectories that answer one question each, side by side (the paper's gridworld figure).

    Under each panel's name stands its question, below the grid what came of it. Colour and arrows show time; the
    jitter only keeps trajectories apart that share cells. Drawn are the window's states: a rollout's last action, after
    s[K-1], counts only in its return. A panel without trajectories has just its grid.
    """
    figure = Figure(figsize=(WIDTH, 2.72), layout="constrained")
    row = figure.subplots(1, len(panels), squeeze=False)[0]
    steps = max(len(states) for panel in panels for states in panel.states)
    time = time_colours(steps)
    for number, (axes, panel) in enumerate(zip(row, panels, strict=True), start=1):
        draw_grid(axes)
        if panel.states:
            _draw_trajectories(axes, np.asarray(panel.states), time)
        _draw_given(axes, panel, steps)
        axes.text(0.5, 1.16, f"({number}) {panel.name}", transform=axes.transAxes, ha="center", fontsize=NORMAL)
        axes.set_title(panel.question, fontsize=0.86 * SMALL, family=MONOSPACE, pad=4)
        axes.set_xlabel(_outcome(panel), fontsize=SMALL + 0.5)
    colorbar = figure.colorbar(time, ax=row, shrink=0.62, aspect=14, pad=0.01, ticks=range(0, steps, 3))
    colorbar.set_label("step", fontsize=SMALL)
    colorbar.ax.tick_params(labelsize=SMALL, length=2)
    figure.legend(
        handles=[*_grid_handles(), *_trajectory_handles()],
        loc="outside lower center",
        ncols=7,
        fontsize=SMALL,
        frameon=False,
        handletextpad=0.5,
        columnspacing=1.4,
    )
    return figure


def trajectories(
    groups: Mapping[str, np.ndarray], *, captions: Sequence[str] = (), cell: int | None = None, most: int = 12
) -> Figure:
    """Trajectories that answer different questions, a grid for each, with jitter (the paper's property figure).

    Args:
        groups: question, for people -> (N, T, 2) agent and key cells.
        captions: line below each grid.
        cell: cell to mark, of which the questions speak.
        most: number of trajectories of each group that are drawn, the first ones.
    """
    width = min(WIDTH, 2.7 * len(groups) + 0.9)
    figure = Figure(figsize=(width, 3.1), layout="constrained")
    row = figure.subplots(1, len(groups), squeeze=False)[0]
    steps = max(states.shape[1] for states in groups.values())
    time = time_colours(steps)
    for axes, (name, states) in zip(row, groups.items(), strict=True):
        draw_grid(axes)
        _draw_trajectories(axes, states[:most], time)
        if cell is not None:
            square(axes, *coordinates(cell), size=0.92, fill=False, edgecolor=PURPLE, linewidth=2.5, zorder=1.5)
        axes.set_title(name, fontsize=NORMAL, pad=4)
    for axes, caption in zip(row, captions, strict=False):
        axes.set_xlabel(caption, fontsize=SMALL + 0.5)
    colorbar = figure.colorbar(time, ax=row, shrink=0.7, aspect=16, pad=0.02, ticks=range(0, steps, 3))
    colorbar.set_label("step", fontsize=SMALL)
    colorbar.ax.tick_params(labelsize=SMALL, length=2)
    points = _trajectory_handles()[:-1]
    marked: list[Patch | Line2D] = (
        [] if cell is None else [Patch(fill=False, edgecolor=PURPLE, linewidth=2, label="the cell in question")]
    )
    columns = 7 if len(groups) > 2 else 3
    figure.legend(
        handles=[*_grid_handles(), *points, *marked],
        loc="outside lower center",
        ncols=columns,
        fontsize=SMALL,
        frameon=False,
    )
    return figure


def _draw_trajectories(axes: Axes, states: np.ndarray, time: ScalarMappable) -> None:
    """The agent's ways, (N, T, 2) agent and key cells, and where each one's key lay at first."""
    N, T, _ = states.shape
    rng = np.random.default_rng(0)  # always the same: part of the drawing
    jitter = rng.uniform(-0.1, 0.1, size=(N, T, 2))
    apart = np.stack([0.18 * (np.arange(N) - (N - 1) / 2)] * 2, axis=-1)  # (N, 2)
    if N > FEW:  # side by side they would leave their cells
        apart = rng.uniform(-0.26, 0.26, size=(N, 2))
    points = np.stack(coordinates(states[..., 0]), axis=-1) + apart[:, None] + jitter  # (N, T, 2)
    for way in points:
        _draw_way(axes, way, time.to_rgba(np.arange(T)))
    key_x, key_y = coordinates(np.unique(states[:, 0, 1]))
    style: dict[str, Any] = {"color": ORANGE, "edgecolors": BLACK, "linewidths": 0.4}
    axes.scatter(key_x + 0.25, key_y - 0.32, marker=KEY, s=130, zorder=5, **style)


def _draw_way(axes: Axes, points: np.ndarray, colours: np.ndarray) -> None:
    """One trajectory through (T, 2) points, with an arrow wherever the agent moved."""
    segments = np.stack([points[:-1], points[1:]], axis=1)  # (T - 1, 2, 2)
    axes.add_collection(LineCollection(list(segments), colors=colours[:-1], linewidths=1.5, zorder=2))
    for (start, end), colour in zip(segments, colours[:-1], strict=True):
        move = end - start
        if np.hypot(*move) > 0.5:
            style: dict[str, Any] = {
                "arrowstyle": "-|>",
                "color": colour,
                "linewidth": 0,
                "mutation_scale": 9,
                "shrinkB": 0,
            }
            axes.annotate("", start + 0.66 * move, start + 0.2 * move, arrowprops=style, zorder=3)
    axes.scatter(points[1:-1, 0], points[1:-1, 1], c=colours[1:-1], s=7, zorder=3)
    axes.scatter(
        points[0, 0], points[0, 1], marker="o", s=42, color=colours[0], edgecolors="white", linewidths=0.8, zorder=4
    )
    axes.scatter(
        points[-1, 0], points[-1, 1], marker="s", s=38, color=colours[-1], edgecolors=BLACK, linewidths=0.8, zorder=4
    )


def _draw_given(axes: Axes, panel: Panel, steps: int) -> None:
    """A frame around the agent's cell of each state that was given in advance."""
    for token, (_, state) in given_states(panel.given, steps).items():
        x, y = coordinates(state[0])
        square(axes, x, y, fill=False, edgecolor=PURPLE, linewidth=2, linestyle=(0, (2.2, 1)), zorder=1.5)
        axes.text(x - 0.42, y + 0.4, token, fontsize=SMALL - 1, family=MONOSPACE, zorder=6)


def _outcome(panel: Panel) -> str:
    """What came of a panel's question, in a line; and how often drawn actions do what it asks, in another."""
    reached = {name: all(values) for name, values in panel.achieved.items() if name.endswith(" reached")}
    words = [name if met else f"{name.removesuffix(' reached')} missed" for name, met in reached.items()]
    if "return" in panel.achieved:
        asked = [f"asked for {value:g}" for token, value in panel.given.items() if token.startswith("rtg")]
        words.append(f"returned {np.mean(panel.achieved['return']):g}")
        words = asked + words
        if not panel.given:
            words.append("goal reached" if all(panel.achieved["success"]) else "goal missed")
    if "possible histories" in panel.achieved:
        found = panel.achieved["possible histories"]
        words.append(f"{found} possible histories" if found else "no possible history found")
    drawn = [] if panel.share is None else [f"{panel.share:.0%} of drawn rollouts"]
    return "\n".join([", ".join(words), *drawn])


def _grid_handles() -> list[Patch | Line2D]:
    return [
        Patch(facecolor=WALL, label="wall"),
        Patch(facecolor="#F9D9C7", edgecolor=VERMILLION, label="door, locked"),
        Patch(facecolor="#8CD0BC", label="goal"),
    ]


def _trajectory_handles() -> list[Patch | Line2D]:
    point: dict[str, Any] = {"linestyle": "none", "markersize": 6}
    return [
        _key_handle("key at the start"),
        Line2D([], [], marker="o", color=TIME(0.0), label="first state", **point),
        Line2D([], [], marker="s", color=TIME(1.0), markeredgecolor=BLACK, label="last state", **point),
        Patch(fill=False, edgecolor=PURPLE, linestyle="--", linewidth=1.5, label="state given in advance"),
    ]


def _key_handle(label: str) -> Line2D:
    style: dict[str, Any] = {"color": ORANGE, "markeredgecolor": BLACK, "markeredgewidth": 0.4, "markersize": 11}
    return Line2D([], [], marker=KEY, linestyle="none", label=label, **style)


def state_distributions(answer: Answer) -> Figure:
    """DoorKey's predicted states, one grid per step (the paper's figure of predicted state distributions).

    The agent's cell is a heat map, the key's a key in the corner of each cell where it may lie, the more solid the
    likelier. Shown states have a frame.

    Args:
        answer: one to a question about `s`, with probabilities for every step, as `predicted_states` gives.

    Raises:
        ValueError: the answer says nothing about some steps.
    """
    parts = (part for part in answer["s"] if isinstance(part, DiscreteDistribution))
    agent, key = (part.probabilities[0].numpy(force=True) for part in parts)  # (K, 16) each
    shown = answer.mask.shown["s"][0].tolist()
    silent = np.flatnonzero(np.isnan(agent).any(axis=1)).tolist()
    if silent:
        neither = ", ".join(f"s[{at}]" for at in silent)
        raise ValueError(f"The picture needs every state shown or asked for; the answer has neither for {neither}.")
    columns = -(-len(agent) // 2)
    figure = Figure(figsize=(WIDTH, 4.12), layout="constrained")
    grids = figure.subplots(2, columns, squeeze=False).flat
    probability = ScalarMappable(Normalize(0, 1), "Blues")
    for at, axes in enumerate(grids):
        if at >= len(agent):
            axes.set_axis_off()
            continue
        draw_grid(axes)
        _draw_probabilities(axes, agent[at], key[at], probability)
        axes.set_title(f"s[{at}]  shown" if shown[at] else f"s[{at}]", fontsize=NORMAL, family=MONOSPACE, pad=4)
        if shown[at]:
            axes.title.set(color=PURPLE, fontweight="bold")
            axes.spines[:].set(color=PURPLE, linewidth=3)
    colorbar = figure.colorbar(probability, ax=figure.axes, shrink=0.7, aspect=22, pad=0.01)
    colorbar.set_label("probability of the agent's cell", fontsize=SMALL + 0.5)
    colorbar.ax.tick_params(labelsize=SMALL, length=2)
    handles = [*_grid_handles(), _key_handle("key: the more solid, the likelier"), shown_handle()]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=SMALL, frameon=False)
    return figure


def _draw_probabilities(axes: Axes, agent: np.ndarray, key: np.ndarray, probability: ScalarMappable) -> None:
    """One step's distributions of the agent's cell and of the key's, (16,) each; below 1 % nothing is drawn."""
    for cell in CELLS:
        x, y = coordinates(cell)
        if agent[cell] >= LEAST:
            square(axes, x, y, size=0.86, facecolor=probability.to_rgba(agent[cell]), zorder=1)
            colour = "white" if agent[cell] > 0.55 else BLACK
            axes.text(
                x, y + 0.2, f"{agent[cell]:.2f}", fontsize=SMALL, ha="center", va="center", color=colour, zorder=3
            )
        if key[cell] >= LEAST:
            style: dict[str, Any] = {"color": ORANGE, "edgecolors": BLACK, "linewidths": 0.4, "alpha": float(key[cell])}
            axes.scatter(x, y - 0.25, marker=KEY, s=120, zorder=2, **style)
