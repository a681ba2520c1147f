"""The paper's Maze2D table: returns of behaviour cloning and reward conditioning by model and context length.

Every run trains one model for the same number of updates and rolls it out with LeRobot's evaluation, with its most
likely actions. Rows that answer both questions (multi-task, random masks) are trained once and rolled out twice.
Fine-tuning makes further updates, stated in the table, on weights of the same seed.

Note: The paper stops early by the evaluation's reward, which chooses by what is reported; here the last weights count.
    It gives models of longer contexts fewer updates; here all have the same.
"""

import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from dataset_builders.maze2d import build_maze2d
from lerobot_unimask.data.factors import RETURN_TO_GO, STATE
from lerobot_unimask.data.returns import read_starts
from lerobot_unimask.evaluating import rollout
from lerobot_unimask.paper.study import Run, StudyConfig, check_rows, key, mean_over_seeds, run_study, write_results
from lerobot_unimask.paper.study_tables import QUESTIONS, returns_table
from lerobot_unimask.training import Trainer

BOTH = "both"

# Row -> settings of a model that answers both questions. Without training_masks: one model for each question.
ROWS: dict[str, dict[str, Any]] = {
    "unimask_single_task": {},
    "unimask_multi_task": {"training_masks": list(QUESTIONS.values())},
    "unimask_random_mask": {"training_masks": "random_mask"},
    "acts_and_asks": {"training_masks": "random_mask", "attention": "both"},
    "acts_and_asks_gaussian": {"training_masks": "random_mask", "attention": "both", "continuous_head": "gaussian"},
    "feedforward": {"network": "feedforward", "attention": None},
    "decision_transformer": {"network": "decision_transformer", "attention": None},
    "decision_gpt": {"attention": "causal"},
}

FINETUNED = {  # row -> the one whose weights it goes on from
    "unimask_multi_task_finetune": "unimask_multi_task",
    "unimask_random_mask_finetune": "unimask_random_mask",
}


@dataclass
class TableConfig(StudyConfig):
    """A grid of runs, as its YAML file gives it."""

    name: str = "maze_table"
    rows: list[str] = field(default_factory=lambda: [*ROWS, *FINETUNED])
    context_lengths: list[int] = field(default_factory=lambda: [5, 10])
    steps: int = 16000
    finetune_steps: int = 4000
    episodes: int = 1000
    training_episodes: int = 900
    rollouts: int = 1000
    finetune_policy: dict[str, Any] = field(default_factory=dict)
    # Settings that fine-tuning changes.
    data: str = "data/maze2d"
    output: str = "outputs/maze_table"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rows(self.rows, ROWS, FINETUNED)


def table(config: TableConfig, **study: Any) -> dict[str, Any]:
    """Do what is left of the grid; write `table.json` and `table.md`.

    Args:
        study: storage and workers, as `run_study` takes them.

    Returns:
        The record that `table.json` holds.
    """
    root = Path(config.data)
    if not (root / "meta" / "info.json").exists():
        build_maze2d(root, episodes=config.episodes, seed=0, progress=False)
    grid = [(K, seed) for K in config.context_lengths for seed in config.seeds]

    def runs(rows: Sequence[str]) -> list[Run]:
        return [
            {"row": row, "task": task, "context_length": K, "seed": seed}
            for K, seed in grid
            for row in rows
            for task in ((BOTH,) if "training_masks" in ROWS.get(row, {}) else QUESTIONS.values())
        ]

    output = Path(config.output)
    share = partial(
        run_study, config.name, execute=partial(execute, config), output=output, settings=config.settings(), **study
    )
    records = share(runs=runs([row for row in config.rows if row in ROWS]))
    tuned = runs([row for row in config.rows if row in FINETUNED])
    if tuned:  # needs the others' weights
        records += share(runs=tuned)
    states, returns = read_starts(root, [STATE], RETURN_TO_GO)
    record = {
        "what": "mean return of LeRobot's evaluation, most likely actions; standard errors over seeds",
        "config": asdict(config),
        "expert": returns.mean().item(),
        "bound": (states[:, :2] - states[:, 2:]).norm(dim=1).mean().item(),
        "returns": summary(records),
        "runs": records,
    }
    write_results(output, "table", record, markdown(record))
    return record


def execute(config: TableConfig, run: Run) -> dict[str, Any]:
    """One run: train, save, roll out."""
    checkpoints = Path(config.output) / "checkpoints"
    before = None
    if run["row"] in FINETUNED:
        before = checkpoints / key({**run, "row": FINETUNED[run["row"]], "task": BOTH})
        if not before.exists():
            raise FileNotFoundError(f"{before} is not here: that model was trained on another machine.")
        settings = {"training_masks": run["task"], **config.finetune_policy}
    else:
        settings = {**config.policy, "push_to_hub": False, "context_length": run["context_length"]}
        settings |= {"training_masks": run["task"]} | ROWS[run["row"]]
    trainer = Trainer(
        settings,
        Path(config.data),
        seed=run["seed"],
        steps=config.finetune_steps if before else config.steps,
        batch_size=config.batch_size,
        checkpoint=before,
        episodes=list(range(config.training_episodes)),
    )
    losses = list(trainer)
    saved = checkpoints / key(run)
    trainer.policy.save_pretrained(saved)
    questions = QUESTIONS.values() if run["task"] == BOTH else [run["task"]]
    return {
        "loss": sum(losses[-100:]) / len(losses[-100:]),
        "returns": {question: maze_returns(saved, question, config.rollouts) for question in questions},
        **trainer.record(),
    }


def maze_returns(checkpoint: Path, question: str, episodes: int) -> dict[str, Any]:
    """`rollouts` of one of `QUESTIONS`, from the same starts for every model."""
    asked = {"inference_mask": question, "target_return": "auto" if question == "reward_conditioned" else None}
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):  # LeRobot's progress bars
        return rollout(checkpoint, "maze2d", episodes, batch_size=min(100, episodes), seed=100_000, **asked)


def summary(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Row -> column (k5_bc, ...) -> mean over seeds, its standard error (of one seed, over rollouts), seeds."""
    found: dict[str, dict[str, list[dict]]] = {}
    names = {question: name for name, question in QUESTIONS.items()}
    for record in records:
        for question, result in record["returns"].items():
            column = f"k{record['context_length']}_{names[question]}"
            found.setdefault(record["row"], {}).setdefault(column, []).append(result)
    return {row: {name: mean_return(results) for name, results in columns.items()} for row, columns in found.items()}


def mean_return(results: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Of one seed the standard error is that over its rollouts."""
    return mean_over_seeds([result["mean_return"] for result in results], alone=results[0]["standard_error"])


def markdown(record: Mapping[str, Any]) -> str:
    """The table, and what it is of."""
    config = record["config"]
    return (
        f"Maze2D, mean return ± standard error over {len(config['seeds'])} seed(s) (of one seed, over rollouts), "
        f"{config['rollouts']} rollouts each, {config['steps']} updates for every model and {config['finetune_steps']} "
        f"more for fine-tuned ones. In brackets the paper's. Expert {record['expert']:.2f}, bound "
        f"{record['bound']:.2f}.\n\n{returns_table(record)}\n"
    )
