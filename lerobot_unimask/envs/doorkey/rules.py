"""DoorKey, the paper's gridworld: fetch the key, open the door, walk to the goal (section 5.1 and its appendix).

    x  0 1 2 3 4 5
    y 0 # # # # # #      A  agent and K key start in different cells of the left room, x in {1, 2}
      1 # . . D . #      D  the door, locked until the agent walks into it with the key
      2 # . A # . #      G  the goal; reaching it does not end the episode
      3 # K . # . #
      4 # . . # G #      actions: right 0, down 1, left 2, up 3
      5 # # # # # #

The rules come twice, and a test holds them together: here, as functions of arrays, which broadcast over any number of
states, and in `environment`, where `DoorKeyEnv` plays them on MiniGrid's own objects.

A cell is numbered 4 (y - 1) + (x - 1). A state is (agent cell, key cell, door open): a carried key is where the agent
is, and stepping on the key picks it up, so the agent carries it exactly when the two cells are equal.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

ENV_ID = "lerobot_unimask/DoorKey-v0"

TASK = "use the key to open the door and then get to the goal"

HORIZON = 10  # steps in every episode

FPS = 10

ACTIONS = ("right", "down", "left", "up")

_SIZE = 4  # cells along each side, inside the outer walls

_WALL_X = 3  # the inner wall's column, which the door is in

_DX, _DY = np.array([1, 0, -1, 0]), np.array([0, 1, 0, -1])  # of each action; y grows downwards


def coordinates(cell: ArrayLike) -> tuple[Any, Any]:
    """(x, y), each 1 to 4, of cells 0 to 15: numbers, or arrays of any shape."""
    cell = np.asarray(cell)
    return cell % _SIZE + 1, cell // _SIZE + 1


def cell_at(x: ArrayLike, y: ArrayLike) -> np.ndarray:
    """The cell, 0 to 15, at (x, y), each 1 to 4; any shape."""
    return _SIZE * (np.asarray(y) - 1) + np.asarray(x) - 1


CELLS = np.arange(_SIZE * _SIZE)

DOOR, GOAL = int(cell_at(_WALL_X, 1)), int(cell_at(_SIZE, _SIZE))

START_CELLS = CELLS[coordinates(CELLS)[0] < _WALL_X]  # the left room

# The equally likely starts, (56, 2): agent cell, key cell
START_PAIRS = np.array([(agent, key) for agent in START_CELLS for key in START_CELLS if agent != key])


def step(
    agent: ArrayLike, key: ArrayLike, door_open: ArrayLike, action: ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The next state's (agent, key, door_open). The arguments, and the results, broadcast against each other."""
    agent, key, door_open, action = np.broadcast_arrays(agent, key, door_open, action)
    x, y = coordinates(agent)
    x, y = x + _DX[action], y + _DY[action]
    inside = (x >= 1) & (x <= _SIZE) & (y >= 1) & (y <= _SIZE)
    tried = cell_at(x, y)  # means a cell only where `inside`
    wall = (x == _WALL_X) & (tried != DOOR)
    locked = (tried == DOOR) & ~door_open & (agent != key)
    next_agent = np.where(inside & ~wall & ~locked, tried, agent)
    next_key = np.where(agent == key, next_agent, key)
    return next_agent, next_key, door_open | (next_agent == DOOR)


def distance_to_goal(agent: ArrayLike) -> np.ndarray:
    """Steps of the walk from these cells through the door to the goal; any shape."""
    x, y = coordinates(agent)
    through_door = np.abs(x - (_WALL_X - 1)) + np.abs(y - 1) + 1 + 4
    return np.where(x < _WALL_X, through_door, np.abs(x - _SIZE) + np.abs(y - _SIZE))


def reward(agent: ArrayLike, next_agent: ArrayLike) -> np.ndarray:
    """By how much the step brought the agent closer to the goal: 1, 0 or -1."""
    return distance_to_goal(agent) - distance_to_goal(next_agent)


class DynamicsCheck:
    """Whether states and actions can follow each other by the rules: a check for `policy.sample`.

    The door is not in the state, nor is it needed: without the key it is closed, for a key once taken is carried on,
    and with the key it opens. So there are 69 states, those 56 in which an episode may start and 13 with the key.

    Args:
        agree: insist, too, that all decided tokens agree, however far apart: that one whole episode has them all. This
            is the rejection that the paper leaves undone, of what contradicts a state shown elsewhere. Without it each
            step is judged by itself, from what is decided of its two states and its action.
        first_step: the episode's step at which the windows start; `agree` knows which states it can have.
    """

    def __init__(self, *, agree: bool = False, first_step: int = 0):
        self.agree = agree
        with_key = [(cell, cell) for cell in CELLS[~((coordinates(CELLS)[0] == _WALL_X) & (CELLS != DOOR))]]
        agent, key = np.concatenate([START_PAIRS, with_key]).T  # (69,)
        self._number = np.full((len(CELLS), len(CELLS)), -1)  # of the state with these cells; -1: there is none
        self._number[agent, key] = np.arange(len(agent))
        following = step(agent[:, None], key[:, None], np.array(False), np.arange(len(ACTIONS)))
        self._following = self._number[following[0], following[1]]  # (69, 4)
        self._first = np.arange(len(agent)) < len(START_PAIRS)  # (69,) the states at the windows' first step
        for _ in range(first_step):
            self._first = self._image(self._first[None], np.ones((1, len(ACTIONS)), dtype=bool))[0]

    def __call__(self, values: Mapping[str, torch.Tensor], decided: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """(N,) bool, from `s` (N, K, 2) and `a` (N, K, 1), and which of them are decided, (N, K) each."""
        cells = values["s"].nan_to_num(0).long().numpy(force=True)
        states = _possible(self._number[cells[..., 0], cells[..., 1]], decided["s"], len(self._following))  # (N, K, 69)
        taken = values["a"][..., 0].nan_to_num(0).long().numpy(force=True)
        actions = _possible(taken, decided["a"], len(ACTIONS))  # (N, K, 4)
        before = states[:, 0] & self._first if self.agree else states[:, 0]
        fine = before.any(axis=1) & np.all(states.any(axis=-1), axis=1)  # (N,)
        for k in range(states.shape[1] - 1):
            after = self._image(before, actions[:, k]) & states[:, k + 1]
            fine &= after.any(axis=1)
            before = after if self.agree else states[:, k + 1]
        return torch.from_numpy(fine).to(values["s"].device)

    def _image(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The states (N, 69) that some of these states, (N, 69), lead to by some of these actions, (N, 4)."""
        image = np.zeros(states.shape, dtype=bool)
        for action, following in enumerate(self._following.T):
            n, state = (states & actions[:, action, None]).nonzero()
            image[n, following[state]] = True
        return image


def _possible(number: np.ndarray, decided: torch.Tensor, count: int) -> np.ndarray:
    """(N, K) -> (N, K, count) bool: the one number where decided, all of them elsewhere."""
    return (number[..., None] == np.arange(count)) | ~decided.numpy(force=True)[..., None]
