"""DoorKey, the paper's gridworld: fetch the key, open the door, walk to the goal (section 5.1 and its appendix).

    x  0 1 2 3 4 5
    y 0 # # # # # #      A  agent and K key start in different cells of the left room, x in {1, 2}
      1 # . . D . #      D  the door, locked until the agent walks into it with the key
      2 # . A # . #      G  the goal; reaching it does not end the episode
      3 # K . # . #
      4 # . . # G #      actions: right 0, down 1, left 2, up 3
      5 # # # # # #

The rules come twice, and a test holds them together: as functions of arrays, which broadcast over any number of states
(`step`, `reward`, `expert_probabilities`), and as `DoorKeyEnv`, which plays them on MiniGrid's own objects.

A cell is numbered 4 (y - 1) + (x - 1). A state is (agent cell, key cell, door open): a carried key is where the agent
is, and stepping on the key picks it up, so the agent carries it exactly when the two cells are equal.
"""

from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
from minigrid.core.actions import Actions
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import Door, Goal, Key
from minigrid.minigrid_env import MiniGridEnv

Expert = Literal["paper", "released"]

ENV_ID = "lerobot_unimask/DoorKey-v0"
TASK = "use the key to open the door and then get to the goal"
HORIZON = 10  # steps in every episode
FPS = 10
ACTIONS = ("right", "down", "left", "up")

_SIZE = 4  # cells along each side, inside the outer walls
_WALL_X = 3  # the inner wall's column, which the door is in
_DX, _DY = np.array([1, 0, -1, 0]), np.array([0, 1, 0, -1])  # of each action; y grows downwards


