"""Pictures of answers: each function makes one matplotlib Figure, without pyplot, so no display or backend is needed.

Colours are those of Okabe and Ito (2008), which colour-blind readers can tell apart; time runs along viridis. Figures
are 9 inches wide: saved with `figure.savefig(path, dpi=200)` they read well at 900 pixels.
"""

from lerobot_unimask.plots.answers import distributions, marginals, mask_diagram
from lerobot_unimask.plots.curves import cost_of_context, cost_of_growth, learning_curves
from lerobot_unimask.plots.grid import draw_grid, five_panels, state_distributions, trajectories
from lerobot_unimask.plots.heatmaps import Panel, heatmaps
from lerobot_unimask.plots.maze import draw_maze, maze_trajectories
from lerobot_unimask.plots.style import ASKED, LEAST, SHOWN, WALL, WIDTH

__all__ = [
    "ASKED",
    "LEAST",
    "SHOWN",
    "WALL",
    "WIDTH",
    "Panel",
    "cost_of_context",
    "cost_of_growth",
    "distributions",
    "draw_grid",
    "draw_maze",
    "five_panels",
    "heatmaps",
    "learning_curves",
    "marginals",
    "mask_diagram",
    "maze_trajectories",
    "state_distributions",
    "trajectories",
]
