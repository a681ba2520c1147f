"""Training masks against a loop over windows, and their marginals."""

from collections import Counter

import pytest
import torch
from test_masks import slow_table
from torch.utils._python_dispatch import TorchDispatchMode

from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import RANDOM_MASK, TASKS, tabulate
from lerobot_unimask.language.training_masks import TrainingMasks, counter_uniform, mixture

FACTORS = ("s", "a", "rtg")


def chi_square_bound(cells):
    """A value that chi-square with cells - 1 degrees of freedom exceeds once in 3 million (Wilson and Hilferty)."""
    df = cells - 1
    return df * (1 - 2 / (9 * df) + 5 * (2 / (9 * df)) ** 0.5) ** 3


def assert_frequencies(observed, expected):
    """Counts against probabilities, one for each cell."""
    observed, expected = torch.as_tensor(observed).double(), torch.as_tensor(expected).double()
    expected = expected / expected.sum() * observed.sum()
    assert ((observed - expected).square() / expected).sum() < chi_square_bound(len(observed)), (observed, expected)


M64 = 2**64 - 1
GOLDEN = 0x9E3779B97F4A7C15


def mix64(z):
    """SplitMix64's finaliser on Python's unbounded integers."""
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & M64
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & M64
    return z ^ (z >> 31)


def slow_uniform(seed, step, index, n):
    key = mix64((mix64(seed * GOLDEN & M64) + step) & M64)
    base = mix64(key ^ (index * GOLDEN & M64))
    return [(mix64((base + lane * GOLDEN) & M64) >> 40) / 2**24 for lane in range(1, n + 1)]


def test_counter_uniform_is_splitmix64():
    # The reference implementation's first output for the seed 0 is E220A8397B1DCDAF.
    assert counter_uniform(0, 0, torch.tensor([0]), 1).item() == 0xE220A8 / 2**24
    index = torch.tensor([0, 1, 7, 2**31, 2**62, 123_456_789])
    for seed, step in ((0, 0), (1, 0), (12345, 7), (3, -1), (2**40, 10**9)):
        fast = counter_uniform(seed, step, index, 5)
        assert fast.dtype == torch.float32
        assert fast.tolist() == [slow_uniform(seed, step, i, 5) for i in index.tolist()]
        assert torch.equal(fast, counter_uniform(seed, torch.tensor(step), index, 5))
    assert torch.equal(counter_uniform(0, 0, index, 5)[:, :3], counter_uniform(0, 0, index, 3))


def test_counter_uniform_is_uniform_in_every_direction():
    over_index = counter_uniform(0, 5, torch.arange(20_000), 3)
    over_step = torch.cat([counter_uniform(0, step, torch.tensor([4]), 3) for step in range(5_000)])
    over_seed = torch.cat([counter_uniform(seed, 0, torch.tensor([0]), 3) for seed in range(5_000)])
    over_lane = counter_uniform(2, 9, torch.tensor([11]), 60_000).view(-1, 3)
    for numbers in (over_index, over_step, over_seed, over_lane):
        assert numbers.min() >= 0
        assert numbers.max() < 1
        for column in numbers.T:
            assert_frequencies((column * 16).long().bincount(minlength=16), torch.ones(16))
        cells = (numbers[:, 0] * 6).long() * 36 + (numbers[:, 1] * 6).long() * 6 + (numbers[:, 2] * 6).long()
        assert_frequencies(cells.bincount(minlength=216), torch.ones(216))  # the columns are independent
        neighbours = (numbers[:-1, 0] * 8).long() * 8 + (numbers[1:, 0] * 8).long()
        assert_frequencies(neighbours.bincount(minlength=64), torch.ones(64))


def ragged(B, K, generator=None):
    """(B, K) bool: windows with 1 to K valid steps."""
    lengths = torch.randint(1, K + 1, (B,), generator=generator or torch.Generator().manual_seed(0))
    return torch.arange(K) < lengths[:, None]


