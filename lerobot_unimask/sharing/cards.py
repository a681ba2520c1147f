"""Cards: the README.md, and its picture, that goes to the Hub with a policy or a dataset.

Written from what the policy or the dataset's folder itself holds, without asking any server.
"""

import html
import io
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from textwrap import dedent, indent
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from huggingface_hub import DatasetCardData, ModelCardData
from lerobot.utils.constants import OBS_STATE
from matplotlib.figure import Figure

from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.episodes import provenance_of, read_info
from lerobot_unimask.data.factors import flat_names
from lerobot_unimask.language.masks import RANDOM_MASK, TASKS, Mask, tabulate
from lerobot_unimask.language.training_masks import TrainingMasks
from lerobot_unimask.plots.answers import mask_diagram
from lerobot_unimask.records import markdown_table, read_json

PLUGIN = "lerobot_policy_unimask"

INSTALL = f"pip install {PLUGIN}  # or, in a copy of the project: pip install ."

LICENSE = "apache-2.0"

DRAWN_EPISODES = 6


@dataclass(frozen=True)
class PolicyFacts:
    """What a policy's card is written from.

    Attributes:
        weights: training masks, text -> weight.
        parameters: number of the network's.
        updates: number of those made.
        train_config: what lerobot-train saved beside the weights.
        command: training command.
    """

    config: UniMASKConfig
    weights: Mapping[str, float]
    parameters: int
    updates: int
    train_config: Mapping[str, Any] | None = None
    command: str | None = None


def policy_card(facts: PolicyFacts, repo_id: str, results: Sequence[Mapping[str, Any]] = ()) -> dict[str, bytes]:
    """A policy's card: file name -> content.

    Args:
        repo_id: name under which it is to be found, for the commands that the card shows.
        results: records of `unimask validate` (losses by task) and lerobot-eval's `eval_info.json`s (rollouts).

    Raises:
        ValueError: a record of another kind.
    """
    config, train_config = facts.config, facts.train_config
    data = (train_config or {}).get("dataset") or {}
    public = bool(config.dataset_revision or not data.get("root")) and data.get("repo_id")
    metadata = ModelCardData(
        license=config.license or LICENSE,
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=sorted({"lerobot", "robotics", "unimask", *(config.tags or [])}),
        datasets=[data["repo_id"]] if public else None,
    )
    questions, picture = _questions(facts)
    parts = [
        f"# {_plain(repo_id.split('/')[-1])}",
        "A [UniMASK](https://arxiv.org/abs/2211.10869) policy: one masked model that answers any question about "
        "behaviour, as a policy of [LeRobot](https://github.com/huggingface/lerobot). It needs the plugin "
        f"`{PLUGIN}` (version {version(PLUGIN)} has pushed it):",
        _code(INSTALL),
        "## Try it",
        _code(_commands(facts, repo_id)),
        "## The questions it was trained on",
        questions,
        "![The question that it answers when it acts](mask.png)",
        "## The model",
        _model(facts),
        "## Training",
        _training(facts, repo_id),
    ]
    if results:
        parts += ["## Results", *_results(results)]
    text = "\n\n".join([f"---\n{metadata.to_yaml()}\n---", *parts]) + "\n"
    return {"README.md": text.encode(), "mask.png": picture}


def _questions(facts: PolicyFacts) -> tuple[str, bytes]:
    """Each training mask with its share of the windows and, drawn, one of its masks; the acting question's picture."""
    factors, K = tuple(facts.config.features), facts.config.context_length
    cameras = tuple(facts.config.pictures)
    weights = facts.weights
    lines = []
    for text, weight in weights.items():
        if text == RANDOM_MASK:
            mask, meaning = (
                _random_example(factors, K, cameras),
                "any states and actions given any others; for instance",
            )
        else:
            mask, t = _example(text, factors, K, cameras)
            meaning = TASKS.get(text, text) + (f"   at t = {t}" if t is not None else "")
        name = text if text in TASKS or text == RANDOM_MASK else "question"
        lines += [f"{name} ({weight / sum(weights.values()):.0%}): {meaning}", indent(mask.draw(), "    ")]
    acting, _ = _example(facts.config.inference_mask, factors, K, cameras)
    legend = "Shown `#`, asked `?`, neither `.`, over the steps of a window:"
    return f"{legend}\n\n{_code(chr(10).join(lines), 'text')}", _png(mask_diagram(acting))


