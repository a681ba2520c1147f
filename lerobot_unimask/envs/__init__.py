"""The environments: importing this registers their gymnasium ids and LeRobot's `--env.type` names.

The ids name their classes by text, so no simulator is imported before an environment is made.
"""

from gymnasium.envs.registration import register

from lerobot_unimask.envs.configs import DoorKeyEnvConfig, Maze2DEnvConfig

__all__ = ["DoorKeyEnvConfig", "Maze2DEnvConfig"]

register(id="lerobot_unimask/DoorKey-v0", entry_point="lerobot_unimask.envs.doorkey.environment:DoorKeyEnv")
register(id="lerobot_unimask/Maze2D-v0", entry_point="lerobot_unimask.envs.maze2d.environment:Maze2DEnv")
