"""The tables of README.md and docs/, written from their records.

A page names records above a table, one in a line, and the table's head says what is shown of them:

    <!-- from: docs/results/doorkey_500.json -->
    | task | this policy | spread | paper, random-mask | best possible |
"""

import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_unimask.bench import tables as bench_tables
from lerobot_unimask.language.masks import TASKS
from lerobot_unimask.paper import claims, study_tables
from lerobot_unimask.records import markdown_table, read_json

Record = Mapping[str, Any]

UNDER_RECORDS = re.compile(r"((?:<!-- from: \S+ -->\n)+)((?:\|.*\n)+)")

EVALUATED = re.compile(r"maze2d_k(\d+)(_s1)?_imitation")  # files of lerobot-eval, each followed by that of its returns


def rewrite(page: str, root: Path) -> tuple[str, list[str]]:
    """
    Args:
        root: the folder that the records' paths are relative to.

    Returns:
        The page, its tables written anew; and the heads of tables under records that are of no kind in `KINDS`, which
        are left as they are.
    """
    unknown = []

    def write(found: re.Match[str]) -> str:
        paths, head = re.findall(r"from: (\S+)", found[1]), found[2].partition("\n")[0]
        for kind, written in KINDS.items():
            if re.match(rf"\| {kind}", head):
                return found[1] + written(*({"path": path, **read_json(root / path)} for path in paths)) + "\n"
        unknown.append(head)
        return found[0]

    return UNDER_RECORDS.sub(write, page), unknown


def pages(root: Path) -> list[Path]:
    """README.md and every page in docs/."""
    return [root / "README.md", *sorted(root.glob("docs/*.md"))]


def _cell(mean: float, error: float, digits: int = 2) -> str:
    return f"{mean:.{digits}f} ± {error:.{digits}f}"


def _evaluated(record: Record) -> str:
    """Mean return and its standard error, of lerobot-eval's eval_info.json."""
    returns = [value for task in record["per_task"] for value in task["metrics"]["sum_rewards"]]
    return _cell(statistics.mean(returns), statistics.stdev(returns) / len(returns) ** 0.5)


# --- DoorKey ---------------------------------------------------------------------------------------------------------


def _beside_the_papers_model(record: Record) -> str:
    paper = study_tables.paper_losses(500)["random_mask"]
    best = record["optimum"]["expected_losses"]
    rows = (
        (
            f"`{task}`",
            f"{record['mean'][task]:.3f}",
            f"{record['spread'][task]:.3f}",
            f"{paper[task]:g}",
            f"{best[task]:.3f}",
        )
        for task in TASKS
    )
    return markdown_table(("task", "this policy", "spread", "paper, random-mask", "best possible"), rows)


def _action_rules(*records: Record) -> str:
    rows = (
        (rule, f"{record['overall']['pc_success']:.1f} %", _evaluated(record))
        for rule, record in zip(("most likely", "sampled"), records, strict=True)
    )
    return markdown_table(("action rule", "success", "mean return"), rows)


def _from_pictures(*records: Record) -> str:
    rows = (
        (
            "blind" if "blind" in record["path"] else "sees it",
            _evaluated(record),
            f"{record['overall']['pc_success']:.0f} %",
            str(record["overall"]["n_episodes"]),
        )
        for record in records
    )
    return markdown_table(("the goal in the picture", "return", "success", "rollouts"), rows)


def _beside_the_optimum(record: Record) -> str:
    ours, best = record["mean"], record["optimum"]["losses"]
    rows = ((f"`{task}`", f"{ours[task]:.3f}", f"{best[task]:.3f}", f"{ours[task] - best[task]:.3f}") for task in TASKS)
    return markdown_table(("task", "this policy", "best possible", "difference"), rows)


def _above_the_optimum(record: Record) -> str:
    """A column for each run, by the commit that trained it, and a last row of its mean over the tasks."""
    found = {task: [run["above_optimum"][task] for run in record["runs"]] for task in TASKS}
    mean = ("mean", *(f"{statistics.mean(column):.3f}" for column in zip(*found.values(), strict=True)))
    rows = ((f"`{task}`", *(f"{above:.3f}" for above in of_runs)) for task, of_runs in found.items())
    return markdown_table(("nats above the optimum", *(run["commit"][:7] for run in record["runs"])), [*rows, mean])


