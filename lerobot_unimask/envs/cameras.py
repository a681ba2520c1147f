"""What the environments with a camera share: LeRobot's `obs_type`, and its name for pictures, `pixels`."""

import gymnasium as gym
import numpy as np

OBS_TYPES = ("state", "pixels_agent_pos")


def check_obs_type(obs_type: str) -> str:
    """
    Raises:
        ValueError: another one.
    """
    if obs_type not in OBS_TYPES:
        raise ValueError(f"obs_type is {obs_type!r}; choose one of {', '.join(OBS_TYPES)}.")
    return obs_type


def pixels_space(shape: tuple[int, ...]) -> gym.spaces.Dict:
    """Of one camera, `top`, (height, width, 3)."""
    return gym.spaces.Dict({"top": gym.spaces.Box(0, 255, shape, np.uint8)})
