"""A loop of rollouts: what lerobot-eval does with one checkpoint, in this process."""

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from lerobot.envs.factory import make_env_config
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy_all
from lerobot.utils.random_utils import set_seed


def rollout(
    checkpoint: Path,
    env_type: str,
    episodes: int,
    *,
    batch_size: int,
    seed: int,
    environment: Mapping[str, Any] | None = None,
    **settings: Any,
) -> dict[str, Any]:
    """What lerobot-eval does with one checkpoint, videos apart.

    Args:
        environment: settings of the environment, as `--env.NAME=...`.
        settings: settings of the policy, in place of the checkpoint's, as `--policy.NAME=...`.

    Returns:
        mean return, its standard error, the share of successes, and the seconds that it took.
    """
    set_seed(seed)
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    for name, value in settings.items():
        setattr(config, name, value)
    env_config = make_env_config(env_type, **(environment or {}))
    envs = make_env(env_config, n_envs=batch_size)
    policy = make_policy(config, env_cfg=env_config)
    preprocessor, postprocessor = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    env_preprocessor, env_postprocessor = make_env_pre_post_processors(env_config, config)
    began = time.monotonic()
    with torch.no_grad():
        info = eval_policy_all(
            envs,
            policy,
            env_preprocessor,
            env_postprocessor,
            preprocessor,
            postprocessor,
            n_episodes=episodes,
            start_seed=seed,
        )
    close_envs(envs)
    metrics = [task["metrics"] for task in info["per_task"]]
    returns = torch.tensor([value for task in metrics for value in task["sum_rewards"]])[:episodes]
    successes = [value for task in metrics for value in task["successes"]][:episodes]
    return {
        "updates": int(policy.updates),
        "mean_return": returns.mean().item(),
        "standard_error": returns.std().item() / math.sqrt(len(returns)),
        "success": sum(successes) / len(successes),
        "episodes": len(returns),
        "seconds": round(time.monotonic() - began, 1),
    }
