"""What training minimises: from a window to its loss, captured by torch.compile where the config says so."""

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import ASKABLE
from lerobot_unimask.networks.losses import masked_losses

Losses = tuple[Tensor, dict[str, Tensor]]  # the loss, and each factor's part in it


def batch_loss(policy: Any, window: Window, index: Tensor, step: Tensor | int, reduction: str = "mean") -> Losses:
    """Masks, forward pass and losses of one batch. It never waits for a device, and torch.compile captures it whole.

    Args:
        policy: its masks, statistics, network, factors and config.
        window: values in the dataset's units.
        index: (B,) the windows' first frames, and
        step: updates made so far, on which the masks depend.
        reduction: as `masked_losses` takes it.
    """
    mask = policy.training_masks(window.valid, index, seed=policy.config.mask_seed, step=step)
    window = policy.statistics.normalise(window)
    predictions = policy.network(window, mask.shown, mask.causal, asked=mask.asked)
    losses = masked_losses(predictions, window, mask.asked, policy.factors, reduction=reduction)
    config = policy.config
    each = {name: 1.0 if name in ASKABLE else 1 / config.context_length for name in losses} | config.loss_weights
    return sum(each[name] * part for name, part in losses.items()), losses


class CapturedLoss:
    """`batch_loss`, captured for the shapes of the first batch that trains. What does not fit runs eagerly: another
    number of windows, as in an epoch's last batch, or a loss for each window.

    On a GPU the capture is replayed as CUDA graphs, one for the forward and one for the backward pass. The policy stays
    as it is, so its checkpoints are the same files.
    """

    def __init__(self) -> None:
        self.size: int | None = None  # windows of a batch

    def __call__(self, policy: Any, window: Window, index: Tensor, step: Tensor | int, reduction: str) -> Losses:
        if not policy.training or reduction != "mean" or self.size not in (None, len(window.valid)):
            return batch_loss(policy, window, index, step, reduction)
        self.size = len(window.valid)
        on_gpu = window.valid.device.type == "cuda"
        loss, losses = _captured("reduce-overhead" if on_gpu else "default")(policy, window, index, step)
        # A graph's next replay overwrites its outputs.
        return (loss.clone(), {name: part.clone() for name, part in losses.items()}) if on_gpu else (loss, losses)


@functools.cache
def _captured(mode: str) -> Callable[..., Losses]:
    return torch.compile(batch_loss, dynamic=False, mode=mode)
