"""Answering questions: distributions of the asked-for tokens, samples by the chain rule, and a rollout's memory.

Acting is a question asked at every step, so everything here goes through `answer`; there is no second path.

Legend of shapes: B windows or environments, K steps, D the dimensions of a factor.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from lerobot_unimask.masks import ASKABLE, Mask, parse_token
from lerobot_unimask.networks.transformer import Cache, Predictions
from lerobot_unimask.window import Component, Factor, Statistics, Window

ORDERS = ("forward", "backward", "random")
# A model: (window with normalised values, mask, cache of a rollout) -> predictions. `UniMASKPolicy.predict` is one.
Predict = Callable[[Window, Mask, Cache | None], Predictions]
# (values, decided): factor -> (n, K, D) and (n, K) bool -> (n,) bool, False where the decided tokens contradict it
Check = Callable[[Mapping[str, Tensor], Mapping[str, Tensor]], Tensor]
Given = Mapping[str, Any]  # token text -> its value, shared (D,) or one per environment (B, D); a number where D = 1


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
        shown = mask.visible[name].unsqueeze(-1)
        known = shown | mask.predict[name].unsqueeze(-1)  # (B, K, 1)
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


class RejectionError(ValueError):
    """No sample passed the check in as many tries as it was given."""


@dataclass
class Samples(Window):
    """Drawn windows: shown and drawn values, NaN elsewhere; and what the check cost.

    drawn: tokens drawn, those that the check rejected included.
    rejected: of these, how many it rejected.
    restarted: how often a sample started over because no value of a token passed the check.
    """

    drawn: int = 0
    rejected: int = 0
    restarted: int = 0

    @property
    def acceptance(self) -> float:
        """The share of drawn tokens that the check accepted."""
        return 1 - self.rejected / max(self.drawn, 1)


def sample(
    predict: Predict,
    statistics: Statistics,
    factors: Mapping[str, Factor],
    window: Window,
    mask: Mask,
    *,
    order: str,
    generator: torch.Generator,
    check: Check | None = None,
    tries: int = 100,
) -> Samples:
    """Draw the asked-for tokens one after another, each given the shown ones and those already drawn (chain rule).

    A token's own components (agent and key, say) are drawn side by side from their marginals. With a check, a token
    that contradicts what is shown or already drawn is drawn again (the paper's repair of backward inference, appendix
    "Fixing prediction inconsistencies"), and a sample in a dead end starts over.

    Note: Rejection looks at what is decided so far and not ahead, so the accepted samples are not quite distributed as
        all samples that happen to pass are.

    Args:
        order: `forward` in time (s0, a0, s1, ...), `backward`, or `random` (one order for the whole batch).
        check: tells which samples contradict themselves; called after each drawn token with the samples that drew it.
        tries: how often one token is drawn before its sample starts over, and how often a sample starts before all is
            given up.

    Raises:
        ValueError: an unknown order, or a check that what is shown fails.
        RejectionError: one that every start of some sample fails.
    """
    if order not in ORDERS:
        raise ValueError(f"order is {order!r}; choose one of {', '.join(ORDERS)}.")
    if tries < 1:
        raise ValueError(f"tries is {tries}; it must be at least 1.")
    asked = torch.stack([mask.predict[name].any(0) for name in ASKABLE], dim=1)  # (K, 2)
    tokens = [(ASKABLE[i], step) for step, i in asked.nonzero().tolist()]  # forward
    if order == "backward":
        tokens.reverse()
    elif order == "random":
        shuffle = torch.randperm(len(tokens), generator=generator, device=generator.device).tolist()
        tokens = [tokens[i] for i in shuffle]
    shown = {name: visible.unsqueeze(-1) for name, visible in mask.visible.items()}
    samples = Samples({name: torch.where(shown[name], v, torch.nan) for name, v in window.values.items()}, window.valid)
    if check is not None and not check(samples.values, mask.visible).all():
        raise ValueError(
            "By the check what is shown is impossible already, so no sample can pass: show something else."
        )

    def start(rows: Tensor) -> Tensor:
        """Draw all tokens of some samples, (n,) their numbers, and return those that got stuck."""
        stuck = [rows[:0]]
        values = {name: value[rows] for name, value in samples.values.items()}
        visible = {name: shown[rows] for name, shown in mask.visible.items()}
        for name, step in tokens:
            here = torch.zeros_like(visible[name])
            here[:, step] = mask.predict[name][rows, step]
            nothing = {other: torch.zeros_like(here) for other in visible}
            posed = Mask(visible, nothing | {name: here})
            said = answer(predict, statistics, factors, Window(values, samples.valid[rows]), posed)
            visible = visible | {name: visible[name] | here}
            redraw = here[:, step].nonzero().squeeze(-1)
            for _ in range(tries):
                value = torch.cat([distribution.at(redraw, step).draw(generator) for distribution in said[name]], -1)
                values[name][redraw, step] = value[:, 0]
                samples.drawn += len(redraw)
                redraw = redraw[:0] if check is None else redraw[~check(_rows(values, redraw), _rows(visible, redraw))]
                samples.rejected += len(redraw)
                if len(redraw) == 0:
                    break
            else:
                going_on = torch.ones_like(rows, dtype=torch.bool).index_fill(0, redraw, False)
                stuck.append(rows[~going_on])
                values, visible, rows = _rows(values, going_on), _rows(visible, going_on), rows[going_on]
        for name in ASKABLE:
            samples.values[name][rows] = values[name]
        return torch.cat(stuck)

    rows = torch.arange(len(window.valid), device=window.valid.device)
    for _ in range(tries):
        rows = start(rows)
        if len(rows) == 0:
            return samples
        samples.restarted += len(rows)
    raise RejectionError(
        f"{len(rows)} of {len(window.valid)} samples did not pass the check, each started {tries} times; it rejected "
        f"{samples.rejected} of {samples.drawn} drawn tokens. The model finds what is shown hard to reconcile with it: "
        "show something likelier, draw in another order, or raise tries."
    )


def _rows(tensors: Mapping[str, Tensor], rows: Tensor) -> dict[str, Tensor]:
    return {name: tensor[rows] for name, tensor in tensors.items()}


# --- Values that a user gives ----------------------------------------------------------------------------------------


def read_given(
    given: Given, factors: Mapping[str, Factor], context_length: int, batch_size: int | None = None
) -> dict[tuple[str, int], Tensor]:
    """Check what a user gives: (factor, position) -> (B, D) or (1, D), D as the user counts it, without computed parts.

    Args:
        batch_size: B; None where it is not known yet, and any number of rows will do.

    Raises:
        MaskError: a key that is not a token of the window.
        ValueError: a value of the wrong size, not finite, or not one of the categories.
    """
    tokens = {}
    for text, value in given.items():
        name, step = parse_token(text, tuple(factors), context_length)
        if (name, step) in tokens:
            raise ValueError(f"{name}[{step}] is given twice, the second time as {text}.")
        tokens[name, step] = _token(text, value, factors[name], batch_size)
    return tokens


def give(
    window: Window, tokens: Mapping[tuple[str, int], Tensor], known: Mapping[str, Tensor]
) -> tuple[Window, dict[str, Tensor]]:
    """The window with the given tokens where nothing has been observed, and which tokens are known then.

    Args:
        tokens: as `read_given` returns them.
        known: factor -> (K,) bool, True where the window holds an observed value, which wins over a given one.
    """
    values, known = dict(window.values), dict(known)
    for (name, step), value in tokens.items():
        if not known[name][step]:
            values[name], known[name] = values[name].clone(), known[name].clone()
            values[name][:, step, : value.shape[-1]] = value.to(window.valid.device)
            known[name][step] = True
    return Window(values, window.valid), known


def _token(text: str, value: Any, factor: Factor, B: int | None) -> Tensor:
    """(B, given_size) or (1, given_size), checked."""
    size = factor.given_size
    try:
        token = torch.as_tensor(value, dtype=torch.float32)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{text} is given {value!r}; give {size} number{'s' * (size > 1)}.") from error
    if token.ndim == 0 or (token.ndim == 1 and size == 1 and token.shape[0] in (B or token.shape[0], 1)):
        token = token.reshape(-1, 1)
    elif token.ndim == 1:
        token = token.unsqueeze(0)
    if token.ndim != 2 or token.shape[1] != size or token.shape[0] not in (1, B or token.shape[0]):
        each = "each window or environment" if B is None else f"each of the {B} windows or environments"
        raise ValueError(
            f"{text} is given {value!r}; give {size} number{'s' * (size > 1)}, or one such row for {each}."
        )
    check_values(f"{text} is given {value!r}, which", token, factor)
    return token


def check_values(what: str, values: Tensor, factor: Factor) -> None:
    """Values of a factor, (..., D) or without its computed numbers, must be finite, and categories where discrete.

    Raises:
        ValueError: they are not; names `what` and the first bad value.
    """
    fine = values.isfinite()
    if not fine.all():
        raise ValueError(f"{what} holds {values[~fine][0].item()}; its numbers must be finite.")
    for component in factor.components:
        if component.discrete:
            numbers = values[..., component.dims]
            bad = (numbers < 0) | (numbers >= component.categories) | (numbers != numbers.round())
            if bad.any():
                raise ValueError(
                    f"{what} holds {numbers[bad][0].item():g}; {component.name} is a category from 0 to "
                    f"{component.categories - 1}."
                )


def check_shown(tokens: Iterable[tuple[str, int]], visible: Mapping[str, Tensor], text: str) -> None:
    """A given token must be one that the mask shows, (..., K) bool for each factor, or giving it changes nothing.

    Raises:
        ValueError: the mask does not show it.
    """
    for name, step in tokens:
        if not visible[name][..., step].any():
            raise ValueError(
                f"{name}[{step}] is given, but the mask does not show it:\n  {text}\n"
                f"Add {name}[{step}] after the bar, or do not give it."
            )


def check_known(mask: Mask, known: Mapping[str, Tensor], text: str) -> None:
    """Everything that the mask shows must be known.

    Raises:
        ValueError: it shows a token that has been neither observed nor given.
    """
    missing = [
        f"{name}[{step}]"
        for name, shown in mask.visible.items()
        for step in (shown.any(0).cpu() & ~known[name]).nonzero().flatten().tolist()
    ]
    if missing:
        example = missing[0]
        raise ValueError(
            f"The mask shows {', '.join(missing)}, which has been neither observed nor given.\n  {text}\n"
            f'Give its value, as in given={{"{example}": ...}}, or choose a mask that does not show it.'
        )


# --- Acting ----------------------------------------------------------------------------------------------------------


class RolloutMemory:
    """The last K states and actions of each environment in a batch, and the return each had received by then.

    The present stands at position min(step, K - 1): before the window is full, later positions are empty; then it
    slides.
    """

    @torch.inference_mode(False)
    def __init__(self, factors: Mapping[str, Factor], context_length: int, batch_size: int, device: torch.device):
        K = context_length
        self.step = -1  # of the episode; nothing has been observed yet
        self.acted = True  # the step has ended, so that the next observation begins another
        self.values = {name: torch.zeros(batch_size, K, factor.size, device=device) for name, factor in factors.items()}
        self.return_so_far = torch.full((batch_size, K), torch.nan, device=device)
        self.target_return: Tensor | None = None  # (B, 1) or (1, 1): asked for from the first step on
        self.valid = torch.ones(batch_size, K, dtype=torch.bool, device=device)
        self.cache = Cache()  # of the steps in the window, until it slides

    @property
    def position(self) -> int:
        """Where the present stands in the window."""
        return min(self.step, self.valid.shape[1] - 1)

    @property
    def first_step(self) -> int:
        """The episode's step at position 0."""
        return self.step - self.position

    @torch.inference_mode(False)  # LeRobot acts in inference mode; what is remembered outlives it
    def observe(self, state: Tensor, return_so_far: Tensor | None) -> None:
        """Begin a step: (B, D) of `s`, and (B,) the rewards received so far, where the environment reports them.

        Where the last step found no action, because its question was refused, it begins again.
        """
        K = self.valid.shape[1]
        if self.acted:
            self.step += 1
            if self.step >= K:
                for name in ASKABLE:
                    self.values[name] = self.values[name].roll(-1, dims=1)
                self.return_so_far = self.return_so_far.roll(-1, dims=1)
                self.cache = Cache()
            self.acted = False
        self.values["s"][:, self.position] = state.clone()
        self.return_so_far[:, self.position] = torch.nan if return_so_far is None else return_so_far

    @torch.inference_mode(False)
    def act(self, action: Tensor) -> None:
        """End the step: (B, D) of `a`."""
        self.values["a"][:, self.position] = action.clone()
        self.acted = True

    def known(self) -> dict[str, Tensor]:
        """factor -> (K,) bool: states up to the present, actions before it."""
        steps = torch.arange(self.valid.shape[1])
        before = {"s": steps <= self.position, "a": steps < self.position}
        return {name: before.get(name, torch.zeros_like(steps, dtype=torch.bool)) for name in self.values}

    def window(self, horizon: Tensor) -> Window:
        """The window as it stands; the return token knows its timestep, its return is for `give` to fill in."""
        values = dict(self.values)
        if "rtg" in values:
            values["rtg"] = values["rtg"].clone()
            values["rtg"][..., -1] = (self.first_step + torch.arange(self.valid.shape[1]).to(horizon)) / horizon
        return Window(values, self.valid)

    def carry_return(self, window: Window) -> None:
        """Write into a window what is left of its first step's return at the later steps, NaN where nobody has reported
        the rewards since. No mask shows it; a Decision Transformer reads it."""
        if "rtg" in window.values:
            received = self.return_so_far[:, 1:] - self.return_so_far[:, :1]  # (B, K - 1)
            window.values["rtg"][:, 1:, 0] = window.values["rtg"][:, :1, 0] - received

    def remaining(self, target_return: Tensor) -> Tensor:
        """What is left of the target return at the window's first step, (B, 1).

        Raises:
            ValueError: the window has slid and the environment never reported the return so far.
        """
        if self.first_step == 0:
            return target_return.expand(len(self.valid), 1)
        received = self.return_so_far[:, :1]
        if received.isnan().any():
            raise ValueError(
                "Asking for a return needs the environment to report what it has paid so far, as "
                "'observation.return_so_far' (an array 'return_so_far' of shape (1,) in its observations)."
            )
        return target_return - received
