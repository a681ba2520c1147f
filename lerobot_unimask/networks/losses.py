"""What a prediction costs, over the asked-for tokens alone.

Legend of shapes: B windows, K steps, D the dimensions of a factor.
"""

import functools
import math
from collections.abc import Iterator, MutableMapping
from typing import Any

import torch
from torch import Tensor, distributed
from torch.nn import functional

from lerobot_unimask.data.factors import Factor, Output
from lerobot_unimask.data.window import Window
from lerobot_unimask.networks.layers import Predictions, marginals


class LossParts(MutableMapping[str, Any]):
    """What makes up a loss, for the log: scalar tensors, read off the device when somebody asks for the numbers.

    lerobot-train does so once it has waited for the update, so that between forward and backward nothing waits; what it
    has to log besides it writes in here.
    """

    def __init__(self, parts: dict[str, Any]):
        self._parts = parts

    def __getitem__(self, name: str) -> Any:
        part = self._parts[name]
        return float(part) if isinstance(part, Tensor) else part

    def __setitem__(self, name: str, value: Any) -> None:
        self._parts[name] = value

    def __delitem__(self, name: str) -> None:
        del self._parts[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)


def output_loss(prediction: Tensor, value: Tensor, output: Output) -> Tensor:
    """What one output costs at every step, (B, K): cross-entropy in nats; or, averaged over its numbers and in units of
    their standard deviations, the squared error or the Gaussians' negative log-likelihood in nats.

    Note: The gradient of a Gaussian's means and scales is that of the negative log-likelihood times the predicted
        scale (Seitzer et al., "On the pitfalls of heteroscedastic uncertainty estimation", 2022, beta = 1/2); a
        mixture's Gaussians besides share it as they share the density. Without it, what is predicted to within a
        fiftieth of a standard deviation pulls fifty times as hard as what is not, and a model that learns where the
        mass goes is slow to learn what moves it (docs/experiments.md).
    """
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
