"""Validation losses of a trained policy, task by task: the rows of the paper's heatmap (paper, appendix F).

A task's loss is the mean cross-entropy of each component (agent cell, key cell, action) over all asked-for tokens of
all windows, the components added up. One window for each episode, from its first step, with t uniform; the windows and
their masks are the same for every policy.
"""

import contextlib
import logging
import platform
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor

from lerobot_unimask.data.checkpoints import checkpoints_of, training_settings
from lerobot_unimask.data.episodes import first_windows, open_dataset, provenance_of
from lerobot_unimask.data.window import Window
from lerobot_unimask.envs.doorkey.expert import Expert
from lerobot_unimask.envs.doorkey.optimum import (
    Optimum,
    check_expert,
    check_features,
    divergences,
    entropies,
    mean_over_asked,
    random_mask_divergence,
)
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import RANDOM_MASK, TASKS, Mask
from lerobot_unimask.language.training_masks import VALIDATION_STEP, TrainingMasks
from lerobot_unimask.modeling_unimask import UniMASKPolicy
from lerobot_unimask.networks.losses import masked_losses

logger = logging.getLogger(__name__)


def question_masks(policy: UniMASKPolicy, window: Window, index: Tensor, text: str) -> Mask:
    """One question for each window, the same for every policy.

    Raises:
        MaskError: the policy lacks a factor of the question.
    """
    draw = TrainingMasks(text, tuple(policy.factors), policy.config.context_length).to(policy.device)
    return draw(window.valid, index, seed=0, step=VALIDATION_STEP)


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
    """Mask text -> loss in nats, s and a added with weight 1."""
    policy.eval()
    window = policy.make_window(batch)
    normalised = policy.statistics.normalise(window)
    index = batch["index"].to(policy.device)
    losses = {}
    for text in masks:
        mask = question_masks(policy, window, index, text)
        predictions = policy.predict(normalised, mask)
        parts = masked_losses(predictions, normalised, mask.asked, policy.factors)
        losses[text] = sum(part.item() for part in parts.values())
    return losses


@torch.no_grad()
def beside_optimum(
    policies: Sequence[UniMASKPolicy], batch: dict[str, Tensor], masks: Sequence[str], expert: Expert
) -> tuple[dict, list[dict]]:
    """DoorKey's exact optimum on the windows and masks of `task_losses`, and how far from it each policy is.

    Returns:
        The optimum's record: its loss on each task, and the loss that it expects, which no model can beat but by
        chance; and for each policy, each task's mean Kullback-Leibler divergence from the exact marginals to its own,
        components added up, and that over many random masks by kind of token and by how much is hidden.

    Raises:
        ValueError: the policies' features are not DoorKey's.
    """
    check_features(policies[0].config.features)
    optimum = Optimum(expert)
    window = policies[0].make_window(batch)
    index = batch["index"].to(policies[0].device)
    record: dict = {"expert": expert, "losses": {}, "expected_losses": {}}
    distances: list[dict] = [{"divergence": {}} for _ in policies]
    normalised = [policy.eval().statistics.normalise(window) for policy in policies]
    for text in masks:
        mask = question_masks(policies[0], window, index, text)
        exact = optimum(window, mask)
        parts = masked_losses(exact, window, mask.asked, policies[0].factors)
        record["losses"][text] = sum(part.item() for part in parts.values())
        record["expected_losses"][text] = mean_over_asked(entropies(exact), mask.asked)
        for policy, values, distance in zip(policies, normalised, distances, strict=True):
            predictions = policy.predict(values, mask)
            distance["divergence"][text] = mean_over_asked(divergences(exact, predictions), mask.asked)
    if RANDOM_MASK in masks:
        for policy, values, distance in zip(policies, normalised, distances, strict=True):
            distance["random_mask_divergence"] = random_mask_divergence(optimum, policy.predict, window, values, index)
    return record, distances


@torch.no_grad()
def probability_of_truth(policy: UniMASKPolicy, batch: dict[str, Tensor], text: str) -> float:
    """The probability that the policy puts on what was recorded, its mean over the asked-for tokens of all windows.

    Of one task with discrete factors; a token's components are independent, so their probabilities multiply.
    """
    window = policy.make_window(batch)
    mask = question_masks(policy, window, batch["index"].to(policy.device), text)
    answer = policy.infer(window, mask)
    probabilities = []
    for name, distributions in answer.distributions.items():
        asked = mask.asked[name]
        token = torch.ones(int(asked.sum()), device=policy.device)
        for distribution in distributions:
            truth = window.values[name][..., distribution.component.dims].long()
            token = token * distribution.probabilities.gather(-1, truth).squeeze(-1)[asked]
        probabilities.append(token)
    return torch.cat(probabilities).mean().item()


def validate(runs: Sequence[Path], root: Path, repo_id: str, exact: Expert | None = None) -> dict:
    """Validate every checkpoint of each run; of each run, keep the one with the lowest random-mask loss (of a
    model that answers no random masks, the lowest mean over the tasks that it does).

    Args:
        exact: whose data it is, to set DoorKey's exact optimum beside the runs.

    Raises:
        FileNotFoundError: a folder that is neither a checkpoint nor a training run.
        ValueError: the runs have different windows or features; the optimum is asked for of other data.

    Returns:
        A JSON record: for each run the chosen checkpoint's losses and training settings, and over the runs each task's
        mean and spread.
    """
    provenance = provenance_of(root)
    check_expert(root, exact)
    results, chosen = [], []
    model = None
    for run in runs:
        curve = {}
        for path in checkpoints_of(run):
            policy = UniMASKPolicy.from_pretrained(path)
            if model is None:  # one question, and the same windows, for all
                model = policy.config.context_length, policy.config.features
                batch = first_windows(open_dataset(policy.config, root, repo_id))
                masks = answered(policy, batch)
            elif model != (policy.config.context_length, policy.config.features):
                raise ValueError(f"{path} has another context length or other features than {runs[0]}: not comparable.")
            losses = task_losses(policy, batch, masks)
            updates = int(policy.updates)
            curve[updates] = losses.get(RANDOM_MASK, sum(losses.values()) / len(losses))
            if curve[updates] == min(curve.values()):
                best, best_policy = {"updates": updates, "losses": losses, "training": training_settings(path)}, policy
                if "forward_dynamics" in masks and all(c.discrete for c in policy.factors["s"].components):
                    truth = probability_of_truth(policy, batch, "forward_dynamics")
                    best["forward_dynamics_probability_of_truth"] = truth
            logger.info("%s: %.4f", path, curve[updates])
        results.append({**best, "random_mask_loss_by_updates": curve})
        chosen.append(best_policy)
    tasks = list(results[0]["losses"])
    values = {task: [result["losses"][task] for result in results] for task in tasks}
    optimum = {}
    if exact:
        optimum["optimum"], distances = beside_optimum(chosen, batch, tasks, exact)
        best = optimum["optimum"]["losses"]
        for result, distance in zip(results, distances, strict=True):
            result["above_optimum"] = {task: loss - best[task] for task, loss in result["losses"].items()}
            result.update(distance)
    return {
        "what": "validation loss in nats per task; one window from each episode's first step, t uniform",
        "validation_episodes": len(batch["index"]),
        "validation_data": provenance,
        "mean": {task: sum(numbers) / len(numbers) for task, numbers in values.items()},
        "spread": {task: max(numbers) - min(numbers) for task, numbers in values.items()},
        **optimum,
        "runs": results,
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("torch", "lerobot", "lerobot_policy_unimask")},
        },
    }