def _causal_share(both: Record, both_1: Record, random: Record, random_1: Record, stacked: Record) -> str:
    def row(task: str) -> tuple[str, ...]:
        causal, alone = ([found["mean"][task] for found in pair] for pair in ((both, both_1), (random, random_1)))
        seeds = (", ".join(f"{loss:.3f}" for loss in losses) for losses in (causal, alone))
        best = both["optimum"]["losses"][task]
        return (
            f"`{task}`",
            *seeds,
            f"{100 * (sum(causal) / sum(alone) - 1):+.1f} %",
            f"{stacked['mean'][task]:.3f}",
            f"{best:.3f}",
        )

    heads = ("task", "7.5 % causal", "random masks alone", "difference", "the same, stacked", "best possible")
    return markdown_table(heads, map(row, TASKS))


def _asked_rollouts(record: Record) -> str:
    goals, visits = record["goals"], record["visits"]
    rows = [
        (
            "reach a final state that the expert reaches with 1 to 10 %",
            goals["reached"],
            goals["reached_by_imitation"],
            goals["reached_by_the_expert"],
        ),
        ("visit the corner, asked to", visits["asked_to"], visits["imitation"], visits["expert"]),
        ("visit the corner, asked not to", visits["asked_not_to"], visits["imitation"], visits["expert"]),
    ]
    percent = ((what, *(f"{share:.1%}" for share in shares)) for what, *shares in rows)
    return markdown_table(("sampled rollouts", "asked", "imitation", "expert"), percent)


def _asked_returns(record: Record) -> str:
    rows = (
        (row["asked"], _cell(row["mean_return"], row["standard_error"]), row["rollouts"])
        for row in record["returns"]["returns"]
    )
    return markdown_table(("return asked for", "mean return", "rollouts"), rows)


def _backward(record: Record) -> str:
    found = record["backward"]
    rows = [("as they come", f"{found['unchecked']['impossible_steps']:,}", None)]
    for check in ("dynamics", "agreement"):
        rows.append(
            (f"`--check={check}`", f"{found[check]['impossible_steps']:,}", f"{found[check]['acceptance']:.1%}")
        )
    return markdown_table(
        (f"{found['samples']:,} histories sampled backwards", "impossible steps", "tokens accepted"), rows
    )


# --- Maze2D ----------------------------------------------------------------------------------------------------------


def _both_questions(*records: Record) -> str:
    def row(imitation: Record, asked: Record) -> tuple[str, ...]:
        K, second = EVALUATED.search(imitation["path"]).groups()
        return f"{K}, second seed" if second else K, _evaluated(imitation), _evaluated(asked)

    return markdown_table(("K", "imitation", "reward-conditioned"), map(row, records[::2], records[1::2]))


def _ahead(random: Record, acts: Record) -> str:
    rows = [("the last displacement repeated five times", random["ahead"]["last_displacement_repeated"])]
    for record, what in (
        (random, "random masks alone, {} updates"),
        (acts, "the model that acts too, {} updates, half of the windows causal"),
    ):
        rows.append((what.format(f"{record['policy']['updates']:,}"), record["ahead"]["model"]))
    return markdown_table(("model, K = 10", "distance"), ((what, f"{distance:.4f}") for what, distance in rows))


def _encoding(record: Record) -> str:
    rows = (
        (
            row.partition(",")[0],
            *(_cell(*_of(cells[question])) for question in ("behavior_cloning", "reward_conditioned")),
            _cell(*_of(cells["error_ahead"]), digits=3),
        )
        for row, cells in record["summary"].items()
    )
    return markdown_table(("numbers", "imitation", "reward-conditioned", "distance three steps ahead"), rows)


def _of(cell: Mapping[str, float]) -> tuple[float, float]:
    return cell["mean"], cell["standard_error"]


def _last_checkpoints(record: Record) -> str:
    last = [(run["run"], run["checkpoints"][-1]) for run in record["runs"]]
    rows = ((f"`{run}`", _cell(found["mean_return"], found["standard_error"])) for run, found in last)
    return markdown_table(("config", "mean return"), rows)


# --- Hours and size --------------------------------------------------------------------------------------------------


