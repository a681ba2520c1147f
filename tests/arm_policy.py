"""The default policy on a task of MetaWorld's arm: trained as lerobot-train does, and rolled out.

    OMP_NUM_THREADS=1 uv run python tests/arm_policy.py --root=DATA --output=docs/results/FILE.json

Episodes start as in `tests/arm.py`; `tests/arm_perceptron.py` is what to compare with. A setting can be changed:
`--settings='{"context_length": 3}'`.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch
from arm import success

import lerobot_policy_unimask  # noqa: F401 (registers)
from lerobot_unimask.data.episodes import provenance_of
from lerobot_unimask.envs.metaworld.environment import MetaWorldEnv
from lerobot_unimask.machine import describe_machine
from lerobot_unimask.records import versions, write_json
from lerobot_unimask.training import Trainer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, required=True, help="a dataset of `unimask build metaworld`, of one task")
    parser.add_argument("--settings", type=json.loads, default={}, help="of the policy; default: none changed")
    parser.add_argument("--updates", type=int, default=3000)
    parser.add_argument("--batch_size", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0, help="of weights, batches and masks; default: %(default)s")
    parser.add_argument("--remember", default="", help="values of n_obs_steps beside the default, comma-separated")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--starts", type=int, default=100_000, help="seed of the first start; default: %(default)s")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    task = provenance_of(arguments.root)["task"]
    settings: dict[str, Any] = {"mask_seed": arguments.seed, **arguments.settings}
    trainer = Trainer(
        settings, arguments.root, seed=arguments.seed, steps=arguments.updates, batch_size=arguments.batch_size
    )
    began = time.process_time()
    for _ in trainer:
        pass
    seconds = time.process_time() - began
    policy = trainer.policy.eval()
    envs = [MetaWorldEnv(task, render_mode=None) for _ in range(arguments.episodes)]
    found = {}
    for remembered in (None, *map(int, filter(None, arguments.remember.split(",")))):
        policy.config.n_obs_steps = remembered
        found[str(remembered or policy.config.context_length)] = success(policy, envs, arguments.starts)
    kept = ("context_length", "training_masks", "causal_share", "fine_inputs", "continuous_head", "dropout")
    record = {
        "what": "share of successful episodes from unseen starts, most likely actions, by what acting remembers",
        "task": task,
        "command": {name: str(value) for name, value in vars(arguments).items()},
        "train_processor_seconds": round(seconds, 1),
        "training": trainer.record(),
        "policy": {name: getattr(policy.config, name) for name in kept},
        "remembers": found,
        "machine": describe_machine(),
        "versions": versions("metaworld"),
    }
    write_json(arguments.output, record)
    print(task, round(seconds), json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
