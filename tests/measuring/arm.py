"""Rollouts on MetaWorld's arm, as `tests/measuring/arm_tasks.py` and `tests/measuring/arm_others.py` measure them."""

import time
from typing import Any

import torch

from lerobot_unimask import UniMASKPolicy
from lerobot_unimask.envs.metaworld.environment import HORIZON, MetaWorldEnv

TOGETHER = 25  # episodes: one that fails costs its whole batch 500 steps


def success(policy: UniMASKPolicy, envs: list[MetaWorldEnv], seed: int) -> dict[str, Any]:
    """Episodes from unseen starts, `TOGETHER` at once: the share that succeeds, and processor milliseconds of acting
    for a step of one of them."""
    done, spent, steps = [], 0.0, 0
    for first in range(0, len(envs), TOGETHER):
        part = envs[first : first + TOGETHER]
        succeeded, seconds, acted = _roll_out(policy, part, seed + first)
        done.append(succeeded)
        spent, steps = spent + seconds, steps + acted * len(part)
    share = torch.cat(done).float().mean().item()
    error = (share * (1 - share) / len(envs)) ** 0.5
    return {
        "success": round(share, 4),
        "standard_error": round(error, 4),
        "episodes": len(envs),
        "acting_ms_per_episode_step": round(1000 * spent / steps, 3),
    }


def _roll_out(policy: UniMASKPolicy, envs: list[MetaWorldEnv], seed: int) -> tuple[torch.Tensor, float, int]:
    """Which episodes succeed, (N,); processor seconds of acting, and for how many steps."""
    policy.reset()
    observations = [env.reset(seed=seed + i)[0] for i, env in enumerate(envs)]
    done = torch.zeros(len(envs), dtype=torch.bool)
    spent, steps = 0.0, 0
    while steps < HORIZON and not done.all():
        batch: dict[str, Any] = {
            f"observation.{key}": torch.tensor([one[name] for one in map(dict, observations)])
            for key, name in (("state", "agent_pos"), ("environment_state", "environment_state"))
        }
        batch["task"] = [env.task_description for env in envs]
        began = time.process_time()
        actions = policy.select_action(batch)
        spent, steps = spent + time.process_time() - began, steps + 1
        for i in (~done).nonzero().flatten().tolist():
            observations[i], _, succeeded, _, _ = envs[i].step(actions[i].numpy())
            done[i] = succeeded
    return done, spent, steps
