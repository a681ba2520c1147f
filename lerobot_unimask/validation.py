"""Validation losses of a trained policy, task by task: the rows of the paper's heatmap (paper, appendix F).

A task's loss is the mean cross-entropy of each component (agent cell, key cell, action) over all asked-for tokens of
all windows, the components added up. One window for each episode, from its first step, with t uniform; the windows and
their masks are the same for every policy.
"""

import contextlib
import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lerobot_unimask.asking.answers import DiscreteDistribution
from lerobot_unimask.asking.foresight import QUESTION, foretold
from lerobot_unimask.data.checkpoints import checkpoints_of, episodes_trained_on, training_settings
from lerobot_unimask.data.episodes import first_windows, open_dataset, provenance_of
from lerobot_unimask.envs import environment_of_states
from lerobot_unimask.envs.record import optimum_of
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import ASKABLE, RANDOM_MASK, TASKS
from lerobot_unimask.language.training_masks import validation_masks
from lerobot_unimask.modeling_unimask import UniMASKPolicy
from lerobot_unimask.objective import masked_losses
from lerobot_unimask.records import versions

logger = logging.getLogger(__name__)


def answered(policy: UniMASKPolicy, batch: dict[str, Tensor]) -> list[str]:
    """The tasks, and random masks, that the policy answers: it has the factors, and attends as they need."""
    found = []
    for text in (*TASKS, RANDOM_MASK):
        with contextlib.suppress(MaskError):
            task_losses(policy, batch, [text])
            found.append(text)
    return found


@torch.no_grad()
def task_losses(policy: UniMASKPolicy, batch: dict[str, Tensor], masks: Iterable[str]) -> dict[str, float]:
    """Mask text -> loss in nats, s and a added with weight 1; of each component's marginal, as the paper has it."""
    policy.eval()
    window = policy.make_window(batch)
    normalised = policy.statistics.normalise(window)
    losses = {}
    for text in masks:
        mask = validation_masks(text, tuple(policy.factors), window.valid, batch["index"], tuple(policy.cameras))
        predictions = policy.predict(normalised, mask)
        parts = masked_losses(predictions, normalised, mask.asked, policy.factors, apart=True)
        losses[text] = sum(parts[name].item() for name in ASKABLE)
    return losses


def foretold_properties(policy: UniMASKPolicy, batch: dict[str, Tensor]) -> dict[str, list[dict[str, Any]]]:
    """The return and each property of one number, where the policy predicts them: how well, see `foretold`."""
    window = policy.make_window(batch)
    names = [name for name in policy.config.predicted(policy.factors) if name not in ASKABLE]
    return {
        name: foretold(policy.infer, window, name, tuple(policy.cameras))
        for name in names
        if policy.factors[name].given_size == 1
    }


@torch.no_grad()
def probability_of_truth(policy: UniMASKPolicy, batch: dict[str, Tensor], text: str) -> float:
    """The probability that the policy puts on what was recorded, its mean over the asked-for tokens of all windows.

    Of one task with discrete factors; outputs of a token are independent, so their probabilities multiply.
    """
    window = policy.make_window(batch)
    mask = validation_masks(text, tuple(policy.factors), window.valid, batch["index"], tuple(policy.cameras))
    answer = policy.infer(window, mask)
    probabilities = []
    for name, distributions in answer.distributions.items():
        asked = mask.asked[name]
        token = torch.ones(int(asked.sum()), device=policy.device)
        for distribution in (part for part in distributions if isinstance(part, DiscreteDistribution)):
            token = token * distribution.probability(window.values[name].nan_to_num())[asked]
        probabilities.append(token)
    return torch.cat(probabilities).mean().item()


