"""Answers: the distribution of every asked token given the shown ones, in the dataset's units.

Acting and sampling are questions too, so everything goes through `answer`; there is no second path. Which way a window
is read follows from what is asked: `predict` says how.

Legend of shapes: B windows, K steps, D the numbers of a factor, d those of one of its components.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.factors import Camera, Component, Factor, Output
from lerobot_unimask.data.returns import EpisodeStarts
from lerobot_unimask.data.window import Statistics, Window
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import ASKABLE, Mask
from lerobot_unimask.language.training_masks import TrainingMasks, check_predicted
from lerobot_unimask.networks.layers import Cache, Predictions


class Model(Protocol):
    """What answers are made of: `UniMASKPolicy` is one, and so is an environment's exact optimum."""

    statistics: Statistics

    @property
    def factors(self) -> Mapping[str, Factor]: ...

    def predict(self, window: Window, mask: Mask, cache: Cache | None = None) -> Predictions:
        """A network's outputs for a window of normalised values."""
        ...


class LearntModel(Model, Protocol):
    """What is asked and acts: a policy, of which there is its config, its network, what it was trained on, and what it
    keeps of its training episodes."""

    config: UniMASKConfig
    cameras: Mapping[str, Camera]
    network: nn.Module
    training_masks: TrainingMasks
    episode_starts: EpisodeStarts
    device: torch.device

    def make_window(self, batch: Mapping[str, Any], *, partial: bool = False) -> Window:
        """A LeRobot batch in the dataset's units."""
        ...


CLIMBS = 20  # steps from a Gaussian's mean to a mixture's mode
HALVINGS = 24  # of the interval that a mixture's median lies in


@dataclass
class DiscreteDistribution:
    """The answer about discrete components at every step: one, or several of a token together.

    Where the token was shown: the shown value, with certainty. Where it was neither shown nor asked: NaN.

    Attributes:
        probabilities: (B, K, C), of the component's categories, or of all combinations of the components'.
    """

    output: Output
    probabilities: Tensor

    @property
    def component(self) -> Component:
        return self.output.components[0]

    @property
    def name(self) -> str:
        return self.component.name

    @property
    def most_likely(self) -> Tensor:
        """(B, K, d): the categories of the highest probability."""
        best = self.output.split(self.probabilities.nan_to_num(-1.0).argmax(-1)).to(self.probabilities.dtype)
        return torch.where(self.probabilities.isnan().any(-1, keepdim=True), torch.nan, best)

    carried_out = most_likely

    def marginals(self) -> "list[DiscreteDistribution]":
        """One for each component."""
        if len(self.output.components) == 1:
            return [self]
        table = self.probabilities.unflatten(-1, self.output.categories)
        axes = range(-len(self.output.categories), 0)
        parts = [table.sum([other for other in axes if other != axis]) for axis in axes]
        return [DiscreteDistribution(*pair) for pair in zip(self.output.apart, parts, strict=True)]

    def probability(self, values: Tensor) -> Tensor:
        """That of the values of tokens, (B, K, D) -> (B, K)."""
        return self.probabilities.gather(-1, self.output.combination(values).unsqueeze(-1)).squeeze(-1)

    def at(self, rows: Tensor, step: int) -> "DiscreteDistribution":
        """That of some windows, (n,) their numbers, at one step: (n, 1, C)."""
        return DiscreteDistribution(self.output, self.probabilities[rows, step : step + 1])

    def draw(self, generator: torch.Generator | None) -> Tensor:
        """One sample for each step, (B, K, d)."""
        certain = torch.zeros_like(self.probabilities)
        certain[..., 0] = 1.0  # where nothing was asked, anything may be drawn, but something must
        weights = torch.where(self.probabilities.isnan(), certain, self.probabilities)
        drawn = torch.multinomial(weights.flatten(0, 1), 1, generator=generator)
        return self.output.split(drawn.view(self.probabilities.shape[:2])).to(self.probabilities.dtype)


