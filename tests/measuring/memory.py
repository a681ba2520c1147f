"""How much acting should remember in an environment: rollouts of one checkpoint by `n_obs_steps`.

OMP_NUM_THREADS=1 uv run python tests/measuring/memory.py --policy=RUN --env=maze2d --output=docs/results/FILE.json
"""

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig

import lerobot_policy_unimask  # noqa: F401 (registers)
from lerobot_unimask.data.checkpoints import last_checkpoint
from lerobot_unimask.evaluating import rollout
from lerobot_unimask.machine import describe_machine
from lerobot_unimask.records import versions, write_json


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", type=Path, required=True, help="a checkpoint or a lerobot-train output folder")
    parser.add_argument("--env", required=True, help="LeRobot's --env.type")
    parser.add_argument("--remember", default="1,2,3,5,10,20", help="values of n_obs_steps; default: %(default)s")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--batch_size", type=int, default=100, help="episodes at a time; default: %(default)s")
    parser.add_argument("--seed", type=int, default=100_000)
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    checkpoint = Path(last_checkpoint(arguments.policy))
    found: dict[str, Any] = {}
    for h in map(int, arguments.remember.split(",")):
        found[str(h)] = rollout(
            checkpoint,
            arguments.env,
            arguments.episodes,
            batch_size=arguments.batch_size,
            seed=arguments.seed,
            n_obs_steps=h,
        )
        print("remembers", h, json.dumps(found[str(h)]), flush=True)
    config = PreTrainedConfig.from_pretrained(checkpoint)
    kept = ("context_length", "training_masks", "attention", "causal_share", "width", "depth", "continuous_head")
    write_json(
        arguments.output,
        {
            "what": "return of rollouts from unseen starts, most likely actions, by how many steps acting remembers",
            "command": {name: str(value) for name, value in vars(arguments).items()},
            "policy": {name: getattr(config, name) for name in kept},
            "remembers": found,
            "machine": describe_machine(),
            "versions": versions(),
        },
    )


if __name__ == "__main__":
    main()
