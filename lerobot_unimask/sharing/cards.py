"""Cards: the README.md, and its picture, that goes to the Hub with a policy or a dataset.

Written from what the policy or the dataset's folder itself holds, without asking any server.
"""

import io
import json
import shlex
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from textwrap import dedent, indent
from typing import Any, NamedTuple

import numpy as np
import pyarrow.parquet as pq
import torch
from huggingface_hub import DatasetCardData, ModelCardData
from lerobot.utils.constants import ACTION, OBS_STATE
from matplotlib.figure import Figure

from lerobot_unimask.envs.doorkey import rules
from lerobot_unimask.envs.doorkey.pictures import trajectories
from lerobot_unimask.envs.maze2d import maze
from lerobot_unimask.envs.maze2d.pictures import draw_maze
from lerobot_unimask.language.masks import RANDOM_MASK, TASKS, Mask, tabulate
from lerobot_unimask.language.training_masks import TrainingMasks
from lerobot_unimask.modeling_unimask import UniMASKPolicy
from lerobot_unimask.plots.answers import mask_diagram
from lerobot_unimask.plots.style import WIDTH

PLUGIN = "lerobot_policy_unimask"

INSTALL = f"pip install {PLUGIN}  # or, in a copy of the project: pip install ."

LICENSE = "apache-2.0"

DRAWN_EPISODES = 6


def policy_card(
    policy: UniMASKPolicy,
    repo_id: str,
    *,
    train_config: Mapping[str, Any] | None = None,
    command: str | None = None,
    results: Sequence[Mapping[str, Any]] = (),
) -> dict[str, bytes]:
    """A policy's card: file name -> content.

    Args:
        repo_id: where it is to be found, for the commands that the card shows.
        train_config: what lerobot-train saved beside the weights.
        command: the training command.
        results: records of `unimask validate` (losses by task) and lerobot-eval's `eval_info.json`s (rollouts).

    Raises:
        ValueError: a record of another kind.
    """
    config = policy.config
    data = (train_config or {}).get("dataset") or {}
    public = bool(config.dataset_revision or not data.get("root")) and data.get("repo_id")
    metadata = ModelCardData(
        license=config.license or LICENSE,
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=sorted({"lerobot", "robotics", "unimask", *(config.tags or [])}),
        datasets=[data["repo_id"]] if public else None,
    )
    questions, picture = _questions(policy)
    parts = [
        f"# {repo_id.split('/')[-1]}",
        "A [UniMASK](https://arxiv.org/abs/2211.10869) policy: one masked model that answers any question about "
        "behaviour, as a policy of [LeRobot](https://github.com/huggingface/lerobot). It needs the plugin "
        f"`{PLUGIN}` (version {version(PLUGIN)} has pushed it):",
        _code(INSTALL),
        "## Try it",
        _code(_commands(policy, repo_id, train_config or {})),
        "## The questions it was trained on",
        questions,
        "![The question that it answers when it acts](mask.png)",
        "## The model",
        _model(policy),
        "## Training",
        _training(policy, repo_id, train_config, command),
    ]
    if results:
        parts += ["## Results", *_results(results)]
    text = "\n\n".join([f"---\n{metadata.to_yaml()}\n---", *parts]) + "\n"
    return {"README.md": text.encode(), "mask.png": picture}


def _questions(policy: UniMASKPolicy) -> tuple[str, bytes]:
    """Each training mask with its share of the windows and, drawn, one of its masks; the acting question's picture."""
    factors, K = tuple(policy.factors), policy.config.context_length
    weights = policy.training_masks.weights
    lines = []
    for text, weight in weights.items():
        if text == RANDOM_MASK:
            mask, meaning = _random_example(factors, K), "any states and actions given any others; for instance"
        else:
            mask, t = _example(text, factors, K)
            meaning = TASKS.get(text, text) + (f"   at t = {t}" if t is not None else "")
        name = text if text in TASKS or text == RANDOM_MASK else "question"
        lines += [f"{name} ({weight / sum(weights.values()):.0%}): {meaning}", indent(mask.draw(), "    ")]
    acting, _ = _example(policy.config.inference_mask, factors, K)
    legend = "Shown `#`, asked `?`, neither `.`, over the steps of a window:"
    return f"{legend}\n\n{_code(chr(10).join(lines), 'text')}", _png(mask_diagram(acting))


