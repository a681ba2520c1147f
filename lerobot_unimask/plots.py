"""Pictures of answers: each function makes one matplotlib Figure, without pyplot, so no display or backend is needed.

Colours are those of Okabe and Ito (2008), which colour-blind readers can tell apart; time runs along viridis. Figures
are 9 inches wide: saved with `figure.savefig(path, dpi=200)` they read well at 900 pixels.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.path import Path

from lerobot_unimask.envs.doorkey import CELLS, DOOR, GOAL, coordinates
from lerobot_unimask.experiments.gridworld import Panel, given_states
from lerobot_unimask.inference import Answer
from lerobot_unimask.masks import Mask

# From Okabe and Ito's palette
BLACK, ORANGE, GREEN = "#000000", "#E69F00", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
WALL, FAINT = "#4D4D4D", "#E6E6E6"

WIDTH = 9.0  # inches
SMALL, NORMAL = 7.0, 9.0  # points
MONOSPACE = "DejaVu Sans Mono"  # comes with matplotlib

# viridis without its palest end, which white paper swallows
TIME = LinearSegmentedColormap.from_list("time", matplotlib.colormaps["viridis"](np.linspace(0.0, 0.88, 256)))
LEAST = 0.01  # probabilities below this are not drawn

# How a token of a mask is drawn
SHOWN = {"facecolor": BLUE, "edgecolor": BLUE, "linewidth": 1.2}
ASKED = {"facecolor": "#FBE9DD", "edgecolor": VERMILLION, "linewidth": 1.2}
HIDDEN = {"facecolor": "#F2F2F2", "edgecolor": "#CFCFCF", "linewidth": 0.6}


# --- The grid ---------------------------------------------------------------------------------------------------------


def draw_grid(axes: Axes) -> None:
    """DoorKey's rooms, seen from above: walls, the locked door, the goal, and the cells' numbers along both sides."""
    x, y = coordinates(CELLS)
    wall = (x == coordinates(DOOR)[0]) & (CELLS != DOOR)
    for cell_x, cell_y, solid in zip(x, y, wall, strict=True):
        _square(axes, cell_x, cell_y, facecolor=WALL if solid else "white", edgecolor=FAINT, linewidth=0.6, zorder=0)
    _square(axes, *coordinates(GOAL), facecolor=GREEN, alpha=0.45, linewidth=0, zorder=0.2)
    door_x, door_y = coordinates(DOOR)
    _square(axes, door_x, door_y, facecolor=VERMILLION, alpha=0.18, linewidth=0, zorder=0.2)
    axes.plot([door_x - 0.46] * 2, [door_y - 0.46, door_y + 0.46], color=VERMILLION, linewidth=3, zorder=0.4)
    axes.set(xlim=(0.5, x.max() + 0.5), ylim=(y.max() + 0.5, 0.5), aspect="equal")
    axes.set_xticks(np.unique(x))
    axes.set_yticks(np.unique(y))
    axes.tick_params(length=0, labelsize=SMALL, colors=WALL, pad=2)
    axes.spines[:].set(color=WALL, linewidth=2.5)


def _square(axes: Axes, x: float, y: float, size: float = 1.0, **style) -> None:
    axes.add_patch(Rectangle((x - size / 2, y - size / 2), size, size, **style))


def _key_marker() -> Path:
    """A key: ring, shaft and two teeth."""
    turn = np.linspace(0, 2 * np.pi, 25)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    corners = [(-0.2, 0.16), (1.9, 0.16), (1.9, -0.6), (1.55, -0.6), (1.55, -0.16)]
    corners += [(1.2, -0.16), (1.2, -0.5), (0.85, -0.5), (0.85, -0.16), (-0.2, -0.16), (-0.2, 0.16)]
    parts = [0.75 * circle - (0.95, 0), 0.36 * circle[::-1] - (0.95, 0), np.array(corners[::-1])]
    return Path.make_compound_path(*(Path(part, closed=True) for part in parts))


KEY = _key_marker()


# --- Trajectories -----------------------------------------------------------------------------------------------------


def five_panels(panels: Sequence[Panel]) -> Figure:
    """Trajectories that answer one question each, side by side (the paper's gridworld figure).

    Under each panel's name stands its question, below the grid what came of it. Colour and arrows show time; the
    jitter only keeps trajectories apart that share cells. Drawn are the window's states: a rollout's last action, after
    s[K-1], counts in its return alone.
    """
    figure = Figure(figsize=(WIDTH, 2.72), layout="constrained")
    row = figure.subplots(1, len(panels), squeeze=False)[0]
    steps = max(len(states) for panel in panels for states in panel.states)
    time = _time(steps)
    for number, (axes, panel) in enumerate(zip(row, panels, strict=True), start=1):
        draw_grid(axes)
        _draw_trajectories(axes, np.asarray(panel.states), time)
        _draw_given(axes, panel)
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


def _time(steps: int) -> ScalarMappable:
    """The colours of steps 0 to steps - 1."""
    return ScalarMappable(Normalize(0, steps - 1), TIME)


def _draw_trajectories(axes: Axes, states: np.ndarray, time: ScalarMappable) -> None:
    """The agent's ways, (N, T, 2) agent and key cells, and where each one's key lay at first."""
    N, T, _ = states.shape
    jitter = np.random.default_rng(0).uniform(-0.1, 0.1, size=(N, T, 2))  # always the same: part of the drawing
    apart = 0.18 * (np.arange(N) - (N - 1) / 2)  # (N,)
    points = np.stack(coordinates(states[..., 0]), axis=-1) + apart[:, None, None] + jitter  # (N, T, 2)
    for way in points:
        _draw_way(axes, way, time.to_rgba(np.arange(T)))
    key_x, key_y = coordinates(np.unique(states[:, 0, 1]))
    style = {"color": ORANGE, "edgecolors": BLACK, "linewidths": 0.4}
    axes.scatter(key_x + 0.25, key_y - 0.32, marker=KEY, s=130, zorder=5, **style)


def _draw_way(axes: Axes, points: np.ndarray, colours: np.ndarray) -> None:
    """One trajectory through (T, 2) points, with an arrow wherever the agent moved."""
    segments = np.stack([points[:-1], points[1:]], axis=1)  # (T - 1, 2, 2)
    axes.add_collection(LineCollection(segments, colors=colours[:-1], linewidths=1.5, zorder=2))
    for (start, end), colour in zip(segments, colours[:-1], strict=True):
        move = end - start
        if np.hypot(*move) > 0.5:
            style = {"arrowstyle": "-|>", "color": colour, "linewidth": 0, "mutation_scale": 9, "shrinkB": 0}
            axes.annotate("", start + 0.66 * move, start + 0.2 * move, arrowprops=style, zorder=3)
    axes.scatter(*points[1:-1].T, c=colours[1:-1], s=7, zorder=3)
    axes.scatter(*points[0], marker="o", s=42, color=colours[0], edgecolors="white", linewidths=0.8, zorder=4)
    axes.scatter(*points[-1], marker="s", s=38, color=colours[-1], edgecolors=BLACK, linewidths=0.8, zorder=4)


def _draw_given(axes: Axes, panel: Panel) -> None:
    """A frame around the agent's cell of each state that was given in advance."""
    for token, (_, state) in given_states(panel.given, len(panel.states[0])).items():
        x, y = coordinates(state[0])
        _square(axes, x, y, fill=False, edgecolor=PURPLE, linewidth=2, linestyle=(0, (2.2, 1)), zorder=1.5)
        axes.text(x - 0.42, y + 0.4, token, fontsize=SMALL - 1, family=MONOSPACE, zorder=6)


def _outcome(panel: Panel) -> str:
    """What came of a panel's question, in a line."""
    reached = {name: all(values) for name, values in panel.achieved.items() if name.endswith(" reached")}
    words = [name if met else f"{name.removesuffix(' reached')} missed" for name, met in reached.items()]
    if "return" in panel.achieved:
        asked = [f"asked for {value:g}" for token, value in panel.given.items() if token.startswith("rtg")]
        words.append(f"returned {np.mean(panel.achieved['return']):g}")
        words = asked + words
        if not panel.given:
            words.append("goal reached" if all(panel.achieved["success"]) else "goal missed")
    if "possible" in panel.achieved:
        words.append(f"{panel.achieved['possible']} of {panel.achieved['samples']} samples possible")
    return ", ".join(words)


def _grid_handles() -> list[Patch | Line2D]:
    return [
        Patch(facecolor=WALL, label="wall"),
        Patch(facecolor="#F9D9C7", edgecolor=VERMILLION, label="door, locked"),
        Patch(facecolor="#8CD0BC", label="goal"),
    ]


def _trajectory_handles() -> list[Patch | Line2D]:
    point = {"linestyle": "none", "markersize": 6}
    return [
        _key_handle("key at the start"),
        Line2D([], [], marker="o", color=TIME(0.0), label="first state", **point),
        Line2D([], [], marker="s", color=TIME(1.0), markeredgecolor=BLACK, label="last state", **point),
        Patch(fill=False, edgecolor=PURPLE, linestyle="--", linewidth=1.5, label="state given in advance"),
    ]


def _key_handle(label: str) -> Line2D:
    style = {"color": ORANGE, "markeredgecolor": BLACK, "markeredgewidth": 0.4, "markersize": 11}
    return Line2D([], [], marker=KEY, linestyle="none", label=label, **style)


# --- Distributions ----------------------------------------------------------------------------------------------------


def state_distributions(answer: Answer, *, window: int = 0) -> Figure:
    """DoorKey's predicted states, one grid per step (the paper's figure of predicted state distributions).

    The agent's cell is a heat map, the key's a key in the corner of each cell where it may lie, the more solid the
    likelier. Shown states have a frame.

    Args:
        answer: To a question about `s`, with probabilities for every step, as `experiments.gridworld.predicted_states`
            gives.
        window: Which of the answer's windows.

    Raises:
        ValueError: The answer says nothing about some steps.
    """
    agent, key = (distribution.probabilities[window].numpy(force=True) for distribution in answer["s"])  # (K, 16) each
    shown = answer.mask.visible["s"][window].tolist()
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
    handles = [*_grid_handles(), _key_handle("key: the more solid, the likelier"), _shown_handle()]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=SMALL, frameon=False)
    return figure


