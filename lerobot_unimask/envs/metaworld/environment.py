"""MetaWorld's tasks for a Sawyer arm on MuJoCo (Yu et al., 2019), observed by numbers instead of pictures.

LeRobot's own `--env.type=metaworld` shows pictures alone. Here `agent_pos` is the hand's position and the gripper's
opening, and `environment_state` the objects' positions and quaternions and the goal's position. The numbers that a task
has no object for, and the repetition of the step before, are left out.
"""

from typing import Any, Literal

import gymnasium as gym
import numpy as np

ENV_ID = "lerobot_unimask/MetaWorld-v0"
HORIZON = 500  # steps after which an episode ends without success
FPS = 80
HAND = 4  # numbers: x, y, z and how far the gripper is open
OBJECT = 7  # numbers: a position and a quaternion

EXTRA = "MetaWorld is an extra: pip install 'lerobot_policy_unimask[metaworld]'."


def load_metaworld() -> Any:
    """The package `metaworld`, mended for MuJoCo 4.

    Note: metaworld 3.0.0 writes 11 numbers to a weld constraint's data, of which MuJoCo 4 has 12. The first 11 mean
        what they did; here the twelfth stays as the model has it.

    Raises:
        ImportError: it is not installed.
    """
    try:
        import metaworld
        import mujoco
        from metaworld.sawyer_xyz_env import SawyerMocapBase
    except ImportError as error:
        raise ImportError(EXTRA) from error

    def reset_mocap_welds(self: Any) -> None:
        weld = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 5.0])
        for i in np.flatnonzero(self.model.eq_type == mujoco.mjtEq.mjEQ_WELD):
            self.model.eq_data[i, : len(weld)] = weld

    setattr(SawyerMocapBase, "reset_mocap_welds", reset_mocap_welds)  # noqa: B010 (a type checker reads it so)
    return metaworld


def task_names() -> list[str]:
    """MetaWorld's fifty tasks."""
    load_metaworld()
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    return sorted(ALL_V3_ENVIRONMENTS)


def describe_task(name: str) -> str:
    """The sentence that LeRobot gives a task.

    Raises:
        ValueError: there is no task of that name.
    """
    from lerobot.envs.metaworld import TASK_DESCRIPTIONS

    if name not in TASK_DESCRIPTIONS:
        raise ValueError(f"MetaWorld has no task {name!r}; its tasks are {', '.join(task_names())}.")
    return TASK_DESCRIPTIONS[name]


class MetaWorldEnv(gym.Env):
    """One task; every reset draws the objects and the goal anew. An episode ends with success, or after 500 steps.

    Args:
        task: name of the task, such as `peg-insert-side-v3`.
        objects: number of objects to tell of, one or two; None: as many as the task has.

    Raises:
        ValueError: there is no such task.
        ImportError: the extra is not installed.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012 (gymnasium's)

    def __init__(self, task: str, objects: int | None = None, render_mode: Literal["rgb_array"] | None = "rgb_array"):
        load_metaworld()
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS

        self.task, self.task_description, self.render_mode = task, describe_task(task), render_mode
        self._max_episode_steps = HORIZON  # LeRobot's evaluation reads it
        self.arm = ALL_V3_ENVIRONMENTS[task](render_mode=render_mode, camera_name="corner2")
        self.arm._partially_observable = False  # the goal is observed: its bounds are not the point 0 then
        self.arm.__dict__.pop("sawyer_observation_space", None)  # is made anew
        self.arm._freeze_rand_vec, self.arm.seeded_rand_vec, self.arm._set_task_called = False, True, True
        self.arm.reset()
        self.objects = objects or len(self.arm._get_pos_objects()) // 3
        self.numbers = OBJECT * self.objects + 3
        unbounded: dict[str, Any] = {"low": -np.inf, "high": np.inf, "dtype": np.float32}
        self.observation_space = gym.spaces.Dict(
            {
                "agent_pos": gym.spaces.Box(shape=(HAND,), **unbounded),
                "environment_state": gym.spaces.Box(shape=(self.numbers,), **unbounded),
            }
        )
        self.action_space = gym.spaces.Box(-1, 1, (4,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        self.arm.seed(int(self.np_random.integers(2**31)))
        self.full, _ = self.arm.reset()
        return self._observe(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        self.full, reward, _, truncated, info = self.arm.step(np.clip(action, -1, 1).astype(np.float64))
        success = bool(info["success"])
        return self._observe(), float(reward), success, bool(truncated), {"is_success": success}

    def render(self) -> np.ndarray:
        return np.flip(self.arm.render(), (0, 1)).copy()  # this camera hangs upside down

    def close(self) -> None:
        self.arm.close()

    def _observe(self) -> dict[str, np.ndarray]:
        full = self.full.astype(np.float32)  # hand 4, objects 14, both of the step before, goal 3
        rest = np.concatenate([full[HAND : HAND + OBJECT * self.objects], full[-3:]])
        return {"agent_pos": full[:HAND], "environment_state": rest}
