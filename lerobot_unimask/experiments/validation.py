"""Validation losses of a trained policy, task by task: the rows of the paper's heatmap (paper, appendix F).

A task's loss is the mean cross-entropy of each component (agent cell, key cell, action) over all asked-for tokens of
all windows, the components added up. One window for each episode, from its first step, with t uniform; the windows and
their masks are the same for every policy.
"""

import json
import logging
import platform
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from torch.utils.data import default_collate

from lerobot_unimask.losses import masked_losses
from lerobot_unimask.masks import RANDOM_MASK, TASKS, TrainingMasks
from lerobot_unimask.modeling_unimask import VALIDATION_STEP, UniMASKPolicy

logger = logging.getLogger(__name__)


def first_windows(policy: UniMASKPolicy, root: Path, repo_id: str) -> dict[str, Tensor]:
    """The window at each episode's first step, as one LeRobot batch, (E, K, ...).

    Raises:
        FileNotFoundError: there is no dataset in `root`. (LeRobot would ask the Hub for it.)
    """
    if not (root / "meta" / "info.json").exists():
        raise FileNotFoundError(f"{root} holds no LeRobotDataset: there is no meta/info.json in it.")
    meta = LeRobotDatasetMetadata(repo_id, root=root)
    deltas = resolve_delta_timestamps(policy.config, meta)
    dataset = LeRobotDataset(repo_id, root=root, delta_timestamps=deltas)
    starts = list(meta.episodes["dataset_from_index"])
    read = dataset.__getitems__
    return default_collate(read(starts) if read else [dataset[start] for start in starts])


@torch.no_grad()
def task_losses(policy: UniMASKPolicy, batch: dict[str, Tensor], masks: Iterable[str]) -> dict[str, float]:
    """Mask text -> loss in nats, s and a added with weight 1."""
    policy.eval()
    window = policy.make_window(batch)
    normalised = policy.statistics.normalise(window)
    index = batch["index"].to(policy.device)
    losses = {}
    for text in masks:
        draw = TrainingMasks(text, tuple(policy.factors), policy.config.context_length).to(policy.device)
        mask = draw(window.valid, index, seed=0, step=VALIDATION_STEP)
        predictions = policy.network(normalised, mask.visible)
        parts = masked_losses(predictions, normalised, mask.predict, policy.factors)
        losses[text] = sum(part.item() for part in parts.values())
    return losses


@torch.no_grad()
def probability_of_truth(policy: UniMASKPolicy, batch: dict[str, Tensor], text: str) -> float:
    """The probability that the policy puts on what was recorded, its mean over the asked-for tokens of all windows.

    Of one task with discrete factors; a token's components are independent, so their probabilities multiply.
    """
    window = policy.make_window(batch)
    draw = TrainingMasks(text, tuple(policy.factors), policy.config.context_length).to(policy.device)
    mask = draw(window.valid, batch["index"].to(policy.device), seed=0, step=VALIDATION_STEP)
    answer = policy.infer(window, mask)
    probabilities = []
    for name, distributions in answer.distributions.items():
        asked = mask.predict[name]
        token = torch.ones(int(asked.sum()), device=policy.device)
        for distribution in distributions:
            truth = window.values[name][..., distribution.component.dims].long()
            token = token * distribution.probabilities.gather(-1, truth).squeeze(-1)[asked]
        probabilities.append(token)
    return torch.cat(probabilities).mean().item()


def checkpoints_of(run: Path) -> list[Path]:
    """A training run's checkpoints in order, or the folder itself if it is a checkpoint.

    Raises:
        FileNotFoundError: it is neither.
    """
    if (run / "config.json").exists():
        return [run]
    found = sorted(path.parent for path in run.glob("checkpoints/*/pretrained_model/config.json"))
    found = [path for path in found if path.parent.name != "last"]  # a link to one of the others
    if not found:
        raise FileNotFoundError(
            f"{run} is neither a checkpoint (a folder with config.json) nor a training run (with checkpoints/)."
        )
    return found


def validate(runs: Sequence[Path], root: Path, repo_id: str) -> dict:
    """Validate every checkpoint of each run; of each run, keep the one with the lowest random-mask loss.

    Raises:
        FileNotFoundError: a folder that is neither a checkpoint nor a training run.
        ValueError: the runs have different windows or features.

    Returns:
        A JSON record: for each run the chosen checkpoint's losses and training settings, and over the runs each task's
        mean and spread.
    """
    results = []
    model = None
    for run in runs:
        best = None
        curve = {}
        for path in checkpoints_of(run):
            policy = UniMASKPolicy.from_pretrained(path)
            if model is None:  # one question, and the same windows, for all
                model = policy.config.context_length, policy.config.features
                batch = first_windows(policy, root, repo_id)
                masks = [
                    text
                    for text in (*TASKS, RANDOM_MASK)
                    if "rtg" not in TASKS.get(text, "") or "rtg" in policy.factors
                ]
            elif model != (policy.config.context_length, policy.config.features):
                raise ValueError(f"{path} has another context length or other features than {runs[0]}: not comparable.")
            losses = task_losses(policy, batch, masks)
            updates = int(policy.updates)
            curve[updates] = losses[RANDOM_MASK]
            if best is None or losses[RANDOM_MASK] < best["losses"][RANDOM_MASK]:
                best = {"updates": updates, "losses": losses, "training": training_settings(path)}
                if all(component.discrete for component in policy.factors["s"].components):
                    truth = probability_of_truth(policy, batch, "forward_dynamics")
                    best["forward_dynamics_probability_of_truth"] = truth
            logger.info("%s: random_mask %.4f", path, losses[RANDOM_MASK])
        results.append({**best, "random_mask_loss_by_updates": curve})
    tasks = list(results[0]["losses"])
    values = {task: [result["losses"][task] for result in results] for task in tasks}
    return {
        "what": "validation loss in nats per task; one window from each episode's first step, t uniform",
        "validation_episodes": len(batch["index"]),
        "validation_data": _provenance(root),
        "mean": {task: sum(numbers) / len(numbers) for task, numbers in values.items()},
        "spread": {task: max(numbers) - min(numbers) for task, numbers in values.items()},
        "runs": results,
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("torch", "lerobot", "lerobot_policy_unimask")},
        },
    }


def _provenance(root: Path) -> dict | None:
    path = root / "meta" / "provenance.json"
    return json.loads(path.read_text()) if path.exists() else None


def training_settings(checkpoint: Path) -> dict | None:
    """What lerobot-train saved beside the weights: the policy's settings, the seed, the data and its provenance."""
    path = checkpoint / "train_config.json"
    if not path.exists():
        return None
    config = json.loads(path.read_text())
    root = config["dataset"].get("root")
    keep = ("seed", "batch_size", "steps")
    policy = {
        key: value for key, value in config["policy"].items() if isinstance(value, str | int | float | dict | list)
    }
    for unrelated in ("input_features", "output_features", "features", "normalization_mapping", "pretrained_path"):
        policy.pop(unrelated, None)
    return {**{key: config[key] for key in keep}, "policy": policy, "data": _provenance(Path(root)) if root else None}
