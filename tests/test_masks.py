"""The mask language against a slow reference, and training masks against a loop over windows."""

import random
import re
from collections import Counter

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from lerobot_unimask.masks import (
    MAX_CONTEXT,
    MAX_TEXT,
    RANDOM_MASK,
    REGIMES,
    TASKS,
    Mask,
    MaskError,
    TrainingMasks,
    counter_uniform,
    mixture,
    parse,
    parse_token,
    tabulate,
)

FACTORS = ("s", "a", "rtg")
QUESTIONS = [
    *TASKS.values(),
    "s[1:9] | s[0], s[3], s[6]",
    "s[:] | a[0]",
    "s[:], a[:]",
    "a[t] |",
    "a[t:t+3] | s[:t+1]",
    "a[t-1], s[t+2] | s[t-2:t], s[-1]",
    "s[t+1:t-1], a[0] | s[t]",
    "a[1,3,5:], s[t, -1] | s[::4], a[::2]",
    "s[-3:] | s[-20:20:3], rtg[0]",
    "s[t-3::2] | a[:t+2:2], rtg[:1]",
    "a[t] | s[t-1], s[t+1]",
    "s[2:-2] | s[:2], s[-2:]",
    "a[-1] | a[:-1]",
]


# --- The language, against a slow reading of the same text -----------------------------------------------------------


def slow_steps(text, K, t):
    """The steps that one part between commas names; None where an integer rules t out, IndexError where none exists."""
    if ":" not in text:
        step = eval(text, {}, {"t": t})
        if "t" in text:
            return {step} if 0 <= step < K else None
        if not -K <= step < K:
            raise IndexError(text)
        return {step + K if step < 0 else step}
    start, stop, stride = [*text.split(":"), ""][:3]

    def bound(part, default):
        if not part.strip():
            return default
        value = eval(part, {}, {"t": t})
        if "t" not in part and value < 0:
            value += K
        return value

    first, last, stride = max(bound(start, 0), 0), bound(stop, K), int(stride) if stride.strip() else 1
    return {p for p in range(K) if first <= p < last and (p - first) % stride == 0}


def slow_table(text, factors, K):
    """Rows (t, shown, asked), each a set of (factor, step); IndexError where the text cannot be asked."""
    asked_text, _, shown_text = text.partition("|")
    rows = []
    for t in range(K) if re.search(r"\bt\b", text) else [-1]:
        sides = []
        for side in (shown_text, asked_text):
            tokens = set()
            for factor, inside in re.findall(r"(\w+)\s*\[([^\]]*)\]", side):
                for part in inside.split(","):
                    steps = slow_steps(part, K, t)
                    tokens = None if steps is None or tokens is None else tokens | {(factor, p) for p in steps}
            sides.append(tokens)
        shown, asked = sides
        if shown is not None and asked is not None and asked - shown:
            rows.append((t, shown, asked - shown))
    if not rows:
        raise IndexError(text)
    return rows


def tokens(table, K):
    """{(factor, step)} of one (F, K) boolean table."""
    return {(FACTORS[f], step) for f, step in table.nonzero().tolist()}


def assert_table_is_the_slow_one(text, K):
    try:
        expected = slow_table(text, FACTORS, K)
    except IndexError:
        with pytest.raises(MaskError):
            tabulate(text, FACTORS, K)
        return
    table = tabulate(text, FACTORS, K)
    assert table.t.tolist() == [t for t, _, _ in expected]
    for row, (_, shown, asked) in enumerate(expected):
        assert tokens(table.visible[row], K) == shown
        assert tokens(table.predict[row], K) == asked


@pytest.mark.parametrize("K", [1, 2, 3, 7, 10, 13])
def test_every_question_is_the_slow_one(K):
    for text in QUESTIONS:
        assert_table_is_the_slow_one(text, K)


def test_random_questions_are_the_slow_ones():
    rng = random.Random(0)

    def bound():
        return rng.choice(["", "t", f"t+{rng.randint(0, 7)}", f"t - {rng.randint(0, 7)}", str(rng.randint(-7, 7))])

    def part():
        if rng.random() < 0.4:
            return bound() or "0"
        return f"{bound()}:{bound()}" + rng.choice(["", ":", f":{rng.randint(1, 3)}"])

    def terms():
        return ", ".join(f"{rng.choice('sa')}[{', '.join(part() for _ in range(rng.randint(1, 3)))}]" for _ in range(2))

    texts = [f"{terms()} | {terms()}" for _ in range(300)]
    for text in texts:
        assert_table_is_the_slow_one(text, 6)
    readable = 0
    for text in texts:
        try:
            readable += bool(slow_table(text, FACTORS, 6))
        except IndexError:
            continue
    assert readable > 100  # or the comparison above would be of errors alone