@dataclass
class ContinuousDistribution:
    """The answer about continuous components at every step, as n Gaussians; shown and hidden tokens as in
    `DiscreteDistribution`.

    Attributes:
        weights: (B, K, n), that add up to 1.
        means: (B, K, n, d)
        scales: (B, K, n, d), standard deviations: 0 where shown; None from an L2 head, which has none.
    """

    output: Output
    weights: Tensor
    means: Tensor
    scales: Tensor | None

    @property
    def component(self) -> Component:
        return self.output.components[0]

    @property
    def name(self) -> str:
        return self.component.name

    @property
    def mean(self) -> Tensor:
        """(B, K, d), over all Gaussians."""
        if self.means.shape[-2] == 1:
            return self.means[..., 0, :]
        return (self.weights.unsqueeze(-1) * self.means).sum(-2)

    @property
    def scale(self) -> Tensor | None:
        """(B, K, d), the standard deviation over all Gaussians."""
        if self.scales is None or self.means.shape[-2] == 1:
            return None if self.scales is None else self.scales[..., 0, :]
        apart = (self.means - self.mean.unsqueeze(-2)).square() + self.scales.square()
        return (self.weights.unsqueeze(-1) * apart).sum(-2).sqrt()

    @property
    def most_likely(self) -> Tensor:
        """(B, K, d): the mean of a single Gaussian; of several the highest mode, to which the mean of each climbs by
        the fixed point of Carreira-Perpinan ("Mode-finding for mixtures of Gaussian distributions", 2000)."""
        if self.scales is None or self.means.shape[-2] == 1:
            return self.mean
        x = self.means  # (B, K, n, d), one start for each
        precise = self.scales.clamp_min(1e-12).square().reciprocal().unsqueeze(-3)  # (B, K, 1, n, d)
        for _ in range(CLIMBS):
            share = self._log_densities(x).softmax(-1).unsqueeze(-1) * precise  # (B, K, n, n, d)
            x = (share * self.means.unsqueeze(-3)).sum(-2) / share.sum(-2)
        height = self._log_densities(x).logsumexp(-1)  # (B, K, n)
        best = height.nan_to_num(-torch.inf).argmax(-1, keepdim=True).unsqueeze(-1)
        return torch.where((self.weights[..., :1] == 1), self.mean, x.take_along_dim(best, -2)[..., 0, :])

    @property
    def carried_out(self) -> Tensor:
        """(B, K, d), what acting does: the mean of a single Gaussian; of several each number's median, by bisection.

        Note: Not the highest mode. Where a dataset's actions were clipped, a Gaussian as narrow as it may be stands on
            the limit, and is the highest mode by far with a twentieth of the weight (docs/experiments.md).
        """
        if self.scales is None or self.means.shape[-2] == 1:
            return self.mean
        reach = 4 * self.scales
        low, high = (self.means - reach).amin(-2), (self.means + reach).amax(-2)  # (B, K, d)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            apart = (middle.unsqueeze(-2) - self.means) / self.scales.clamp_min(1e-12)
            below = (self.weights.unsqueeze(-1) * torch.special.ndtr(apart)).sum(-2) < 0.5
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        return torch.where(self.weights[..., :1] == 1, self.mean, (low + high) / 2)

    def _log_densities(self, x: Tensor) -> Tensor:
        """Those of each Gaussian, times its weight, at m places for each step: (B, K, m, d) -> (B, K, m, n)."""
        if self.scales is None:
            raise ValueError("An L2 head's answers have no density.")
        scales = self.scales.clamp_min(1e-12)
        surprise = (x.unsqueeze(-2) - self.means.unsqueeze(-3)) / scales.unsqueeze(-3)
        logs = -(surprise.square() / 2 + math.log(2 * math.pi) / 2 + scales.log().unsqueeze(-3)).sum(-1)
        return logs + self.weights.log().unsqueeze(-2)

    def cumulative(self, values: Tensor) -> Tensor:
        """The probability that the first number lies below, in the dataset's units: (B, K, n) -> (B, K, n)."""
        if self.scales is None:
            raise ValueError("An L2 head's answers have no density.")
        mean, scale = self.means[..., 0], self.scales[..., 0].clamp_min(1e-12)  # (B, K, m)
        below = torch.special.ndtr((values.unsqueeze(-1) - mean.unsqueeze(-2)) / scale.unsqueeze(-2))
        return (below * self.weights.unsqueeze(-2)).sum(-1)

    def log_density(self, values: Tensor) -> Tensor:
        """That of the values of tokens, in nats and the dataset's units: (B, K, D) -> (B, K)."""
        return self._log_densities(values[..., self.output.dims].unsqueeze(-2)).logsumexp(-1)[..., 0]

    def marginals(self) -> "list[ContinuousDistribution]":
        """One for each component."""
        if len(self.output.components) == 1:
            return [self]
        sizes = [len(part.numbers) for part in self.output.apart]
        scales = [None] * len(sizes) if self.scales is None else self.scales.split(sizes, -1)
        parts = zip(self.output.apart, self.means.split(sizes, -1), scales, strict=True)
        return [ContinuousDistribution(part, self.weights, mean, scale) for part, mean, scale in parts]

    def at(self, rows: Tensor, step: int) -> "ContinuousDistribution":
        """That of some windows, (n,) their numbers, at one step: (n, 1, ...)."""
        here = rows, slice(step, step + 1)
        scales = None if self.scales is None else self.scales[here]
        return ContinuousDistribution(self.output, self.weights[here], self.means[here], scales)

    def draw(self, generator: torch.Generator | None) -> Tensor:
        """One sample for each step, (B, K, d): of one Gaussian, drawn by its weight; an L2 head's is its mean."""
        if self.scales is None:
            return self.mean
        mean, scale = self.means[..., 0, :], self.scales[..., 0, :]
        if self.means.shape[-2] > 1:
            chosen = torch.multinomial(self.weights.nan_to_num(1.0).flatten(0, 1), 1, generator=generator)
            chosen = chosen.view(*self.weights.shape[:2], 1, 1)
            mean, scale = (part.take_along_dim(chosen, -2)[..., 0, :] for part in (self.means, self.scales))
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        return mean + scale * noise


Distribution = DiscreteDistribution | ContinuousDistribution