def coordinates(cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(x, y), each 1 to 4, of cells 0 to 15; any shape."""
    cell = np.asarray(cell)
    return cell % _SIZE + 1, cell // _SIZE + 1


def cell_at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The cell, 0 to 15, at (x, y), each 1 to 4; any shape."""
    return _SIZE * (np.asarray(y) - 1) + np.asarray(x) - 1


CELLS = np.arange(_SIZE * _SIZE)
DOOR, GOAL = int(cell_at(_WALL_X, 1)), int(cell_at(_SIZE, _SIZE))
START_CELLS = CELLS[coordinates(CELLS)[0] < _WALL_X]  # the left room
# The equally likely starts, (56, 2): agent cell, key cell
START_PAIRS = np.array([(agent, key) for agent in START_CELLS for key in START_CELLS if agent != key])


# --- The rules, over arrays -------------------------------------------------------------------------------------------


def step(
    agent: np.ndarray, key: np.ndarray, door_open: np.ndarray, action: np.ndarray
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


def distance_to_goal(agent: np.ndarray) -> np.ndarray:
    """Steps of the walk from these cells through the door to the goal; any shape."""
    x, y = coordinates(agent)
    through_door = np.abs(x - (_WALL_X - 1)) + np.abs(y - 1) + 1 + 4
    return np.where(x < _WALL_X, through_door, np.abs(x - _SIZE) + np.abs(y - _SIZE))


def reward(agent: np.ndarray, next_agent: np.ndarray) -> np.ndarray:
    """By how much the step brought the agent closer to the goal: 1, 0 or -1."""
    return distance_to_goal(agent) - distance_to_goal(next_agent)


def expert_probabilities(
    agent: np.ndarray, key: np.ndarray, door_open: np.ndarray, *, expert: Expert = "paper", beta: float = 1.0
) -> np.ndarray:
    """The noisy-rational expert's action probabilities, proportional to exp(beta C(a)); they depend on the door too.

    Args:
        agent, key, door_open: States, of any shapes that broadcast to one shape (...).
        expert: How C counts a bump, see `expert_progress`.
        beta: Rationality; 0 is uniform.

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


# --- A check for samples ----------------------------------------------------------------------------------------------


class DynamicsCheck:
    """Whether states and actions can follow each other by the rules: a check for `policy.sample`.

    The door is not in the state, nor is it needed: without the key it is closed, for a key once taken is carried on,
    and with the key it opens. So there are 69 states, those 56 in which an episode may start and 13 with the key.

    Args:
        agree: insist, too, that all decided tokens agree, however far apart: that one whole episode has them all. This
            is the rejection that the paper leaves undone, of what contradicts a state shown elsewhere. Without it each
            step is judged alone, from what is decided of its two states and its action.
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

    def __call__(self, values: dict[str, torch.Tensor], decided: dict[str, torch.Tensor]) -> torch.Tensor:
        """(N,) bool, from `s` (N, K, 2) and `a` (N, K, 1), and which of them are decided, (N, K) each."""
        cells = values["s"].nan_to_num(0).long().numpy(force=True)
        states = _possible(self._number[cells[..., 0], cells[..., 1]], decided["s"], len(self._following))  # (N, K, 69)
        taken = values["a"][..., 0].nan_to_num(0).long().numpy(force=True)
        actions = _possible(taken, decided["a"], len(ACTIONS))  # (N, K, 4)
        before = states[:, 0] & self._first if self.agree else states[:, 0]
        fine = before.any(axis=1) & states.any(axis=-1).all(axis=1)  # (N,)
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


# --- The environment, on MiniGrid's objects ---------------------------------------------------------------------------


class _DoorKeyGrid(MiniGridEnv):
    """MiniGrid's simulator with DoorKey's layout. Its own reward, observation and end of episode are not used."""

    def __init__(self) -> None:
        super().__init__(
            mission_space=MissionSpace(mission_func=lambda: TASK),
            grid_size=_SIZE + 2,
            render_mode="rgb_array",
            highlight=False,  # what the agent would see from where it looks says nothing here
        )

    def gen_obs(self) -> dict[str, Any]:
        return {}  # MiniGrid would draw its egocentric view after each of its steps, which costs more than the step

    def place(self, agent: int, key: int) -> None:
        """Start anew with agent and key in these cells."""
        self._start = agent, key
        self.reset()

    def _gen_grid(self, width: int, height: int) -> None:
        agent, key = self._start
        self.grid = Grid(width, height)
        self.grid.wall_rect(0, 0, width, height)
        self.grid.vert_wall(_WALL_X, 0)
        self.door, self.key = Door("yellow", is_locked=True), Key("yellow")
        self.put_obj(self.door, *_position(DOOR))
        self.put_obj(Goal(), *_position(GOAL))
        self.put_obj(self.key, *_position(key))
        self.agent_pos, self.agent_dir = _position(agent), 0

    def move(self, direction: int) -> None:
        """One DoorKey action, in up to seven of MiniGrid's. Its directions have our actions' numbers."""
        while self.agent_dir != direction:
            self.step(Actions.right)
        before = tuple(self.agent_pos)
        self.step(Actions.pickup)
        self.step(Actions.forward)
        if tuple(self.agent_pos) == before:  # only now: toggling first would close an open door
            self.step(Actions.toggle)
            self.step(Actions.forward)

    @property
    def state(self) -> tuple[int, int, bool]:
        """(agent cell, key cell, door open)."""
        agent = int(cell_at(*self.agent_pos))
        key = agent if self.carrying else int(cell_at(*self.key.cur_pos))
        return agent, key, self.door.is_open


def _position(cell: int) -> tuple[int, int]:
    x, y = coordinates(cell)
    return int(x), int(y)


class DoorKeyEnv(gym.Env):
    """DoorKey as a gymnasium environment that LeRobot's evaluation loop can run.

    Observation: `agent_pos`, (2,) int64, the agent's cell and the key's (LeRobot hands it on as `observation.state`),
    and `return_so_far`, (1,) float32, the sum of this episode's rewards. Action: (1,) int64, one of `ACTIONS`; plain
    integers and floats, which are rounded, do as well.

    An episode is truncated after `HORIZON` steps and never terminated. `info["is_success"]` is True from the step on
    that first reached the goal. `reset(options={"agent": cell, "key": cell})` chooses either or both start cells.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012 (gymnasium's own way)
    task = "DoorKey-v0"
    task_description = TASK
    _max_episode_steps = HORIZON  # LeRobot reads it from the environment itself

    def __init__(self, render_mode: str | None = "rgb_array") -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"DoorKey draws to arrays only: render_mode must be 'rgb_array', got {render_mode!r}.")
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Dict(
            {
                "agent_pos": gym.spaces.MultiDiscrete([len(CELLS), len(CELLS)]),
                "return_so_far": gym.spaces.Box(-HORIZON, HORIZON, shape=(1,), dtype=np.float32),
            }
        )
        self.action_space = gym.spaces.MultiDiscrete([len(ACTIONS)])  # (1,), so that a batch of them is (B, 1)
        self._grid = _DoorKeyGrid()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Start an episode.

        Raises:
            ValueError: If a chosen start cell is not in the left room, or both are the same.
        """
        super().reset(seed=seed)
        self._grid.place(*self._start_cells(options or {}))
        self._steps, self._return, self._reached_goal = 0, 0, False
        return self._observation(), {"is_success": False}

    def step(self, action: Any) -> tuple[dict, float, bool, bool, dict]:
        """Take one action.

        Raises:
            ValueError: If the action is not one number that rounds to 0, 1, 2 or 3.
        """
        before, _, _ = self._grid.state
        self._grid.move(_as_action(action))
        agent, _, _ = self._grid.state
        gained = float(reward(before, agent))
        self._steps += 1
        self._return += gained
        self._reached_goal |= agent == GOAL
        return self._observation(), gained, False, self._steps >= HORIZON, {"is_success": self._reached_goal}

    def render(self) -> np.ndarray:
        """(192, 192, 3) uint8: the whole grid as MiniGrid draws it, without a display."""
        return self._grid.render()

    @property
    def door_open(self) -> bool:
        """Whether the door has been opened; the expert acts on it, the observation does not show it."""
        return self._grid.door.is_open

    def _observation(self) -> dict[str, np.ndarray]:
        agent, key, _ = self._grid.state
        return {"agent_pos": np.array([agent, key]), "return_so_far": np.array([self._return], dtype=np.float32)}

    def _start_cells(self, options: dict[str, Any]) -> list[int]:
        chosen = [options.get("agent"), options.get("key")]
        taken = [cell for cell in chosen if cell is not None]
        if not np.isin(taken, START_CELLS).all() or len(set(taken)) < len(taken):
            raise ValueError(
                f"Agent and key start in different cells of the left room, {START_CELLS.tolist()}; "
                f"got agent {chosen[0]}, key {chosen[1]}."
            )
        drawn = iter(self.np_random.permutation(np.setdiff1d(START_CELLS, taken)))
        return [int(next(drawn) if cell is None else cell) for cell in chosen]


def _as_action(action: Any) -> int:
    try:
        number = np.rint(np.asarray(action, dtype=np.float64).reshape(()))
    except (TypeError, ValueError):  # no number, or more than one
        number = np.nan
    if not 0 <= number < len(ACTIONS):  # NaN too
        raise ValueError(f"A DoorKey action is one number from 0 to 3 ({', '.join(ACTIONS)}), got {action!r}.")
    return int(number)
