"""The mask language, the table of named tasks, and the masks of a batch. `training_masks.py` draws them for training.

A question is written in the paper's own notation, P(what is asked | what is shown), over a window of K steps:
`a[t] | s[:t+1], a[:t]` is behaviour cloning. Here such a text becomes a boolean table with one row for each t that it
admits; a mask for a batch is a choice of rows. A mask is boolean and True means: the model may see it.

Legend of shapes: B windows, K steps, F factors, R rows (one for each admissible t of each task).
"""

import difflib
import functools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_unimask.language.grammar import (
    Index,
    MaskError,
    Question,
    Slice,
    Term,
    check_text,
    parse_question,
    parse_terms,
)

# Paper, appendix "Training regimes". The names are the columns of the published heatmap. The waypoints are its steps
# 0, K//3, 2K//3 and K-1 for K = 10; inverse dynamics is the paper's definition (recover the previous state).
TASKS: dict[str, str] = {
    "behavior_cloning": "a[t] | s[:t+1], a[:t]",
    "reward_conditioned": "a[t] | s[:t+1], a[:t], rtg[0]",
    "goal_conditioned": "a[t] | s[:t+1], a[:t], s[-1]",
    "waypoint_conditioned": "a[t] | s[:t+1], a[:t], s[::3]",
    "past": "s[:t], a[:t] | s[t:], a[t:]",
    "future": "s[t+1:], a[t:] | s[:t+1], a[:t]",
    "forward_dynamics": "s[t+1] | s[t], a[t]",
    "inverse_dynamics": "s[t-1] | s[t], a[t-1]",
}

RANDOM_MASK = "random_mask"  # not a question: each window draws how much of it is hidden, and where

REGIMES: dict[str, tuple[str, ...]] = {"multi_task": tuple(TASKS)}

# Every other factor is a camera, shown at any step and never asked, or a property, shown or asked at step 0.
ASKABLE = ("s", "a")  # at every step
STATE = "state"  # in a text, the numbers of `s` without the cameras; in tables and masks these are the factor "s"


class Token(NamedTuple):
    """One token: a factor at a position of the window, or at a step of the episode."""

    factor: str
    step: int
    of_episode: bool = False

    def __str__(self) -> str:
        return f"{self.factor}@{self.step}" if self.of_episode else f"{self.factor}[{self.step}]"


def parse_token(text: str, factors: Sequence[str], context_length: int, cameras: Sequence[str] = ()) -> Token:
    """A single token: `s[-1]`, the window's last state, `top[-1]`, its last picture, or `s@150`, the state at step 150
    of the episode. `s` and `state` both name the numbers here.

    Raises:
        MaskError: it is not one token of this model.
    """
    terms = parse_terms(text)
    steps = [step for term in terms for step in term.steps]
    if len(steps) != 1 or not isinstance(steps[0], Index) or steps[0].relative:
        raise MaskError("A value is given to a single token, such as s[-1], rtg[0] or s@150.", text, 0)
    _check_factors(terms, (*factors, *cameras), text)
    name = _own_factor(terms[0].factor, factors)
    if terms[0].of_episode:
        if name not in (*ASKABLE, *cameras):
            raise MaskError(f"{name} can be given at step 0 only: write {name}[0].", text, 0)
        return Token(name, steps[0].value, of_episode=True)
    chosen = _select(terms, factors, cameras, context_length, -1, text)
    return Token(name, int(chosen.any(0).int().argmax()))


