"""The paper's heatmap: validation losses of training regimes x evaluation tasks in DoorKey (paper, appendix F).

Every run trains one model of one row, number of episodes and seed, keeps the weights with the lowest validation loss of
what it is trained on (the paper's early stopping), and is evaluated on every task that it answers; `finetune` is one
model for each task, which goes on from the random-mask model of its seed. All are validated on the same windows and
masks, as `unimask validate` does. The row `optimum` is the lowest loss that any model can have there in expectation.

Note: The paper's losses are probably those of its authors' code (`expert=released`), whose questions in three columns
    are slightly different ones; here they are the paper's definitions.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dataset_builders.doorkey import build_doorkey
from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.episodes import first_windows, open_dataset
from lerobot_unimask.data.window import make_window
from lerobot_unimask.envs.doorkey.optimum import FACTORS, FEATURES, Optimum, entropies, mean_over_asked
from lerobot_unimask.envs.doorkey.rules import FPS, HORIZON
from lerobot_unimask.language.masks import RANDOM_MASK, TASKS
from lerobot_unimask.language.training_masks import VALIDATION_STEP, TrainingMasks
from lerobot_unimask.networks.layers import by_component
from lerobot_unimask.paper.early_stopping import train_to_lowest
from lerobot_unimask.paper.heatmap_panels import Panel, heatmaps
from lerobot_unimask.paper.study import Run, StudyConfig, check_rows, key, mean_over_seeds, run_study, write_results
from lerobot_unimask.paper.study_tables import losses_table, normalised_table, paper_losses
from lerobot_unimask.training import Trainer
from lerobot_unimask.validation import answered, task_losses

FINETUNE = "finetune"

# The paper's other architectures, as settings over those of the config file; its Decision-GPT is the causal transformer
ARCHITECTURES: dict[str, dict[str, Any]] = {
    "feedforward": {"network": "feedforward", "attention": None, "token_layout": "separate"},
    "decision_gpt": {"attention": "causal", "token_layout": "separate"},
    "decision_transformer": {"network": "decision_transformer", "attention": None, "token_layout": "separate"},
}

# Row -> its policy's settings, over those of the config file
ROWS: dict[str, dict[str, Any]] = {
    **{task: {"training_masks": task} for task in TASKS},
    "multi_task": {"training_masks": "multi_task"},
    RANDOM_MASK: {"training_masks": RANDOM_MASK},
    "acts_and_asks": {"training_masks": RANDOM_MASK, "attention": "both", "token_layout": "separate"},
    **{
        f"{name}_{task}": {"training_masks": task, **ARCHITECTURES[name]}
        for name, tasks in {
            "feedforward": ("behavior_cloning", RANDOM_MASK),
            "decision_gpt": ("behavior_cloning", "reward_conditioned"),
            "decision_transformer": ("behavior_cloning", "reward_conditioned"),
        }.items()
        for task in tasks
    },
}


@dataclass
class HeatmapConfig(StudyConfig):
    """A grid of runs, as its YAML file gives it."""

    name: str = "heatmap"
    rows: list[str] = field(default_factory=lambda: [*TASKS, "multi_task", RANDOM_MASK, FINETUNE])
    # What is trained: names in `ROWS`, and finetune, which needs random_mask.
    episodes: list[int] = field(default_factory=lambda: [500])
    expert: str = "released"
    finetune_steps: int = 1000
    evaluate_every: int = 250
    # Updates between validations, of which the best counts.
    patience: int | None = None
    # Validations in a row without a better one, after which a run ends; null: none does.
    validation_episodes: int = 1000
    finetune_policy: dict[str, Any] = field(default_factory=dict)
    # Settings that fine-tuning changes.
    data: str = "data/heatmap"
    output: str = "outputs/heatmap"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rows(self.rows, ROWS, {FINETUNE: RANDOM_MASK})


def heatmap(config: HeatmapConfig, **study: Any) -> dict[str, Any]:
    """Do what is left of the grid; write `heatmap.json`, `heatmap.md` and two figures for each number of episodes.

    Args:
        study: storage and workers, as `run_study` takes them.

    Returns:
        The record that `heatmap.json` holds.
    """
    for episodes in config.episodes:
        _build(config, _training_root(config, episodes), episodes, seed=0)
    _build(config, _validation_root(config), config.validation_episodes, seed=1)
    grid = [(episodes, seed) for episodes in config.episodes for seed in config.seeds]
    first: list[Run] = [
        {"row": row, "episodes": episodes, "seed": seed}
        for episodes, seed in grid
        for row in config.rows
        if row != FINETUNE
    ]
    second: list[Run] = [
        {"row": FINETUNE, "task": task, "episodes": episodes, "seed": seed}
        for episodes, seed in grid
        for task in (TASKS if FINETUNE in config.rows else ())
    ]
    output = Path(config.output)
    share = partial(
        run_study, config.name, execute=partial(execute, config), output=output, settings=config.settings(), **study
    )
    records = share(runs=first)
    if second:  # needs the first ones' weights
        records += share(runs=second)
    record = {
        "what": "validation loss in nats, its mean over seeds; one window from each episode's first step, t uniform",
        "config": asdict(config),
        "optimum": optimum_losses(config),
        "losses": {
            str(episodes): _table([one for one in records if one["episodes"] == episodes])
            for episodes in config.episodes
        },
        "runs": records,
    }
    write_results(output, "heatmap", record, markdown(record))
    for episodes in config.episodes:
        for name, figure in figures(record, episodes).items():
            figure.savefig(output / f"{name}.png", dpi=200)
    return record


def execute(config: HeatmapConfig, run: Run) -> dict[str, Any]:
    """One run: train, keep the best weights, evaluate."""
    tuned = run["row"] == FINETUNE
    settings = {**config.policy, "push_to_hub": False}
    if tuned:
        settings = {"training_masks": run["task"], **config.finetune_policy}
    else:
        settings |= ROWS[run["row"]]
    before = _checkpoint(config, run) if tuned else None
    if before and not before.exists():
        raise FileNotFoundError(f"{before} is not here: the random-mask model was trained on another machine.")
    trainer = Trainer(
        settings,
        _training_root(config, run["episodes"]),
        seed=run["seed"],
        steps=config.finetune_steps if tuned else config.steps,
        batch_size=config.batch_size,
        checkpoint=before,
    )
    policy = trainer.policy
    batch = first_windows(open_dataset(policy.config, _validation_root(config)))
    lowest = train_to_lowest(trainer, batch, every=config.evaluate_every, patience=config.patience, count_start=tuned)
    if run["row"] == RANDOM_MASK:
        policy.save_pretrained(_checkpoint(config, run))
    tasks = [run["task"]] if tuned else [task for task in answered(policy, batch) if task in TASKS]
    return {
        **lowest,
        "losses": task_losses(policy, batch, tasks),
        "expert": config.expert,
        **trainer.record(),
    }


def optimum_losses(config: HeatmapConfig) -> dict[str, float]:
    """The loss that no model can beat in expectation, on the validation windows and masks."""
    policy = UniMASKConfig(**config.policy)
    K = policy.context_length
    batch = first_windows(open_dataset(policy, _validation_root(config)))
    window = make_window(batch, FEATURES, K, horizon=torch.tensor(float(HORIZON)), fps=torch.tensor(float(FPS)))
    optimum = Optimum(config.expert)
    losses = {}
    for task in TASKS:
        mask = TrainingMasks(task, tuple(FEATURES), K)(window.valid, batch["index"], seed=0, step=VALIDATION_STEP)
        losses[task] = mean_over_asked(entropies(by_component(optimum.predict(window, mask), FACTORS)), mask.asked)
    return losses


def _table(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Row -> task -> mean, standard error and spread (largest minus smallest) over seeds."""
    found: dict[str, dict[str, list[float]]] = {}
    for record in records:
        for task, loss in record["losses"].items():
            found.setdefault(record["row"], {}).setdefault(task, []).append(loss)
    return {
        row: {task: {**mean_over_seeds(v), "spread": max(v) - min(v)} for task, v in tasks.items()}
        for row, tasks in found.items()
    }