def _example(text: str, factors: tuple[str, ...], K: int, cameras: tuple[str, ...]) -> tuple[Mask, int | None]:
    """A question's mask, at the middle one of its t, and that t."""
    table = tabulate(text, factors, K, cameras)
    t = int(table.t[len(table.t) // 2]) if table.question.uses_t else None
    return table.at(t), t


def _random_example(factors: tuple[str, ...], K: int, cameras: tuple[str, ...]) -> Mask:
    """Of some windows' draws the one that hides nearest to half of the states and actions."""
    windows = 64
    draws = TrainingMasks(RANDOM_MASK, factors, K, cameras=cameras)(
        torch.ones(windows, K, dtype=torch.bool), torch.arange(windows), seed=0, step=0
    )
    hidden = torch.cat(list(draws.asked.values()), dim=1).sum(1)  # (64,)
    best = int((hidden - K).abs().argmin())
    shown, asked = (
        {name: tokens[best : best + 1] for name, tokens in part.items()} for part in (draws.shown, draws.asked)
    )
    return Mask(shown, asked)


def _model(facts: PolicyFacts) -> str:
    rows = []
    for name, features in facts.config.features.items():
        for feature in features:
            names = _plain(", ".join(feature.names or ["…"] * min(feature.size, 12)))
            values = "continuous"
            if feature.categories:
                values = " x ".join(map(str, feature.categories)) + " categories"
            rows.append([_span(name), _span(feature.key), feature.size, names, values])
    config = facts.config
    for name, camera in config.pictures.items():
        shape = " x ".join(map(str, camera.shape))
        rows.append([_span(name), _span(camera.key), shape, "", "pictures, read at this size; shown, never asked"])
    table = markdown_table(("factor", "column", "numbers", "names", "values"), rows)
    return (
        f"{table}\n\nContext length: {config.context_length} steps. Attention: {config.attention}. Acting asks "
        f"{_span(TASKS.get(config.inference_mask, config.inference_mask))}. {facts.parameters:,} parameters, "
        f"{facts.updates:,} updates."
    )


def _training(facts: PolicyFacts, repo_id: str) -> str:
    if facts.train_config is None:
        return "How it was trained was not saved with it."
    data = facts.train_config["dataset"]
    revision = facts.config.dataset_revision
    place = f"at revision {_span(revision)}" if revision else "local: it was read from a folder, which has no revision"
    again = f"lerobot-train --config_path={repo_id} --policy.push_to_hub=false --output_dir=outputs/again"
    return f"Data: {_span(data['repo_id'])}, {place}.\n\n{_code(facts.command or again)}"


def _commands(facts: PolicyFacts, repo_id: str) -> str:
    """Evaluating, asking, fine-tuning: three commands that work as they stand where the training did."""
    train_config, config = facts.train_config or {}, facts.config
    data = train_config.get("dataset") or {"repo_id": "ME/DATASET"}
    dataset = f"--dataset.repo_id={shlex.quote(str(data['repo_id']))}"
    if data.get("root") and not config.dataset_revision:
        dataset += f" --dataset.root={shlex.quote(str(data['root']))}"
    environment = (train_config.get("env") or {}).get("type") or _robot(data.get("root")) or "YOUR_ENVIRONMENT"
    question = next((text for text in facts.weights if text != RANDOM_MASK), "behavior_cloning")
    _, t = _example(question, tuple(config.features), config.context_length, tuple(config.pictures))
    at = "" if t is None else f" --t={t}"
    return (
        f"lerobot-eval --policy.path={repo_id} --env.type={shlex.quote(str(environment))} --eval.n_episodes=100 "
        "--eval.batch_size=50\n"
        f"unimask query --policy.path={repo_id} {dataset} --episode=0 --mask={shlex.quote(question)}{at}\n"
        f"lerobot-train --policy.path={repo_id} --policy.push_to_hub=false {dataset} "
        "--policy.training_masks=behavior_cloning --policy.optimizer_lr=1e-4 --steps=500 --batch_size=100 "
        "--num_workers=0 --output_dir=outputs/tuned"
    )


def _robot(root: str | None) -> str | None:
    """The robot of a training dataset, which for one built here is its `--env.type`, if its folder is still there."""
    info = Path(root or "") / "meta" / "info.json"
    return read_json(info).get("robot_type") if root and info.exists() else None


def _results(results: Sequence[Mapping[str, Any]]) -> list[str]:
    parts = []
    for record in results:
        if "mean" in record and "validation_episodes" in record:
            rows = [[_span(task), f"{loss:.3f}"] for task, loss in record["mean"].items()]
            runs = len(record["runs"])
            parts.append(
                f"Validation loss, in nats per asked token, on {record['validation_episodes']:,} episodes"
                f"{f', mean of {runs} runs' if runs > 1 else ''}:\n\n{markdown_table(('task', 'loss'), rows)}"
            )
        elif "n_episodes" in record.get("overall", {}):
            overall = record["overall"]
            parts.append(
                f"Rollouts: {overall['n_episodes']:,} episodes, mean return {overall['avg_sum_reward']:.2f}, success "
                f"{overall['pc_success']:.1f} %."
            )
        else:
            raise ValueError("A record of results is one of `unimask validate` or lerobot-eval's eval_info.json.")
    return parts


Provenance = Mapping[str, Any]  # what a dataset's folder says of how it was built


@dataclass(frozen=True)
class Described:
    """What a dataset's card says of its environment.

    Attributes:
        type: its name in `--env.type=`.
        horizon: steps of an episode.
        description: sentences; so are `expert` and `reward`.
        columns: meaning of each of its own columns.
        draw_episodes: picture of the first episodes' states, (N, T, D).
    """

    type: str
    horizon: int
    description: str
    expert: str
    reward: str
    columns: Mapping[str, str]
    draw_episodes: Callable[[np.ndarray, Provenance], Figure]


COLUMNS = {
    "observation.return_to_go": "the sum of rewards from this step to the episode's end",
    "observation.success": "whether the episode reaches what it is to",
    "next.reward": "the reward of this step",
    "next.done": "whether this step is the episode's last",
    "timestamp": "seconds since the episode's start",
    "frame_index": "the step's number within the episode",
    "episode_index": "the episode's number",
    "index": "the step's number within the dataset",
    "task_index": "the task's number in meta/tasks.parquet",
}


def dataset_card(root: Path, repo_id: str, environment: Described | None = None) -> dict[str, bytes]:
    """A dataset's card: file name -> content; with a picture where it is of an environment of this package."""
    info = read_info(root)
    provenance = provenance_of(root)
    metadata = DatasetCardData(
        license=LICENSE,
        task_categories=["robotics"],
        tags=["LeRobot", *([environment.type] if environment else [])],
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )
    facts = {
        "episodes": f"{info['total_episodes']:,}, {info['total_frames']:,} steps in all, {info['fps']} a second",
        "format": f"LeRobotDataset {info['codebase_version']}",
        "licence": LICENSE,
    }
    if environment:
        expert = str(provenance["expert"])
        settings = ", ".join(f"{name} {provenance[name]}" for name in ("beta", "noise", "maze") if name in provenance)
        facts = {
            "environment": f"{environment.description} (--env.type={environment.type})",
            "expert": f"{expert}: {environment.expert}" if expert not in environment.expert else environment.expert,
            "settings": f"{settings}, seed {provenance['seed']}",
            "reward": environment.reward,
            **facts,
        }
    meanings = {**COLUMNS, **(environment.columns if environment else {})}
    columns = [
        [
            _span(name),
            f"{_plain(column['dtype'])} ({', '.join(map(str, column['shape']))})",
            _plain(" x ".join(map(str, column.get("categories") or []))),
            meanings.get(name) or _plain(", ".join(flat_names(column.get("names")))),
        ]
        for name, column in info["features"].items()
    ]
    parts = [
        f"# {_plain(repo_id.split('/')[-1])}",
        "A dataset for [LeRobot](https://github.com/huggingface/lerobot).",
        "\n".join(f"- {name}: {_plain(fact)}" for name, fact in facts.items()),
        "## Columns",
        markdown_table(("column", "type", "categories", "meaning"), columns),
        "## Use",
        _code(
            f"{INSTALL}\nlerobot-train --policy.type=unimask --policy.push_to_hub=false --dataset.repo_id={repo_id} "
            "--steps=2000 --batch_size=100 --num_workers=0"
        ),
    ]
    if "command" in provenance:
        parts += [f"Made by {PLUGIN} {_plain(provenance['package_version'])} with:", _code(str(provenance["command"]))]
    files = {}
    if environment:
        files["episodes.png"] = _png(_draw_episodes(root, info, provenance, environment))
        parts.insert(3, f"![The first {DRAWN_EPISODES} episodes](episodes.png)")
    text = "\n\n".join([f"---\n{metadata.to_yaml()}\n---", *parts]) + "\n"
    return {"README.md": text.encode(), **files}


def _draw_episodes(root: Path, info: Mapping[str, Any], provenance: Provenance, environment: Described) -> Figure:
    """The first episodes, all of one length."""
    length = environment.horizon
    path = root / info["data_path"].format(chunk_index=0, file_index=0)
    states = next(pq.ParquetFile(path).iter_batches(DRAWN_EPISODES * length, columns=[OBS_STATE]))[OBS_STATE]
    states = np.array(states.to_pylist()).reshape(-1, length, len(states[0]))  # (N, T, D)
    return environment.draw_episodes(states, provenance)


def _code(text: str, language: str = "bash") -> str:
    """A block of code, whose fence is longer than any in it."""
    text = dedent(text)
    fence = "`" * max(3, *(len(run) + 1 for run in re.findall("`+", text)), 3)
    return f"{fence}{language}\n{text}\n{fence}"


def _plain(text: Any) -> str:
    """Text from a file as one line that is no Markdown and no HTML."""
    return re.sub(r"([\\`*\[\]])", r"\\\1", html.escape(" ".join(str(text).split()), quote=False))


def _span(text: Any) -> str:
    """Text from a file as code within a line."""
    return "`" + " ".join(str(text).split()).replace("`", "'") + "`"


def _png(figure: Figure) -> bytes:
    """Without the version and the date that matplotlib notes: the same picture is the same file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100, metadata={"Software": None})
    return buffer.getvalue()
