"""Maze2D's record, for the rest of the package."""

import numpy as np
from lerobot.utils.constants import ACTION, OBS_STATE
from matplotlib.figure import Figure

from lerobot_unimask.asking.answers import Answer
from lerobot_unimask.asking.sampling import Samples
from lerobot_unimask.data.window import Window
from lerobot_unimask.envs.maze2d.maze import ENV_ID, HORIZON
from lerobot_unimask.envs.maze2d.pictures import draw_ways, maze_trajectories
from lerobot_unimask.envs.record import Environment, Provenance
from lerobot_unimask.language.masks import ASKABLE, Mask


def _draw_answer(
    question: str, answer: Answer | Samples, mask: Mask, recorded: Window | None, provenance: Provenance
) -> Figure | None:
    """Where the mass is over the maze, if states are asked, and no return or property is, and there is one maze."""
    beside = any(asked.any() for name, asked in mask.asked.items() if name not in ASKABLE)
    mazes = mazes_of(provenance)
    if isinstance(answer, Samples) or beside or not mask.asked["s"].any() or len(mazes) > 1:
        return None
    return maze_trajectories(answer, recorded, maze=mazes[0])


def _draw_episodes(states: np.ndarray, provenance: Provenance) -> Figure:
    mazes = mazes_of(provenance)
    return draw_ways(states[:: len(mazes)], mazes[0])


def mazes_of(provenance: Provenance) -> list[str]:
    """The mazes, names or texts, that a dataset was built in, an episode of each in turn."""
    return provenance.get("maze", "medium").split(",")


MAZE2D = Environment(
    type="maze2d",
    env_id=ENV_ID,
    state_names=("x", "y", "goal_x", "goal_y"),
    horizon=HORIZON,
    description="Maze2D, a point mass in a maze on MuJoCo, its velocity hidden. Every episode has 200 steps.",
    expert="a waypoint controller with normal noise on its actions",
    reward="by how much the distance to the goal shrank, in cells",
    columns={
        OBS_STATE: "the position and the goal's, x and y each, in cells",
        ACTION: "the force along x and y, each in [-1, 1]",
    },
    draw_episodes=_draw_episodes,
    draw_answer=_draw_answer,
)
