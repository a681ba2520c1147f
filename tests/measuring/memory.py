"""How much acting should remember in an environment: rollouts of one checkpoint by `n_obs_steps`.

    OMP_NUM_THREADS=1 uv run python tests/measuring/memory.py --policy=RUN --env=maze2d --output=docs/results/FILE.json

Each call adds a run to the record.
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
from lerobot_unimask.records import read_json, versions, write_json

KEPT = ("training_masks", "attention", "causal_share", "width", "depth", "dropout", "fine_inputs", "continuous_head")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", type=Path, required=True, help="a checkpoint or a lerobot-train output folder")
    parser.add_argument("--env", required=True, help="LeRobot's --env.type")
    parser.add_argument("--remember", default="1,2,3,5,10", help="n_obs_steps beside K; default: %(default)s")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--batch_size", type=int, default=100, help="episodes at a time; default: %(default)s")
    parser.add_argument("--seed", type=int, default=100_000)
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    checkpoint = Path(last_checkpoint(arguments.policy))
    config = PreTrainedConfig.from_pretrained(checkpoint)
    run: dict[str, Any] = {
        "task": arguments.env,
        "context_length": config.context_length,
        "policy": {name: getattr(config, name) for name in KEPT},
        "command": {name: str(value) for name, value in vars(arguments).items()},
        "remembers": {},
    }
    fewer = [h for h in map(int, arguments.remember.split(",")) if h < config.context_length]
    for h in [*fewer, config.context_length]:
        run["remembers"][str(h)] = rollout(
            checkpoint,
            arguments.env,
            arguments.episodes,
            batch_size=arguments.batch_size,
            seed=arguments.seed,
            n_obs_steps=h,
        )
        run["updates"] = run["remembers"][str(h)].pop("updates")
        print("remembers", h, json.dumps(run["remembers"][str(h)]), flush=True)
    write_json(
        arguments.output,
        {
            "what": "return of rollouts from unseen starts, most likely actions, by how many steps acting remembers",
            "runs": [*(read_json(arguments.output)["runs"] if arguments.output.exists() else []), run],
            "machine": describe_machine(),
            "versions": versions(),
        },
    )


if __name__ == "__main__":
    main()
