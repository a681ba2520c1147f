"""The environments: importing this registers their gymnasium ids and LeRobot's `--env.type` names.

The ids name their classes by text, and records are looked up when they are wanted, so no simulator is imported before
an environment is made.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register

from lerobot_unimask.envs.configs import DoorKeyEnvConfig, Maze2DEnvConfig, MetaWorldEnvConfig

if TYPE_CHECKING:
    from lerobot_unimask.envs.record import Environment

__all__ = [
    "DoorKeyEnvConfig",
    "Maze2DEnvConfig",
    "MetaWorldEnvConfig",
    "environment_of_data",
    "environment_of_states",
    "environments",
]

register(id="lerobot_unimask/DoorKey-v0", entry_point="lerobot_unimask.envs.doorkey.environment:DoorKeyEnv")
register(id="lerobot_unimask/Maze2D-v0", entry_point="lerobot_unimask.envs.maze2d.environment:Maze2DEnv")
register(id="lerobot_unimask/MetaWorld-v0", entry_point="lerobot_unimask.envs.metaworld.environment:MetaWorldEnv")


def environments() -> Iterator["Environment"]:
    """The record of each environment."""
    from lerobot_unimask.envs.doorkey.record import DOORKEY
    from lerobot_unimask.envs.maze2d.record import MAZE2D
    from lerobot_unimask.envs.metaworld.record import METAWORLD

    yield from (DOORKEY, MAZE2D, METAWORLD)


def environment_of_states(names: Sequence[str]) -> "Environment | None":
    """The environment whose states' numbers have these names."""
    return next((known for known in environments() if known.state_names == tuple(names)), None)


def environment_of_data(provenance: Mapping[str, Any]) -> "Environment | None":
    """The environment that a dataset was built in."""
    return next((known for known in environments() if known.env_id == provenance.get("environment")), None)
