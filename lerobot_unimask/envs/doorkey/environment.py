"""DoorKey as a gymnasium environment, played on MiniGrid's own objects; a test holds it to `rules`."""

from typing import Any

import gymnasium as gym
import numpy as np
from minigrid.core.actions import Actions
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import Door, Goal, Key
from minigrid.minigrid_env import MiniGridEnv

from lerobot_unimask.envs.cameras import check_obs_type, pixels_space
from lerobot_unimask.envs.doorkey.rules import (
    _SIZE,
    _WALL_X,
    ACTIONS,
    CELLS,
    DOOR,
    FPS,
    GOAL,
    HORIZON,
    START_CELLS,
    TASK,
    cell_at,
    coordinates,
    reward,
)

CAMERA_SHAPE = (96, 96, 3)


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
        place = None if self.carrying else self.key.cur_pos
        return agent, agent if place is None else int(cell_at(*place)), self.door.is_open


def _position(cell: int) -> tuple[int, int]:
    x, y = coordinates(cell)
    return int(x), int(y)


class DoorKeyEnv(gym.Env):
    """DoorKey as a gymnasium environment that LeRobot's evaluation loop can run.

    Observation: `agent_pos`, (2,) int64, the agent's cell and the key's (LeRobot hands it on as `observation.state`),
    and `return_so_far`, (1,) float32, the sum of this episode's rewards; with `obs_type="pixels_agent_pos"` also
    `pixels`, whose `top` is `camera_picture`, (96, 96, 3) uint8. Action: (1,) int64, one of `ACTIONS`; plain
    integers and floats, which are rounded, do as well.

    An episode is truncated after `HORIZON` steps and never terminated. `info["is_success"]` is True from the step on
    that first reached the goal. `reset(options={"agent": cell, "key": cell})` chooses either or both start cells.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012 (gymnasium's own way)
    task = "DoorKey-v0"
    task_description = TASK
    _max_episode_steps = HORIZON  # LeRobot reads it from the environment itself

    def __init__(self, render_mode: str | None = "rgb_array", obs_type: str = "state") -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"DoorKey draws to arrays only: render_mode must be 'rgb_array', got {render_mode!r}.")
        self.render_mode = render_mode
        self.obs_type = check_obs_type(obs_type)
        spaces: dict[str, gym.Space] = {
            "agent_pos": gym.spaces.MultiDiscrete([len(CELLS), len(CELLS)]),
            "return_so_far": gym.spaces.Box(-HORIZON, HORIZON, shape=(1,), dtype=np.float32),
        }
        if obs_type != "state":
            spaces["pixels"] = pixels_space(CAMERA_SHAPE)
        self.observation_space = gym.spaces.Dict(spaces)
        self.action_space = gym.spaces.MultiDiscrete([len(ACTIONS)])  # (1,), so that a batch of them is (B, 1)
        self._grid = _DoorKeyGrid()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Start an episode.

        Raises:
            ValueError: If a chosen start cell is not in the left room, or both are the same.
        """
        super().reset(seed=seed)
        self._grid.place(*self._start_cells(options or {}))
        self._steps, self._return, self._reached_goal = 0, 0.0, False
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

    def camera_picture(self) -> np.ndarray:
        """(96, 96, 3) uint8: the whole grid, smaller."""
        return self._grid.get_frame(highlight=False, tile_size=CAMERA_SHAPE[0] // (_SIZE + 2))

    @property
    def door_open(self) -> bool:
        """Whether the door has been opened; the expert acts on it, the observation does not show it."""
        return self._grid.door.is_open

    def _observation(self) -> dict[str, Any]:
        agent, key, _ = self._grid.state
        observation: dict[str, Any] = {
            "agent_pos": np.array([agent, key]),
            "return_so_far": np.array([self._return], dtype=np.float32),
        }
        if self.obs_type != "state":
            observation["pixels"] = {"top": self.camera_picture()}
        return observation

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
        number = float(np.rint(np.asarray(action, dtype=np.float64).reshape(())))
    except (TypeError, ValueError):  # no number, or more than one
        number = np.nan
    if not 0 <= number < len(ACTIONS):  # NaN too
        raise ValueError(f"A DoorKey action is one number from 0 to 3 ({', '.join(ACTIONS)}), got {action!r}.")
    return int(number)
