"""LeRobot's own policies on a task of MetaWorld's arm, trained for so much time or so many updates, then rolled out.

    OMP_NUM_THREADS=1 uv run python tests/measuring/arm_others.py --root=data/peg --policy=act --seconds=130 \
        --settings='{"dim_model": 128}' --output=docs/results/FILE.json

Each call adds a run to the record; a policy has a process of its own, for memory is that process's at its most. Their
processors, optimiser and data are LeRobot's; the learning rate does not follow a schedule, for how many updates there
will be is not known. `diffusion` needs LeRobot's extra of that name. Episodes start as in `tests/measuring/arm.py`.
"""

import argparse
import json
import math
import resource
import time
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import torch
from arm import success
from lerobot.configs import FeatureType
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.sampler import EpisodeAwareSampler
from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors
from lerobot.utils.random_utils import set_seed

import lerobot_policy_unimask  # noqa: F401 (reads windows in batches)
from lerobot_unimask.data.episodes import provenance_of
from lerobot_unimask.envs.metaworld.environment import MetaWorldEnv
from lerobot_unimask.machine import describe_machine, keep_freed_memory
from lerobot_unimask.records import read_json, versions, write_json

LATENCIES = 5  # times that a chunk is planned for one environment


class Acting:
    """A policy of LeRobot's with its processors, as `success` takes a policy."""

    def __init__(self, policy: Any, before: Any, after: Any):
        self.policy, self.before, self.after = policy, before, after

    def reset(self) -> None:
        self.policy.reset()

    def select_action(self, batch: dict[str, Any]) -> torch.Tensor:
        with torch.no_grad():
            return self.after(self.policy.select_action(self.before(batch)))


def train(arguments: argparse.Namespace) -> tuple[Acting, dict[str, Any]]:
    """A policy trained until its time is spent or its updates are made, and what the record says of that."""
    set_seed(arguments.seed)
    keep_freed_memory()
    config = make_policy_config(arguments.policy, device="cpu", push_to_hub=False, **arguments.settings)
    meta = LeRobotDatasetMetadata("local/arm", root=arguments.root)
    policy = make_policy(config, ds_meta=meta)  # completes the config's features, which the windows depend on
    deltas = resolve_delta_timestamps(config, meta)
    dataset = LeRobotDataset("local/arm", root=arguments.root, delta_timestamps=deltas)
    before, after = make_pre_post_processors(config, dataset_stats=meta.stats)
    preset = config.get_optimizer_preset()
    optimizer = preset.build(policy.get_optim_params())
    sampler = EpisodeAwareSampler(
        meta.episodes["dataset_from_index"],
        meta.episodes["dataset_to_index"],
        drop_n_last_frames=getattr(config, "drop_n_last_frames", 0),
        shuffle=True,
        seed=arguments.seed,
    )
    loader = torch.utils.data.DataLoader(dataset, batch_size=arguments.batch_size, sampler=sampler)
    updates, spent, began = 0, 0.0, time.process_time()
    policy.train()
    for batch in chain.from_iterable(repeat(loader)):  # another order in each epoch
        policy.forward(before(batch))[0].backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), preset.grad_clip_norm)
        optimizer.step()
        optimizer.zero_grad()
        updates, spent = updates + 1, time.process_time() - began
        if spent >= arguments.seconds or updates == arguments.updates:
            break
    facts = {
        "updates": updates,
        "train_processor_seconds": round(spent, 1),
        "ms_per_update": round(1000 * spent / updates, 1),
        "parameters": sum(parameter.numel() for parameter in policy.parameters()),
    }
    return Acting(policy.eval(), before, after), facts


def latency(acting: Acting, config: Any) -> dict[str, float]:
    """Processor milliseconds of planning a chunk for one environment, the median, and the actions that it yields."""
    observation = {
        name: torch.zeros(1, *feature.shape)
        for name, feature in config.input_features.items()
        if feature.type is not FeatureType.VISUAL
    }
    times = []
    for _ in range(LATENCIES):
        acting.reset()
        began = time.process_time()
        acting.select_action(dict(observation))
        times.append(1000 * (time.process_time() - began))
    return {"ms_per_plan": round(sorted(times)[LATENCIES // 2], 2), "actions_per_plan": config.n_action_steps}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, required=True, help="a dataset of `unimask build metaworld`, of one task")
    parser.add_argument("--policy", required=True, help="a type of LeRobot's, such as act")
    parser.add_argument("--settings", type=json.loads, default={}, help="of the policy; default: none changed")
    parser.add_argument("--seconds", type=float, default=math.inf, help="processor time of the training; default: any")
    parser.add_argument("--updates", type=int, help="of the training; default: as many as its time allows")
    parser.add_argument("--batch_size", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=50, help="0: none, where acting takes too long")
    parser.add_argument("--starts", type=int, default=100_000)
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    acting, facts = train(arguments)
    task = provenance_of(arguments.root)["task"]
    facts |= latency(acting, acting.policy.config)
    if arguments.episodes:
        envs = [MetaWorldEnv(task, render_mode=None) for _ in range(arguments.episodes)]
        facts |= success(acting, envs, arguments.starts)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    run = {"policy": arguments.policy, "task": task, **facts, "memory_gib": round(memory, 2)}
    run["command"] = {name: str(value) for name, value in vars(arguments).items() if value is not None}
    runs = read_json(arguments.output)["runs"] if arguments.output.exists() else []
    write_json(
        arguments.output,
        {
            "what": "LeRobot's own policies on MetaWorld's arm: success from unseen starts after so much training",
            "runs": [*runs, run],
            "machine": describe_machine(),
            "versions": versions("metaworld"),
        },
    )
    print(json.dumps(run), flush=True)


if __name__ == "__main__":
    main()
