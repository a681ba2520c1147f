"""Numbers by row and column, as colours.

Legend of shapes: R rows, C columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure
from torch import Tensor

from lerobot_unimask.plots.style import FAINT, SMALL, WIDTH


@dataclass
class Panel:
    """One heatmap."""

    title: str
    numbers: Tensor
    """(R, C), what is written in the cells; NaN: nothing."""
    colours: Tensor | None = None
    """(R, C), what colours them, from 1 to 2; None: the numbers."""
    signed: bool = False
    """Whether they are coloured from -1 to 1 instead, and written with their signs."""


def heatmaps(panels: Sequence[Panel], rows: Sequence[str], columns: Sequence[str]) -> Figure:
    """Heatmaps side by side, with the same rows, of which the last one is set apart, and the same columns."""
    figure = Figure(figsize=(WIDTH, 1.2 + 0.2 * len(rows)), layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(panels), sharey=True, squeeze=False)[0], panels, strict=True):
        colours = panel.numbers if panel.colours is None else panel.colours
        scale = {"vmin": -1, "vmax": 1, "cmap": "RdBu_r"} if panel.signed else {"vmin": 1, "vmax": 2, "cmap": "Blues"}
        image = axes.imshow(colours.numpy(), aspect="auto", **scale)
        for row, column in panel.numbers.isfinite().nonzero().tolist():
            *rgb, _ = image.to_rgba(colours[row, column].item())
            text = f"{panel.numbers[row, column].item():{'+.2f' if panel.signed else '#.3g'}}"
            colour = "white" if sum(rgb) < 1.5 else "black"
            axes.text(column, row, text, ha="center", va="center", color=colour, fontsize=SMALL - 1)
        axes.set_facecolor(FAINT)  # where there is no number
        axes.axhline(len(rows) - 1.5, color="white", linewidth=3)
        axes.set_xticks(range(len(columns)), columns, rotation=40, ha="right")
        axes.set_yticks(range(len(rows)), rows)
        axes.tick_params(labelsize=SMALL, length=0)
        axes.spines[:].set_visible(False)
        axes.set_title(panel.title, fontsize=SMALL)
    figure.axes[0].set_ylabel("trained on", fontsize=SMALL)
    figure.supxlabel("evaluated on", fontsize=SMALL)
    return figure
