"""Masks and answers of any model: which tokens are shown and asked for, and what is said about them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from lerobot_unimask.asking.answers import Answer, ContinuousDistribution, DiscreteDistribution, Distribution
from lerobot_unimask.data.factors import Factor
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import ASKABLE, Mask
from lerobot_unimask.plots.style import (
    ASKED,
    BLACK,
    BLUE,
    COLOURS,
    FAINT,
    HIDDEN,
    MONOSPACE,
    NORMAL,
    PURPLE,
    SHOWN,
    SMALL,
    VERMILLION,
    WIDTH,
    shown_handle,
)


def mask_diagram(mask: Mask) -> Figure:
    """The first window's mask: a row for each factor, a column for each step; shown, asked for, or neither."""
    names = list(mask.shown)
    shown = np.stack([mask.shown[name][0].numpy(force=True) for name in names])  # (F, K)
    asked = np.stack([mask.asked[name][0].numpy(force=True) for name in names])
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


def marginals(answer: Answer, truth: Window | None = None) -> Figure:
    """What a model of any factors says about each component at each step of the first window: probabilities, or means
    and scales; about the return and a property the one distribution, as bars or as a density.

    Args:
        answer: one to any question.
        truth: recorded windows, to draw over it.
    """
    rows = [(name, distribution) for name in answer.distributions for distribution in answer[name]]
    rows = [(name, d) for name, d in rows if answer.mask.asked[name][0].any()]
    rows.sort(key=lambda row: row[0] not in ASKABLE)  # properties, which have no steps, below
    heights = [0.5 + 0.13 * min(d.component.categories or 12, 20) if name in ASKABLE else 1.5 for name, d in rows]
    figure = Figure(figsize=(WIDTH, 0.9 + sum(heights)), layout="constrained")
    grid = figure.subplots(len(rows), 1, squeeze=False, height_ratios=heights)[:, 0]
    K = answer.mask.shown["s"].shape[1]
    maps = [axes for axes, (name, d) in zip(grid, rows, strict=True) if name in ASKABLE]
    for axes, (name, distribution) in zip(grid, rows, strict=True):
        recorded = None
        if truth is not None:
            recorded = truth.values[name][0, :, distribution.component.dims].numpy(force=True)  # (K, d)
            recorded = np.where(truth.valid[0].numpy(force=True)[:, None], recorded, np.nan)
        shown = answer.mask.shown[name][0].numpy(force=True)  # (K,)
        axes.set_ylabel(f"{name}: {distribution.name}", fontsize=SMALL + 1)
        axes.tick_params(labelsize=SMALL)
        if name not in ASKABLE:
            _draw_property(axes, distribution, None if recorded is None else recorded[0, 0])
            continue
        axes.set(xlim=(-0.5, K - 0.5), xticks=range(0, K, max(1, K // 20)))
        axes.tick_params(labelbottom=axes is maps[-1])
        if isinstance(distribution, DiscreteDistribution):
            _draw_heat_map(axes, distribution, recorded, shown)
        else:
            _draw_bands(axes, distribution, recorded, shown)
    if maps:
        maps[-1].set_xlabel("step")
    if any(isinstance(d, DiscreteDistribution) and name in ASKABLE for name, d in rows):
        probability = ScalarMappable(Normalize(0, 1), "Blues")
        colorbar = figure.colorbar(probability, ax=maps, shrink=0.8, aspect=25, pad=0.01)
        colorbar.set_label("probability", fontsize=SMALL + 1)
        colorbar.ax.tick_params(labelsize=SMALL, length=2)
    point: dict[str, Any] = {"marker": "x", "linestyle": "none", "markersize": 5, "color": VERMILLION}
    handles = [shown_handle()] + [Line2D([], [], label="recorded", **point)] * (truth is not None)
    figure.legend(handles=handles, loc="outside upper center", ncols=2, fontsize=SMALL + 1, frameon=False)
    return figure


def _draw_property(axes: Axes, distribution: Distribution, recorded: float | None) -> None:
    """The distribution of its token: a bar for each category, or the density, of an L2 head its mean alone."""
    here = distribution.at(torch.tensor([0]), 0)
    if isinstance(here, DiscreteDistribution):
        probabilities = here.probabilities[0, 0].numpy(force=True)
        labels = here.component.labels or range(len(probabilities))
        axes.bar(range(len(probabilities)), probabilities, 0.8, color=BLUE)
        axes.set(ylim=(0, 1), xticks=range(len(probabilities)))
        axes.set_xticklabels([str(label) for label in labels])
    elif here.scales is None:
        axes.axvline(here.mean.item(), color=BLUE)
        axes.set_yticks([])
    else:
        reach = 4 * here.scales[0, 0, :, 0]
        ends = torch.cat([here.means[0, 0, :, 0] - reach, here.means[0, 0, :, 0] + reach])
        places = torch.linspace(ends.min().item(), ends.max().item(), 401)
        below = here.cumulative(places.to(ends.device).view(1, 1, -1))[0, 0].numpy(force=True)  # a spike keeps its mass
        axes.stairs(np.diff(below), places.numpy(), fill=True, color=BLUE)
        axes.set_yticks([])
    if recorded is not None and not np.isnan(recorded):
        axes.axvline(recorded, color=VERMILLION, linestyle="--", linewidth=1.2)


def _draw_heat_map(
    axes: Axes, distribution: DiscreteDistribution, recorded: np.ndarray | None, shown: np.ndarray
) -> None:
    """Categories upwards, steps to the right; what is neither shown nor asked stays grey."""
    probabilities = distribution.probabilities[0].numpy(force=True)  # (K, categories)
    axes.set_facecolor(HIDDEN["facecolor"])
    axes.imshow(probabilities.T, cmap="Blues", vmin=0, vmax=1, aspect="auto", origin="lower")
    for step in np.flatnonzero(shown):
        at = int(probabilities[step].argmax())
        axes.add_patch(Rectangle((step - 0.5, at - 0.5), 1, 1, fill=False, edgecolor=PURPLE, linewidth=1.6))
    if recorded is not None:
        asked = ~shown & ~np.isnan(probabilities).any(axis=1)
        axes.scatter(np.flatnonzero(asked), recorded[asked, 0], marker="x", s=20, color=VERMILLION, linewidths=1.2)
    axes.set_yticks(range(0, probabilities.shape[1], max(1, probabilities.shape[1] // 8)))


def _draw_bands(
    axes: Axes, distribution: ContinuousDistribution, recorded: np.ndarray | None, shown: np.ndarray
) -> None:
    """A line for each dimension, with a band of one scale to each side, in the dataset's units."""
    mean = distribution.mean[0].numpy(force=True)  # (K, d)
    steps = np.arange(len(mean))
    for i, colour in zip(range(mean.shape[1]), COLOURS * mean.shape[1], strict=False):
        axes.plot(steps, mean[:, i], marker=".", color=colour, linewidth=1.2, label=distribution.component.names[i])
        if distribution.scale is not None:
            scale = distribution.scale[0, :, i].numpy(force=True)
            axes.fill_between(steps, mean[:, i] - scale, mean[:, i] + scale, color=colour, alpha=0.2, linewidth=0)
        axes.scatter(steps[shown], mean[shown, i], s=45, facecolors="none", edgecolors=PURPLE, linewidths=1.6, zorder=3)
        if recorded is not None:
            axes.scatter(steps[~shown], recorded[~shown, i], marker="x", s=18, color=VERMILLION, zorder=3)
    axes.grid(color=FAINT)
    if mean.shape[1] > 1:
        axes.legend(fontsize=SMALL, ncols=2, loc="best")


def distributions(groups: Mapping[str, Window], factors: Mapping[str, Factor]) -> Figure:
    """How often each state, action and property occurs, over all windows and steps: recorded ones beside sampled ones,
    say.

    Args:
        groups: name of a group, for people -> its windows, in the dataset's units. What is NaN or not valid is left
            out.
        factors: factors of the model.

    Raises:
        ValueError: there is nothing that all groups have.
    """
    parts = []  # of each number: its label, component, and each group's values
    for name in factors:
        for component in factors[name].components:
            if component.computed or not all(name in window.values for window in groups.values()):
                continue
            for i in range(component.dims.start, component.dims.stop):
                column = {group: window.values[name][..., i][window.valid] for group, window in groups.items()}
                values = {group: v[~v.isnan()].numpy(force=True) for group, v in column.items()}
                if all(map(len, values.values())):
                    label = component.names[i - component.dims.start]
                    parts.append((f"{name}: {label}", component, values))
    if not parts:
        raise ValueError("There is no token that all of the windows have: nothing to draw.")
    columns = min(3, len(parts))
    figure = Figure(figsize=(WIDTH, 0.5 + 2.3 * -(-len(parts) // columns)), layout="constrained")
    grid = figure.subplots(-(-len(parts) // columns), columns, squeeze=False).flat
    for axes, (label, component, values) in zip(grid, parts, strict=False):
        low, high = min(v.min() for v in values.values()), max(v.max() for v in values.values())
        for n, ((group, numbers), colour) in enumerate(zip(values.items(), (BLUE, VERMILLION, BLACK), strict=False)):
            if component.categories is not None:
                share = np.bincount(numbers.astype(int), minlength=component.categories) / len(numbers)
                thickness = 0.8 / len(values)
                offset = (n - (len(values) - 1) / 2) * thickness
                axes.bar(np.arange(component.categories) + offset, share, thickness, color=colour, label=group)
            else:
                weights = np.full(len(numbers), 1 / len(numbers))
                style: dict[str, Any] = {"histtype": "step", "linewidth": 1.4, "color": colour, "label": group}
                axes.hist(numbers, np.linspace(low, high, 40), weights=weights, **style)
        axes.set_xlabel(label, fontsize=SMALL + 1)
        axes.set_ylabel("share", fontsize=SMALL + 1)
        axes.tick_params(labelsize=SMALL)
        if component.categories is not None:
            axes.set_xticks(range(0, component.categories, max(1, component.categories // 8)))
    for axes in list(figure.axes)[len(parts) :]:
        axes.set_axis_off()
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(groups), fontsize=NORMAL - 1, frameon=False)
    return figure