def _hours(*records: Record) -> str:
    def row(record: Record) -> tuple[str, ...]:
        runs = record["runs"]
        wall, processor = (
            sum(run.get(f"{clock}_seconds", 0) for run in runs) / 3600 for clock in ("wall", "processor")
        )
        seeds = len({run["seed"] for run in runs})
        machines = {run["machine"]["processor"] for run in runs if "machine" in run}
        commits = {run["commit"][:7] for run in runs if run.get("commit")}
        return (
            f"`{Path(record['path']).name}`",
            str(len(runs)),
            str(seeds),
            f"{wall:.1f}",
            f"{processor:.1f}",
            ", ".join(sorted(machines)),
            ", ".join(sorted(commits)),
        )

    heads = (
        "record",
        "runs",
        "seeds",
        "hours",
        "of which processor's, where recorded",
        "machine, where recorded",
        "commits",
    )
    return markdown_table(heads, map(row, records))


def _scale(record: Record) -> str:
    heads = ("frames", "first batch after opening", "memory beyond the imports", "windows read per second")
    rows = (
        (
            f"{size['frames']:,}",
            f"{size['seconds']['first_batch']:.2f} s",
            f"{size['megabytes_beyond_imports']:,} MB",
            f"{size['windows_read_per_second']:,}",
        )
        for size in (record["small"], record["large"])
    )
    return markdown_table(heads, rows)


def _frames(record: Record) -> str:
    heads = ("windows a second", "LeRobot, item by item", "batched, from cached frames", "times as many")
    rate = record["windows_per_second"]
    off = f"{record['largest_difference_in_grey_levels']:.0f} grey levels"
    row = (None, f"{rate['lerobot']:.0f}", f"{rate['cached']:,.0f}", f"{record['times_as_many']:.0f}", off)
    return markdown_table((*heads, "largest difference"), [row])


def _attacks(record: Record) -> str:
    counts = ("tried", "refused", "held", "lost")
    rows = ((what, *(f"{found[count]:,}" for count in counts)) for what, found in record["attacks"].items())
    return markdown_table(("attack", *counts), rows)


# --- The arm, and how much acting remembers ---------------------------------------------------------------------------


def _percent(runs: Sequence[Record]) -> str:
    """Mean success, and its standard error over all episodes."""
    share = statistics.mean(run["success"] for run in runs)
    error = sum(run["standard_error"] ** 2 for run in runs) ** 0.5 / len(runs)
    return f"{100 * share:.0f} ({100 * error:.0f})"


def _beside_a_perceptron(record: Record) -> str:
    """Success in % and processor seconds of training, a row for each task. The last column is how many times the time
    of the perceptron that succeeds most, the shorter one of two that are alike."""
    tasks = list(dict.fromkeys(run["task"] for run in record["runs"]))
    models = sorted({(run["model"] != "unimask", run["updates"]) for run in record["runs"]})

    def runs(model: tuple[bool, int], task: str) -> list[Record]:
        return [r for r in record["runs"] if (r["model"] != "unimask", r["updates"]) == model and r["task"] == task]

    def seconds(model: tuple[bool, int], task: str) -> float:
        return statistics.mean(run["train_processor_seconds"] for run in runs(model, task))

    def best(task: str) -> tuple[bool, int]:
        return max(models[1:], key=lambda model: (sum(run["success"] for run in runs(model, task)), -model[1]))

    def row(tasks: Sequence[str]) -> list[str]:
        spent = {model: statistics.mean(seconds(model, task) for task in tasks) for model in models}
        found = {model: [run for task in tasks for run in runs(model, task)] for model in models}
        times = sum(seconds(models[0], task) for task in tasks) / sum(seconds(best(task), task) for task in tasks)
        return [*(f"{_percent(found[model])}, {spent[model]:.0f} s" for model in models), f"{times:.1f}"]

    heads = [f"{'perceptron' if other else 'the default'}, {updates:,} updates" for other, updates in models]
    rows = [(task, *row([task])) for task in tasks]
    return markdown_table(("one model a task", *heads, "times"), [*rows, ("mean", *row(tasks))])


