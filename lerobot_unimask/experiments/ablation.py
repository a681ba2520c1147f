"""What earns its place: the same model with one thing changed at a time, at equal updates, on Maze2D.

A variant is a set of policy settings. Every run trains one model, rolls it out with both questions, and measures how
well it predicts unseen actions, how far ahead it sees, whether its directions agree, and what it costs.
"""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from lerobot.policies.factory import make_pre_post_processors

from dataset_builders.maze2d import build_maze2d
from lerobot_unimask import plots
from lerobot_unimask.experiments.learning_curve import rollouts
from lerobot_unimask.experiments.measures import latency, measure
from lerobot_unimask.experiments.study import Run, key, run_study
from lerobot_unimask.experiments.training import Trainer

QUESTIONS = ("behavior_cloning", "reward_conditioned")


@dataclass
class AblationConfig:
    """A grid of runs, as its YAML file gives it."""

    name: str = "ablation"
    # Of the study: runs of the same name in the same storage are shared.
    variants: dict[str, dict[str, Any]] = field(default_factory=lambda: {"default": {}})
    # Name -> settings of the policy that differ from `policy`.
    zero_hidden: list[str] = field(default_factory=list)
    # Variants in which hidden tokens are embedded as zeros, which is no setting of the policy.
    context_lengths: list[int] = field(default_factory=lambda: [10])
    seeds: list[int] = field(default_factory=lambda: [0, 1])
    steps: int = 2000
    batch_size: int = 100
    episodes: int = 1000
    training_episodes: int = 900
    rollouts: int = 200
    ahead: int = 5
    # Steps that the model is asked to see ahead.
    policy: dict[str, Any] = field(default_factory=dict)
    data: str = "data/maze2d"
    # The dataset, which is built where it is missing.
    output: str = "outputs/ablation"
    # Folder of the records, the table, the figure and the study's file.

    def __post_init__(self) -> None:
        if not self.variants or not self.context_lengths or not self.seeds:
            raise ValueError("An ablation needs at least one variant, context length and seed.")
        if any("/" in name for name in self.variants):
            raise ValueError("A variant gives its files their names: leave '/' out of it.")
        if unknown := set(self.zero_hidden) - self.variants.keys():
            raise ValueError(f"zero_hidden names {unknown.pop()!r}; the variants are {', '.join(self.variants)}.")
        if min(self.steps, self.rollouts, self.training_episodes) < 1 or self.training_episodes >= self.episodes:
            raise ValueError("steps and rollouts are at least 1, training_episodes too and fewer than episodes.")


def ablation(config: AblationConfig, *, storage: str | None = None, workers: int = 1, **study: Any) -> dict[str, Any]:
    """Do what is left of the grid; write `NAME.json`, `NAME.md` and `NAME.png`.

    Returns:
        The record that the JSON holds.
    """
    root = Path(config.data)
    if not (root / "meta" / "info.json").exists():
        build_maze2d(root, episodes=config.episodes, seed=0, progress=False)
    runs = [
        {"row": variant, "context_length": K, "seed": seed}
        for seed in config.seeds
        for K in config.context_lengths
        for variant in config.variants
    ]
    output = Path(config.output)
    axes = ("name", "variants", "zero_hidden", "context_lengths", "seeds", "output")
    settings = {name: value for name, value in asdict(config).items() if name not in axes}
    settings |= {
        f"variants.{name}": variant | {"zero_hidden": name in config.zero_hidden}
        for name, variant in config.variants.items()
    }
    do = partial(run_study, config.name, runs, partial(execute, config), output=output, settings=settings)
    records = do(storage=storage, workers=workers, **study)
    record = {
        "what": "return of LeRobot's evaluation, most likely actions; error of the predicted state some steps ahead",
        "config": asdict(config),
        "summary": summary(records),
        "runs": records,
    }
    (output / f"{config.name}.json").write_text(json.dumps(record, indent=2) + "\n")
    (output / f"{config.name}.md").write_text(markdown(record))
    if len(config.context_lengths) > 1:
        plots.cost_of_context(record).savefig(output / f"{config.name}.png", dpi=200)
    return record


