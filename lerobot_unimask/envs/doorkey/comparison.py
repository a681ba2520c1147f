"""Policies beside DoorKey's exact optimum, on the same windows and masks."""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from lerobot_unimask.asking.answers import answer
from lerobot_unimask.asking.foresight import foretold
from lerobot_unimask.envs.doorkey.expert import Expert
from lerobot_unimask.envs.doorkey.optimum import (
    FACTORS,
    Optimum,
    divergences,
    entropies,
    known_properties,
    mean_over_asked,
    random_mask_divergence,
)
from lerobot_unimask.language.masks import ASKABLE, RANDOM_MASK
from lerobot_unimask.language.training_masks import validation_masks
from lerobot_unimask.modeling_unimask import UniMASKPolicy
from lerobot_unimask.networks.layers import by_component
from lerobot_unimask.objective import masked_losses


@torch.no_grad()
def beside_optimum(
    policies: Sequence[UniMASKPolicy], batch: dict[str, Tensor], masks: Sequence[str], expert: Expert
) -> tuple[dict, list[dict]]:
    """DoorKey's exact optimum on the windows and masks of `task_losses`, and how far from it each policy is.

    Returns:
        The optimum's record: its loss on each task, the loss that it expects, which no model can beat but by chance,
        and how well it foretells what the first policy predicts beside states and actions; and for each policy, each
        task's mean Kullback-Leibler divergence from the exact marginals to its own, components added up, and that over
        many random masks by kind of token and by how much is hidden.

    Raises:
        ValueError: the policies' features are not DoorKey's.
    """
    optimum = Optimum(expert, properties=known_properties(policies[0].config.features))
    window = policies[0].make_window(batch)
    index = batch["index"].to(policies[0].device)
    record: dict = {"expert": expert, "losses": {}, "expected_losses": {}}
    names = policies[0].config.predicted(policies[0].factors)
    record["foretold"] = {
        name: foretold(partial(answer, optimum), window, name) for name in names if name not in ASKABLE
    }
    distances: list[dict] = [{"divergence": {}} for _ in policies]
    normalised = [policy.eval().statistics.normalise(window) for policy in policies]
    for text in masks:
        mask = validation_masks(text, tuple(policies[0].factors), window.valid, index)
        exact = optimum.predict(window, mask)
        marginals = by_component(exact, FACTORS)
        parts = masked_losses(exact, window, mask.asked, FACTORS, apart=True)  # asks for states and actions alone
        record["losses"][text] = sum(part.item() for part in parts.values())
        record["expected_losses"][text] = mean_over_asked(entropies(marginals), mask.asked)
        for policy, values, distance in zip(policies, normalised, distances, strict=True):
            predictions = by_component(policy.predict(values, mask), policy.factors)
            distance["divergence"][text] = mean_over_asked(divergences(marginals, predictions), mask.asked)
    if RANDOM_MASK in masks:
        for policy, values, distance in zip(policies, normalised, distances, strict=True):
            distance["random_mask_divergence"] = random_mask_divergence(optimum, policy, window, values, index)
    return record, distances
