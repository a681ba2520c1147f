"""DoorKey's record, for the rest of the package."""

import numpy as np
from lerobot.utils.constants import ACTION, OBS_STATE
from matplotlib.figure import Figure

from lerobot_unimask.asking.answers import Answer
from lerobot_unimask.asking.sampling import Samples
from lerobot_unimask.data.window import Window
from lerobot_unimask.envs.doorkey.comparison import beside_optimum
from lerobot_unimask.envs.doorkey.optimum import exact_answer
from lerobot_unimask.envs.doorkey.pictures import state_distributions, trajectories
from lerobot_unimask.envs.doorkey.rules import ENV_ID, HORIZON, DynamicsCheck
from lerobot_unimask.envs.record import Environment, ExactOptimum, Provenance
from lerobot_unimask.language.masks import ASKABLE, Mask


def _draw_answer(
    question: str, answer: Answer | Samples, mask: Mask, recorded: Window | None, provenance: Provenance
) -> Figure | None:
    """Where the agent and the key are, if every state is shown or asked, and no return or property is."""
    beside = any(asked.any() for name, asked in mask.asked.items() if name not in ASKABLE)
    if beside or not (mask.shown["s"] | mask.asked["s"]).all():
        return None
    if isinstance(answer, Samples):
        return trajectories({question: answer.values["s"].long().numpy(force=True)})
    return state_distributions(answer)


def _draw_episodes(states: np.ndarray, provenance: Provenance) -> Figure:
    return trajectories({f"{len(states)} episodes": states}, most=len(states))


DOORKEY = Environment(
    type="doorkey",
    env_id=ENV_ID,
    state_names=("agent_cell", "key_cell"),
    horizon=HORIZON,
    description="DoorKey, a gridworld of 4 x 4 cells: fetch the key, open the door, walk to the goal. Every episode "
    "has 10 steps.",
    expert="noisily rational, its actions drawn with probability proportional to exp(beta C(a))",
    reward="by how many steps the agent came closer to the goal: 1, 0 or -1",
    columns={
        OBS_STATE: "the agent's cell and the key's, 0 to 15, numbered row by row; equal once the key is carried",
        ACTION: "right 0, down 1, left 2, up 3",
    },
    draw_episodes=_draw_episodes,
    draw_answer=_draw_answer,
    checks={
        "dynamics": lambda first_step: DynamicsCheck(first_step=first_step),
        "agreement": lambda first_step: DynamicsCheck(agree=True, first_step=first_step),
    },
    optimum=ExactOptimum(("paper", "released"), answer=exact_answer, compare=beside_optimum),
)