def execute(config: AblationConfig, run: Run) -> dict[str, Any]:
    """One run: train, save, roll out, measure."""
    settings = {**config.policy, "push_to_hub": False, "context_length": run["context_length"]}
    settings |= config.variants[run["row"]]
    root = Path(config.data)
    trainer = Trainer(
        settings,
        root,
        seed=run["seed"],
        steps=config.steps,
        batch_size=config.batch_size,
        episodes=list(range(config.training_episodes)),
    )
    if run["row"] in config.zero_hidden:
        for embedding in trainer.policy.network.embeddings.values():
            embedding.hidden.requires_grad_(False).zero_()
    began = time.process_time()
    losses = list(trainer)
    seconds = time.process_time() - began
    policy = trainer.policy.eval()
    saved = Path(config.output) / "checkpoints" / key(run)
    policy.save_pretrained(saved)
    for processor in make_pre_post_processors(policy.config):
        processor.save_pretrained(saved)
    returns = {}
    for question in QUESTIONS:
        asked = {"inference_mask": question, "target_return": "auto" if question == "reward_conditioned" else None}
        returns[question] = rollouts(
            saved, "maze2d", config.rollouts, batch_size=min(100, config.rollouts), seed=100_000, **asked
        )
    return {
        "loss": sum(losses[-100:]) / len(losses[-100:]),
        "returns": returns,
        "steps": config.steps,
        "batch_size": config.batch_size,
        "settings": settings,
        "zero_hidden": run["row"] in config.zero_hidden,
        "parameters": sum(parameter.numel() for parameter in policy.network.parameters()),
        "processor_seconds_per_update": seconds / config.steps,
        "latency": latency(policy),
        "device": str(policy.device),
        **measure(policy, root, range(config.training_episodes, config.episodes), ahead=config.ahead),
    }


def summary(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Variant, with its context length -> quantity -> mean over seeds and standard error (of one seed: over rollouts,
    where it is a return)."""
    found: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for record in records:
        cells = found.setdefault(f"{record['row']}, K = {record['context_length']}", {})
        for question, result in record["returns"].items():
            cells.setdefault(question, []).append((result["mean_return"], result["standard_error"]))
        if "action_error" in record:
            for question, error in record["action_error"].items():
                cells.setdefault(f"{question}_error", []).append((error, 0.0))
        if "ahead" in record:
            cells.setdefault("error_ahead", []).append((record["ahead"]["model"], 0.0))
        cells.setdefault("ms_per_update", []).append((1000 * record["processor_seconds_per_update"], 0.0))
        cells.setdefault("latency_ms", []).append((record["latency"]["median_ms"], 0.0))
    return {row: {name: _mean(values) for name, values in cells.items()} for row, cells in found.items()}


def _mean(values: Sequence[tuple[float, float]]) -> dict[str, float]:
    numbers = torch.tensor([value for value, _ in values], dtype=torch.float64)
    n = len(numbers)
    error = numbers.std().item() / math.sqrt(n) if n > 1 else values[0][1]
    return {"mean": numbers.mean().item(), "standard_error": error, "seeds": n}


def markdown(record: Mapping[str, Any]) -> str:
    """The summary as a table."""
    config = record["config"]
    columns = {
        "behavior_cloning": "imitation",
        "reward_conditioned": "reward-conditioned",
        "behavior_cloning_error": "error of the imitated action",
        "reward_conditioned_error": "of the reward-conditioned one",
        "error_ahead": f"error {config['ahead']} steps ahead",
        "ms_per_update": "ms of processor per update",
        "latency_ms": "ms per action",
    }
    digits = dict.fromkeys(columns, 2) | {"error_ahead": 4, "ms_per_update": 0, "latency_ms": 1}
    digits |= {"behavior_cloning_error": 3, "reward_conditioned_error": 3}
    lines = [
        f"{config['steps']} updates of {config['batch_size']} windows, {len(config['seeds'])} seed(s), "
        f"{config['rollouts']} rollouts each, ± standard error over seeds (of one seed, over rollouts).\n",
        "| variant | " + " | ".join(columns.values()) + " |",
        "| --- " * (1 + len(columns)) + "|",
    ]
    for row, cells in record["summary"].items():
        texts = [_text(cells.get(name), digits[name]) for name in columns]
        lines.append(f"| {row} | " + " | ".join(texts) + " |")
    return "\n".join(lines) + "\n"


def _text(cell: Mapping[str, float] | None, digits: int) -> str:
    if cell is None:
        return ""
    error = f" ± {cell['standard_error']:.{digits}f}" if cell["standard_error"] else ""
    return f"{cell['mean']:.{digits}f}{error}"
