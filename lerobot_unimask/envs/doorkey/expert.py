"""DoorKey's noisy-rational expert (section 5.1 of the paper and its appendix); for cells and states see `rules`."""

from typing import Literal

import numpy as np

from lerobot_unimask.envs.doorkey.rules import _DX, _DY, _SIZE, _WALL_X, ACTIONS, DOOR, GOAL, coordinates, step

Expert = Literal["paper", "released"]


def expert_probabilities(
    agent: np.ndarray, key: np.ndarray, door_open: np.ndarray, *, expert: Expert = "paper", beta: float = 1.0
) -> np.ndarray:
    """The noisy-rational expert's action probabilities, proportional to exp(beta C(a)); they depend on the door too.

    Args:
        agent, key, door_open: states, of any shapes that broadcast to one shape (...).
        expert: name of the way in which C counts a bump, see `expert_progress`.
        beta: rationality; 0 is uniform.

    Returns:
        (..., 4) float64, summing to one over the last axis.

    Raises:
        ValueError: If `expert` is unknown or `beta` is not finite.
    """
    if not np.isfinite(beta):
        raise ValueError(f"The expert's beta must be a finite number, got {beta}.")
    logits = beta * expert_progress(agent, key, door_open, expert=expert)
    weights = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return weights / weights.sum(axis=-1, keepdims=True)


def expert_progress(
    agent: np.ndarray, key: np.ndarray, door_open: np.ndarray, *, expert: Expert = "paper"
) -> np.ndarray:
    """C(a): by how much each action brings the agent closer, in plain Manhattan distance, to the expert's target.

    The target is the key, then the door, then, once that has been opened, the goal, from the left room too.

    Note: The paper counts the move as it really goes, so a bump has C = 0. In the authors' released code what counts is
        the cell tried, with coordinates cut to 0 .. 4 and the inner wall's cells left out, so that a bump into the left
        or top outer wall or the locked door can have C = -1 (a bump right or down still has 0).

    Args:
        agent, key, door_open: States, of any shapes that broadcast to one shape (...).
        expert: "paper" or "released".

    Returns:
        (..., 4) integers in {-1, 0, 1}.

    Raises:
        ValueError: If `expert` is unknown.
    """
    agent, key, door_open = (array[..., None] for array in np.broadcast_arrays(agent, key, door_open))  # (..., 1)
    x, y = coordinates(agent)
    if expert == "paper":
        tried_x, tried_y = coordinates(step(agent, key, door_open, np.arange(len(ACTIONS)))[0])
    elif expert == "released":
        tried_x, tried_y = np.clip(x + _DX, 0, _SIZE), np.clip(y + _DY, 0, _SIZE)
        wall = (tried_x == _WALL_X) & (tried_y > 1)
        tried_x, tried_y = np.where(wall, x, tried_x), np.where(wall, y, tried_y)
    else:
        raise ValueError(f"The expert must be 'paper' or 'released', got {expert!r}.")
    target_x, target_y = coordinates(np.where(door_open, GOAL, np.where(agent == key, DOOR, key)))
    distance = np.abs(x - target_x) + np.abs(y - target_y)
    return distance - np.abs(tried_x - target_x) - np.abs(tried_y - target_y)
