"""UniMASK for LeRobot: one masked sequence model that answers any question about behaviour.

The public names are loaded when they are first used, so that a command line's help loads neither torch nor LeRobot;
using one registers the policy and the environments with LeRobot, as LeRobot's own plugin discovery does.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lerobot_unimask.asking.answers import Answer
    from lerobot_unimask.configuration_unimask import UniMASKConfig
    from lerobot_unimask.data.window import Window
    from lerobot_unimask.language.grammar import MaskError
    from lerobot_unimask.language.masks import TASKS, Mask
    from lerobot_unimask.modeling_unimask import UniMASKPolicy

__all__ = ["TASKS", "Answer", "Mask", "MaskError", "UniMASKConfig", "UniMASKPolicy", "Window"]

_ROOMS = {
    "TASKS": "language.masks",
    "Answer": "asking.answers",
    "Mask": "language.masks",
    "MaskError": "language.grammar",
    "UniMASKConfig": "configuration_unimask",
    "UniMASKPolicy": "modeling_unimask",
    "Window": "data.window",
}


def __getattr__(name: str) -> Any:
    if name not in _ROOMS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    importlib.import_module("lerobot_policy_unimask")  # registers
    return getattr(importlib.import_module(f"{__name__}.{_ROOMS[name]}"), name)
