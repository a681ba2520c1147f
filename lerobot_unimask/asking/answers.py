"""Answering questions: distributions of the asked-for tokens, samples by the chain rule, and a rollout's memory.

Acting is a question asked at every step, so everything here goes through `answer`; there is no second path.

Legend of shapes: B windows or environments, K steps, D the dimensions of a factor.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from lerobot_unimask.data.factors import Component, Factor
from lerobot_unimask.data.window import Statistics, Window
from lerobot_unimask.language.masks import Mask
from lerobot_unimask.networks.layers import Cache, Predictions

# A model: (window with normalised values, mask, cache of a rollout) -> predictions. `UniMASKPolicy.predict` is one.
Predict = Callable[[Window, Mask, Cache | None], Predictions]


@dataclass
class Distribution:
    """The answer about one component at every step, in the dataset's units.

    Where the token was shown: the shown value, with certainty. Where it was neither shown nor asked for: NaN.
    """

    component: Component
    probabilities: Tensor | None  # (B, K, categories), of a discrete component
    mean: Tensor | None  # (B, K, d), of a continuous one
    scale: Tensor | None = None  # (B, K, d), its standard deviation: 0 where shown; None from an L2 head

    @property
    def name(self) -> str:
        return self.component.name

    @property
    def most_likely(self) -> Tensor:
        """(B, K, d): the category of the highest probability, or the mean."""
        if self.probabilities is None:
            return self.mean
        best = self.probabilities.nan_to_num(-1.0).argmax(-1, keepdim=True).to(self.probabilities.dtype)
        return torch.where(self.probabilities.isnan().any(-1, keepdim=True), torch.nan, best)

    def at(self, rows: Tensor, step: int) -> "Distribution":
        """That of some windows, (n,) their numbers, at one step: (n, 1, ...)."""
        parts = {name: getattr(self, name) for name in ("probabilities", "mean", "scale")}
        chosen = {name: None if part is None else part[rows, step : step + 1] for name, part in parts.items()}
        return replace(self, **chosen)

    def draw(self, generator: torch.Generator | None) -> Tensor:
        """One sample for each step, (B, K, d). An L2 head has no spread: there it is the mean."""
        if self.probabilities is None:
            if self.scale is None:
                return self.mean
            noise = torch.randn(self.mean.shape, generator=generator, device=self.mean.device)
            return self.mean + self.scale * noise
        certain = functional.one_hot(
            torch.zeros_like(self.probabilities[..., 0], dtype=torch.long), self.component.size
        )
        weights = torch.where(self.probabilities.isnan(), certain.to(self.probabilities.dtype), self.probabilities)
        drawn = torch.multinomial(weights.flatten(0, 1), 1, generator=generator)
        return drawn.view(*self.probabilities.shape[:2], 1).to(self.probabilities.dtype)


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


def answer(
    predict: Predict,
    statistics: Statistics,
    factors: Mapping[str, Factor],
    window: Window,
    mask: Mask,
    cache: Cache | None = None,
) -> Answer:
    """The distribution of every asked-for token given the shown ones.

    Args:
        cache: of the rollout that asks.
    """
    predictions = predict(statistics.normalise(window), mask, cache)
    distributions = {}
    for name, outputs in predictions.items():
        shown = mask.shown[name].unsqueeze(-1)
        known = shown | mask.asked[name].unsqueeze(-1)  # (B, K, 1)
        distributions[name] = []
        for output, component in zip(outputs, factors[name].components, strict=True):
            output = output.float()  # also under autocast, or probabilities would not sum to one
            value = window.values[name][..., component.dims]
            if component.discrete:
                certain = torch.where(shown, value, 0.0).squeeze(-1).long()
                certain = functional.one_hot(certain, component.categories).to(output.dtype)
                probabilities = torch.where(shown, certain, output.softmax(-1))
                probabilities = torch.where(known, probabilities, torch.nan)
                distributions[name].append(Distribution(component, probabilities, None))
            else:
                mean, scale = statistics.denormalise(name, component, output)
                mean = torch.where(known, torch.where(shown, value, mean), torch.nan)
                if scale is not None:
                    scale = torch.where(known, torch.where(shown, 0.0, scale), torch.nan)
                distributions[name].append(Distribution(component, None, mean, scale))
    return Answer(mask, distributions)