def slow_mask(masks, valid, index, seed, step, factors):
    """One window's (shown, asked) sets, drawn by a loop from the same uniform numbers."""
    K = len(valid)
    uniform = slow_uniform(seed, step, index, 3 + len(factors) * K)
    weights = mixture(masks)
    total, reached, chosen = sum(weights.values()), 0.0, list(weights)[-1]
    for text, weight in weights.items():
        reached += weight / total
        if uniform[0] < reached:
            chosen = text
            break
    if chosen == RANDOM_MASK:
        everything = [(name, p) for name in factors for p in range(K)]
        hidden = {token for token, u in zip(everything, uniform[3:], strict=True) if u < uniform[2]}
        for name in factors:
            if name not in ("s", "a"):
                hidden -= {(name, 0)}
                hidden |= {(name, p) for p in range(1, K)}
                if uniform[3 + factors.index(name) * K] < 0.5:
                    hidden.add((name, 0))
        shown, asked = set(everything) - hidden, {token for token in hidden if token[0] in ("s", "a")}
    else:
        text = TASKS.get(chosen, chosen)
        rows = [row for row in slow_table(text, factors, K) if any(valid[p] for _, p in row[2])]
        if not rows:
            return set(), set()
        _, shown, asked = rows[int(uniform[1] * len(rows))]
    return {(f, p) for f, p in shown if valid[p]}, {(f, p) for f, p in asked if valid[p]}


MIXTURES = [
    RANDOM_MASK,
    "behavior_cloning",
    "multi_task",
    ["multi_task", RANDOM_MASK],
    {"a[t] | s[t]": 1, RANDOM_MASK: 0.5, "s[4:] | s[0], rtg[0]": 2.5},
]


@pytest.mark.parametrize("masks", MIXTURES)
def test_training_masks_are_those_of_a_loop_over_windows(masks):
    K, index = 6, torch.arange(0, 900, 3)
    valid = ragged(len(index), K)
    drawn = TrainingMasks(masks, FACTORS, K)(valid, index, seed=7, step=3)
    for b in range(len(index)):
        shown, asked = slow_mask(masks, valid[b].tolist(), int(index[b]), 7, 3, FACTORS)
        assert {(f, p) for f in FACTORS for p in drawn.shown[f][b].nonzero().flatten().tolist()} == shown
        assert {(f, p) for f in FACTORS for p in drawn.asked[f][b].nonzero().flatten().tolist()} == asked


def test_a_window_that_no_question_fits_asks_for_nothing():
    valid = torch.arange(5) < torch.tensor([[1], [5]])
    mask = TrainingMasks("forward_dynamics", ("s", "a"), 5)(valid, torch.tensor([0, 1]), seed=0, step=0)
    assert mask.draw(0) == "s .....  a ....."
    assert "?" in mask.draw(1)


def test_multi_task_goes_without_the_return_where_there_is_none():
    weights = mixture("multi_task", ("s", "a"))
    assert "reward_conditioned" not in weights
    assert sum(weights.values()) == pytest.approx(1)


def test_a_regime_shares_its_weight():
    assert mixture("multi_task") == pytest.approx(dict.fromkeys(TASKS, 1 / 8))
    assert mixture(["multi_task", "past"])["past"] == pytest.approx(1 + 1 / 8)
    assert mixture({RANDOM_MASK: 3, "multi_task": 8})["future"] == pytest.approx(1)


@pytest.mark.parametrize(
    "masks", [[], {}, {"past": 0}, {"past": -1.0}, {"past": float("nan")}, {"past": float("inf")}, {"past": "much"}]
)
def test_no_masks_and_impossible_weights_are_refused(masks):
    with pytest.raises(ValueError, match="training_masks"):
        TrainingMasks(masks, FACTORS, 10)


def test_training_masks_must_fit_the_model():
    with pytest.raises(MaskError, match="no factor 'rtg'"):
        TrainingMasks("reward_conditioned", ("s", "a"), 10)
    with pytest.raises(MaskError, match="outside the window"):
        TrainingMasks(["past", "s[1] | s[7]"], FACTORS, 5)


def test_random_masking_has_the_papers_marginals():
    B, K = 40_000, 3
    valid = torch.ones(B, K, dtype=torch.bool)
    mask = TrainingMasks(RANDOM_MASK, FACTORS, K)(valid, torch.arange(B), seed=3, step=8)
    hidden = ~torch.cat([mask.shown["s"], mask.shown["a"]], dim=1)  # (B, 2 K)
    assert torch.equal(hidden, torch.cat([mask.asked["s"], mask.asked["a"]], dim=1))
    # With p ~ U(0, 1), the number hidden is uniform on 0 .. 2 K, and given the number every choice is equally likely.
    assert_frequencies(hidden.sum(1).bincount(minlength=2 * K + 1), torch.ones(2 * K + 1))
    pairs = hidden[hidden.sum(1) == 2].long() @ 2 ** torch.arange(2 * K)
    assert_frequencies(torch.tensor(list(Counter(pairs.tolist()).values())), torch.ones(15))
    shown = mask.shown["rtg"][:, 0]
    assert_frequencies([int(shown.sum()), int((~shown).sum())], [1, 1])
    # The return is shown or not whatever the rest.
    many = hidden.sum(1) > K
    assert_frequencies([int(shown[many].sum()), int((~shown)[many].sum())], [1, 1])