def _draw_probabilities(axes: Axes, agent: np.ndarray, key: np.ndarray, probability: ScalarMappable) -> None:
    """One step's distributions of the agent's cell and of the key's, (16,) each; below 1 % nothing is drawn."""
    for cell in CELLS:
        x, y = coordinates(cell)
        if agent[cell] >= LEAST:
            _square(axes, x, y, size=0.86, facecolor=probability.to_rgba(agent[cell]), zorder=1)
            colour = "white" if agent[cell] > 0.55 else BLACK
            axes.text(
                x, y + 0.2, f"{agent[cell]:.2f}", fontsize=SMALL, ha="center", va="center", color=colour, zorder=3
            )
        if key[cell] >= LEAST:
            style = {"color": ORANGE, "edgecolors": BLACK, "linewidths": 0.4, "alpha": float(key[cell])}
            axes.scatter(x, y - 0.25, marker=KEY, s=120, zorder=2, **style)


def _shown_handle() -> Patch:
    return Patch(fill=False, edgecolor=PURPLE, linewidth=2, label="shown")


# --- Masks ------------------------------------------------------------------------------------------------------------


def mask_diagram(mask: Mask, *, window: int = 0) -> Figure:
    """One window's mask: a row for each factor, a column for each step; shown, asked for, or neither.

    Args:
        mask: Of any questions and factors.
        window: Which of the mask's windows.
    """
    names = list(mask.visible)
    shown = np.stack([mask.visible[name][window].numpy(force=True) for name in names])  # (F, K)
    asked = np.stack([mask.predict[name][window].numpy(force=True) for name in names])
    F, K = shown.shape
    figure = Figure(figsize=(min(WIDTH, 1.5 + 0.42 * K), 0.9 + 0.42 * F), layout="constrained")
    axes = figure.subplots()
    for row, step in np.ndindex(F, K):
        mark, style = ("", HIDDEN)
        if shown[row, step]:
            mark, style = "", SHOWN
        elif asked[row, step]:
            mark, style = "?", ASKED
        axes.add_patch(Rectangle((step - 0.42, row - 0.42), 0.84, 0.84, **style))
        axes.text(step, row, mark, ha="center", va="center", fontsize=NORMAL, color=VERMILLION, fontweight="bold")
    axes.set(xlim=(-0.5, K - 0.5), ylim=(F - 0.5, -0.5), aspect="equal", xlabel="step")
    axes.set_yticks(range(F), names, family=MONOSPACE)
    axes.set_xticks(range(0, K, max(1, K // 20)))
    axes.tick_params(length=0, labelsize=NORMAL - 1)
    axes.spines[:].set_visible(False)
    handles = [
        Patch(label="shown", **SHOWN),
        Patch(label="asked for", **ASKED),
        Patch(label="neither", **HIDDEN),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3, fontsize=NORMAL - 1, frameon=False)
    return figure


# --- Experiments ------------------------------------------------------------------------------------------------------


def learning_curves(record: Mapping[str, Any]) -> Figure:
    """Mean return against updates, one line for each run, with bars of one standard error.

    Args:
        record: As `experiments.learning_curve` makes it.
    """
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    axes = figure.subplots()
    for run, colour, marker in zip(
        record["runs"], (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, BLACK), "os^Dvx", strict=False
    ):
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
