"""What earns its place: the same model with one thing changed at a time, at equal updates, on Maze2D.

A variant is a set of policy settings. Every run trains one model, rolls it out with both questions, and measures how
well it predicts unseen actions, how far ahead it sees, whether its directions agree, and what it costs.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from dataset_builders.maze2d import build_maze2d
from lerobot_unimask.data.episodes import open_dataset
from lerobot_unimask.measures import measure
from lerobot_unimask.paper.study import Run, VariantsConfig, key, mean_over_seeds, run_study, write_results
from lerobot_unimask.paper.study_tables import QUESTIONS, summary_table
from lerobot_unimask.paper.table import maze_returns, mean_return
from lerobot_unimask.plots.style import COLOURS, FAINT, SMALL, WIDTH
from lerobot_unimask.training import Trainer


@dataclass
class AblationConfig(VariantsConfig):
    """A grid of runs, as its YAML file gives it."""

    name: str = "ablation"
    zero_hidden: str | None = None
    # The variant in which hidden tokens are embedded as zeros, which is no setting of the policy.
    context_lengths: list[int] = field(default_factory=lambda: [10])
    steps: int = 2000
    episodes: int = 1000
    training_episodes: int = 900
    measured_episodes: int | None = None
    # How many of those that are not trained on are measured, the first ones; None: all.
    rollouts: int = 200
    ahead: int = 5
    # Steps that the model is asked to see ahead.
    data: str = "data/maze2d"
    output: str = "outputs/ablation"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.training_episodes >= self.episodes:
            raise ValueError(f"training_episodes is {self.training_episodes}; it must be less than {self.episodes}.")
        if self.zero_hidden not in (None, *self.variants):
            raise ValueError(f"zero_hidden is {self.zero_hidden!r}; the variants are {', '.join(self.variants)}.")


def ablation(config: AblationConfig, **study: Any) -> dict[str, Any]:
    """Do what is left of the grid; write `NAME.json` and `NAME.md`, and of several context lengths `NAME.png`.

    Args:
        study: storage and workers, as `run_study` takes them.

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
    records = run_study(config.name, runs, partial(execute, config), output=output, settings=config.settings(), **study)
    record = {
        "what": "return of LeRobot's evaluation, most likely actions; error of the predicted state some steps ahead",
        "config": asdict(config),
        "summary": summary(records),
        "runs": records,
    }
    write_results(output, config.name, record, markdown(record))
    if len(config.context_lengths) > 1:
        cost_of_context(record).savefig(output / f"{config.name}.png", dpi=200)
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
    if run["row"] == config.zero_hidden:
        for embedding in trainer.policy.network.embeddings.values():
            embedding.hidden.requires_grad_(False).zero_()
    began = time.process_time()
    losses = list(trainer)
    seconds = time.process_time() - began
    policy = trainer.policy.eval()
    saved = Path(config.output) / "checkpoints" / key(run)
    policy.save_pretrained(saved)
    unseen = range(config.training_episodes, config.episodes)
    return {
        "loss": sum(losses[-100:]) / len(losses[-100:]),
        "returns": {question: maze_returns(saved, question, config.rollouts) for question in QUESTIONS.values()},
        **trainer.record(),
        "zero_hidden": run["row"] == config.zero_hidden,
        "processor_seconds_per_update": seconds / config.steps,
        **measure(policy, open_dataset(policy.config, root), unseen[: config.measured_episodes], ahead=config.ahead),
    }


def summary(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Variant, with its context length -> quantity -> mean over seeds and standard error (of one seed: over rollouts,
    where it is a return)."""
    found: dict[str, list[Mapping[str, Any]]] = {}
    for record in records:
        found.setdefault(f"{record['row']}, K = {record['context_length']}", []).append(record)
    return {row: _quantities(of_seeds) for row, of_seeds in found.items()}


def _quantities(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    quantities = {
        question: mean_return([record["returns"][question] for record in records]) for question in records[0]["returns"]
    }
    for question in records[0].get("action_error", ()):
        quantities[f"{question}_error"] = mean_over_seeds([record["action_error"][question] for record in records])
    if "ahead" in records[0]:
        quantities["error_ahead"] = mean_over_seeds([record["ahead"]["model"] for record in records])
    seconds = [record["processor_seconds_per_update"] for record in records]
    quantities["ms_per_update"] = mean_over_seeds([1000 * value for value in seconds])
    quantities["latency_ms"] = mean_over_seeds([record["latency"]["median_ms"] for record in records])
    return quantities


def markdown(record: Mapping[str, Any]) -> str:
    """The summary as a table, and what it is of."""
    config = record["config"]
    return (
        f"{config['steps']} updates of {config['batch_size']} windows, {len(config['seeds'])} seed(s), "
        f"{config['rollouts']} rollouts each, ± standard error over seeds (of one seed, over rollouts).\n\n"
        f"{summary_table(record)}\n"
    )


def cost_of_context(record: Mapping[str, Any]) -> Figure:
    """Return, cost of an update and latency against the context length, each with its standard error over seeds.

    Args:
        record: one of `ablation`, of several context lengths.
    """
    figure = Figure(figsize=(WIDTH, 2.9), layout="constrained")
    panels: dict[str, dict[str, str | None]] = {
        "mean return": {"behavior_cloning": "imitation", "reward_conditioned": "reward-conditioned"},
        "processor time per update (ms)": {"ms_per_update": None},
        "time per action (ms)": {"latency_ms": None},
    }
    lengths = record["config"]["context_lengths"]
    for axes, (title, quantities) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        for variant in record["config"]["variants"]:
            for (quantity, label), marker in zip(quantities.items(), "os", strict=False):
                cells = [record["summary"][f"{variant}, K = {K}"][quantity] for K in lengths]
                many = len(record["config"]["variants"]) > 1
                axes.errorbar(
                    lengths,
                    [cell["mean"] for cell in cells],
                    [cell["standard_error"] for cell in cells],
                    color=COLOURS[list(quantities).index(quantity)],
                    marker=marker,
                    markersize=4,
                    linewidth=1.2,
                    capsize=2,
                    label=", ".join(filter(None, [variant if many else None, label])),
                )
        axes.set_xscale("log", base=2)
        axes.set_xticks(lengths, [str(K) for K in lengths])
        axes.set_xlabel("context length K")
        axes.set_title(title, fontsize=SMALL)
        if not title.startswith("mean"):
            axes.set_ylim(bottom=0)
        axes.grid(color=FAINT)
    figure.axes[0].legend(fontsize=SMALL)
    return figure
