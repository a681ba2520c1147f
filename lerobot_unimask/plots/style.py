"""What all pictures share: colours, sizes, and how a token of a mask is drawn."""

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.patches import Patch, Rectangle

# From Okabe and Ito's palette
BLACK, ORANGE, GREEN = "#000000", "#E69F00", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, BLACK)  # of lines and bars, in this order
WALL, FAINT = "#4D4D4D", "#E6E6E6"

WIDTH = 9.0  # inches
SMALL, NORMAL = 7.0, 9.0  # points
MONOSPACE = "DejaVu Sans Mono"  # comes with matplotlib

# viridis without its palest end, which white paper swallows
TIME = LinearSegmentedColormap.from_list("time", matplotlib.colormaps["viridis"](np.linspace(0.0, 0.88, 256)))
LEAST = 0.01  # probabilities below this are not drawn

# How a token of a mask is drawn
SHOWN: dict[str, Any] = {"facecolor": BLUE, "edgecolor": BLUE, "linewidth": 1.2}
ASKED: dict[str, Any] = {"facecolor": "#FBE9DD", "edgecolor": VERMILLION, "linewidth": 1.2}
HIDDEN: dict[str, Any] = {"facecolor": "#F2F2F2", "edgecolor": "#CFCFCF", "linewidth": 0.6}


def time_colours(steps: int) -> ScalarMappable:
    """The colours of steps 0 to steps - 1."""
    return ScalarMappable(Normalize(0, steps - 1), TIME)


def square(axes: Axes, x: float, y: float, size: float = 1.0, **style) -> None:
    axes.add_patch(Rectangle((x - size / 2, y - size / 2), size, size, **style))


def shown_handle() -> Patch:
    return Patch(fill=False, edgecolor=PURPLE, linewidth=2, label="shown")