def markdown(record: Mapping[str, Any]) -> str:
    """Tables of the losses, and of the losses over the lowest in each column, for each number of episodes."""
    config = record["config"]
    text = [
        f"Validation losses in nats, `expert={config['expert']}`, {config['validation_episodes']} unseen episodes, "
        f"mean ± standard error over {len(config['seeds'])} seed(s). {config['steps']} updates of "
        f"{config['batch_size']} windows, {config['finetune_steps']} more for finetune; of the weights after every "
        f"{config['evaluate_every']} the best on what they are trained on. In brackets the paper's. `optimum`: the "
        "lowest possible in expectation."
    ]
    for episodes in record["losses"]:
        text += [f"**{episodes} episodes**", losses_table(record, episodes), normalised_table(record, episodes)]
    return "\n\n".join(text) + "\n"


def _means(rows: Mapping[str, Mapping[str, Mapping[str, float]]]) -> list[dict[str, float]]:
    return [{task: cell["mean"] for task, cell in tasks.items()} for tasks in rows.values()]


def _grid(rows: Sequence[Mapping[str, float]]) -> Tensor:
    """(rows, tasks); NaN where there is no number."""
    return torch.tensor([[losses.get(task, math.nan) for task in TASKS] for losses in rows])


def _normalised(losses: Tensor) -> Tensor:
    """(rows, tasks) over the lowest in each column, as in the paper's figure; the last row is the optimum, no model."""
    return losses / losses[:-1].nan_to_num(math.inf).min(0).values