@pytest.mark.parametrize("masks", MIXTURES)
def test_a_mask_depends_on_seed_update_and_frame_alone(masks):
    K = 8
    drawer = TrainingMasks(masks, FACTORS, K)
    index, valid = torch.arange(100), ragged(100, K)

    def draw(rows, seed=5, step=11):
        mask = drawer(valid[rows], index[rows], seed=seed, step=step)
        return torch.stack([*mask.shown.values(), *mask.asked.values()], dim=1)

    every = torch.arange(100)
    whole = draw(every)
    order = torch.randperm(100, generator=torch.Generator().manual_seed(0))
    assert torch.equal(draw(order), whole[order])
    assert torch.equal(torch.cat([draw(part) for part in every.split(13)]), whole)
    assert torch.equal(draw(torch.tensor([42, 42])), whole[[42, 42]])
    assert torch.equal(draw(every, step=torch.tensor(11)), whole)
    assert not torch.equal(draw(every, seed=6), whole)
    assert not torch.equal(draw(every, step=12), whole)


def test_the_global_generator_is_neither_used_nor_moved():
    drawer = TrainingMasks(["multi_task", RANDOM_MASK], FACTORS, 8)
    valid, index = ragged(50, 8), torch.arange(50)
    torch.manual_seed(0)
    before = torch.get_rng_state()
    first = drawer(valid, index, seed=0, step=0)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(1)
    second = drawer(valid, index, seed=0, step=0)
    assert all(torch.equal(first.shown[name], second.shown[name]) for name in FACTORS)


class CountOperations(TorchDispatchMode):
    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += 1
        return func(*args, **(kwargs or {}))


def test_drawing_makes_no_loop_over_windows():
    drawer = TrainingMasks(["multi_task", RANDOM_MASK], FACTORS, 8)
    counts = []
    for B in (2, 2000):
        valid = ragged(B, 8)
        with CountOperations() as operations:
            drawer(valid, torch.arange(B), seed=0, step=0)
        counts.append(operations.count)
    assert counts[0] == counts[1]


def test_training_masks_leave_nothing_in_the_checkpoint():
    assert TrainingMasks("multi_task", FACTORS, 10).state_dict() == {}


def causal_masks(masks, share=1.0, B=2000, K=4, factors=("s", "a", "rtg"), **settings):
    drawn = TrainingMasks(masks, factors, K, causal_share=share, **settings)
    return drawn, drawn(torch.ones(B, K, dtype=torch.bool), torch.arange(B), seed=0, step=3)


def test_a_causal_window_asks_a_question_at_every_step_at_once():
    _, mask = causal_masks("behavior_cloning", B=1)
    assert mask.causal.all()
    assert mask.shown["s"].all()
    assert mask.shown["a"][0].tolist() == [True] * 3 + [False]
    assert mask.asked["a"].all()
    assert not mask.asked["s"].any()
    assert not mask.shown["rtg"].any()
    _, mask = causal_masks("reward_conditioned", B=1)
    assert mask.shown["rtg"][0].tolist() == [True, False, False, False]


@pytest.mark.parametrize("task", ["behavior_cloning", "reward_conditioned", "a[t] | s[:t+1]", "a[t] | s[:t+1], rtg[0]"])
def test_causality_keeps_the_steps_of_a_causal_window_apart(task):
    """For every t, what a causal window shows before a[t] is what the question at t shows."""
    K, factors = 4, ("s", "a", "rtg")
    _, union = causal_masks(task, B=1)
    assert union.asked["a"].all()
    table = tabulate(task, factors, K)
    for row, t in enumerate(table.t.tolist()):
        before = {"s": t + 1, "a": t, "rtg": K}
        for f, name in enumerate(factors):
            assert torch.equal(union.shown[name][0, : before[name]], table.shown[row, f, : before[name]])
            assert not table.shown[row, f, before[name] :].any()