def _example(text: str, factors: tuple[str, ...], K: int) -> tuple[Mask, int | None]:
    """A question's mask, at the middle one of its t, and that t."""
    table = tabulate(text, factors, K)
    t = int(table.t[len(table.t) // 2]) if table.question.uses_t else None
    return table.at(t), t


def _random_example(factors: tuple[str, ...], K: int) -> Mask:
    """Of some windows' draws the one that hides nearest to half of the states and actions."""
    windows = 64
    draws = TrainingMasks(RANDOM_MASK, factors, K)(
        torch.ones(windows, K, dtype=torch.bool), torch.arange(windows), seed=0, step=0
    )
    hidden = torch.cat(list(draws.asked.values()), dim=1).sum(1)  # (64,)
    best = int((hidden - K).abs().argmin())
    return Mask(
        *({name: tokens[best : best + 1] for name, tokens in part.items()} for part in (draws.shown, draws.asked))
    )


def _model(policy: UniMASKPolicy) -> str:
    rows = []
    for name, features in policy.config.features.items():
        for feature in features:
            names = ", ".join(feature.names or ["…"] * feature.size)
            values = "continuous"
            if feature.categories:
                values = " x ".join(map(str, feature.categories)) + " categories"
            rows.append(f"| `{name}` | `{feature.key}` | {feature.size} | {names} | {values} |")
    parameters = sum(parameter.numel() for parameter in policy.network.parameters())
    config = policy.config
    return (
        "| factor | column | numbers | names | values |\n| --- | --- | --- | --- | --- |\n"
        + "\n".join(rows)
        + f"\n\nContext length: {config.context_length} steps. Attention: {config.attention}. Acting asks "
        f"`{TASKS.get(config.inference_mask, config.inference_mask)}`. {parameters:,} parameters, "
        f"{int(policy.updates):,} updates."
    )


def _training(policy: UniMASKPolicy, repo_id: str, train_config: Mapping[str, Any] | None, command: str | None) -> str:
    if train_config is None:
        return "How it was trained was not saved with it."
    data = train_config["dataset"]
    revision = policy.config.dataset_revision
    place = f"at revision `{revision}`" if revision else "local: it was read from a folder, which has no revision"
    again = f"lerobot-train --config_path={repo_id} --policy.push_to_hub=false --output_dir=outputs/again"
    return f"Data: `{data['repo_id']}`, {place}.\n\n{_code(command or again)}"


def _commands(policy: UniMASKPolicy, repo_id: str, train_config: Mapping[str, Any]) -> str:
    """Evaluating, asking, fine-tuning: three commands that work as they stand where the training did."""
    data = train_config.get("dataset") or {"repo_id": "ME/DATASET"}
    dataset = f"--dataset.repo_id={data['repo_id']}"
    if data.get("root") and not policy.config.dataset_revision:
        dataset += f" --dataset.root={shlex.quote(str(data['root']))}"
    environment = (train_config.get("env") or {}).get("type") or _environment(data.get("root")) or "YOUR_ENVIRONMENT"
    weights = policy.training_masks.weights
    question = next((text for text in weights if text != RANDOM_MASK), "behavior_cloning")
    _, t = _example(question, tuple(policy.factors), policy.config.context_length)
    at = "" if t is None else f" --t={t}"
    return (
        f"lerobot-eval --policy.path={repo_id} --env.type={environment} --eval.n_episodes=100 --eval.batch_size=50\n"
        f"unimask query --policy.path={repo_id} {dataset} --episode=0 --mask={shlex.quote(question)}{at}\n"
        f"lerobot-train --policy.path={repo_id} --policy.push_to_hub=false {dataset} "
        "--policy.training_masks=behavior_cloning --policy.optimizer_lr=1e-4 --steps=500 --batch_size=100 "
        "--num_workers=0 --output_dir=outputs/tuned"
    )


def _environment(root: str | None) -> str | None:
    """The `--env.type` of a dataset built here, if its folder is still there."""
    info = Path(root or "") / "meta" / "info.json"
    robot = json.loads(info.read_text()).get("robot_type") if root and info.exists() else None
    return robot if robot in ("doorkey", "maze2d") else None


def _results(results: Sequence[Mapping[str, Any]]) -> list[str]:
    parts = []
    for record in results:
        if "mean" in record and "validation_episodes" in record:
            rows = "\n".join(f"| `{task}` | {loss:.3f} |" for task, loss in record["mean"].items())
            runs = len(record["runs"])
            parts.append(
                f"Validation loss, in nats per asked token, on {record['validation_episodes']:,} episodes"
                f"{f', mean of {runs} runs' if runs > 1 else ''}:\n\n| task | loss |\n| --- | --- |\n{rows}"
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


class Environment(NamedTuple):
    """What a dataset's card says about where its episodes took place."""

    type: str  # --env.type
    description: str
    expert: str
    reward: str
    columns: dict[str, str]


ENVIRONMENTS = {
    rules.ENV_ID: Environment(
        type="doorkey",
        description="DoorKey, a gridworld of 4 x 4 cells: fetch the key, open the door, walk to the goal. Every "
        "episode has 10 steps.",
        expert="noisily rational, its actions drawn with probability proportional to exp(beta C(a))",
        reward="by how many steps the agent came closer to the goal: 1, 0 or -1",
        columns={
            OBS_STATE: "the agent's cell and the key's, 0 to 15, numbered row by row; equal once the key is carried",
            ACTION: "right 0, down 1, left 2, up 3",
        },
    ),
    maze.ENV_ID: Environment(
        type="maze2d",
        description="Maze2D, a point mass in a maze on MuJoCo, its velocity hidden. Every episode has 200 steps.",
        expert="a waypoint controller with normal noise on its actions",
        reward="by how much the distance to the goal shrank, in cells",
        columns={
            OBS_STATE: "the position and the goal's, x and y each, in cells",
            ACTION: "the force along x and y, each in [-1, 1]",
        },
    ),
}

COLUMNS = {
    "observation.return_to_go": "the sum of rewards from this step to the episode's end",
    "next.reward": "the reward of this step",
    "next.done": "whether this step is the episode's last",
    "timestamp": "seconds since the episode's start",
    "frame_index": "the step's number within the episode",
    "episode_index": "the episode's number",
    "index": "the step's number within the dataset",
    "task_index": "the task's number in meta/tasks.parquet",
}


def dataset_card(root: Path, repo_id: str) -> dict[str, bytes]:
    """A dataset's card: file name -> content; with a picture where it is of an environment of this package."""
    info = json.loads((root / "meta" / "info.json").read_text())
    path = root / "meta" / "provenance.json"
    provenance = json.loads(path.read_text()) if path.exists() else {}
    environment = ENVIRONMENTS.get(provenance.get("environment"))
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
        expert = provenance["expert"]
        settings = ", ".join(f"{name} {provenance[name]}" for name in ("beta", "noise", "maze") if name in provenance)
        facts = {
            "environment": f"{environment.description} (`--env.type={environment.type}`)",
            "expert": f"{expert}: {environment.expert}" if expert not in environment.expert else environment.expert,
            "settings": f"{settings}, seed {provenance['seed']}",
            "reward": environment.reward,
            **facts,
        }
    meanings = {**COLUMNS, **(environment.columns if environment else {})}
    columns = "\n".join(
        f"| `{name}` | {column['dtype']} ({', '.join(map(str, column['shape']))}) | {_categories(column)} | "
        f"{meanings.get(name) or ', '.join(column.get('names') or [])} |"
        for name, column in info["features"].items()
    )
    parts = [
        f"# {repo_id.split('/')[-1]}",
        "A dataset for [LeRobot](https://github.com/huggingface/lerobot).",
        "\n".join(f"- {name}: {fact}" for name, fact in facts.items()),
        "## Columns",
        f"| column | type | categories | meaning |\n| --- | --- | --- | --- |\n{columns}",
        "## Use",
        _code(
            f"{INSTALL}\nlerobot-train --policy.type=unimask --policy.push_to_hub=false --dataset.repo_id={repo_id} "
            "--steps=2000 --batch_size=100 --num_workers=0"
        ),
    ]
    if "command" in provenance:
        parts += [f"Made by {PLUGIN} {provenance['package_version']} with:", _code(provenance["command"])]
    files = {}
    if environment:
        files["episodes.png"] = _png(_draw_episodes(root, info, provenance, environment))
        parts.insert(3, f"![The first {DRAWN_EPISODES} episodes](episodes.png)")
    text = "\n\n".join([f"---\n{metadata.to_yaml()}\n---", *parts]) + "\n"
    return {"README.md": text.encode(), **files}


def _categories(column: Mapping[str, Any]) -> str:
    return " x ".join(map(str, column.get("categories") or []))


def _draw_episodes(
    root: Path, info: Mapping[str, Any], provenance: Mapping[str, Any], environment: Environment
) -> Figure:
    """The ways of the first episodes, all of one length, seen from above."""
    length = {"doorkey": rules.HORIZON, "maze2d": maze.HORIZON}[environment.type]
    path = root / info["data_path"].format(chunk_index=0, file_index=0)
    states = next(pq.ParquetFile(path).iter_batches(DRAWN_EPISODES * length, columns=[OBS_STATE]))[OBS_STATE]
    states = np.array(states.to_pylist()).reshape(-1, length, len(states[0]))  # (N, T, D)
    if environment.type == "doorkey":
        return trajectories({f"{len(states)} episodes": states}, most=DRAWN_EPISODES)
    figure = Figure(figsize=(0.6 * WIDTH, 0.6 * WIDTH), layout="constrained")
    axes = figure.subplots()
    draw_maze(axes, provenance["maze"])
    for way in states:
        (line,) = axes.plot(way[:, 0], way[:, 1], linewidth=1.2)
        axes.plot(*way[0, :2], marker=".", color=line.get_color())
        axes.plot(*way[0, 2:], marker="*", markersize=9, color=line.get_color())
    axes.set_title("from the dot towards the star")
    return figure


def _code(text: str, language: str = "bash") -> str:
    return f"```{language}\n{dedent(text)}\n```"


def _png(figure: Figure) -> bytes:
    """Without the version and the date that matplotlib notes: the same picture is the same file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100, metadata={"Software": None})
    return buffer.getvalue()
