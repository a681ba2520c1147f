"""The mask language against a slow reference."""

import random
import re

import pytest
import torch

from lerobot_unimask.language.grammar import MAX_CONTEXT, MAX_TEXT, MaskError
from lerobot_unimask.language.masks import RANDOM_MASK, REGIMES, TASKS, Token, parse, parse_token, tabulate

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
        assert tokens(table.shown[row], K) == shown
        assert tokens(table.asked[row], K) == asked


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
    assert torch.equal(tight.shown, loose.shown)
    assert torch.equal(tight.asked, loose.asked)
    assert torch.equal(tabulate(" past\n", FACTORS, 7).asked, tabulate("past", FACTORS, 7).asked)


def test_a_table_answers_for_the_steps_that_it_admits():
    table = tabulate("past", FACTORS, 4)
    mask = table.at(3, batch_size=2)
    assert mask.shown["s"].shape == (2, 4)
    assert mask.draw(1) == "s ???#  a ???#  rtg ...."
    with pytest.raises(MaskError, match=r"t=0.* 1, 2, 3"):
        table.at(0)
    with pytest.raises(MaskError, match="say which"):
        table.at(None)
    mask.shown["s"][:] = True  # a mask is the caller's to change, the table is everybody's
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
    ("s[1], ^rtg[1] | s[0]", "step 0 only"),
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
    with pytest.raises(MaskError, match=name):
        parse(name)


def test_a_text_is_bounded_and_a_text():
    with pytest.raises(MaskError, match="1000"):
        parse("a[0], " * 1000)
    with pytest.raises(MaskError, match="1000"):
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
            assert tabulate(text, FACTORS, 4).asked.any()
        except MaskError:
            continue


def test_a_given_token_is_a_single_one():
    assert parse_token("s[-1]", FACTORS, 10) == Token("s", 9)
    assert parse_token(" rtg [ 0 ] ", FACTORS, 10) == Token("rtg", 0)
    assert parse_token("s@150", FACTORS, 10) == Token("s", 150, of_episode=True)
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
        "s@-1",
        "rtg@3",
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
