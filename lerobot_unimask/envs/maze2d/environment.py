"""Maze2D as a gymnasium environment on MuJoCo; positions are joint positions, in cells, as `maze` has them."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from lerobot_unimask.envs.cameras import check_obs_type, pixels_space
from lerobot_unimask.envs.maze2d.maze import (
    BODY_OFFSET,
    FPS,
    HORIZON,
    MASS_RADIUS,
    MAX_SPEED,
    SECONDS_PER_STEP,
    START_SPEED,
    START_SPREAD,
    SUCCESS_DISTANCE,
    WALL_OFFSET,
    Cell,
    Maze,
    parse_maze,
    task_of,
)
from lerobot_unimask.envs.maze2d.rendering import camera_picture, draw_maze


@lru_cache(maxsize=32)
def compile_maze(maze: Maze) -> mujoco.MjModel:
    """The maze's MuJoCo model, with D4RL's constants. Shared by all environments of this maze: do not change it."""
    spec = mujoco.MjSpec()
    spec.option.timestep = SECONDS_PER_STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.gravity = (0, 0, 0)
    default = spec.default.geom
    default.density = 1000
    default.friction = (0.5, 0.1, 0.1)
    default.margin = 0.002
    default.condim = 1
    default.contype, default.conaffinity = 2, 1

    mass = spec.worldbody.add_body(name="mass", pos=(BODY_OFFSET, BODY_OFFSET, 0))
    mass.add_geom(name="mass", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(MASS_RADIUS, 0, 0), contype=1)
    limited = mujoco.mjtLimited
    for name, axis in (("x", (1, 0, 0)), ("y", (0, 1, 0))):
        joint = mass.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, damping=1.0)
        joint.limited = limited.mjLIMITED_FALSE
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gear[0] = 100
        motor.ctrllimited = limited.mjLIMITED_TRUE
        motor.ctrlrange = (-1, 1)
    for r, row in enumerate(maze.rows):
        for c, cell in enumerate(row):
            if cell == "#":
                wall = spec.worldbody.add_geom(name=f"wall {r} {c}", type=mujoco.mjtGeom.mjGEOM_BOX)
                wall.size = (0.5, 0.5, 0.2)
                wall.pos = (r + WALL_OFFSET, c + WALL_OFFSET, 0)
    return spec.compile()


class Maze2DEnv(gym.Env):
    """Push a point mass, whose velocity is hidden, to a goal: 200 steps of 0.01 s, one simulation step each.

    Observation: `agent_pos` float32 (4,): x, y, goal x, goal y (LeRobot's name for what becomes
    `observation.state`), and `return_so_far` float32 (1,). With `obs_type="pixels_agent_pos"` also `pixels`, whose
    `top` is `camera_picture`'s; with `hide_goal` `agent_pos` is x and y only. Action: float32 (2,) in [-1, 1], the
    motors' forces; values outside are clipped. Reward: by how much the distance to the goal shrank. An episode is
    truncated after 200 steps and never terminates; `info["is_success"]` says whether the mass has been within 0.5 of
    the goal.

    `reset(options=...)` reads these keys and ignores others, LeRobot's among them:
        goal: (row, column) of a free cell.
        position, velocity: the start (x, y) and (vx, vy), taken exactly, so that a recorded episode can be replayed.
    What is not given is drawn: a free cell, the position around it, the velocity, another cell as goal.
    Drawn starts are float32 numbers, so a float32 record of them is exact.

    Raises:
        ValueError: a bad maze (see `parse_maze`), a goal or position in a wall or outside the maze, a start that is
            not two finite numbers, an action that is not two finite numbers.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012 (gymnasium's own way)
    task = "Maze2D-v0"
    _max_episode_steps = HORIZON  # LeRobot reads it from the environment itself

    def __init__(
        self,
        maze: str = "medium",
        render_mode: str | None = "rgb_array",
        obs_type: str = "state",
        hide_goal: bool = False,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"Maze2D draws to arrays only: render_mode must be 'rgb_array', got {render_mode!r}.")
        self.maze, self.task_description = parse_maze(maze), task_of(maze)
        self.render_mode = render_mode
        self.obs_type, self.hide_goal = check_obs_type(obs_type), hide_goal
        spaces: dict[str, gym.Space] = {
            "agent_pos": gym.spaces.Box(-np.inf, np.inf, (2 if hide_goal else 4,), np.float32),
            "return_so_far": gym.spaces.Box(-np.inf, np.inf, (1,), np.float32),
        }
        if obs_type != "state":
            spaces["pixels"] = pixels_space(camera_picture(self.maze, (1, 1), (1, 1)).shape)
        self.observation_space = gym.spaces.Dict(spaces)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._model = compile_maze(self.maze)
        self._data = mujoco.MjData(self._model)

    @property
    def position(self) -> tuple[float, float]:
        """The mass's joint position (x, y), in cells."""
        return self._trail[-1]

    @property
    def velocity(self) -> tuple[float, float]:
        """The mass's velocity (vx, vy), in cells per second: what the observation hides."""
        return tuple(self._data.qvel.tolist())

    @property
    def goal(self) -> Cell:
        """The goal's cell (row, column), which is also its position."""
        return self._goal

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        options = options or {}
        goal = self._read_goal(options["goal"]) if "goal" in options else None
        if "position" in options:
            position = self._read_position(options["position"])
            cell = (round(position[0]), round(position[1]))
        else:
            cell = self._draw_cell(other_than=goal)
            spread = self.np_random.uniform(-START_SPREAD, START_SPREAD, 2)
            position = (np.array(cell) + spread).astype(np.float32).tolist()
        if "velocity" in options:
            velocity = _two_numbers("velocity", options["velocity"])
        else:
            velocity = (START_SPEED * self.np_random.standard_normal(2)).astype(np.float32).tolist()
        self._goal = goal or self._draw_cell(other_than=cell)

        mujoco.mj_resetData(self._model, self._data)  # time and the solver's warm start too
        self._data.qpos[:] = position
        self._data.qvel[:] = velocity
        self._trail = [(position[0], position[1])]
        self._distance = self._start_distance = math.dist(position, self._goal)
        self._is_success = self._distance <= SUCCESS_DISTANCE
        return self._observation(), {"is_success": self._is_success}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        action_x, action_y = _two_numbers("action", action)
        data = self._data
        velocity_x, velocity_y = data.qvel.tolist()
        if abs(velocity_x) > MAX_SPEED or abs(velocity_y) > MAX_SPEED:
            np.clip(data.qvel, -MAX_SPEED, MAX_SPEED, out=data.qvel)
        control = data.ctrl
        control[0], control[1] = action_x, action_y  # the motors' control range clips them
        mujoco.mj_step(self._model, data)

        x, y = data.qpos.tolist()
        position = (x, y)
        self._trail.append(position)
        distance = math.dist(position, self._goal)
        reward = self._distance - distance
        self._distance = distance
        self._is_success = self._is_success or distance <= SUCCESS_DISTANCE
        truncated = len(self._trail) > HORIZON
        return self._observation(), reward, False, truncated, {"is_success": self._is_success}

    def render(self) -> np.ndarray:
        """The maze from above, uint8 (height, width, 3), both even."""
        return draw_maze(self.maze, self._goal, self._trail)

    def _observation(self) -> dict[str, Any]:
        observation: dict[str, Any] = {
            "agent_pos": np.array((*self._trail[-1], *(() if self.hide_goal else self._goal)), np.float32),
            # The rewards' sum telescopes: no rounding error piles up.
            "return_so_far": np.array((self._start_distance - self._distance,), np.float32),
        }
        if self.obs_type != "state":
            observation["pixels"] = {"top": camera_picture(self.maze, self._goal, self._trail[-1])}
        return observation

    def _draw_cell(self, other_than: Cell | None) -> Cell:
        cells = [cell for cell in self.maze.cells if cell != other_than]
        return cells[self.np_random.integers(len(cells))]

    def _read_goal(self, goal: Sequence[int]) -> Cell:
        row, column = _two_numbers("goal", goal)
        if not (row.is_integer() and column.is_integer() and self.maze.is_free((int(row), int(column)))):
            text = "\n".join(self.maze.rows)
            raise ValueError(f"The goal {goal} is not a free cell (row, column) of the maze, counted from 0:\n{text}")
        return int(row), int(column)

    def _read_position(self, position: Sequence[float]) -> list[float]:
        x, y = _two_numbers("position", position)
        # In the walls' frame: boxes of half-size 0.5 around whole numbers.
        box_x, box_y = x + BODY_OFFSET - WALL_OFFSET, y + BODY_OFFSET - WALL_OFFSET
        cell = (round(box_x), round(box_y))
        # A drawn start may lie on a wall's very face, and float32 may round it 1e-7 beyond.
        inside = max(abs(box_x - cell[0]), abs(box_y - cell[1])) < 0.5 - 1e-6
        if inside and not self.maze.is_free(cell):
            raise ValueError(f"The position {(x, y)} is inside a wall or outside the maze.")
        return [x, y]


def _two_numbers(name: str, values: ArrayLike) -> tuple[float, float]:
    numbers = np.asarray(values, np.float64)
    if numbers.shape != (2,):
        raise ValueError(f"The {name} must be two numbers, its shape is {numbers.shape}.")
    first, second = pair = numbers.tolist()
    if not (math.isfinite(first) and math.isfinite(second)):
        raise ValueError(f"The {name} must be finite, it is {pair}.")
    return first, second