@dataclass
class Answer:
    """What a policy answers to one mask: `answer["a"][0].probabilities` is (B, K, categories).

    Attributes:
        distributions: factor -> one distribution for each of its outputs, of the output's components together; of the
            return and properties, whose only token is at step 0, where they are asked.
    """

    mask: Mask
    distributions: dict[str, list[Distribution]]

    def __getitem__(self, factor: str) -> list[Distribution]:
        """One distribution for each component of a factor, its marginal, in the order in which the dataset stores
        them."""
        parts = [part for distribution in self.distributions[factor] for part in distribution.marginals()]
        return sorted(parts, key=lambda part: part.component.dims.start)

    def most_likely(self, factor: str) -> Tensor:
        """(B, K, D): shown values as they are, the most likely ones where asked, NaN elsewhere; D without computed
        numbers."""
        return self._tokens(factor, [distribution.most_likely for distribution in self.distributions[factor]])

    def draw(self, factor: str, generator: torch.Generator | None) -> Tensor:
        """(B, K, D): one sample for each step."""
        return self._tokens(factor, [distribution.draw(generator) for distribution in self.distributions[factor]])

    def carried_out(self, factor: str) -> Tensor:
        """(B, K, D): what acting does where asked; otherwise as in `most_likely`."""
        return self._tokens(factor, [distribution.carried_out for distribution in self.distributions[factor]])

    def at(self, rows: Tensor, step: int) -> "Answer":
        """That of some windows, (n,) their numbers, at one step."""
        here = {name: [part.at(rows, step) for part in parts] for name, parts in self.distributions.items()}
        shown = {name: tokens[rows, step : step + 1] for name, tokens in self.mask.shown.items()}
        asked = {name: tokens[rows, step : step + 1] for name, tokens in self.mask.asked.items()}
        return Answer(Mask(shown, asked), here)

    def _tokens(self, factor: str, parts: list[Tensor]) -> Tensor:
        """The outputs' values, (B, K, d) each, as tokens, (B, K, D)."""
        if len(parts) == 1:
            return parts[0]
        numbers = [number for distribution in self.distributions[factor] for number in distribution.output.numbers]
        tokens = torch.cat(parts, dim=-1)
        return (
            tokens if numbers == sorted(numbers) else tokens[..., sorted(range(len(numbers)), key=numbers.__getitem__)]
        )


def answer(
    model: Model, window: Window, mask: Mask, cache: Cache | None = None, factors: Sequence[str] | None = None
) -> Answer:
    """The distribution of every asked token given the shown ones.

    Args:
        window: values in the dataset's units.
        cache: what the rollout that asks has computed before.
        factors: those that anybody will look at; None: `s` and `a`.
    """
    predictions = model.predict(model.statistics.normalise(window), mask, cache)
    distributions: dict[str, list[Distribution]] = {}
    for name in predictions if factors is None else factors:
        if name not in ASKABLE and not mask.asked[name].any():
            continue
        shown = mask.shown[name].unsqueeze(-1)
        known = shown | mask.asked[name].unsqueeze(-1)  # (B, K, 1)
        distributions[name] = []
        for prediction, output in zip(predictions[name], model.factors[name].outputs, strict=True):
            prediction = prediction.float()  # also under autocast, or probabilities would not sum to one
            if output.discrete:
                probabilities = output.table(prediction).softmax(-1)
                certain = output.combination(torch.where(shown, window.values[name], 0.0))
                certain = functional.one_hot(certain, probabilities.shape[-1]).to(prediction.dtype)
                probabilities = torch.where(shown, certain, probabilities)
                probabilities = torch.where(known, probabilities, torch.nan)
                distributions[name].append(DiscreteDistribution(output, probabilities))
            else:
                weights, means, scales = model.statistics.denormalise(name, output, prediction)
                first = torch.arange(weights.shape[-1], device=weights.device) == 0
                weights = torch.where(known, torch.where(shown, first.to(weights.dtype), weights), torch.nan)
                value = window.values[name][..., output.dims].unsqueeze(-2)
                here, there = shown.unsqueeze(-1), known.unsqueeze(-1)  # (B, K, 1, 1)
                means = torch.where(there, torch.where(here, value, means), torch.nan)
                if scales is not None:
                    scales = torch.where(there, torch.where(here, 0.0, scales), torch.nan)
                distributions[name].append(ContinuousDistribution(output, weights, means, scales))
    return Answer(mask, distributions)


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


def predict(model: LearntModel, window: Window, mask: Mask, cache: Cache | None = None) -> Predictions:
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
            "This model attends causally alone, and answers what it was trained on, for one token at a time: "
            f"{', '.join(model.training_masks.weights)} (random_mask: a token given all before it). A model of "
            "attention=both answers any question.",
            mask.draw(),
        )
    predictions = network(window, mask.shown, False, asked=mask.asked)
    if any(tokens.any() for tokens in causally.values()):
        for name, outputs in network(window, mask.shown, True, asked=causally).items():
            here = causally[name].unsqueeze(-1)
            pairs = zip(outputs, predictions[name], strict=True)
            predictions[name] = [torch.where(here, causal, other) for causal, other in pairs]
    return predictions
