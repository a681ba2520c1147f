"""DoorKey datasets: the noisy-rational expert of the paper, rolled out over the rules' tables."""

from typing import NamedTuple

import numpy as np

from lerobot_unimask.envs.doorkey.expert import Expert, expert_probabilities
from lerobot_unimask.envs.doorkey.rules import CELLS, HORIZON, START_PAIRS, reward, step


class Episodes(NamedTuple):
    """E episodes of T = 10 steps; the states include the one after the last action."""

    agent: np.ndarray  # (E, T + 1) int64, the agent's cell
    key: np.ndarray  # (E, T + 1) int64, the key's cell
    door_open: np.ndarray  # (E, T + 1) bool
    action: np.ndarray  # (E, T) int64
    reward: np.ndarray  # (E, T) int64


def rollout(episodes: int, rng: np.random.Generator, *, expert: Expert = "paper", beta: float = 1.0) -> Episodes:
    """Roll out the expert, all episodes at once.

    Each episode takes the same number of draws from `rng`, one after another: so a first call for n episodes and a
    second for m give the episodes of one call for n + m.

    Raises:
        ValueError: If `episodes` is below 1, `expert` unknown or `beta` not finite.
    """
    if episodes < 1:
        raise ValueError(f"At least one episode is needed, got {episodes}.")
    table = expert_probabilities(
        CELLS[:, None, None], CELLS[:, None], np.array([False, True]), expert=expert, beta=beta
    )
    thresholds = table.cumsum(axis=-1)[..., :-1]  # (agent, key, door, 3)
    draws = rng.random((episodes, 1 + HORIZON))
    agent, key = START_PAIRS[(draws[:, 0] * len(START_PAIRS)).astype(np.int64)].T  # (E,)
    door_open = np.zeros(episodes, dtype=bool)
    states, actions = [(agent, key, door_open)], []
    for draw in draws[:, 1:].T:
        action = (draw[:, None] >= thresholds[agent, key, door_open.astype(np.int64)]).sum(axis=1)
        agent, key, door_open = step(agent, key, door_open, action)
        states.append((agent, key, door_open))
        actions.append(action)
    agents, keys, doors = (np.stack(column, axis=1) for column in zip(*states, strict=True))
    return Episodes(agents, keys, doors, np.stack(actions, axis=1), reward(agents[:, :-1], agents[:, 1:]))
