"""What training minimises: from a window to its loss, over the asked-for tokens; captured by torch.compile where the
config says so.

Legend of shapes: B windows, K steps, D the dimensions of a factor.
"""

import functools
import logging
import math
from collections import UserDict
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, distributed
from torch.nn import functional

from lerobot_unimask.data.factors import LINK, Factor, Output
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import ASKABLE
from lerobot_unimask.networks.layers import Predictions, marginals

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


def output_loss(prediction: Tensor, value: Tensor, output: Output) -> Tensor:
    """What one output costs at every step, (B, K): cross-entropy in nats; or, averaged over its numbers and in units of
    their standard deviations, the squared error or the Gaussians' negative log-likelihood in nats.

    Note: The gradient of a Gaussian's means and scales is that of the negative log-likelihood times the predicted
        scale (Seitzer et al., "On the pitfalls of heteroscedastic uncertainty estimation", 2022, beta = 1/2); a
        mixture's Gaussians besides share it as they share the density. Without it, what is predicted to within a
        fiftieth of a standard deviation pulls fifty times as hard as what is not, and a model that learns where the
        mass goes is slow to learn what moves it (docs/experiments.md).
    """
    if output.chained:
        return _chain_loss(prediction, value, output)
    if output.discrete:
        return functional.cross_entropy(prediction.transpose(1, 2), output.combination(value), reduction="none")
    target = value[..., output.dims]
    if output.gaussians:
        logits, means, scales = output.unpack(prediction)
        surprise = (target.unsqueeze(-2) - means) * (-scales).exp()
        cost = surprise.square() / 2 + scales + math.log(2 * math.pi) / 2  # (B, K, n, d)
        constant = cost.detach()
        cost = constant + scales.detach().exp() * (cost - constant)
        return -(logits.log_softmax(-1) - cost.sum(-1)).logsumexp(-1) / target.shape[-1]
    return (prediction - target).square().mean(-1)


def _chain_loss(prediction: Tensor, value: Tensor, output: Output) -> Tensor:
    """Cross-entropy by the chain rule, (B, K): that of `Output.table`, of which it computes what was true alone."""
    cost, told = torch.zeros_like(prediction[..., 0]), prediction.new_zeros(LINK)
    for component, (logits, vectors) in zip(output.components, output.links(prediction), strict=True):
        true = value[..., component.dims.start].long().unsqueeze(-1)  # (B, K, 1)
        given = (logits + (vectors * told).sum(-1)).log_softmax(-1)
        cost = cost - given.gather(-1, true).squeeze(-1)
        told = told + vectors.take_along_dim(true.unsqueeze(-1), -2)  # (B, K, 1, LINK)
    return cost


def token_count(asked: Tensor) -> Tensor:
    """The asked-for tokens of a batch, at least 1; of several processes' batches, on average over the processes.

    Several processes train with the average of their gradients and log the average of their losses. Divided by this
    count, a process's sum over tokens averages to the mean over all their tokens, as one process would have it that had
    all their windows in one batch. A collective call: every process of the group computes its loss, or none.
    """
    count = asked.sum()
    if not (distributed.is_available() and distributed.is_initialized()):
        return count.clamp_min(1)
    distributed.all_reduce(count)
    return count.clamp_min(1) / distributed.get_world_size()


def masked_losses(
    predictions: Predictions,
    window: Window,
    asked: dict[str, Tensor],
    factors: dict[str, Factor],
    *,
    reduction: str = "mean",
    apart: bool = False,
) -> dict[str, Tensor]:
    """Each factor's loss: its outputs' mean losses over the asked-for tokens of the batch, added up. With several
    processes it is this process's part in the mean over all their tokens, see `token_count`.

    Args:
        predictions: factor -> one (B, K, size) per output, as a network puts them out.
        window: the recorded values, normalised.
        asked: factor -> (B, K) bool, True = asked for; never a step outside the episode.
        reduction: "mean"; or "none", each window's part, whose mean over the windows is that mean.
        apart: whether the components of a token count one by one, by their marginals, as the paper's do.

    Returns:
        factor -> scalar, or (B,); 0 where nothing of the factor is asked.

    Raises:
        ValueError: another reduction.
    """
    if reduction not in ("mean", "none"):
        raise ValueError(f"reduction is {reduction!r}; choose mean or none.")
    losses = {}
    for name, outputs in predictions.items():
        here = asked[name]
        # Replaced where not asked: past the end of an episode anything may stand, even no number at all.
        value = torch.where(here.unsqueeze(-1), window.values[name], 0.0)
        count = token_count(here)
        pairs = list(zip(outputs, factors[name].outputs, strict=True))
        if apart:
            pairs = [
                pair for whole, output in pairs for pair in zip(marginals(whole, output), output.apart, strict=True)
            ]
        costs = (output_loss(prediction, value, output) * here for prediction, output in pairs)
        cost = functools.reduce(torch.add, costs)  # (B, K)
        losses[name] = cost.sum() / count if reduction == "mean" else cost.sum(1) * (len(here) / count)
    return losses


class LossParts(UserDict[str, Any]):
    """What makes up a loss, for the log: scalar tensors, read off the device when somebody asks for the numbers.

    lerobot-train does so once it has waited for the update, so that between forward and backward nothing waits; what it
    has to log besides it writes in here.
    """

    def __getitem__(self, name: str) -> Any:
        part = super().__getitem__(name)
        return float(part) if isinstance(part, Tensor) else part


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