def figures(record: Mapping[str, Any], episodes: int) -> dict[str, Figure]:
    """Name -> figure: `heatmap_N`, as the paper's, of losses over the lowest of their column, and `heatmap_N_raw` in
    nats. Where there are the paper's numbers, they stand beside the one, the difference from them beside the other."""
    rows = record["losses"][str(episodes)]
    published = paper_losses(episodes) or {}
    losses = _grid([*_means(rows), record["optimum"]])
    paper = _grid([*(published.get(row, {}) for row in rows), {}])
    panels = {
        "": [
            Panel(f"{episodes} episodes: loss over the lowest of its column", _normalised(losses)),
            Panel("the paper's", _normalised(paper)),
        ],
        "_raw": [
            Panel(f"{episodes} episodes: loss in nats", losses, colours=_normalised(losses)),
            Panel("minus the paper's", losses - paper, signed=True),
        ],
    }
    names, tasks = ([name.replace("_", " ") for name in some] for some in ([*rows, "optimum"], TASKS))
    return {
        f"heatmap_{episodes}{kind}": heatmaps([p for p in some if p.numbers.isfinite().any()], names, tasks)
        for kind, some in panels.items()
    }


def _build(config: HeatmapConfig, root: Path, episodes: int, *, seed: int) -> None:
    if not (root / "meta" / "info.json").exists():
        build_doorkey(root, episodes=episodes, seed=seed, expert=config.expert, progress=False)


def _training_root(config: HeatmapConfig, episodes: int) -> Path:
    return Path(config.data) / f"{config.expert}_{episodes}"


def _validation_root(config: HeatmapConfig) -> Path:
    return Path(config.data) / f"{config.expert}_validation_{config.validation_episodes}"


def _checkpoint(config: HeatmapConfig, run: Run) -> Path:
    """Where the random-mask model of a run's episodes and seed is kept."""
    model = {"row": RANDOM_MASK, "episodes": run["episodes"], "seed": run["seed"]}
    return Path(config.output) / "checkpoints" / key(model)
