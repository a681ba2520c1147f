"""How much acting should remember on MetaWorld's arm: success by `n_obs_steps`, sliding and forgetting.

    OMP_NUM_THREADS=1 uv run python tests/arm.py --policy=RUN --task=peg-insert-side-v3 --output=docs/results/FILE.json

Forgetting every h steps is `policy.reset()`, so that the window never slides; remembering h steps lets it slide.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch

import lerobot_policy_unimask  # noqa: F401 (registers)
from lerobot_unimask import UniMASKPolicy
from lerobot_unimask.envs.metaworld.environment import HORIZON, MetaWorldEnv
from lerobot_unimask.machine import describe_machine
from lerobot_unimask.records import versions, write_json

TOGETHER = 25  # episodes: one that fails costs its whole batch 500 steps


def success(policy: UniMASKPolicy, envs: list[MetaWorldEnv], seed: int, forget: int | None = None) -> dict[str, Any]:
    """Episodes from unseen starts, `TOGETHER` at once: the share that succeeds, and processor milliseconds of acting
    for a step of one of them."""
    done, spent, steps = [], 0.0, 0
    for first in range(0, len(envs), TOGETHER):
        part = envs[first : first + TOGETHER]
        succeeded, seconds, acted = _roll_out(policy, part, seed + first, forget)
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


def _roll_out(
    policy: UniMASKPolicy, envs: list[MetaWorldEnv], seed: int, forget: int | None
) -> tuple[torch.Tensor, float, int]:
    """Which episodes succeed, (N,); processor seconds of acting, and for how many steps."""
    policy.reset()
    observations = [env.reset(seed=seed + i)[0] for i, env in enumerate(envs)]
    done = torch.zeros(len(envs), dtype=torch.bool)
    spent, steps = 0.0, 0
    for step in range(HORIZON):
        if forget and step % forget == 0:
            policy.reset()
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
        if done.all():
            break
    return done, spent, steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", required=True, help="a checkpoint or a lerobot-train output folder")
    parser.add_argument("--task", required=True)
    parser.add_argument("--remember", default="1,2,3,5,10", help="values of n_obs_steps; default: %(default)s")
    parser.add_argument("--forget", default="1,3,6,10", help="steps after which all is forgotten; default: %(default)s")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=100_000)
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    policy = UniMASKPolicy.from_pretrained(arguments.policy)
    envs = [MetaWorldEnv(arguments.task, render_mode=None) for _ in range(arguments.episodes)]
    found: dict[str, dict[str, Any]] = {"remembers": {}, "forgets": {}}
    for h in map(int, filter(None, arguments.remember.split(","))):
        policy.config.n_obs_steps = h
        found["remembers"][str(h)] = success(policy, envs, arguments.seed)
        print("remembers", h, json.dumps(found["remembers"][str(h)]), flush=True)
    policy.config.n_obs_steps = None
    for h in map(int, filter(None, arguments.forget.split(","))):
        found["forgets"][str(h)] = success(policy, envs, arguments.seed, forget=h)
        print("forgets", h, json.dumps(found["forgets"][str(h)]), flush=True)
    settings = {name: str(value) for name, value in vars(arguments).items()}
    kept = ("context_length", "training_masks", "attention", "causal_share", "width", "depth", "continuous_head")
    write_json(
        arguments.output,
        {
            "what": "share of successful episodes from unseen starts, most likely actions, by what acting remembers",
            "command": settings,
            "updates": int(policy.updates),
            "policy": {name: getattr(policy.config, name) for name in kept},
            **found,
            "machine": describe_machine(),
            "versions": versions("metaworld"),
        },
    )


if __name__ == "__main__":
    main()
