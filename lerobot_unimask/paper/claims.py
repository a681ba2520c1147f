"""The paper's claims as comparisons of two models, and whether they hold of our records.

Each says on how many tasks, or in how many columns of the Maze2D table, one model is better than another, and by how
much on average: once of the paper's numbers, once of ours.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from lerobot_unimask.language.masks import TASKS
from lerobot_unimask.paper.study_tables import QUESTIONS, paper_losses, paper_returns
from lerobot_unimask.records import markdown_table

SINGLE = "single_task"  # one model for each task

Scores = Mapping[str, Sequence[float | None]]  # model -> its numbers, one for each task or column


class Compared(NamedTuple):
    wins: int  # tasks or columns in which the one is better
    of: int
    by: float  # how much better it is on average


class Claim(NamedTuple):
    text: str
    model: str
    other: str
    holds: Callable[[Compared], bool]


def on(least: int) -> Callable[[Compared], bool]:
    return lambda found: found.wins >= least


def everywhere(found: Compared) -> bool:
    return found.wins == found.of


def on_few(found: Compared) -> bool:
    return found.wins < found.of / 2


def nowhere(found: Compared) -> bool:
    return found.wins == 0


def about_level(found: Compared) -> bool:
    return abs(found.by) < 0.1


def behind(least: float) -> Callable[[Compared], bool]:
    return lambda found: nowhere(found) and found.by < -least


DOORKEY = [  # `by` is in nats
    Claim("Against H1: multi-task training is worse than single-task training", "multi_task", SINGLE, on_few),
    Claim("H1: random masks are better than it on half of the tasks", "random_mask", SINGLE, on(4)),
    Claim("H1: fine-tuned, on most (in the paper's words all but one)", "finetune", SINGLE, on(5)),
    Claim("H2: random masks beat multi-task training on almost all tasks", "random_mask", "multi_task", on(6)),
    Claim("The Decision Transformer is slightly worse than the transformer", "decision_transformer", SINGLE, nowhere),
    Claim("A perceptron is much worse than it", "feedforward_random_mask", "random_mask", behind(0.1)),
]

TUNED, TUNED_MULTI = "random_mask_finetune", "multi_task_finetune"

MAZE2D = [  # `by` is a difference of returns
    Claim("Multi-task training acts about as well as single-task training", "multi_task", SINGLE, about_level),
    Claim("Random masks act worse (counter to H2)", "random_mask", SINGLE, nowhere),
    Claim("Fine-tuning recovers what random masks lose", TUNED, "random_mask", everywhere),
    Claim("H1: fine-tuned random masks beat single-task training", TUNED, SINGLE, everywhere),
    Claim("K = 5: they beat Decision-GPT", f"{TUNED}, K = 5", "decision_gpt, K = 5", everywhere),
    Claim("K = 10: Decision-GPT beats them", "decision_gpt, K = 10", f"{TUNED}, K = 10", everywhere),
    Claim("K = 10: they beat multi-task, fine-tuned", f"{TUNED}, K = 10", f"{TUNED_MULTI}, K = 10", everywhere),
    Claim("Decision-GPT gains with context", "decision_gpt, K = 10", "decision_gpt, K = 5", everywhere),
    Claim("Single-task models lose with context", f"{SINGLE}, K = 10", f"{SINGLE}, K = 5", nowhere),
    Claim("The perceptron is far behind", "feedforward", SINGLE, behind(0.3)),
    Claim("The Decision Transformer is far behind", "decision_transformer", SINGLE, behind(0.3)),
]


def doorkey_claims(record: Mapping[str, Any]) -> str:
    """Of a heatmap's record of 500 episodes."""
    ours = {row: {task: cell["mean"] for task, cell in cells.items()} for row, cells in record["losses"]["500"].items()}
    paper = paper_losses(500) or {}
    return _table("DoorKey", DOORKEY, _losses(paper), _losses(ours), lambda one, other: other - one)


def maze2d_claims(record: Mapping[str, Any]) -> str:
    """Of a record of the Maze2D table."""
    ours = {row: {name: cell["mean"] for name, cell in cells.items()} for row, cells in record["returns"].items()}
    paper = paper_returns()
    return _table("Maze2D", MAZE2D, _returns(paper), _returns(ours), lambda one, other: one - other)


def _losses(rows: Mapping[str, Mapping[str, float]]) -> Scores:
    found = {row: [cells.get(task) for task in TASKS] for row, cells in rows.items()}
    for name, prefix in ((SINGLE, ""), ("decision_transformer", "decision_transformer_")):
        found[name] = [rows.get(f"{prefix}{task}", {}).get(task) for task in TASKS]
    return found


def _returns(rows: Mapping[str, Mapping[str, float]]) -> Scores:
    found = {}
    for row, cells in rows.items():
        name = row.removeprefix("unimask_")
        halves = {K: [cells.get(f"k{K}_{question}") for question in QUESTIONS] for K in (5, 10)}
        found[name] = [*halves[5], *halves[10]]
        found |= {f"{name}, K = {K}": half for K, half in halves.items()}
    return found


def _table(
    where: str,
    claims: Sequence[Claim],
    paper: Scores,
    ours: Scores,
    better: Callable[[float, float], float],
) -> str:
    def compare(claim: Claim, scores: Scores) -> Compared | None:
        pairs = zip(scores.get(claim.model, ()), scores.get(claim.other, ()), strict=False)
        by = [better(one, other) for one, other in pairs if one is not None and other is not None]
        return Compared(sum(value > 0 for value in by), len(by), sum(by) / len(by)) if by else None

    def row(claim: Claim) -> tuple[str, ...]:
        cells, found = [], compare(claim, ours)
        for one, missing in ((compare(claim, paper), "drawn, not told"), (found, "not run")):
            cells.append(f"{one.wins} of {one.of}, {one.by:+.2f}" if one else missing)
        verdict = "not run" if found is None else "**yes**" if claim.holds(found) else "**no**"
        return claim.text, f"`{claim.model}` / `{claim.other}`", *cells, verdict

    heads = (f"{where}: the paper's claim", "better / worse", "the paper's numbers", "ours", "holds here")
    return markdown_table(heads, map(row, claims))
