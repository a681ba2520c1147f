"""LeRobot's `--env.type=...` for this package's environments.

One environment is one `EnvConfig` of a few lines: its `task`, which with the package's name is the gymnasium id, its
`fps`, and the shapes of what it takes and gives.
"""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import gymnasium as gym
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_unimask.envs.cameras import check_obs_type
from lerobot_unimask.envs.maze2d.maze import CAMERA_PIXELS_PER_CELL, parse_maze
from lerobot_unimask.envs.returns import ReportReturn


def state_and_action(state: int, action: int) -> dict[str, PolicyFeature]:
    """The features of an environment that observes `state` numbers, and the return so far, and takes `action`."""
    return {
        ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(action,)),
        "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(state,)),
        "return_so_far": PolicyFeature(type=FeatureType.STATE, shape=(1,)),
    }


@dataclass
class UniMASKEnvConfig(EnvConfig):
    """What the environments of this package share: names in LeRobot, and synchronous stepping."""

    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "return_so_far": "observation.return_so_far",
        }
    )

    @property
    def package_name(self) -> str:
        """The gymnasium namespace, and the package whose import registers the ids."""
        return "lerobot_unimask"

    @property
    def gym_kwargs(self) -> Mapping[str, Any]:
        return {"render_mode": "rgb_array"}

    def add_camera(self, height: int, width: int) -> None:
        """Declare what `obs_type=pixels_agent_pos` shows."""
        self.features["pixels/top"] = PolicyFeature(type=FeatureType.VISUAL, shape=(height, width, 3))
        self.features_map["pixels/top"] = f"{OBS_IMAGES}.top"

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """{type: {0: SyncVectorEnv of `n_envs`}}, synchronous whatever `use_async_envs` says.

        Asynchronous ones, LeRobot's default, import torch in every worker: a minute or more and half a gigabyte each,
        for environments that step in well under a millisecond.
        """
        return super().create_envs(n_envs, use_async_envs=False)


@EnvConfig.register_subclass("doorkey")
@dataclass
class DoorKeyEnvConfig(UniMASKEnvConfig):
    """`--env.type=doorkey`"""

    task: str | None = "DoorKey-v0"
    """Name of the environment."""
    fps: int = 10
    """Steps a second."""
    features: dict[str, PolicyFeature] = field(default_factory=lambda: state_and_action(state=2, action=1))
    obs_type: str = "state"
    """What is observed: "state", or "pixels_agent_pos", a picture too."""

    def __post_init__(self) -> None:
        if check_obs_type(self.obs_type) != "state":
            self.add_camera(96, 96)

    @property
    def gym_kwargs(self) -> Mapping[str, Any]:
        return {**super().gym_kwargs, "obs_type": self.obs_type}


@EnvConfig.register_subclass("maze2d")
@dataclass
class Maze2DEnvConfig(UniMASKEnvConfig):
    """`--env.type=maze2d`"""

    task: str | None = "Maze2D-v0"
    """Name of the environment."""
    fps: int = 100
    """Steps a second."""
    features: dict[str, PolicyFeature] = field(default_factory=lambda: state_and_action(state=4, action=2))
    maze: str = "medium"
    """Maze: umaze, medium, large, or its text, a line for each row (see `envs/maze2d/maze.py`)."""
    obs_type: str = "state"
    """What is observed: "state", or "pixels_agent_pos", a picture too."""
    hide_goal: bool = False
    """Whether the state is the position without the goal, which is then to be seen in the picture only."""

    def __post_init__(self) -> None:
        if self.hide_goal:
            self.features |= state_and_action(state=2, action=2)
        if check_obs_type(self.obs_type) != "state":
            rows = parse_maze(self.maze).rows
            self.add_camera(len(rows) * CAMERA_PIXELS_PER_CELL, len(rows[0]) * CAMERA_PIXELS_PER_CELL)

    @property
    def gym_kwargs(self) -> Mapping[str, Any]:
        settings = {"maze": self.maze, "obs_type": self.obs_type, "hide_goal": self.hide_goal}
        return {**super().gym_kwargs, **settings}


@EnvConfig.register_subclass("metaworld_state")
@dataclass
class MetaWorldEnvConfig(UniMASKEnvConfig):
    """`--env.type=metaworld_state`: MetaWorld observed by numbers; LeRobot's own `metaworld` shows pictures."""

    task: str | None = "peg-insert-side-v3"
    """Name of the task."""
    fps: int = 80
    """Steps a second."""
    objects: int | None = None
    """Number of objects that the observation tells of, one or two; None: as many as the task has."""
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(4,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(4,)),
            "environment_state": PolicyFeature(type=FeatureType.ENV, shape=(10,)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {ACTION: ACTION, "agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}
    )

    @property
    def gym_id(self) -> str:
        return "lerobot_unimask/MetaWorld-v0"

    @property
    def gym_kwargs(self) -> Mapping[str, Any]:
        return {**super().gym_kwargs, "task": self.task, "objects": self.objects}


@EnvConfig.register_subclass("gymnasium")
@dataclass
class GymnasiumEnvConfig(UniMASKEnvConfig):
    """`--env.type=gymnasium --env.task=Pendulum-v1`: any gymnasium environment with continuous actions, as
    one that reports what it has paid so far.

    Raises:
        ValueError: no task is named, or its actions are not continuous.
    """

    task: str | None = None
    """gymnasium id of the environment."""
    package: str | None = None
    """Package whose import registers the environment, such as gym_pusht."""
    fps: int = 30
    """Steps a second."""

    def __post_init__(self) -> None:
        if self.task is None:
            raise ValueError("Which environment? --env.type=gymnasium needs --env.task=ITS-GYMNASIUM-ID.")
        if self.package:
            importlib.import_module(self.package)
        env = self._make()
        if not isinstance(env.action_space, gym.spaces.Box):
            raise ValueError(f"{self.task} takes {env.action_space}; --env.type=gymnasium takes continuous actions.")
        own = {
            name: space
            for name, space in cast(gym.spaces.Dict, env.observation_space).spaces.items()
            if len(space.shape or ()) == 1
        }
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, env.action_space.shape)}
        self.features |= {name: PolicyFeature(FeatureType.STATE, space.shape) for name, space in own.items()}
        self.features_map |= {name: f"observation.{name}" for name in own if name not in self.features_map}
        env.close()

    def _make(self) -> gym.Env:
        return ReportReturn(gym.make(str(self.task), disable_env_checker=True, **self.gym_kwargs))

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """As the other environments'."""
        return {self.type: {0: SyncVectorEnv([self._make] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP)}}
