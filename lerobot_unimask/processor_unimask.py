"""LeRobot's processors for `unimask`: naming, batching and devices.

The steps are LeRobot's own, with its own names, because lerobot-train overrides them by name. The normalisation mapping
is the identity throughout: only the policy normalises, so that everything outside it is in the dataset's units.
"""

from typing import Any

import torch
from lerobot.lerobot_types import PolicyAction
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.factory import make_default_pre_post_processors

from lerobot_unimask.configuration_unimask import UniMASKConfig


def make_unimask_pre_post_processors(
    config: UniMASKConfig,
    dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """LeRobot's default pipelines, found by this function's name."""
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)
