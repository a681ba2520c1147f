"""The masks that training draws: a mixture of questions and of random masking, for whole batches without a loop.

Legend of shapes: B windows, K steps, F factors, R rows (one for each admissible t of each task), T tasks.
"""

from collections.abc import Collection, Mapping, Sequence

import torch
from torch import Tensor, nn

from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import ASKABLE, RANDOM_MASK, REGIMES, TASKS, Mask, MaskTable, parse, tabulate

# The update count of training masks is never negative, so validation draws masks that no update has seen, and at every
# validation the same ones.
VALIDATION_STEP = -1


class TrainingMasks(nn.Module):
    """Draws one mask per window from a mixture of questions and random masking, without a loop over windows.

    A causal window carries all t of a question at once: what any of them shows is shown, and causality keeps them
    apart. That holds for questions that ask for one token and show nothing after it, and before it the same tokens for
    all t: all states and actions, as behaviour cloning does, or the states alone, `a[t] | s[:t+1]`. The causal form of
    random masking shows all of these, each property with probability 1/2, and asks for every state and action but the
    first state: nothing comes before a property either, so none is asked causally.

    Args:
        masks: one text, a list (equal weights), or a mapping from texts to weights. Each text is a question, the name
            of a task, `random_mask`, or a regime's name (`multi_task`: the eight tasks, sharing its weight; without a
            return factor, seven).
        factors: names of the model's factors.
        context_length: K.
        causal_share: share of the windows that are causal.
        cameras: names of its cameras, whose tokens come after the factors'.
        predicted: the factors that random masking asks for where it hides them, and questions may ask for.

    Raises:
        MaskError: a text that does not fit the model, asks for what it does not predict, or with a causal share of 1
            has no causal form.
        ValueError: no masks, or weights that are not positive numbers.
    """

    shown: Tensor
    asked: Tensor
    task_of_row: Tensor
    askable: Tensor
    lasting: Tensor
    cumulative_weights: Tensor
    causal_shown: Tensor
    causal_asked: Tensor
    causal_row: Tensor
    causal_cumulative_weights: Tensor

    def __init__(
        self,
        masks: str | Sequence[str] | Mapping[str, float],
        factors: Sequence[str],
        context_length: int,
        *,
        causal_share: float = 0.0,
        cameras: Sequence[str] = (),
        predicted: Collection[str] = ASKABLE,
    ):
        super().__init__()
        self.cameras = tuple(cameras)
        self.factors = (*factors, *cameras)
        self.weights = mixture(masks, factors)
        tables = {
            text: tabulate(text, tuple(factors), context_length, self.cameras)
            for text in self.weights
            if text != RANDOM_MASK
        }
        for table in tables.values():
            check_predicted(table.masks(), predicted, table.question.text)
        tasks = {text: task for task, text in enumerate(self.weights)}
        self.random_task = tasks.get(RANDOM_MASK)
        empty = torch.zeros(0, len(self.factors), context_length, dtype=torch.bool)
        weights = torch.tensor(list(self.weights.values()), dtype=torch.float64)
        # Worked out from the config, so not part of the checkpoint.
        self._keep("shown", torch.cat([empty, *(table.shown for table in tables.values())]))
        self._keep("asked", torch.cat([empty, *(table.asked for table in tables.values())]))
        self._keep("task_of_row", torch.tensor([tasks[text] for text in tables for _ in tables[text].t]).long())
        lasting = torch.tensor([name in (*ASKABLE, *cameras) for name in self.factors])[:, None]  # (F, 1)
        self._keep("lasting", lasting)
        first = torch.arange(context_length) == 0
        self._keep("askable", torch.tensor([name in predicted for name in self.factors])[:, None] & (lasting | first))
        self._keep("cumulative_weights", _cumulative(weights))
        forms = [self._causal_form(tables.get(text), context_length) for text in self.weights]
        capable = torch.tensor([form is not None for form in forms])
        if causal_share == 1 and not capable.all():
            text = list(self.weights)[forms.index(None)]
            raise MaskError(
                "A model that attends causally alone is trained on random_mask, or on questions that ask for one token "
                "and show nothing after it, and before it the same for every t, such as behavior_cloning or "
                "a[t] | s[:t+1]; this one is not.",
                TASKS.get(text, text),
            )
        self.causal_share = causal_share if capable.any() else 0.0
        nothing = (empty.new_zeros(empty.shape[1:]),) * 2
        shown, asked = zip(*(form or nothing for form in forms), strict=True)
        self._keep("causal_shown", torch.stack(shown))  # (T, F, K) for each of the tasks
        self._keep("causal_asked", torch.stack(asked))
        self._keep("causal_row", capable[self.task_of_row])
        self._keep("causal_cumulative_weights", _cumulative(weights * capable) if capable.any() else torch.zeros(0))

    def _keep(self, name: str, tensor: Tensor) -> None:
        self.register_buffer(name, tensor, persistent=False)

    def _causal_form(self, table: MaskTable | None, K: int) -> tuple[Tensor, Tensor] | None:
        """What a causal window of this task, None for random masking, shows and asks for: two (F, K), or None."""
        if table is None:
            shown = torch.ones(len(self.factors), K, dtype=torch.bool)
            asked = self.askable.clone()
            asked[self.factors.index("s"), 0] = False  # nothing of the window comes before it
            asked[~self.lasting[:, 0]] = False
            shown[~self.lasting[:, 0], 1:] = False
            return shown, asked
        place = self._places(K)
        at = torch.where(table.asked, place, -1).amax((1, 2))  # (R,) of the token that each t asks for
        shown = table.shown.any(0)
        alone = (table.asked.sum((1, 2)) == 1) & (at > 0)  # nothing of the window stands before s[0]
        apart = (table.shown == shown & (place < at[:, None, None])).all()
        return (shown, table.asked.any(0)) if alone.all() and apart else None

    def _places(self, K: int) -> Tensor:
        """Where each token stands among those of a window, (F, K); properties before them all."""
        order = ["s", *self.cameras, "a"]
        steps = len(order) * torch.arange(K)
        return torch.stack([steps + order.index(n) if n in order else torch.full((K,), -1) for n in self.factors])

    def answered_causally(self, mask: Mask) -> dict[str, Tensor]:
        """factor -> (B, K) bool: the asked tokens that follow what is shown, where the model has learnt to predict them
        causally. All else it answers in both directions."""
        whole = torch.zeros(len(mask.shown["s"]), dtype=torch.bool, device=self.causal_row.device)
        if self.causal_share > 0 and self.random_task is not None:
            pictures = [mask.shown[name] == mask.shown["s"] for name in self.cameras]
            whole = torch.stack([~whole, *(same.all(1) for same in pictures)]).all(0)
        following = mask.next_tokens(self.cameras)
        if whole.all() and not len(self.shown):
            return following
        learnt = self.causal_row & (self.causal_share > 0)  # (R,)
        shown = torch.stack([mask.shown[name] for name in self.factors], dim=1)  # (B, F, K)
        same = ((shown[:, None] == self.shown).all((2, 3)) & learnt).float()  # (B, R)
        return {
            name: (tokens & whole[:, None]) | (mask.asked[name] & (same @ self.asked[:, f].float() > 0))
            for f, (name, tokens) in enumerate(following.items())
        }

    def forward(self, valid: Tensor, index: Tensor, *, seed: int, step: Tensor | int) -> Mask:
        """Draw a mask for each window.

        Args:
            valid: (B, K) bool, False past the episode's end.
            index: (B,) the windows' first frames. Together with `seed` and `step` it decides the mask, so that masks
                do not depend on workers, on how a batch is split over processes, or on a restart.
            step: number of updates made so far.
        """
        B, K = valid.shape
        F = len(self.factors)
        draw = _uncompiled_uniform if torch.compiler.is_compiling() else counter_uniform
        uniform = draw(seed, step, index, 4 + F * K)  # (B, 4 + F K)
        task = (self.cumulative_weights <= uniform[:, :1]).sum(1)  # (B,)
        shown = valid.new_zeros(B, F, K)
        asked = valid.new_zeros(B, F, K)
        if len(self.shown):
            shown, asked = self._question_masks(valid, task, uniform[:, 1])
        hidden = self._hidden(uniform[:, 2], uniform[:, 3:-1].view(B, F, K))
        if self.random_task is not None:
            chosen = (task == self.random_task)[:, None, None]
            shown = torch.where(chosen, ~hidden, shown)
            asked = torch.where(chosen, hidden & self.askable, asked)
        causal: Tensor | bool = False
        if self.causal_share > 0:
            causal = uniform[:, -1] < self.causal_share  # (B,)
            task = (self.causal_cumulative_weights <= uniform[:, :1]).sum(1)
            history = self.causal_shown[task]
            if self.random_task is not None:
                history = history & (self.lasting | ~hidden | (task != self.random_task)[:, None, None])
            shown = torch.where(causal[:, None, None], history, shown)
            asked = torch.where(causal[:, None, None], self.causal_asked[task], asked)
        return Mask(self._by_factor(shown), self._by_factor(asked), causal).within(valid)

    def _by_factor(self, tokens: Tensor) -> dict[str, Tensor]:
        return dict(zip(self.factors, tokens.unbind(1), strict=True))

    def _question_masks(self, valid: Tensor, task: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor]:
        """One row per window, uniform among those of its task that ask for something valid: two (B, F, K)."""
        asked = self.asked.any(1)  # (R, K)
        admissible = (valid.float() @ asked.T.float() > 0) & (self.task_of_row == task[:, None])  # (B, R)
        rank = admissible.cumsum(1)
        wanted = (uniform * rank[:, -1]).floor() + 1  # 1 .. number of admissible rows
        row = (admissible & (rank == wanted[:, None])).int().argmax(1)  # (B,)
        some = admissible.any(1)[:, None, None]
        return self.shown[row] & some, self.asked[row] & some

    def _hidden(self, probability: Tensor, uniform: Tensor) -> Tensor:
        """Random masking (paper, section 2.2 and appendix C): p ~ U(0, 1) per window, each state, picture and action
        hidden with probability p; a property's first token hidden with probability 1/2, its later ones always.
        (B, F, K)."""
        hidden = uniform < probability[:, None, None]
        for f, name in enumerate(self.factors):
            if name not in (*ASKABLE, *self.cameras):
                hidden[:, f, 0] = uniform[:, f, 0] < 0.5
                hidden[:, f, 1:] = True
        return hidden


