"""How well the return and properties are foretold: how far off, and whether what is said to be likely comes as often.

Legend of shapes: B windows, K steps, n thresholds.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lerobot_unimask.asking.answers import Answer, ContinuousDistribution, DiscreteDistribution, Distribution
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import Mask, tabulate

QUESTION = "{name}[0] | s[:t+1], a[:t+1]"

THRESHOLDS = 20  # at most, of a continuous property

BINS = 10  # of probabilities


def foretold(
    ask: Callable[[Window, Mask], Answer], window: Window, name: str, cameras: tuple[str, ...] = ()
) -> list[dict[str, Any]]:
    """A property of one number, asked after the first step, a third and two thirds of the window.

    Args:
        ask: what answers, a policy's `infer` or the optimum.
        window: recorded values, all of the property's.

    Returns:
        For each step t: the `mean_absolute_error` of the mean, or of categories the share that is not the most likely
        one, `error`, and the mean `log_loss` in nats; and but for an L2 head `calibration`, in bins of probability how
        often what was `predicted` so `happened`, and the bins' mean difference, `calibration_error`. What happens is
        the category, or that the value exceeds a threshold between recorded ones.
    """
    B, K = window.valid.shape
    factors = tuple(factor for factor in window.values if factor not in cameras)
    table = tabulate(QUESTION.format(name=name), factors, K, cameras)
    truth = window.values[name][:, 0, 0]
    found = []
    for t in sorted({0, K // 3, 2 * K // 3}):
        mask = table.at(t, B).to(window.valid.device).within(window.valid)
        said = ask(window, mask)[name][0]
        found.append({"t": t, "windows": B, **_errors(said, window.values[name]), **_calibration(said, truth)})
    return found


def _errors(said: Distribution, values: Tensor) -> dict[str, float]:
    if isinstance(said, ContinuousDistribution):
        return {"mean_absolute_error": (said.mean[:, 0, 0] - values[:, 0, 0]).abs().mean().item()}
    wrong = said.most_likely[:, 0, 0] != values[:, 0, 0]
    surprise = -said.probability(values[:, :1])[:, 0].clamp_min(1e-12).log()
    return {"error": wrong.float().mean().item(), "log_loss": surprise.mean().item()}


def _calibration(said: Distribution, truth: Tensor) -> dict[str, Any]:
    if isinstance(said, DiscreteDistribution):
        probability = said.probabilities[:, 0, 1:]  # (B, C - 1); of two categories one says all
        happened = truth[:, None] == torch.arange(1, probability.shape[1] + 1, device=truth.device)
    elif said.scales is None:
        return {}
    else:
        levels = truth.unique()
        between = (levels[1:] + levels[:-1]) / 2
        few = torch.linspace(0, len(between) - 1, min(THRESHOLDS, len(between)), device=truth.device).round().long()
        thresholds = between[few].expand(len(truth), -1)  # (B, n)
        probability = 1 - said.cumulative(thresholds.unsqueeze(1).expand(-1, said.means.shape[1], -1))[:, 0]
        happened = truth[:, None] > thresholds
    at = (probability * BINS).long().clamp(0, BINS - 1).flatten()
    count = at.bincount(minlength=BINS)
    predicted, came = (
        torch.zeros(BINS, dtype=torch.float64, device=at.device).index_add_(0, at, events.double().flatten())
        for events in (probability, happened)
    )
    filled = count > 0
    apart = (predicted - came).abs().sum() / count.sum()
    columns = {"predicted": (predicted / count)[filled], "happened": (came / count)[filled], "count": count[filled]}
    return {
        "calibration": {name: column.tolist() for name, column in columns.items()},
        "calibration_error": apart.item(),
    }
