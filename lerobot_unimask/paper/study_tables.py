"""The tables of studies' records, beside the paper's own numbers. Nothing is imported here that takes long."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_unimask.language.masks import TASKS
from lerobot_unimask.records import markdown_table

QUESTIONS = {"bc": "behavior_cloning", "rc": "reward_conditioned"}  # by their names in the paper's table

PAPER = Path(__file__).parent / "paper"

TITLES = [task.replace("_", " ") for task in TASKS]

ROWS = [  # of the Maze2D table, in the paper's order
    "unimask_single_task",
    "unimask_multi_task",
    "unimask_multi_task_finetune",
    "unimask_random_mask",
    "unimask_random_mask_finetune",
    "acts_and_asks",
    "acts_and_asks_gaussian",
    "feedforward",
    "decision_transformer",
    "decision_gpt",
]


def paper_losses(episodes: int) -> dict[str, dict[str, float]] | None:
    """The paper's own numbers, row -> task -> loss; None for a number of episodes of which it gives none as numbers."""
    path = PAPER / f"doorkey_heatmap_{episodes}.csv"
    if not path.exists():
        return None
    with path.open() as file:
        return {row["training"]: {task: float(row[task]) for task in TASKS} for row in csv.DictReader(file)}


def losses_table(record: Mapping[str, Any], episodes: str | None = None) -> str:
    """Mean losses, their standard errors over seeds, and the paper's in brackets.

    Args:
        episodes: which of the record's numbers of episodes; None: the first.
    """
    episodes, rows = _of_episodes(record, episodes)
    paper = paper_losses(int(episodes)) or {}

    def text(row: str, task: str) -> str:
        cell, published = rows.get(row, {}).get(task), paper.get(row, {}).get(task)
        if cell is None:
            return ""
        error = f" ± {cell['standard_error']:.3f}" if cell["seeds"] > 1 else ""
        return f"{cell['mean']:.3f}{error}" + (f" ({published:g})" if published is not None else "")

    lines = [
        (f"`{row}`", *(text(row, task) for task in TASKS), _seeds(rows.get(row))) for row in record["config"]["rows"]
    ]
    optimum = ("`optimum`", *(f"{record['optimum'][task]:.3f}" for task in TASKS))
    return markdown_table(("trained on, nats", *TITLES, "seeds"), [*lines, (*optimum, "")])


def normalised_table(record: Mapping[str, Any], episodes: str | None = None) -> str:
    """Losses over the lowest of their column, ours and, in brackets, the paper's, each over its own lowest."""
    episodes, rows = _of_episodes(record, episodes)
    paper = paper_losses(int(episodes)) or {}
    means = {row: {task: cell["mean"] for task, cell in cells.items()} for row, cells in rows.items()}

    losses = {**means, "optimum": record["optimum"]}

    def lowest(models: Mapping[str, Mapping[str, float]], task: str) -> float:
        return min(cells[task] for cells in models.values() if task in cells)

    def text(row: str, task: str) -> str:
        loss, published = losses[row].get(task), paper.get(row, {}).get(task)
        if loss is None:
            return ""
        brackets = f" ({published / lowest(paper, task):.2f})" if published is not None else ""
        return f"{loss / lowest(means, task):.2f}{brackets}"

    lines = [(f"`{row}`", *(text(row, task) for task in TASKS)) for row in losses]
    return markdown_table(("trained on, over the lowest", *TITLES), lines)


def _of_episodes(record: Mapping[str, Any], episodes: str | None) -> tuple[str, Mapping[str, Any]]:
    episodes = episodes or next(iter(record["losses"]))
    return episodes, record["losses"][episodes]


def _seeds(cells: Mapping[str, Mapping[str, float]] | None) -> str:
    return str(next(iter(cells.values()))["seeds"]) if cells else "not run"


