"""MetaWorld's record, for the rest of the package, and the picture of its episodes."""

import numpy as np
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from matplotlib.figure import Figure

from lerobot_unimask.envs.metaworld.environment import ENV_ID, HORIZON
from lerobot_unimask.envs.record import Environment, Provenance
from lerobot_unimask.plots.style import COLOURS, NORMAL, SMALL, WIDTH

HAND_NAMES = ("hand_x", "hand_y", "hand_z", "gripper")
OBJECT_NAMES = ("object0_x", "object0_y", "object0_z", "object0_qx", "object0_qy", "object0_qz", "object0_qw")


def _draw_episodes(states: np.ndarray, provenance: Provenance) -> Figure:
    """The hand's ways, from above and from the side, each from a dot to a star."""
    figure = Figure(figsize=(WIDTH, 0.45 * WIDTH), layout="constrained")
    for axes, (across, up), title in zip(
        figure.subplots(1, 2), ((0, 1), (1, 2)), ("from above", "from the side"), strict=True
    ):
        for way, colour in zip(states, COLOURS * len(states), strict=False):
            axes.plot(way[:, across], way[:, up], color=colour, linewidth=1.2)
            axes.plot(way[0, across], way[0, up], marker=".", color=colour)
            axes.plot(way[-1, across], way[-1, up], marker="*", markersize=9, color=colour)
        axes.set(xlabel=f"{HAND_NAMES[across]} (m)", ylabel=f"{HAND_NAMES[up]} (m)")
        axes.set_title(f"{provenance.get('task', '')} {title}", fontsize=NORMAL)
        axes.tick_params(labelsize=SMALL)
    return figure


METAWORLD = Environment(
    type="metaworld_state",
    env_id=ENV_ID,
    state_names=(*HAND_NAMES, *OBJECT_NAMES, "goal_x", "goal_y", "goal_z"),
    horizon=HORIZON,
    description="MetaWorld, a Sawyer arm on MuJoCo, observed by numbers. An episode ends with success.",
    expert="MetaWorld's scripted policy, with normal noise on half of its actions",
    reward="MetaWorld's own, dense",
    columns={
        OBS_STATE: "the hand's position and how far the gripper is open",
        OBS_ENV_STATE: "each object's position and quaternion, and the goal's position",
        ACTION: "the hand's displacement along x, y and z, and the gripper's effort, each in [-1, 1]",
    },
    draw_episodes=_draw_episodes,
)
