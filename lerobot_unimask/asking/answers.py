"""Answers: the distribution of every asked token given the shown ones, in the dataset's units.

Acting and sampling are questions too, so everything here goes through `answer`; there is no second path.

Legend of shapes: B windows, K steps, D the numbers of a factor, d those of one of its components.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional

from lerobot_unimask.data.factors import Component, Factor
from lerobot_unimask.data.window import Statistics, Window
from lerobot_unimask.language.masks import Mask
from lerobot_unimask.networks.layers import Cache, Predictions


class Model(Protocol):
    """What answers are made of: `UniMASKPolicy` is one, and so is an environment's exact optimum."""

    factors: Mapping[str, Factor]
    statistics: Statistics

    def predict(self, window: Window, mask: Mask, cache: Cache | None = None) -> Predictions:
        """A network's outputs for a window of normalised values."""
        ...


@dataclass
class DiscreteDistribution:
    """The answer about one discrete component at every step.

    Where the token was shown: the shown value, with certainty. Where it was neither shown nor asked: NaN.

    Attributes:
        probabilities: (B, K, categories)
    """

    component: Component
    probabilities: Tensor

    @property
    def name(self) -> str:
        return self.component.name

    @property
    def most_likely(self) -> Tensor:
        """(B, K, 1): the category of the highest probability."""
        best = self.probabilities.nan_to_num(-1.0).argmax(-1, keepdim=True).to(self.probabilities.dtype)
        return torch.where(self.probabilities.isnan().any(-1, keepdim=True), torch.nan, best)

    def at(self, rows: Tensor, step: int) -> "DiscreteDistribution":
        """That of some windows, (n,) their numbers, at one step: (n, 1, categories)."""
        return DiscreteDistribution(self.component, self.probabilities[rows, step : step + 1])

    def draw(self, generator: torch.Generator | None) -> Tensor:
        """One sample for each step, (B, K, 1)."""
        certain = torch.zeros_like(self.probabilities)
        certain[..., 0] = 1.0  # where nothing was asked, anything may be drawn, but something must
        weights = torch.where(self.probabilities.isnan(), certain, self.probabilities)
        drawn = torch.multinomial(weights.flatten(0, 1), 1, generator=generator)
        return drawn.view(*self.probabilities.shape[:2], 1).to(self.probabilities.dtype)


@dataclass
class ContinuousDistribution:
    """The answer about one continuous component at every step; shown and hidden tokens as in `DiscreteDistribution`.

    Attributes:
        mean: (B, K, d)
        scale: (B, K, d), standard deviation: 0 where shown; None from an L2 head, which has none.
    """

    component: Component
    mean: Tensor
    scale: Tensor | None

    @property
    def name(self) -> str:
        return self.component.name

    @property
    def most_likely(self) -> Tensor:
        """(B, K, d): the mean."""
        return self.mean

    def at(self, rows: Tensor, step: int) -> "ContinuousDistribution":
        """That of some windows, (n,) their numbers, at one step: (n, 1, d)."""
        scale = None if self.scale is None else self.scale[rows, step : step + 1]
        return ContinuousDistribution(self.component, self.mean[rows, step : step + 1], scale)

    def draw(self, generator: torch.Generator | None) -> Tensor:
        """One sample for each step, (B, K, d); an L2 head's is its mean."""
        if self.scale is None:
            return self.mean
        noise = torch.randn(self.mean.shape, generator=generator, device=self.mean.device)
        return self.mean + self.scale * noise


Distribution = DiscreteDistribution | ContinuousDistribution


@dataclass
class Answer:
    """What a policy answers to one mask: `answer["a"][0].probabilities` is (B, K, categories)."""

    mask: Mask
    distributions: dict[str, list[Distribution]]

    def __getitem__(self, factor: str) -> list[Distribution]:
        """One distribution for each component of `s` or `a`, in the order in which the dataset stores them."""
        return self.distributions[factor]

    def most_likely(self, factor: str) -> Tensor:
        """(B, K, D): shown values as they are, the most likely ones where asked, NaN elsewhere."""
        return torch.cat([distribution.most_likely for distribution in self.distributions[factor]], dim=-1)

    def draw(self, factor: str, generator: torch.Generator | None) -> Tensor:
        """(B, K, D): one sample for each step, each component's from its own distribution."""
        return torch.cat([distribution.draw(generator) for distribution in self.distributions[factor]], dim=-1)


def answer(model: Model, window: Window, mask: Mask, cache: Cache | None = None) -> Answer:
    """The distribution of every asked token given the shown ones.

    Args:
        window: values in the dataset's units.
        cache: what the rollout that asks has computed before.
    """
    predictions = model.predict(model.statistics.normalise(window), mask, cache)
    distributions: dict[str, list[Distribution]] = {}
    for name, outputs in predictions.items():
        shown = mask.shown[name].unsqueeze(-1)
        known = shown | mask.asked[name].unsqueeze(-1)  # (B, K, 1)
        distributions[name] = []
        for output, component in zip(outputs, model.factors[name].components, strict=True):
            output = output.float()  # also under autocast, or probabilities would not sum to one
            value = window.values[name][..., component.dims]
            if component.discrete:
                certain = torch.where(shown, value, 0.0).squeeze(-1).long()
                certain = functional.one_hot(certain, component.categories).to(output.dtype)
                probabilities = torch.where(shown, certain, output.softmax(-1))
                probabilities = torch.where(known, probabilities, torch.nan)
                distributions[name].append(DiscreteDistribution(component, probabilities))
            else:
                mean, scale = model.statistics.denormalise(name, component, output)
                mean = torch.where(known, torch.where(shown, value, mean), torch.nan)
                if scale is not None:
                    scale = torch.where(known, torch.where(shown, 0.0, scale), torch.nan)
                distributions[name].append(ContinuousDistribution(component, mean, scale))
    return Answer(mask, distributions)
