"""What training minimises: from a window to its loss, captured by torch.compile where the config says so."""

import functools
import logging
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, distributed

from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import ASKABLE
from lerobot_unimask.networks.losses import masked_losses

logger = logging.getLogger(__name__)

EAGER = 200  # updates before the first that is captured where nobody requires it
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

    Args:
        required: whether updates are captured from the first one on, on any device, and an error ends the training.
            Otherwise they are on a GPU, once there have been `EAGER`, for a short training ends before a capture pays;
            not of cameras, nor in one of several processes; and an error is logged, and updates run eagerly.
    """

    def __init__(self, *, required: bool) -> None:
        self.required = required
        self.size: int | None = None  # windows of a batch
        self.seen = 0  # batches of that size
        self.rehearsed = self.failed = False

    def __call__(self, policy: Any, window: Window, index: Tensor, step: Tensor | int, reduction: str) -> Losses:
        if policy.training and reduction == "mean":
            self.size = self.size or len(window.valid)
            if self.size == len(window.valid):
                self.seen += 1
                if self._captures(policy, window):
                    return self._replay(policy, window, index, step)
        return batch_loss(policy, window, index, step, reduction)

    def _captures(self, policy: Any, window: Window) -> bool:
        if self.required or self.failed:
            return self.required
        alone = not (distributed.is_available() and distributed.is_initialized())
        return window.valid.device.type == "cuda" and alone and not policy.cameras and self.seen > EAGER

    def _replay(self, policy: Any, window: Window, index: Tensor, step: Tensor | int) -> Losses:
        on_gpu = window.valid.device.type == "cuda"
        captured = _captured("reduce-overhead" if on_gpu else "default")
        try:
            if not self.required and not self.rehearsed:
                _rehearse(captured, policy, window, index, step)
                self.rehearsed = True
            loss, losses = captured(policy, window, index, step)
        except Exception as error:
            if self.required:
                raise
            self.failed = True
            logger.warning("Updates are not captured, and run as they did before: %s", str(error).split("\n")[0])
            return batch_loss(policy, window, index, step)
        # A graph's next replay overwrites its outputs.
        return (loss.clone(), {name: part.clone() for name, part in losses.items()}) if on_gpu else (loss, losses)


def _rehearse(captured: Callable[..., Losses], policy: Any, window: Window, index: Tensor, step: Tensor | int) -> None:
    """Forth and back until CUDA graphs have been warmed up, recorded and replayed: what fails, fails here, where
    updates can still go on eagerly."""
    weights = [weight for weight in policy.parameters() if weight.requires_grad]
    for _ in range(3):
        loss, _ = captured(policy, window, index, step)
        with torch.autocast(window.valid.device.type, enabled=False):
            torch.autograd.grad(loss, weights, allow_unused=True)


@functools.cache
def _captured(mode: str) -> Callable[..., Losses]:
    return torch.compile(batch_loss, dynamic=False, mode=mode)