def _one_for_all(*records: Record) -> str:
    """Success in %, a row for each seed of one model a task and of one for all."""
    kinds: dict[tuple[str, int, int], list[Record]] = {}
    for record in records:
        runs = [run for run in record["runs"] if run["model"] == "unimask"]
        whose = "one each" if len({run["data"] for run in runs}) > 1 else "one for all"
        for run in runs:
            kinds.setdefault((whose, run["updates"], run["seed"]), []).append(run)
    rows = (
        (f"{whose}, {updates:,} updates, seed {seed}", *(_percent([run]) for run in runs), _percent(runs))
        for (whose, updates, seed), runs in kinds.items()
    )
    return markdown_table(("models", *(run["task"] for run in next(iter(kinds.values()))), "mean"), rows)


def _trained_as_long(ours: Record, others: Record) -> str:
    """LeRobot's own policies after so much processor time, each beside the default on its task, seed 0."""
    rows = []
    for other in others["runs"]:
        (beside,) = (r for r in ours["runs"] if (r["model"], r["seed"], r["task"]) == ("unimask", 0, other["task"]))
        for name, run in (("the default", beside), (other["policy"], other)):
            spent, acting = run["train_processor_seconds"], run["acting_ms_per_episode_step"]
            size = f"{run['parameters'] / 1e6:.2f} M"
            rows.append(
                (run["task"], name, f"{spent:.0f} s", f"{run['updates']:,}", size, _percent([run]), f"{acting:.2f}")
            )
    heads = ("task", "policy", "trained for", "updates", "parameters", "success", "acting, ms a step")
    return markdown_table(heads, dict.fromkeys(rows))


def _trained_on_pictures(record: Record) -> str:
    """Policies after equal processor time, a row for each."""
    rows = (
        (
            run["policy"],
            f"{run['train_processor_seconds']:.0f} s",
            f"{run['updates']:,}",
            f"{run['parameters'] / 1e6:.2f} M",
            _percent([run]),
        )
        for run in record["runs"]
    )
    return markdown_table(("policy", "trained for", "updates", "parameters", "success"), rows)


def _remembered(record: Record) -> str:
    """Success in %, or mean return, by the steps that acting remembers, h, a row for each window."""
    rows = {}
    for run in record["runs"]:
        found = {str(run["context_length"]): run} | run["remembers"]
        cells = {int(h): _return(one) if "mean_return" in one else _percent([one]) for h, one in found.items()}
        rows[f"{run['task']}, K = {run['context_length']}, {run['updates']:,} updates"] = cells
    steps = sorted({h for cells in rows.values() for h in cells})
    body = ((name, *map(cells.get, steps)) for name, cells in rows.items())
    return markdown_table(("", *(f"h = {h}" for h in steps)), body)


def _return(run: Record) -> str:
    return f"{run['mean_return']:.2f} ({run['standard_error']:.2f})"


# --- Which table a head is of ----------------------------------------------------------------------------------------

KINDS: dict[str, Callable[..., str]] = {  # how the head begins -> the table of these records
    r"task \| this policy \| spread": _beside_the_papers_model,
    r"action rule": _action_rules,
    r"the goal in the picture": _from_pictures,
    r"task \| this policy \| best": _beside_the_optimum,
    r"nats above the optimum": _above_the_optimum,
    r"task \| 7.5 % causal": _causal_share,
    r"sampled rollouts": _asked_rollouts,
    r"return asked for": _asked_returns,
    r"[\d,]+ histories": _backward,
    r"K \| imitation": _both_questions,
    r"model, K = 10": _ahead,
    r"variant \| imitation": study_tables.summary_table,
    r"numbers \| imitation": _encoding,
    r"config \| mean return": _last_checkpoints,
    r"frames \| first batch": _scale,
    r"windows a second": _frames,
    r"attack \| tried": _attacks,
    r"one model a task": _beside_a_perceptron,
    r"models \|.*\| mean": _one_for_all,
    r"task \| policy \| trained for": _trained_as_long,
    r"policy \| trained for": _trained_on_pictures,
    r"\s*\| h = ": _remembered,
    r"H \| carried out": study_tables.acting_table,
    r"delay \| mask": study_tables.real_time_table,
    r"in the maze": study_tables.tasks_table,
    r"H \| shown": study_tables.goals_table,
    r"model \| BC": study_tables.returns_table,
    r"trained on, nats": study_tables.losses_table,
    r"trained on, over": study_tables.normalised_table,
    r"DoorKey: the paper's claim": claims.doorkey_claims,
    r"Maze2D: the paper's claim": claims.maze2d_claims,
    r"record \| runs": _hours,
    r"processor ms": bench_tables.beside,
}