def check_predicted(mask: Mask, predicted: Collection[str], text: str | None = None) -> None:
    """
    Raises:
        MaskError: the mask asks for a factor that is not predicted.
    """
    for name, asked in mask.asked.items():
        if name not in predicted and asked.any():
            raise MaskError(
                f"This model does not predict {name}, which can only be shown to it: ask for {' or '.join(predicted)}, "
                "or train it with ask_properties=true and an attention that is not causal alone.",
                text or mask.draw(),
            )


def validation_masks(
    text: str, factors: tuple[str, ...], valid: Tensor, index: Tensor, cameras: Sequence[str] = ()
) -> Mask:
    """One question for each window, the same for every policy.

    Args:
        text: what is asked, as `training_masks` takes it.
        valid: (B, K) bool, False past the episode's end.
        index: (B,) the windows' first frames.

    Raises:
        MaskError: a factor of the question is not among `factors`.
    """
    draw = TrainingMasks(text, factors, valid.shape[1], cameras=cameras).to(valid.device)
    return draw(valid, index.to(valid.device), seed=0, step=VALIDATION_STEP)


def _cumulative(weights: Tensor) -> Tensor:
    """Where the unit interval is cut so that each task gets its share: (T - 1,)."""
    return (weights / weights.sum()).cumsum(0)[:-1].float()