def test_causal_random_masking_asks_for_every_token_and_shows_half_of_the_properties():
    _, mask = causal_masks("random_mask")
    for name in ("s", "a"):
        assert mask.shown[name].all()
        assert mask.asked[name][:, 1:].all()
    assert mask.asked["a"][:, 0].all()
    assert not mask.asked["s"][:, 0].any()
    assert not mask.shown["rtg"][:, 1:].any()
    assert mask.shown["rtg"][:, 0].float().mean().item() == pytest.approx(0.5, abs=5 * 0.5 / 2000**0.5)


def test_the_share_of_causal_windows_is_as_asked_and_the_others_are_as_without():
    _, mask = causal_masks("multi_task", share=0.3)
    assert mask.causal.float().mean().item() == pytest.approx(0.3, abs=5 * (0.21 / 2000) ** 0.5)
    _, without = causal_masks("multi_task", share=0.0)
    for name in mask.shown:
        assert torch.equal(mask.shown[name][~mask.causal], without.shown[name][~mask.causal])
        assert torch.equal(mask.asked[name][~mask.causal], without.asked[name][~mask.causal])
    conditioned = mask.shown["rtg"][mask.causal][:, 0].float().mean().item()  # two of the tasks have a causal form
    assert conditioned == pytest.approx(0.5, abs=0.11)


@pytest.mark.parametrize("text", ["past", "s[0] | rtg[0]", "a[t] | s[t]", "a[t] | s[t:]", "a[t], s[t+1] | s[:t+1]"])
def test_without_a_causal_form_nothing_is_causal_or_the_mask_is_refused(text):
    _, mask = causal_masks(text, share=0.5)
    assert mask.causal is False
    with pytest.raises(MaskError, match="behavior_cloning"):
        causal_masks(["behavior_cloning", text], share=1.0)


@pytest.mark.parametrize(
    ("masks", "text", "t", "causally"),
    [
        ("random_mask", "behavior_cloning", 2, {"a": [2], "s": []}),
        ("random_mask", "reward_conditioned", 0, {"a": [0], "s": []}),
        ("random_mask", "future", 1, {"a": [1], "s": []}),  # the rest of the future is not the next token
        ("random_mask", "s[3] | s[:3], a[:3]", None, {"s": [3], "a": []}),
        ("random_mask", "goal_conditioned", 2, {"a": [], "s": []}),
        ("random_mask", "past", 2, {"a": [], "s": []}),
        ("random_mask", "forward_dynamics", 1, {"a": [], "s": []}),
        ("random_mask", "s[0]", None, {"a": [], "s": []}),  # nothing comes before it
        ("behavior_cloning", "behavior_cloning", 2, {"a": [2], "s": []}),
        ("behavior_cloning", "reward_conditioned", 2, {"a": [], "s": []}),  # it has not learnt that
        ("behavior_cloning", "s[3] | s[:3], a[:3]", None, {"a": [], "s": []}),
        ("past", "behavior_cloning", 2, {"a": [], "s": []}),
        ("random_mask", "a[t] | s[:t+1]", 2, {"a": [], "s": []}),  # it shows every action before
        (["random_mask", "a[t] | s[:t+1]"], "a[t] | s[:t+1]", 2, {"a": [2], "s": []}),
        (["random_mask", "a[t] | s[:t+1]"], "behavior_cloning", 2, {"a": [2], "s": []}),
        (["random_mask", "a[t] | s[:t+1]"], "a[2:] | s[:3]", None, {"a": [2], "s": []}),
        ("a[t] | s[:t+1]", "behavior_cloning", 2, {"a": [], "s": []}),
        ("a[t] | s[t]", "a[t] | s[t]", 2, {"a": [], "s": []}),  # another t shows another state
    ],
)
def test_what_is_answered_causally(masks, text, t, causally):
    drawn, _ = causal_masks(masks, share=0.5)
    mask = tabulate(text, drawn.factors, 4).at(t, 3)
    for name, tokens in drawn.answered_causally(mask).items():
        assert tokens.shape == (3, 4)
        assert all(row.nonzero().flatten().tolist() == causally.get(name, []) for row in tokens)


def test_nothing_is_answered_causally_by_a_bidirectional_model():
    drawn, _ = causal_masks("random_mask", share=0.0)
    mask = tabulate("behavior_cloning", drawn.factors, 4).at(2)
    assert not any(tokens.any() for tokens in drawn.answered_causally(mask).values())
