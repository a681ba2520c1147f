"""The default policy on tasks of MetaWorld's arm, one for each task or one for all, beside a perceptron; windows and
memories of several lengths.

    OMP_NUM_THREADS=1 uv run python tests/measuring/arm_tasks.py --roots=data/peg,data/hammer --seeds=0,1 \
        --output=docs/results/FILE.json

Trained as lerobot-train does, then rolled out from unseen starts, the same for every model and seed. Each run stands in
the record as soon as it is done, and what stands there is not run again; nor is a policy trained that `--save` kept.
A setting can be changed: `--settings='{"width": 256}'`. A dataset of several tasks makes one policy that is told the
task. `--windows=2,5,10,20 --remember=1,2,3,5,10` trains a policy for each length of window and rolls it out with each
memory that is shorter, too.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import arm_perceptron
import torch
from arm import success

import lerobot_policy_unimask  # noqa: F401 (registers)
from lerobot_unimask import UniMASKConfig, UniMASKPolicy
from lerobot_unimask.data.episodes import provenance_of, read_info
from lerobot_unimask.envs.metaworld.environment import OBJECT, MetaWorldEnv
from lerobot_unimask.machine import describe_machine
from lerobot_unimask.records import read_json, versions, write_json
from lerobot_unimask.training import Trainer

KEPT = ("context_length", "n_obs_steps", "training_masks", "causal_share", "fine_inputs", "continuous_head", "dropout")
DEFAULT = UniMASKConfig().context_length


def train(root: Path, seed: int, K: int, arguments: argparse.Namespace) -> tuple[UniMASKPolicy, dict[str, Any]]:
    """A policy, and what the record says of its training."""
    settings = {"mask_seed": seed, **arguments.settings} | ({} if K == DEFAULT else {"context_length": K})
    trainer = Trainer(settings, root, seed=seed, steps=arguments.updates, batch_size=arguments.batch_size)
    began = time.process_time()
    for _ in trainer:
        pass
    spent = time.process_time() - began
    return trainer.policy.eval(), {"train_processor_seconds": round(spent, 1), **trainer.record()}


def policy_runs(root: Path, seed: int, K: int, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """One policy trained on a dataset, and its success on each of the dataset's tasks."""
    folder = arguments.save and arguments.save / f"{root.name}_{seed}{'' if K == DEFAULT else f'_k{K}'}"
    if folder and folder.exists():
        policy, facts = UniMASKPolicy.from_pretrained(folder), {}
    else:
        policy, facts = train(root, seed, K, arguments)
        if folder:
            policy.save_pretrained(folder)
    facts |= {"updates": int(policy.updates), "policy": {name: getattr(policy.config, name) for name in KEPT}}
    tasks, found = provenance_of(root)["task"].split(","), []
    objects = read_info(root)["features"]["observation.environment_state"]["shape"][0] // OBJECT
    for task in tasks:
        envs = [MetaWorldEnv(task, objects, render_mode=None) for _ in range(arguments.episodes)]
        found.append({"task": task, **facts, **success(policy, envs, arguments.starts)})
        for h in arguments.remember:
            if h < K:
                policy.config.n_obs_steps = h
                found[-1].setdefault("remembers", {})[str(h)] = success(policy, envs, arguments.starts)
        policy.config.n_obs_steps = None
    return found


def perceptron_runs(root: Path, seed: int, updates: int, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """A perceptron trained on a dataset of one task, and its success."""
    task = provenance_of(root)["task"]
    facts = arm_perceptron.run(root, task, seed, updates, arguments.episodes, arguments.starts)
    return [{"task": task, "updates": updates, **facts}]


def numbers(text: str) -> list[int]:
    """Comma-separated numbers."""
    return [int(number) for number in text.split(",") if number]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--roots", required=True, help="datasets of `unimask build metaworld`, comma-separated")
    parser.add_argument(
        "--seeds", type=numbers, default="0,1", help="of weights, batches and masks; default: %(default)s"
    )
    parser.add_argument("--settings", type=json.loads, default={}, help="of the policy; default: none changed")
    parser.add_argument("--windows", type=numbers, default=[DEFAULT], help="K, a policy for each")
    parser.add_argument("--remember", type=numbers, default=[], help="steps, fewer than K, that acting also remembers")
    parser.add_argument("--updates", type=int, default=1500, help="of the policy; default: %(default)s")
    parser.add_argument("--batch_size", type=int, default=64)
    parser.add_argument(
        "--perceptron", type=numbers, default="5000,20000", help="its updates, a run for each; default: %(default)s"
    )
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--starts", type=int, default=100_000, help="seed of the first start; default: %(default)s")
    parser.add_argument(
        "--save", type=Path, help="folder for the policies, NAME_SEED or NAME_SEED_kK; default: none is kept"
    )
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    record: dict[str, Any] = {
        "what": "share of successful episodes from unseen starts, most likely actions",
        "command": {name: str(value) for name, value in vars(arguments).items() if value is not None},
        "machine": describe_machine(),
        "versions": versions("metaworld"),
        "runs": read_json(arguments.output)["runs"] if arguments.output.exists() else [],
    }
    wanted = [
        (model, Path(root), seed, K, updates)
        for seed in arguments.seeds
        for root in arguments.roots.split(",")
        for model, K, updates in [
            *(("unimask", K, arguments.updates) for K in arguments.windows),
            *(("perceptron", None, updates) for updates in arguments.perceptron),
        ]
    ]
    for model, root, seed, K, updates in wanted:
        names = {"model": model, "data": root.name, "seed": seed}
        names |= {"context_length": K} if K else {}
        if any(run["updates"] == updates and names.items() <= run.items() for run in record["runs"]):
            continue
        found = policy_runs(root, seed, K, arguments) if K else perceptron_runs(root, seed, updates, arguments)
        record["runs"] += [{**names, **run} for run in found]
        write_json(arguments.output, record)
        for run in found:
            print(model, root.name, seed, run["task"], updates, run["success"], run.get("train_processor_seconds"))


if __name__ == "__main__":
    main()
