"""UniMASK for LeRobot: importing this package registers the policy `unimask` and its environments."""

from lerobot_unimask import envs, hub, reads  # noqa: F401  (importing envs registers them)
from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.inference import Answer
from lerobot_unimask.masks import TASKS, Mask, MaskError
from lerobot_unimask.modeling_unimask import UniMASKPolicy
from lerobot_unimask.window import Window

__all__ = ["TASKS", "Answer", "Mask", "MaskError", "UniMASKConfig", "UniMASKPolicy", "Window"]

reads.install()
hub.install()
