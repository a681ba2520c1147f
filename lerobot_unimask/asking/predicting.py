"""From a question to the network's outputs: which way a window is read follows from what is asked."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import torch
from torch import nn

from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import Mask
from lerobot_unimask.language.training_masks import TrainingMasks, check_predicted
from lerobot_unimask.networks.layers import Cache, Predictions


class Learnt(Protocol):
    """A network, and what it was trained on."""

    config: UniMASKConfig
    training_masks: TrainingMasks
    network: nn.Module


@contextmanager
def without_dropout(model: nn.Module) -> Iterator[None]:
    """Answers are given in evaluation mode, also while the model is being trained."""
    was_training = model.training
    if was_training:  # each change of mode walks through all modules
        model.eval()
    try:
        yield
    finally:
        if was_training:
            model.train()


def predict(model: Learnt, window: Window, mask: Mask, cache: Cache | None = None) -> Predictions:
    """What the network puts out for each asked token. A token that follows a history shown in full is predicted
    causally, where the model has learnt that, and every other one in both directions; so a token's answer does not
    depend on what else is asked.

    Args:
        window: normalised values.
        cache: what the rollout that asks has computed before; of a causal prediction that is not computed again.

    Raises:
        MaskError: the model attends causally alone and has not learnt to answer this, or asks for what it does not
            predict.
    """
    network = model.network
    if cache is not None and cache.question is mask:
        return network(window, mask.shown, True, cache, mask.asked)
    causally = model.training_masks.answered_causally(mask)
    check_predicted(mask, model.config.predicted(mask.asked))
    if all(torch.equal(causally[name], asked) for name, asked in mask.asked.items()):
        if cache is not None:
            cache.question = mask
        return network(window, mask.shown, True, cache, mask.asked)
    if model.config.attention == "causal":
        raise MaskError(
            "This model attends causally alone. It was trained on "
            f"{', '.join(model.training_masks.weights)}, and asks for one token given every state, picture and "
            "action before it. A model of attention=both answers any question.",
            mask.draw(),
        )
    predictions = network(window, mask.shown, False, asked=mask.asked)
    if any(tokens.any() for tokens in causally.values()):
        for name, outputs in network(window, mask.shown, True, asked=causally).items():
            here = causally[name].unsqueeze(-1)
            pairs = zip(outputs, predictions[name], strict=True)
            predictions[name] = [torch.where(here, causal, other) for causal, other in pairs]
    return predictions