def mixture(masks: str | Sequence[str] | Mapping[str, float], factors: Sequence[str] | None = None) -> dict[str, float]:
    """`training_masks` as one mapping from texts to weights, regimes expanded.

    Args:
        factors: the model's; a regime is then made of the tasks that it has the factors for. None: not known yet.

    Raises:
        ValueError: nothing given, or weights that are not positive numbers.
    """
    if isinstance(masks, str):
        masks = [masks]
    weights = list(masks.items()) if isinstance(masks, Mapping) else [(text, 1.0) for text in masks]
    if not weights:
        raise ValueError(f"training_masks is empty; name a question or a task: {', '.join([*TASKS, RANDOM_MASK])}.")
    expanded: dict[str, float] = {}
    for text, weight in weights:
        if not isinstance(weight, int | float) or not 0 < weight < float("inf"):
            raise ValueError(f"training_masks gives {text!r} the weight {weight!r}; weights are positive numbers.")
        members = REGIMES.get(text, (text,))
        if text in REGIMES and factors is not None:
            members = tuple(m for m in members if {term.factor for term in parse(m).terms} <= set(factors))
        for member in members:
            expanded[member] = expanded.get(member, 0.0) + weight / len(members)
    return expanded


def counter_uniform(seed: int, step: Tensor | int, index: Tensor, n: int) -> Tensor:
    """n uniform numbers in [0, 1) for each of `index` (B,), a pure function of (seed, step, index): (B, n) float32.

    SplitMix64's finaliser (Steele, Lea and Flood, 2014) as a counter-based hash.
    """
    golden = -0x61C8864680B583EB  # 2^64 / golden ratio, as a signed integer
    index = index.to(torch.int64)
    key = _mix64(_mix64(torch.full_like(index, seed) * golden) + step)
    lanes = torch.arange(1, n + 1, device=index.device) * golden
    bits = _mix64(_mix64(key ^ (index * golden))[:, None] + lanes)  # (B, n)
    return _shift_right(bits, 40).float() * 2.0**-24


@torch.library.custom_op("unimask::counter_uniform", mutates_args=())
def _uncompiled_uniform(seed: int, step: Tensor, index: Tensor, n: int) -> Tensor:
    """`counter_uniform`, kept out of what torch.compile translates: in torch 2.11 its code for these 64-bit integers
    writes past the end of a buffer on a processor with AVX2."""
    return counter_uniform(seed, step, index, n)


@_uncompiled_uniform.register_fake
def _(seed: int, step: Tensor, index: Tensor, n: int) -> Tensor:
    return index.new_empty(len(index), n, dtype=torch.float32)


def _mix64(x: Tensor) -> Tensor:
    x = (x ^ _shift_right(x, 30)) * -0x40A7B892E31B1A47
    x = (x ^ _shift_right(x, 27)) * -0x6B2FB644ECCEEE15
    return x ^ _shift_right(x, 31)


def _shift_right(x: Tensor, bits: int) -> Tensor:
    """A logical shift: torch has signed 64-bit integers alone, whose shift copies the sign."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)
