"""What LeRobot's plugin discovery imports, by the distribution's name: registers policy and environments, and applies
the changes to LeRobot that `lerobot_unimask/lerobot_patches.py` lists."""

from lerobot_unimask import envs, lerobot_patches
from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.modeling_unimask import UniMASKPolicy

__all__ = ["UniMASKConfig", "UniMASKPolicy", "envs"]

lerobot_patches.apply()
