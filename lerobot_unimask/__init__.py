"""UniMASK for LeRobot: importing this package registers the policy `unimask` and its environments."""

from lerobot_unimask import envs  # noqa: F401 (registers them)
from lerobot_unimask.asking.answers import Answer
from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data import reads
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import TASKS, Mask
from lerobot_unimask.modeling_unimask import UniMASKPolicy
from lerobot_unimask.sharing import hub

__all__ = ["TASKS", "Answer", "Mask", "MaskError", "UniMASKConfig", "UniMASKPolicy", "Window"]

reads.install()
hub.install()