@pytest.mark.parametrize(
    ("text", "t", "drawing"),
    [
        ("behavior_cloning", 2, "s ###...  a ##?...  rtg ......"),
        ("reward_conditioned", 2, "s ###...  a ##?...  rtg #....."),
        ("goal_conditioned", 2, "s ###..#  a ##?...  rtg ......"),
        ("goal_conditioned", 5, "s ######  a #####?  rtg ......"),
        ("waypoint_conditioned", 1, "s ##.#..  a #?....  rtg ......"),
        ("past", 2, "s ??####  a ??####  rtg ......"),
        ("future", 2, "s ###???  a ##????  rtg ......"),
        ("future", 5, "s ######  a #####?  rtg ......"),
        ("forward_dynamics", 2, "s ..#?..  a ..#...  rtg ......"),
        ("inverse_dynamics", 2, "s .?#...  a .#....  rtg ......"),
        ("s[1:5] | s[0], s[3]", None, "s #??#?.  a ......  rtg ......"),
        ("s[:], a[:]", None, "s ??????  a ??????  rtg ......"),
    ],
)
def test_drawings(text, t, drawing):
    assert tabulate(text, FACTORS, 6).at(t).draw() == drawing


def test_the_papers_waypoints_for_ten_steps():
    assert tabulate("waypoint_conditioned", FACTORS, 10).at(0).draw().startswith("s #..#..#..#")


def test_white_space_means_nothing():
    spread = "  a [ t ]|s[ : t  + 1 ] ,\n\ta[ :t ] "
    tight, loose = (tabulate(text, FACTORS, 7) for text in ("a[t]|s[:t+1],a[:t]", spread))
    assert torch.equal(tight.visible, loose.visible)
    assert torch.equal(tight.predict, loose.predict)
    assert torch.equal(tabulate(" past\n", FACTORS, 7).predict, tabulate("past", FACTORS, 7).predict)


def test_a_slice_with_t_is_clipped_and_never_wraps():
    table = tabulate("a[0] | s[t-2:t+1]", FACTORS, 5)
    drawings = [table.at(t).draw().split("  ")[0] for t in range(5)]
    assert drawings == ["s #....", "s ##...", "s ###..", "s .###.", "s ..###"]


def test_an_integer_with_t_rules_steps_out():
    assert tabulate("a[t] | s[t-2], s[t+1]", FACTORS, 6).t.tolist() == [2, 3, 4]
    assert tabulate("inverse_dynamics", FACTORS, 6).t.tolist() == [1, 2, 3, 4, 5]


def test_a_table_answers_for_the_steps_that_it_admits():
    table = tabulate("past", FACTORS, 4)
    mask = table.at(3, batch_size=2)
    assert mask.visible["s"].shape == (2, 4)
    assert mask.draw(1) == "s ???#  a ???#  rtg ...."
    with pytest.raises(MaskError, match=r"cannot be asked at t=0; it can at t = 1, 2, 3"):
        table.at(0)
    with pytest.raises(MaskError, match="say which"):
        table.at(None)
    mask.visible["s"][:] = True  # a mask is the caller's to change, the table is everybody's
    assert tabulate("past", FACTORS, 4).at(3).draw() == "s ???#  a ???#  rtg ...."


# --- Errors: the caret stands under the character after the mark -----------------------------------------------------

