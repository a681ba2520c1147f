"""The paper's random search for hyperparameters (appendices "Minigrid experiments" and "Maze2D experiments").

Settings are drawn at random from a space, the same draws for every model. Each is trained, and judged by the lowest
validation loss on what the model is trained on, states and actions with weight 1 whatever the training weighs: the
paper's early stopping and its measure. The draws are Optuna's, made before the first run, so they do not depend on who
runs them, and more of them can be added later.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution

from dataset_builders.doorkey import build_doorkey
from dataset_builders.maze2d import build_maze2d
from lerobot_unimask.data.episodes import open_dataset
from lerobot_unimask.measures import unseen_windows
from lerobot_unimask.paper.early_stopping import train_to_lowest
from lerobot_unimask.paper.study import Run, VariantsConfig, run_study, write_results
from lerobot_unimask.records import markdown_table
from lerobot_unimask.training import Trainer, check_settings

BATCH_SIZE = "batch_size"  # the one setting that is not the policy's

BUILDERS = {"doorkey": partial(build_doorkey, expert="released"), "maze2d": build_maze2d}


@dataclass
class SearchConfig(VariantsConfig):
    """A search, as its YAML file gives it.

    Raises:
        ValueError: a setting that does not exist, or no range to draw it from.
    """

    name: str = "search"
    environment: str = "doorkey"
    # Or maze2d.
    space: dict[str, Any] = field(default_factory=dict)
    # Setting of the policy, or batch_size -> a list of choices, or {low: ..., high: ..., log: true}. A dot leads into a
    # mapping: loss_weights.s.
    draws: int = 20
    seeds: list[int] = field(default_factory=lambda: [0])
    # Of the weights and the data's order; of several the mean loss counts.
    evaluate_every: int = 250
    # Updates between validations, of which the best counts.
    episodes: int = 500
    validation_episodes: int = 1000
    data: str = "data/search"
    output: str = "outputs/search"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.environment not in BUILDERS:
            raise ValueError(f"environment is {self.environment!r}; choose one of {', '.join(BUILDERS)}.")
        if not self.space:
            raise ValueError("space is empty; it needs at least one setting to draw.")
        check_settings(name.partition(".")[0] for name in self.space if name != BATCH_SIZE)
        distributions(self.space)

    def settings(self) -> dict[str, Any]:
        return {name: value for name, value in super().settings().items() if name != "draws"}  # there may be more


def distributions(space: Mapping[str, Any]) -> dict[str, BaseDistribution]:
    """Setting -> what Optuna draws it from.

    Raises:
        ValueError: neither a list of choices nor a range.
    """
    found: dict[str, BaseDistribution] = {}
    for name, values in space.items():
        try:
            found[name] = FloatDistribution(**values) if isinstance(values, dict) else CategoricalDistribution(values)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"space.{name} is {values}: give a list of choices or {{low: ..., high: ..., log: true}} ({error})."
            ) from error
    return found


def draw(space: Mapping[str, Any], number: int) -> list[dict[str, Any]]:
    """Settings drawn independently; the first of a larger number are those of a smaller one."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    return [study.ask(distributions(space)).params for _ in range(number)]


def search(config: SearchConfig, **study: Any) -> dict[str, Any]:
    """Do what is left of the search; write `NAME.json` and `NAME.md`.

    Args:
        study: storage and workers, as `run_study` takes them.

    Returns:
        The record that the JSON holds.
    """
    for seed, episodes in enumerate((config.episodes, config.validation_episodes)):
        root = _root(config, episodes, seed)
        if not (root / "meta" / "info.json").exists():
            BUILDERS[config.environment](root, episodes=episodes, seed=seed, progress=False)
    runs: list[Run] = [
        {"row": variant, "draw": number, "seed": seed, "drawn": drawn}
        for number, drawn in enumerate(draw(config.space, config.draws))
        for seed in config.seeds
        for variant in config.variants
    ]
    output = Path(config.output)
    share = partial(run_study, config.name, output=output, settings=config.settings(), **study)
    records = share(runs, partial(execute, config), space=distributions(config.space))
    record = {
        "what": "lowest validation loss on what a model is trained on, mean over seeds, of settings drawn at random",
        "config": asdict(config),
        "best": best(records),
        "runs": records,
    }
    write_results(output, config.name, record, markdown(record))
    return record


def execute(config: SearchConfig, run: Run) -> dict[str, Any]:
    """One run: train with what was drawn, validate on the way."""
    drawn = nested(run["drawn"])
    batch_size = drawn.pop(BATCH_SIZE, config.batch_size)
    settings = {**config.policy, **config.variants[run["row"]], **drawn, "push_to_hub": False}
    root = _root(config, config.episodes, 0)
    trainer = Trainer(settings, root, seed=run["seed"], steps=config.steps, batch_size=batch_size)
    unseen = _root(config, config.validation_episodes, 1)
    batch = unseen_windows(
        open_dataset(trainer.policy.config, unseen),
        trainer.policy.config.context_length,
        range(config.validation_episodes),
    )
    return {**train_to_lowest(trainer, batch, every=config.evaluate_every), **trainer.record()}


def nested(drawn: Mapping[str, Any]) -> dict[str, Any]:
    """{"loss_weights.s": 0.5} as the policy takes it, {"loss_weights": {"s": 0.5}}."""
    settings: dict[str, Any] = {}
    for name, value in drawn.items():
        outer, _, inner = name.partition(".")
        if inner:
            settings.setdefault(outer, {})[inner] = value
        else:
            settings[outer] = value
    return settings


def best(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Model -> its best draw: the settings drawn, their loss, and the median loss of all draws."""
    found: dict[str, dict[int, list[Mapping[str, Any]]]] = {}
    for record in records:
        found.setdefault(record["row"], {}).setdefault(record["draw"], []).append(record)
    chosen = {}
    for row, draws in found.items():
        losses = {number: statistics.fmean(_loss(one) for one in of_seeds) for number, of_seeds in draws.items()}
        number = min(losses, key=losses.get)
        chosen[row] = {
            "draw": number,
            "loss": losses[number],
            "median_loss": statistics.median(losses.values()),
            "updates": [one["updates"] for one in draws[number]],
            "drawn": draws[number][0]["drawn"],
        }
    return chosen


def _loss(record: Mapping[str, Any]) -> float:
    return math.inf if math.isnan(record["loss"]) else record["loss"]  # a learning rate that was too high


def markdown(record: Mapping[str, Any]) -> str:
    """The best settings of each model as a table."""
    config = record["config"]

    def row(model: str, chosen: Mapping[str, Any]) -> list[str]:
        drawn = (chosen["drawn"][name] for name in config["space"])
        texts = (f"{value:.2g}" if isinstance(value, float) else str(value) for value in drawn)
        return [f"`{model}`", f"{chosen['loss']:.4f}", f"{chosen['median_loss']:.4f}", *texts]

    heads = ("model", "loss", "median", *(f"`{name}`" for name in config["space"]))
    return (
        f"Random search, {config['environment']}, {config['episodes']} episodes: {config['draws']} draws of "
        f"{len(config['seeds'])} seed(s), {config['steps']} updates each. For each model the draw with the lowest "
        f"validation loss on what it is trained on ({config['validation_episodes']} unseen episodes, every "
        f"{config['evaluate_every']} updates), and the median of all draws.\n\n"
        f"{markdown_table(heads, (row(model, chosen) for model, chosen in record['best'].items()))}\n"
    )


def _root(config: SearchConfig, episodes: int, seed: int) -> Path:
    return Path(config.data) / f"{config.environment}_{episodes}_seed{seed}"