def paper_returns() -> dict[str, dict[str, float]]:
    """The paper's own numbers, row -> column -> mean return, and its standard error under `COLUMN_se`."""
    with (PAPER / "maze2d_table.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {row.pop("model"): {name: float(value) for name, value in row.items()} for row in rows}


def returns_table(record: Mapping[str, Any]) -> str:
    """Rows in the paper's order, each cell this package's mean and standard error, then the paper's mean."""
    paper = paper_returns()
    columns = [f"k{K}_{name}" for K in record["config"]["context_lengths"] for name in QUESTIONS]

    def text(row: str, column: str) -> str:
        cell, published = record["returns"].get(row, {}).get(column), paper.get(row, {}).get(column)
        ours = f"{cell['mean']:.2f} ± {cell['standard_error']:.2f}" if cell else "not run"
        return ours + (f" ({published:.2f})" if published is not None else "")

    heads = (f"{name[-2:].upper()}, K = {name[1:-3]}" for name in columns)
    return markdown_table(("model", *heads), ((f"`{row}`", *(text(row, name) for name in columns)) for row in ROWS))


def summary_table(record: Mapping[str, Any]) -> str:
    columns = {  # quantity -> its head, and its digits
        "behavior_cloning": ("imitation", 2),
        "reward_conditioned": ("reward-conditioned", 2),
        "behavior_cloning_error": ("error of the imitated action", 3),
        "reward_conditioned_error": ("of the reward-conditioned one", 3),
        "error_ahead": (f"error {record['config']['ahead']} steps ahead", 4),
        "ms_per_update": ("ms of processor per update", 0),
        "latency_ms": ("ms per action", 1),
    }
    rows = (
        (row, *(_text(cells.get(name), digits) for name, (_, digits) in columns.items()))
        for row, cells in record["summary"].items()
    )
    return markdown_table(("variant", *(head for head, _ in columns.values())), rows)


def _text(cell: Mapping[str, float] | None, digits: int) -> str:
    if cell is None:
        return ""
    error = f" ± {cell['standard_error']:.{digits}f}" if cell["standard_error"] else ""
    return f"{cell['mean']:.{digits}f}{error}"


def _returned(row: Mapping[str, float]) -> str:
    return f"{row['mean_return']:.2f} ± {row['standard_error']:.2f}"


def acting_table(record: Mapping[str, Any]) -> str:
    rows = (
        (
            row["chunk_size"],
            row["n_action_steps"],
            _returned(row),
            f"{row['success']:.3f}",
            f"{row['ms']:.1f}",
            f"{row['passes']:.2f}",
        )
        for row in record["acting"]
    )
    return markdown_table(("H", "carried out", "return", "success", "ms", "passes a step"), rows)


SHOWN = {  # as s[-1], by its name in the record
    "nothing": "nothing: imitation",
    "goal": "the goal",
    "other": "another rollout's goal",
}


def goals_table(record: Mapping[str, Any]) -> str:
    rows = (
        (
            row["chunk_size"],
            SHOWN[row["shown"]],
            _returned(row),
            f"{row['success']:.3f}",
            f"{row['there']:.3f}" if "there" in row else "",
        )
        for row in record["goals"]
    )
    return markdown_table(("H", "shown as `s[-1]`", "return", "success", "comes there"), rows)


def tasks_table(record: Mapping[str, Any]) -> str:
    rows = (
        (
            f"`{row['maze']}`",
            "nothing: hidden" if row["asked"] is None else f"`{row['asked']}`",
            _returned(row),
            f"{row['success']:.3f}",
        )
        for row in record["tasks"]
    )
    return markdown_table(("in the maze", "asked for", "return", "success"), rows)


def real_time_table(record: Mapping[str, Any]) -> str:
    rows = (
        (
            row["delay"],
            "with" if row["mask"] else "without",
            _returned(row),
            *(f"{row[name]:.3f}" for name in ("seam_mean", "seam_99", "inside_mean", "inside_99")),
        )
        for row in record["real_time"]["rows"]
    )
    return markdown_table(("delay", "mask", "return", "jump at seams", "99 %", "inside chunks", "99 %"), rows)
