"""The pictures that a question shows, small, above the picture of its answer."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from lerobot_unimask.plots.style import SMALL

HEIGHT = 0.9  # inches of a row
MOST = 12  # pictures; of more, evenly spread ones are drawn


def add_thumbnails(figure: Figure, pictures: Mapping[str, np.ndarray]) -> None:
    """Make room at a figure's top and draw the pictures there, (height, width, colours) by token, in their order."""
    if not pictures:
        return
    tokens = list(pictures)
    tokens = [tokens[i] for i in np.linspace(0, len(tokens) - 1, min(MOST, len(tokens))).round().astype(int)]
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + HEIGHT)
    share = HEIGHT / (height + HEIGHT)
    layout = figure.get_layout_engine()
    if isinstance(layout, ConstrainedLayoutEngine):
        layout.set(rect=(0, 0, 1, 1 - share))
    each = 1 / max(len(tokens), 6)
    for i, token in enumerate(tokens):
        axes = figure.add_axes((i * each + 0.005, 1 - 0.98 * share, each - 0.01, 0.75 * share))
        axes.imshow(pictures[token].squeeze(), cmap="gray")
        axes.set_title(token, fontsize=SMALL, pad=2)
        axes.set_axis_off()