def parse(text: str, factors: Sequence[str] = ()) -> Question:
    """Parse one mask text or the name of a task in `TASKS`, whose rows show `task[0]` too where that is a factor.

    Raises:
        MaskError: the text does not parse; shows it with a caret under the fault.
    """
    check_text(text)
    name = text.strip()
    if re.fullmatch(r"\w+", name):
        if name == RANDOM_MASK or name in REGIMES:
            raise MaskError(f"{name} is a way of training, not a question: only training_masks can name it.", text)
        if name not in TASKS:
            near = difflib.get_close_matches(name, [*TASKS, RANDOM_MASK, *REGIMES], n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise MaskError(
                f"No task is named {name!r}.{hint} Named tasks: {', '.join(TASKS)}. "
                "Any other question is written out, as in 's[1:9] | s[0], s[3]'.",
                text,
                text.index(name),
            )
        text = f"{TASKS[name]}, task[0]" if "task" in factors else TASKS[name]
    return parse_question(text)


@dataclass(frozen=True)
class MaskTable:
    """Every mask that one question stands for: row r is the mask at t = `t[r]`.

    `shown` and `asked` are (R, F, K) booleans, `t` is (R,) int64; a question without t has one row, with t = -1.
    """

    question: Question
    factors: tuple[str, ...]
    shown: Tensor
    asked: Tensor
    t: Tensor
    cameras: tuple[str, ...] = ()  # which of the factors are pictures

    @functools.cached_property
    def shows(self) -> dict[str, Tensor]:
        """factor -> (K,) bool: tokens shown by some row."""
        return dict(zip(self.factors, self.shown.any(0), strict=True))

    @functools.cached_property
    def shows_ahead(self) -> dict[str, Tensor]:
        """factor -> (K,) bool: tokens shown by some row before a rollout at its t can have observed them."""
        steps, t = torch.arange(self.shown.shape[-1]), self.t[:, None]
        always = torch.ones_like(steps > t)  # (R, K); a property is never observed
        ahead = dict.fromkeys(self.factors, always) | dict.fromkeys(("s", *self.cameras), steps > t) | {"a": steps >= t}
        return {name: (self.shown[:, f] & ahead[name]).any(0) for f, name in enumerate(self.factors)}

    @functools.cached_property
    def acts(self) -> bool:
        """Whether there is a row for every step t of the window, and it asks for a[t]: a question for rollouts."""
        steps = torch.arange(self.shown.shape[-1])
        return torch.equal(self.t, steps) and bool(self.asked[steps, self.factors.index("a"), steps].all())

    def masks(self) -> "Mask":
        """Every row as one batch of masks."""
        return Mask(
            dict(zip(self.factors, self.shown.unbind(1), strict=True)),
            dict(zip(self.factors, self.asked.unbind(1), strict=True)),
        )

    def at(self, t: int | None, batch_size: int = 1) -> "Mask":
        """The mask at step t for each window of a batch.

        Raises:
            MaskError: the question has a t and none is given, or it does not admit this one.
        """
        if not self.question.uses_t:
            if t is not None:
                raise MaskError(f"t={t} is given, but the question is about no step t.", self.question.text, 0)
            row = 0
        elif t is None:
            raise MaskError("The question is about a step t: say which, as in t=3.", self.question.text, 0)
        elif int(t) not in self.t.tolist():
            admitted = ", ".join(map(str, self.t.tolist()))
            raise MaskError(
                f"The question cannot be asked at t={int(t)}; it can at t = {admitted}.", self.question.text
            )
        else:
            row = self.t.tolist().index(int(t))
        shape = (batch_size, self.shown.shape[-1])
        return Mask(
            {name: self.shown[row, f].expand(shape).clone() for f, name in enumerate(self.factors)},
            {name: self.asked[row, f].expand(shape).clone() for f, name in enumerate(self.factors)},
        )


@functools.lru_cache(maxsize=256)
def tabulate(text: str, factors: tuple[str, ...], context_length: int, cameras: tuple[str, ...] = ()) -> MaskTable:
    """Work out, for every t that `text` admits, which tokens of a window are shown and which are asked for.

    Args:
        text: a question or the name of a task.
        factors: the model's factors, `s` and `a` first; the others are properties.
        context_length: K.
        cameras: names of its cameras, which the table has after the factors.

    Raises:
        MaskError: unknown factor, a step outside the window, a camera asked for, a property after step 0, nothing
            asked.
    """
    question = parse(text, factors)
    text = question.text
    _check_factors(question.terms, (*factors, *cameras), text)
    for term in question.asked:
        if term.factor in cameras:
            raise MaskError(
                f"{term.factor} is a camera, which can be shown but never asked; ask for s or a.", text, term.position
            )
    rows: list[tuple[int, Tensor, Tensor]] = []
    for t in range(context_length) if question.uses_t else (-1,):
        if not _admits(question.terms, context_length, t):
            continue
        asked = _select(question.asked, factors, cameras, context_length, t, text)
        shown = _select(question.shown, factors, cameras, context_length, t, text)
        asked[len(factors) :] = False  # of all that is observed, `s` asks for the numbers
        asked &= ~shown  # what is shown is not asked
        if asked.any():
            rows.append((t, shown, asked))
    if not rows:
        where = f" for any t in a window of {context_length} steps" if question.uses_t else ""
        raise MaskError(f"Nothing is asked that is not shown{where}.", text, question.asked[0].position)
    return MaskTable(
        question,
        (*factors, *cameras),
        shown=torch.stack([shown for _, shown, _ in rows]),
        asked=torch.stack([asked for _, _, asked in rows]),
        t=torch.tensor([t for t, _, _ in rows]),
        cameras=tuple(cameras),
    )


def _check_factors(terms: Sequence[Term], factors: Sequence[str], text: str) -> None:
    for term in terms:
        if _own_factor(term.factor, factors) not in factors:
            near = difflib.get_close_matches(term.factor, factors, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            known = ", ".join(factors)
            raise MaskError(
                f"This model has no factor {term.factor!r}.{hint} Its factors are {known}.", text, term.position
            )


def _own_factor(name: str, factors: Sequence[str]) -> str:
    """The factor whose tokens a name's own are: that of the state's numbers is called `s`."""
    return "s" if name == STATE and STATE not in factors else name


def _admits(terms: Sequence[Term], K: int, t: int) -> bool:
    """Whether no integer with t falls outside the window."""
    return all(
        0 <= part.value + t < K for term in terms for part in term.steps if isinstance(part, Index) and part.relative
    )


def _select(terms: Sequence[Term], factors: Sequence[str], cameras: Sequence[str], K: int, t: int, text: str) -> Tensor:
    """The tokens that `terms` name at a t that they admit, (F, K) bool, `s` those of every camera too."""
    names = (*factors, *cameras)
    chosen = torch.zeros(len(names), K, dtype=torch.bool)
    for term in terms:
        own = _own_factor(term.factor, factors)
        rows = [names.index(name) for name in (own, *(cameras if term.factor == "s" else ()))]
        for part in term.steps:
            if isinstance(part, Slice):
                bounds = slice(_bound(part.start, K, t), _bound(part.stop, K, t), part.step)
                steps = range(*bounds.indices(K))
            else:
                step = part.value + t if part.relative else part.value
                if not -K <= step < K:
                    raise MaskError(
                        f"Step {step} lies outside the window: its steps are 0 to {K - 1} (or -{K} to -1).",
                        text,
                        part.position,
                    )
                steps = range(step % K, step % K + 1)
            if own not in (*ASKABLE, *cameras) and any(steps):
                raise MaskError(
                    f"{term.factor} has a token at step 0 only: write {term.factor}[0].", text, term.position
                )
            for row in rows:
                chosen[row, list(steps)] = True
    return chosen


def _bound(index: Index | None, K: int, t: int) -> int | None:
    """A slice's bound. With t it is clipped to the window and never wraps; without, it is Python's."""
    if index is None or not index.relative:
        return index.value if index else None
    return min(max(index.value + t, 0), K)


@dataclass
class Mask:
    """Which tokens of a batch of windows the model may see and which it is asked for.

    Two dicts of factor -> (B, K) bool; `shown` and `asked`. Goal-conditioned
    imitation at t = 2 in a window of six steps, `#` shown, `?` asked, `.` neither:

        s ###..#  a ##?...

    Here the factor `s` is the state's numbers; each camera has tokens of its own.

    `causal`, one bool or (B,), says which windows are read causally: each asked token sees only what is shown before it
    in the order properties, s0, a0, s1, a1, ..., a step's cameras between its state and its action; so one window may
    show a token to those after it and ask for it too.
    """

    shown: dict[str, Tensor]
    asked: dict[str, Tensor]
    causal: Tensor | bool = False

    def within(self, valid: Tensor) -> "Mask":
        """The same mask with steps outside the episode, `valid` (B, K) False, neither shown nor asked."""
        shown, asked = ({name: part[name] & valid for name in part} for part in (self.shown, self.asked))
        return Mask(shown, asked, self.causal)

    def repeat(self, times: int) -> "Mask":
        """Each window's mask `times` times, one after another."""
        return self._each(lambda tensor: tensor.repeat_interleave(times, dim=0))

    def to(self, device: torch.device) -> "Mask":
        return self._each(lambda tensor: tensor.to(device))

    def _each(self, change: Callable[[Tensor], Tensor]) -> "Mask":
        """The mask with each of its tensors changed."""
        shown, asked = ({name: change(part[name]) for name in part} for part in (self.shown, self.asked))
        return Mask(shown, asked, self.causal if isinstance(self.causal, bool) else change(self.causal))

    def next_tokens(self, cameras: Sequence[str] = ()) -> dict[str, Tensor]:
        """factor -> (B, K) bool: of the asked tokens the one that follows what is shown, where that is every state and
        action before it, any of the pictures before it, and nothing after; properties may be shown or not, and follow
        nothing."""
        shown, asked = (
            torch.stack([tokens[name] for name in ASKABLE], dim=-1).flatten(1) for tokens in (self.shown, self.asked)
        )  # (B, 2 K), in the order of time
        order = torch.arange(shown.shape[1], device=shown.device)
        count = shown.sum(1, keepdim=True)
        history = shown.any(1, keepdim=True) & (shown == (order < count)).all(1, keepdim=True)
        for name in cameras:  # a picture stands after its step's state, which is shown where it is before
            history = history & (~self.shown[name] | self.shown["s"]).all(1, keepdim=True)
        following = (history & asked & (order == count)).unflatten(1, (-1, 2)).unbind(-1)
        nothing = torch.zeros_like(following[0])
        return dict.fromkeys(self.asked, nothing) | dict(zip(ASKABLE, following, strict=True))

    def draw(self, window: int = 0) -> str:
        """One window's mask as text, in the notation of the class's docstring."""
        rows = []
        for name, shown in self.shown.items():
            marks = zip(shown[window].tolist(), self.asked[name][window].tolist(), strict=True)
            rows.append(f"{name} " + "".join("#" if s else "?" if p else "." for s, p in marks))
        return "  ".join(rows)
