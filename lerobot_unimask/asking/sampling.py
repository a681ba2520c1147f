"""Samples by the chain rule: asked tokens drawn one after another, each given the shown ones and those drawn before it.

Legend of shapes: B windows, K steps, D the numbers of a factor, n some of the windows.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_unimask.asking.answers import Model, answer
from lerobot_unimask.asking.given import text_of
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import ASKABLE, Mask

ORDERS = ("forward", "backward", "random")

# (values, decided): factor -> (n, K, D) and (n, K) bool -> (n,) bool, False where the decided tokens contradict it
Check = Callable[[Mapping[str, Tensor], Mapping[str, Tensor]], Tensor]


class RejectionError(ValueError):
    """No sample passed the check in as many tries as it was given."""


@dataclass
class Samples(Window):
    """Drawn windows: shown and drawn values, NaN elsewhere; and what the check cost.

    drawn: number of tokens drawn, those that the check rejected included.
    rejected: number of these that it rejected.
    restarted: number of times that a sample started over because no value of a token passed the check.
    """

    drawn: int = 0
    rejected: int = 0
    restarted: int = 0

    @property
    def acceptance(self) -> float:
        """The share of drawn tokens that the check accepted."""
        return 1 - self.rejected / max(self.drawn, 1)


def sample(
    model: Model,
    window: Window,
    mask: Mask,
    *,
    order: str,
    generator: torch.Generator | None,
    check: Check | None = None,
    tries: int = 100,
) -> Samples:
    """Draw the asked-for tokens one after another, each given the shown ones and those already drawn (chain rule).

    A token's own numbers (agent and key, say) are drawn together where the model predicts them so, otherwise side by
    side. With a check, a token that contradicts what is shown or already drawn is drawn again (the paper's repair of
    backward inference, appendix "Fixing prediction inconsistencies"), and a sample in a dead end starts over.

    Note: Rejection looks at what is decided so far and not ahead, so the accepted samples are not quite distributed as
        all samples that happen to pass are.

    Args:
        order: `forward` in time (s0, a0, s1, ..., after the return and properties), `backward`, or `random` (one order
            for the whole batch).
        generator: source of the draws, on the window's device; None: torch's global one.
        check: tells which samples contradict themselves; called after each drawn token with the samples that drew it.
        tries: number of times that a token is drawn before its sample starts over, and that a sample starts before all
            is given up.

    Raises:
        ValueError: an unknown order, or a check that what is shown fails.
        RejectionError: one that every start of some sample fails.
    """
    if order not in ORDERS:
        raise ValueError(f"order is {text_of(order)}; choose one of {', '.join(ORDERS)}.")
    check_count(tries, "tries")
    names = [name for name in model.factors if name not in ASKABLE] + list(ASKABLE)
    asked = torch.stack([mask.asked[name].any(0) for name in names], dim=1)  # (K, factors)
    tokens = [(names[i], step) for step, i in asked.nonzero().tolist()]  # forward
    if order == "backward":
        tokens.reverse()
    elif order == "random":
        shuffle = torch.randperm(len(tokens), generator=generator, device=window.valid.device).tolist()
        tokens = [tokens[i] for i in shuffle]
    shown = {
        name: torch.where(mask.shown[name].unsqueeze(-1), value, torch.nan) for name, value in window.values.items()
    }
    samples = Samples(shown, window.valid)
    if check is not None and not check(samples.values, mask.shown).all():
        raise ValueError(
            "By the check what is shown is impossible already, so no sample can pass: show something else."
        )

    def start(rows: Tensor) -> Tensor:
        """Draw all tokens of some samples, (n,) their numbers, and return those that got stuck."""
        stuck = [rows[:0]]
        values = {name: value[rows] for name, value in samples.values.items()}
        shown = {name: tokens[rows] for name, tokens in mask.shown.items()}
        for name, step in tokens:
            here = torch.zeros_like(shown[name])
            here[:, step] = mask.asked[name][rows, step]
            nothing = {other: torch.zeros_like(here) for other in shown}
            question = Mask(shown, nothing | {name: here})
            said = answer(model, Window(values, samples.valid[rows]), question)
            shown = shown | {name: shown[name] | here}
            redraw, given = here[:, step].nonzero().squeeze(-1), model.factors[name].given_size
            values[name][redraw, step, given:] = window.values[name][rows[redraw], step, given:]  # what is computed
            for _ in range(tries):
                values[name][redraw, step, :given] = said.at(redraw, step).draw(name, generator)[:, 0]
                samples.drawn += len(redraw)
                redraw = redraw[:0] if check is None else redraw[~check(_rows(values, redraw), _rows(shown, redraw))]
                samples.rejected += len(redraw)
                if len(redraw) == 0:
                    break
            else:
                going_on = torch.ones_like(rows, dtype=torch.bool).index_fill(0, redraw, False)
                stuck.append(rows[~going_on])
                values, shown, rows = _rows(values, going_on), _rows(shown, going_on), rows[going_on]
        for name in dict(tokens):
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


def check_count(count: int, name: str = "samples") -> int:
    """
    Raises:
        ValueError: not a whole number of at least 1.
    """
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"{name} is {text_of(count)}; give a whole number of at least 1.")
    return count


def make_generator(seed: int, device: torch.device) -> torch.Generator:
    """
    Raises:
        ValueError: a seed that torch does not take.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise ValueError(f"seed is {text_of(seed)}; give a whole number from 0 to 2^63 - 1.")
    return torch.Generator(device).manual_seed(seed)