FAULTS = [
    ("a[t] | ^q[0]", "no factor 'q'"),
    ("^x[t] | s[0]", "Its factors are s, a, rtg"),
    ("a[t] |\n ^rgt[0]", "Did you mean 'rtg'"),
    ("a[t] | s[0], s[^10]", "outside the window: its steps are 0 to 9"),
    ("a[t] | s[0], s[1, ^-11]", "outside the window"),
    ("s[^99999] | s[0]", "outside the window"),
    ("^s[0] | s[0]", "Nothing is asked"),
    ("^s[20:] | s[0]", "Nothing is asked"),
    ("^a[:t] | a[:t+1]", "Nothing is asked that is not shown for any t"),
    ("^a[t+10] | s[0]", "Nothing is asked"),
    ("s[1], ^rtg[0] | s[0]", "never asked"),
    ("a[t] | s[t], ^rtg[1]", "step 0 only"),
    ("a[t] | s[t], ^rtg[t]", "step 0 only"),
    ("a[t] | s[t], ^rtg[:]", "step 0 only"),
    ("a[t] | s[^?]", "Unexpected character '?'"),
    ("a^(t)", "Unexpected character '('"),
    ("a[t^.5]", "Unexpected character '.'"),
    ("__import__^('os')", "Unexpected character '('"),
    ("a[t] | s[:t+1^", "found the end of the text"),
    ("a[t] | s[0] ^| a[0]", "found '|'"),
    ("a[t] ^s[0]", "found 's'"),
    ("^t[0] | s[0]", "'t' is the step"),
    ("a^, s[0]", "factors are always indexed"),
    ("^", "Expected a factor"),
    ("^| s[0]", "Expected a factor"),
    ("a[^]", "Expected a step"),
    ("a[^t2]", "Expected a step"),
    ("a[^+1]", "Expected a step"),
    ("a[t+^]", "Expected an integer"),
    ("a[t+^t]", "Expected an integer"),
    ("a[t] | s[::^0]", "positive integer"),
    ("a[t] | s[::^-1]", "positive integer"),
    ("a[t] | s[::^t]", "positive integer"),
    ("a[^1000000000]", "at most 1024 steps"),
    ("^behaviour_cloning", "Did you mean 'behavior_cloning'"),
    ("  ^forwards ", "Named tasks: behavior_cloning"),
]


@pytest.mark.parametrize(("marked", "message"), FAULTS)
def test_an_error_names_the_fault_and_shows_where(marked, message):
    position, text = marked.index("^"), marked.replace("^", "", 1)
    with pytest.raises(MaskError, match=re.escape(message)) as raised:
        tabulate(text, FACTORS, 10)
    *_, line, caret = str(raised.value).split("\n")
    assert line == "  " + text.replace("\n", " ")
    assert caret == "  " + " " * position + "^"


@pytest.mark.parametrize("name", [RANDOM_MASK, *REGIMES])
def test_a_way_of_training_is_not_a_question(name):
    with pytest.raises(MaskError, match=f"{name} is a way of training, not a question"):
        parse(name)


def test_a_text_is_bounded_and_a_text():
    with pytest.raises(MaskError, match="at most 1000 characters"):
        parse("a[0], " * 1000)
    with pytest.raises(MaskError, match="at most 1000 characters"):
        parse_token("s" * (MAX_TEXT + 1), FACTORS, 10)
    for wrong in (3, None):
        with pytest.raises(TypeError, match="written as text"):
            parse(wrong)
        with pytest.raises(TypeError, match="written as text"):
            parse_token(wrong, FACTORS, 10)
    assert len(tabulate("s[1:] | s[0]", FACTORS, MAX_CONTEXT).t) == 1


def test_garbage_ends_in_a_mask_error():
    rng = random.Random(1)
    for _ in range(3000):
        text = "".join(rng.choice("sat[]:,+-|0123 \trtg?_(é٣") for _ in range(rng.randint(0, 12)))
        try:
            assert tabulate(text, FACTORS, 4).predict.any()
        except MaskError:
            continue


def test_a_given_token_is_a_single_one():
    assert parse_token("s[-1]", FACTORS, 10) == ("s", 9)
    assert parse_token(" rtg [ 0 ] ", FACTORS, 10) == ("rtg", 0)
    for text in (
        "s[t]",
        "s[:]",
        "s[0, 1]",
        "s[0], a[0]",
        "s[0] a[0]",
        "s[0] | a[0]",
        "s[10]",
        "rtg[1]",
        "q[0]",
        "past",
        "",
    ):
        with pytest.raises(MaskError):
            parse_token(text, FACTORS, 10)


# --- Masks for a batch -----------------------------------------------------------------------------------------------


def test_within_and_draw():
    mask = tabulate("goal_conditioned", ("s", "a"), 6).at(2, batch_size=2)
    valid = torch.tensor([[True] * 6, [True] * 2 + [False] * 4])
    inside = mask.within(valid)
    assert [inside.draw(0), inside.draw(1)] == ["s ###..#  a ##?...", "s ##....  a ##...."]
    assert mask.draw(1) == "s ###..#  a ##?..."  # the original is as it was


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
        assert {(f, p) for f in FACTORS for p in drawn.visible[f][b].nonzero().flatten().tolist()} == shown
        assert {(f, p) for f in FACTORS for p in drawn.predict[f][b].nonzero().flatten().tolist()} == asked


