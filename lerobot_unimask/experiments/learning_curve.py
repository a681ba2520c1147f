"""Return against updates: every checkpoint of a run, rolled out with LeRobot's own evaluation."""

import math
import platform
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from lerobot.envs.factory import make_env_config
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy_all
from lerobot.utils.random_utils import set_seed

from lerobot_unimask.experiments.validation import checkpoints_of, training_settings


def rollouts(
    checkpoint: Path, env_type: str, episodes: int, *, batch_size: int, seed: int, **settings: Any
) -> dict[str, Any]:
    """What lerobot-eval does with one checkpoint, videos apart.

    Args:
        settings: of the policy, in place of the checkpoint's, as `--policy.NAME=...`.

    Returns:
        mean return, its standard error, the share of successes, and the seconds that it took.
    """
    set_seed(seed)
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    for name, value in settings.items():
        setattr(config, name, value)
    env_config = make_env_config(env_type)
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


def learning_curve(
    runs: Sequence[Path], env_type: str, *, episodes: int, last_episodes: int, batch_size: int, seed: int
) -> dict[str, Any]:
    """A JSON record of each run's checkpoints.

    Args:
        episodes: rollouts of each checkpoint, with the same starts for all.
        last_episodes: rollouts of the last one, whose mean is what the run is judged by.
    """
    records = []
    for run in runs:
        checkpoints = checkpoints_of(run)
        points = []
        for path in checkpoints:
            count = last_episodes if path == checkpoints[-1] else episodes
            points.append(rollouts(path, env_type, count, batch_size=min(batch_size, count), seed=seed))
            result = "{updates} updates: return {mean_return:.3f} +- {standard_error:.3f} over {episodes}".format(
                **points[-1]
            )
            print(f"{run.name}: {result}, {points[-1]['seconds']} s", flush=True)
        records.append(
            {
                "run": run.name,
                "checkpoints": points,
                "training_seconds_per_update": _seconds_per_update(checkpoints, points),
                "training": training_settings(checkpoints[-1]),
            }
        )
    return {
        "what": "mean return of LeRobot's evaluation, most likely actions unless the settings say otherwise",
        "environment": env_type,
        "seed": seed,
        "runs": records,
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("torch", "lerobot", "lerobot_policy_unimask")},
        },
    }


def _seconds_per_update(checkpoints: Sequence[Path], points: Sequence[dict[str, Any]]) -> float | None:
    """Wall time of training from the first checkpoint to the last, evaluations in between included."""
    if len(checkpoints) < 2:
        return None
    first, last = ((path / "model.safetensors").stat().st_mtime for path in (checkpoints[0], checkpoints[-1]))
    return round((last - first) / (points[-1]["updates"] - points[0]["updates"]), 4)