def validate(
    runs: Sequence[str | Path],
    root: Path | None,
    repo_id: str | None = None,
    *,
    exact: str | None = None,
    revision: str | None = None,
) -> dict[str, Any]:
    """Validate every checkpoint of each run; of each run, keep the one with the lowest random-mask loss (of a
    model that answers no random masks, the lowest mean over the tasks that it does).

    Args:
        runs: checkpoints, lerobot-train output folders or repositories of the Hub.
        root: folder of the dataset; None: `repo_id` names it.
        exact: expert whose data it is, to set the environment's exact optimum beside the runs.
        revision: commit of a repository.

    Raises:
        FileNotFoundError: a folder that is neither a checkpoint nor a training run.
        ValueError: the runs have different windows or features; the optimum is asked for of other data.

    Returns:
        A JSON record: for each run the chosen checkpoint's losses and training settings, and over the runs each task's
        mean and spread.
    """
    results: list[dict[str, Any]] = []
    chosen: list[UniMASKPolicy] = []
    dataset: Any = None
    for run in runs:
        curve: dict[int, float] = {}
        for path in checkpoints_of(Path(run)) if Path(run).is_dir() else [run]:
            policy = UniMASKPolicy.from_pretrained(path, revision=revision)
            if dataset is None:  # one question, and the same windows, for all
                model = policy.config.context_length, policy.config.features
                dataset = open_dataset(policy.config, root, repo_id)
                provenance = provenance_of(Path(dataset.root))
                if exact is not None:
                    exact_optimum = optimum_of(environment_of_states(policy.number_names["s"]), exact, provenance)
                batch = first_windows(dataset)
                masks = answered(policy, batch)
            elif model != (policy.config.context_length, policy.config.features):
                raise ValueError(f"{path} has another context length or other features than {runs[0]}: not comparable.")
            losses = task_losses(policy, batch, masks)
            updates = int(policy.updates)
            curve[updates] = losses.get(RANDOM_MASK, sum(losses.values()) / len(losses))
            if curve[updates] == min(curve.values()):
                best, best_policy = (
                    {"updates": updates, "losses": losses, "training": training_settings(policy.folder)},
                    policy,
                )
                if "forward_dynamics" in masks and policy.factors["s"].discrete:
                    truth = probability_of_truth(policy, batch, "forward_dynamics")
                    best["forward_dynamics_probability_of_truth"] = truth
            logger.info("%s: %.4f", path, curve[updates])
        chosen.append(best_policy)
        count = len(batch["index"])
        seen = len(episodes_trained_on(best_policy.folder, Path(dataset.root), repo_id, count))
        best |= {"trained_on_episodes": seen, "random_mask_loss_by_updates": curve}
        results.append({**best, "foretold": foretold_properties(best_policy, batch)})
        if seen:
            logger.warning(
                "%s was trained on %d of these %d episodes: these losses are not those of unseen ones.",
                run,
                seen,
                count,
            )
    tasks = list(results[0]["losses"])
    values = {task: [result["losses"][task] for result in results] for task in tasks}
    optimum: dict[str, Any] = {}
    if exact is not None:
        optimum["optimum"], distances = exact_optimum.compare(chosen, batch, tasks, exact)
        lowest = optimum["optimum"]["losses"]
        for result, distance in zip(results, distances, strict=True):
            result["above_optimum"] = {task: loss - lowest[task] for task, loss in result["losses"].items()}
            result.update(distance)
    return {
        "what": "validation loss per task; one window from each episode's first step, t uniform",
        "units": "losses, mean, spread, optimum and what lies above it: nats; probabilities: 0 to 1; foretold: errors "
        "in the dataset's units",
        "validation_episodes": len(batch["index"]),
        "validation_data": provenance,
        "mean": {task: sum(numbers) / len(numbers) for task, numbers in values.items()},
        "spread": {task: max(numbers) - min(numbers) for task, numbers in values.items()},
        **optimum,
        "runs": results,
        "versions": versions(),
    }


def summary(record: dict[str, Any]) -> str:
    """A record of `validate` for people, a line for each task, and for each time that a property is foretold."""
    width = max(map(len, record["mean"]))
    lines = []
    for task, loss in record["mean"].items():
        line = f"{task:{width}}  {loss:.4f} nats  (spread {record['spread'][task]:.4f} over {len(record['runs'])} runs)"
        if "optimum" in record:
            best, expected = (record["optimum"][kind][task] for kind in ("losses", "expected_losses"))
            line += f"  optimum {best:.4f}, expected {expected:.4f}"
        lines.append(line)
    optimum = record.get("optimum", {}).get("foretold", {})
    for run in record["runs"]:
        for name, asked in run["foretold"].items():
            best = optimum.get(name, [{}] * len(asked))
            for said, exact in zip(asked, best, strict=True):
                parts = [
                    f"{what.replace('_', ' ')} {said[what]:.4f}"
                    + (f" (optimum {exact[what]:.4f})" if what in exact else "")
                    for what in ("mean_absolute_error", "error", "log_loss", "calibration_error")
                    if what in said
                ]
                lines.append(f"{QUESTION.format(name=name)}, t={said['t']}: {', '.join(parts)}")
    return "\n".join(lines)