@pytest.mark.parametrize("masks", MIXTURES)
def test_nothing_outside_the_episode_and_nothing_twice(masks):
    valid = ragged(2000, 10)
    mask = TrainingMasks(masks, FACTORS, 10)(valid, torch.arange(2000), seed=0, step=0)
    for name in FACTORS:
        assert not (mask.visible[name] & ~valid).any()
        assert not (mask.predict[name] & ~valid).any()
        assert not (mask.visible[name] & mask.predict[name]).any()
        assert mask.visible[name].dtype == torch.bool
    assert not mask.predict["rtg"].any()
    assert not mask.visible["rtg"][:, 1:].any()


@pytest.mark.parametrize("length", [1, 4, 10])
@pytest.mark.parametrize("task", ["behavior_cloning", "past", "future"])
def test_t_is_uniform_among_the_steps_that_ask_for_something_valid(task, length):
    B, K = 20_000, 10
    valid = (torch.arange(K) < length).expand(B, K)
    mask = TrainingMasks(task, FACTORS, K)(valid, torch.arange(B), seed=1, step=2)
    # How many actions are shown or asked tells these masks apart.
    count = mask.predict["a"].sum(1) if task == "past" else mask.visible["a"].sum(1)
    if task == "past":
        # t = 1 .. K - 1, the valid ones of its asked steps 0 .. t - 1: every t at or past the end asks for all of them.
        observed = count.bincount(minlength=length + 1)[1:]
        expected = torch.tensor([1.0] * (length - 1) + [K - length]) if length < K else torch.ones(K - 1)
        observed = observed[: len(expected)]
    else:
        observed = count.bincount(minlength=length)
        expected = torch.ones(length)
    assert observed.sum() == B
    if len(expected) > 1:
        assert_frequencies(observed, expected)


def test_a_window_that_no_question_fits_asks_for_nothing():
    valid = torch.arange(5) < torch.tensor([[1], [5]])
    mask = TrainingMasks("forward_dynamics", ("s", "a"), 5)(valid, torch.tensor([0, 1]), seed=0, step=0)
    assert mask.draw(0) == "s .....  a ....."
    assert "?" in mask.draw(1)


def test_weights_are_respected():
    weights = {"s[0] | s[1]": 1, "s[1] | s[2]": 3, "s[2] | s[3]": 0.5, RANDOM_MASK: 2}
    B, K = 20_000, 6
    mask = TrainingMasks(weights, ("s", "a"), K)(torch.ones(B, K, dtype=torch.bool), torch.arange(B), seed=0, step=0)
    drawings = Counter(mask.draw(b) for b in range(B))
    questions = ["s ?#....  a ......", "s .?#...  a ......", "s ..?#..  a ......"]
    observed = [drawings[drawing] for drawing in questions]
    assert_frequencies([*observed, B - sum(observed)], list(weights.values()))


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
    hidden = ~torch.cat([mask.visible["s"], mask.visible["a"]], dim=1)  # (B, 2 K)
    assert torch.equal(hidden, torch.cat([mask.predict["s"], mask.predict["a"]], dim=1))
    # With p ~ U(0, 1), the number hidden is uniform on 0 .. 2 K, and given the number every choice is equally likely.
    assert_frequencies(hidden.sum(1).bincount(minlength=2 * K + 1), torch.ones(2 * K + 1))
    pairs = hidden[hidden.sum(1) == 2].long() @ 2 ** torch.arange(2 * K)
    assert_frequencies(torch.tensor(list(Counter(pairs.tolist()).values())), torch.ones(15))
    shown = mask.visible["rtg"][:, 0]
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
        return torch.stack([*mask.visible.values(), *mask.predict.values()], dim=1)

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
    assert all(torch.equal(first.visible[name], second.visible[name]) for name in FACTORS)


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


def test_moving_a_mask_keeps_it():
    mask = tabulate("past", FACTORS, 5).at(2)
    moved = mask.to(torch.device("cpu"))
    assert isinstance(moved, Mask)
    assert moved.draw() == mask.draw()


# --- Causal windows --------------------------------------------------------------------------------------------------


