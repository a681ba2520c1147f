"""Any gymnasium environment as one that reports what it has paid so far, as asking for a return needs."""

from typing import Any

import gymnasium as gym
import numpy as np


class ReportReturn(gym.Wrapper):
    """Observations as a dictionary: the environment's own, and `return_so_far`, (1,), the sum of rewards received.

    An environment that observes an array observes it as `agent_pos`, LeRobot's name for what becomes
    `observation.state`.
    """

    def __init__(self, env: gym.Env):
        super().__init__(env)
        spaces = env.observation_space
        self._own = dict(spaces.spaces) if isinstance(spaces, gym.spaces.Dict) else None
        own = self._own if self._own is not None else {"agent_pos": _as_float(spaces)}
        paid = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        self.observation_space = gym.spaces.Dict({**own, "return_so_far": paid})
        self._paid = 0.0

    def reset(self, **how: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        observation, info = self.env.reset(**how)
        self._paid = 0.0
        return self._with_return(observation), info

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._paid += float(reward)
        return self._with_return(observation), float(reward), terminated, truncated, info

    def _with_return(self, observation: Any) -> dict[str, Any]:
        own = observation if self._own is not None else {"agent_pos": np.asarray(observation, np.float32)}
        return {**own, "return_so_far": np.array([self._paid], np.float32)}


def _as_float(space: gym.Space) -> gym.spaces.Box:
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise ValueError(
            f"This environment observes {space}; give one that observes numbers in a row, or a dictionary."
        )
    return gym.spaces.Box(-np.inf, np.inf, space.shape, np.float32)