def causal_masks(masks, share=1.0, B=2000, K=4, factors=("s", "a", "rtg"), **settings):
    drawn = TrainingMasks(masks, factors, K, causal_share=share, **settings)
    return drawn, drawn(torch.ones(B, K, dtype=torch.bool), torch.arange(B), seed=0, step=3)


def test_a_causal_window_asks_a_question_at_every_step_at_once():
    _, mask = causal_masks("behavior_cloning", B=1)
    assert mask.causal.all()
    assert mask.visible["s"].all()
    assert mask.visible["a"][0].tolist() == [True] * 3 + [False]
    assert mask.predict["a"].all()
    assert not mask.predict["s"].any()
    assert not mask.visible["rtg"].any()
    _, mask = causal_masks("reward_conditioned", B=1)
    assert mask.visible["rtg"][0].tolist() == [True, False, False, False]


def test_causality_keeps_the_steps_of_a_causal_window_apart():
    """For every t, what a causal window shows before a[t] is what the question at t shows."""
    K, factors = 4, ("s", "a", "rtg")
    for task in ("behavior_cloning", "reward_conditioned"):
        _, union = causal_masks(task, B=1)
        table = tabulate(task, factors, K)
        for row, t in enumerate(table.t.tolist()):
            before = {"s": t + 1, "a": t, "rtg": K}
            for f, name in enumerate(factors):
                assert torch.equal(union.visible[name][0, : before[name]], table.visible[row, f, : before[name]])
                assert not table.visible[row, f, before[name] :].any()


def test_causal_random_masking_asks_for_every_token_and_shows_half_of_the_properties():
    _, mask = causal_masks("random_mask")
    for name in ("s", "a"):
        assert mask.visible[name].all()
        assert mask.predict[name][:, 1:].all()
    assert mask.predict["a"][:, 0].all()
    assert not mask.predict["s"][:, 0].any()
    assert not mask.visible["rtg"][:, 1:].any()
    assert mask.visible["rtg"][:, 0].float().mean().item() == pytest.approx(0.5, abs=5 * 0.5 / 2000**0.5)


def test_the_share_of_causal_windows_is_as_asked_and_the_others_are_as_without():
    _, mask = causal_masks("multi_task", share=0.3)
    assert mask.causal.float().mean().item() == pytest.approx(0.3, abs=5 * (0.21 / 2000) ** 0.5)
    _, without = causal_masks("multi_task", share=0.0)
    for name in mask.visible:
        assert torch.equal(mask.visible[name][~mask.causal], without.visible[name][~mask.causal])
        assert torch.equal(mask.predict[name][~mask.causal], without.predict[name][~mask.causal])
    conditioned = mask.visible["rtg"][mask.causal][:, 0].float().mean().item()  # two of the tasks have a causal form
    assert conditioned == pytest.approx(0.5, abs=0.11)


def test_an_update_can_draw_its_direction_together():
    valid, index = torch.ones(50, 4, dtype=torch.bool), torch.arange(50)
    drawn = TrainingMasks("random_mask", ("s", "a"), 4, causal_share=0.25, causal_draw="update")
    directions = [drawn(valid, index, seed=0, step=step).causal for step in range(400)]
    assert all(causal.unique().numel() == 1 for causal in directions)
    share = torch.stack(directions)[:, 0].float().mean().item()
    assert share == pytest.approx(0.25, abs=5 * (0.1875 / 400) ** 0.5)


def test_without_a_causal_form_nothing_is_causal_or_the_mask_is_refused():
    _, mask = causal_masks("past", share=0.5)
    assert mask.causal is False
    with pytest.raises(MaskError, match="trained on questions that ask for one token"):
        causal_masks(["behavior_cloning", "future"], share=1.0)


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
    ],
)
def test_what_is_answered_causally(masks, text, t, causally):
    drawn, _ = causal_masks(masks, share=0.5)
    mask = tabulate(text, drawn.factors, 4).at(t, 3)
    for name, tokens in drawn.answered_causally(mask).items():
        assert tokens.shape == (3, 4)
        assert all(row.nonzero().flatten().tolist() == causally[name] for row in tokens)


def test_nothing_is_answered_causally_by_a_bidirectional_model():
    drawn, _ = causal_masks("random_mask", share=0.0)
    mask = tabulate("behavior_cloning", drawn.factors, 4).at(2)
    assert not any(tokens.any() for tokens in drawn.answered_causally(mask).values())
