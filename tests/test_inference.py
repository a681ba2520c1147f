"""Answers, joint samples and the rollout's memory, against networks whose answers are known."""

from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

from lerobot_unimask.asking.answers import answer
from lerobot_unimask.asking.given import check_known, give, in_window, read_given
from lerobot_unimask.asking.memory import RolloutMemory
from lerobot_unimask.asking.sampling import ORDERS, sample
from lerobot_unimask.data.factors import Feature, make_factors
from lerobot_unimask.data.window import Statistics, Window
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import Mask, Token, tabulate

# --- A network that knows the joint distribution ---------------------------------------------------------------------

K = 2
TOKENS = [("s", 0), ("a", 0), ("s", 1), ("a", 1)]
FEATURES = {"s": [Feature("observation.state", 1, [2])], "a": [Feature("action", 1, [3])]}
FACTORS = make_factors(FEATURES)
STATISTICS = Statistics(FEATURES, FACTORS, K)
OUTCOMES = torch.cartesian_prod(torch.arange(2), torch.arange(3), torch.arange(2), torch.arange(3)).float()  # (36, 4)
JOINT = torch.rand(36, generator=torch.Generator().manual_seed(0)).square()
JOINT = JOINT / JOINT.sum()


def exact_network(window, mask, cache=None):
    """Each token's conditional distribution given the shown ones, worked out from `JOINT`."""
    B = len(window.valid)
    agrees = torch.ones(B, 36, dtype=torch.bool)
    for i, (name, step) in enumerate(TOKENS):
        same = window.values[name][:, step] == OUTCOMES[:, i]  # (B, 36)
        agrees &= same | ~mask.shown[name][:, step, None]
    weights = JOINT * agrees
    predictions = {}
    for name, count in (("s", 2), ("a", 3)):
        steps = []
        for step in range(K):
            value = OUTCOMES[:, TOKENS.index((name, step))].long()
            one_hot = torch.nn.functional.one_hot(value, count).float()
            steps.append(weights @ one_hot / weights.sum(1, keepdim=True))
        predictions[name] = [torch.stack(steps, dim=1).log()]
    return predictions


def model(network, statistics=STATISTICS, factors=FACTORS):
    return SimpleNamespace(predict=network, statistics=statistics, factors=factors)


def empty_window(B):
    values = {name: torch.full((B, K, 1), torch.nan) for name in FACTORS}
    return Window(values, torch.ones(B, K, dtype=torch.bool))


def draw(window, mask, order, seed=0, network=exact_network):
    generator = torch.Generator().manual_seed(seed)
    return sample(model(network), window, mask, order=order, generator=generator)


def outcome_numbers(window):
    s, a = (window.values[name][..., 0].long() for name in ("s", "a"))
    return ((s[:, 0] * 3 + a[:, 0]) * 2 + s[:, 1]) * 3 + a[:, 1]


def chi_square(counts, probabilities):
    possible = probabilities > 0
    assert counts[~possible].sum() == 0
    expected = probabilities[possible] / probabilities.sum() * counts.sum()
    return ((counts[possible] - expected).square() / expected).sum().item(), int(possible.sum()) - 1


@pytest.mark.parametrize("order", ORDERS)
def test_samples_follow_the_joint_distribution(order):
    mask = tabulate("s[:], a[:]", ("s", "a"), K).at(None, 6000)
    drawn = draw(empty_window(6000), mask, order)
    statistic, df = chi_square(outcome_numbers(drawn).bincount(minlength=36).float(), JOINT)
    assert statistic < df + 5 * (2 * df) ** 0.5 + 10


@pytest.mark.parametrize("order", ORDERS)
def test_samples_follow_the_conditional_distribution(order):
    """a0 and s1 shown, the others asked: what is shown stays, the rest follows P(s0, a1 | a0, s1)."""
    window = empty_window(6000)
    window.values["a"][:, 0], window.values["s"][:, 1] = 2.0, 1.0
    mask = tabulate("s[0], a[1] | a[0], s[1]", ("s", "a"), K).at(None, 6000)
    drawn = draw(window, mask, order)
    assert (drawn.values["a"][:, 0] == 2).all()
    assert (drawn.values["s"][:, 1] == 1).all()
    agrees = (OUTCOMES[:, 1] == 2) & (OUTCOMES[:, 2] == 1)
    statistic, df = chi_square(outcome_numbers(drawn).bincount(minlength=36).float(), JOINT * agrees)
    assert statistic < df + 5 * (2 * df) ** 0.5 + 10
    # It is not enough to draw the tokens side by side from their marginals.
    marginals = torch.zeros(36)
    conditional = JOINT * agrees / (JOINT * agrees).sum()
    for i in agrees.nonzero().flatten():
        s0, a1 = OUTCOMES[i, 0], OUTCOMES[i, 3]
        marginals[i] = conditional[OUTCOMES[:, 0] == s0].sum() * conditional[OUTCOMES[:, 3] == a1].sum()
    statistic, df = chi_square(outcome_numbers(drawn).bincount(minlength=36).float(), marginals)
    assert statistic > df + 5 * (2 * df) ** 0.5 + 10


def test_orders_are_what_they_are_called():
    def order_of(order, seed=0):
        seen = []

        def spy(window, mask, cache=None):
            shown = mask.shown.items()
            seen.append({(name, k) for name, here in shown for k in here[0].nonzero().flatten().tolist()})
            return exact_network(window, mask)

        drawn = draw(empty_window(1), tabulate("s[:], a[:]", ("s", "a"), K).at(None), order, seed, spy)
        seen.append(set(TOKENS))
        assert not any(value.isnan().any() for value in drawn.values.values())
        return [next(iter(after - before)) for before, after in pairwise(seen)]

    assert order_of("forward") == TOKENS
    assert order_of("backward") == TOKENS[::-1]
    orders = [order_of("random", seed) for seed in range(8)]
    assert all(sorted(order) == sorted(TOKENS) for order in orders)
    assert len({tuple(order) for order in orders}) > 3
    assert order_of("random", 3) == orders[3]
    with pytest.raises(ValueError, match=r"'sideways'.* forward, backward, random"):
        draw(empty_window(1), tabulate("s[:], a[:]", ("s", "a"), K).at(None), "sideways")


def test_each_window_is_asked_its_own_question():
    """Window 0 asks for everything, window 1 shows a0 and asks for s1 alone, window 2 asks for nothing."""
    window = empty_window(3)
    window.values["a"][1, 0] = 1.0
    no, yes = torch.zeros(3, K, dtype=torch.bool), torch.ones(3, K, dtype=torch.bool)
    shown, asked = {"s": no.clone(), "a": no.clone()}, {"s": yes.clone(), "a": yes.clone()}
    shown["a"][1, 0] = True
    asked["s"][1], asked["a"][1] = torch.tensor([False, True]), torch.tensor([False, False])
    asked["s"][2], asked["a"][2] = False, False
    before = {name: tokens.clone() for name, tokens in shown.items()}
    for order in ORDERS:
        drawn = draw(window, Mask(shown, asked), order)
        known = {name: ~value[..., 0].isnan() for name, value in drawn.values.items()}
        assert known["s"].tolist() == [[True, True], [False, True], [False, False]]
        assert known["a"].tolist() == [[True, True], [True, False], [False, False]]
        assert drawn.values["a"][1, 0] == 1
    assert window.values["s"].isnan().all()
    assert all(torch.equal(shown[name], before[name]) for name in shown)


# --- Rejection -------------------------------------------------------------------------------------------------------


def agreeing(values, decided):
    """s[0] and s[1] must be equal."""
    both = decided["s"].all(1)
    return ~both | (values["s"][:, 0, 0] == values["s"][:, 1, 0])


def sample_all(N, check, order="forward", seed=0, **settings):
    mask = tabulate("s[:], a[:]", ("s", "a"), K).at(None, N)
    generator = torch.Generator().manual_seed(seed)
    window = empty_window(N)
    return sample(model(exact_network), window, mask, order=order, generator=generator, check=check, **settings)


def test_what_contradicts_the_check_is_drawn_again():
    """Forward, s1 alone can be rejected: P(s0, a0) stays, s1 equals s0, and a1 follows from the three."""
    drawn = sample_all(6000, agreeing, tries=5000)
    agrees = OUTCOMES[:, 0] == OUTCOMES[:, 2]
    first_two = torch.zeros(36)
    for i in range(36):
        alike = (OUTCOMES[:, :2] == OUTCOMES[i, :2]).all(1)
        first_two[i] = JOINT[alike].sum() * JOINT[i] / JOINT[alike & agrees].sum()
    statistic, df = chi_square(outcome_numbers(drawn).bincount(minlength=36).float(), first_two * agrees)
    assert statistic < df + 5 * (2 * df) ** 0.5 + 10
    assert drawn.drawn - drawn.rejected == 4 * 6000  # none was thrown away for another reason
    assert drawn.restarted == 0
    assert drawn.acceptance == 1 - drawn.rejected / drawn.drawn
    # s1 is drawn until it agrees: 1 / P(it does) times on average, which depends on s0 and a0.
    expected = 0.0
    for s0 in range(2):
        for a0 in range(3):
            alike = (OUTCOMES[:, 0] == s0) & (OUTCOMES[:, 1] == a0)
            expected += JOINT[alike].sum() * (JOINT[alike].sum() / JOINT[alike & agrees].sum() - 1)
    assert drawn.rejected / 6000 == pytest.approx(expected.item(), rel=0.15)


@pytest.mark.parametrize("order", ORDERS)
def test_a_check_that_is_always_met_changes_nothing(order):
    checked = sample_all(200, lambda values, decided: torch.ones(len(values["s"]), dtype=torch.bool), order)
    assert torch.equal(outcome_numbers(checked), outcome_numbers(sample_all(200, None, order)))
    assert (checked.drawn, checked.rejected, checked.restarted, checked.acceptance) == (800, 0, 0, 1.0)


def test_a_check_sees_what_is_decided_and_the_samples_that_have_just_drawn():
    seen = []

    def check(values, decided):
        for name in ("s", "a"):
            assert torch.equal(values[name][..., 0].isnan(), ~decided[name])
        seen.append((int(decided["s"][0].sum() + decided["a"][0].sum()), len(values["s"])))
        return torch.arange(len(values["s"])) > 0  # of each draw the first sample is rejected, if there are others

    sample_all(3, lambda values, decided: check(values, decided) | (len(values["s"]) == 1) | ~decided["s"][:, 0])
    assert seen == [(0, 3), *((count, n) for count in (1, 2, 3, 4) for n in (3, 1))]


def test_a_dead_end_starts_the_sample_over():
    """After a0 = 2 nothing can be drawn as s1."""

    def check(values, decided):
        return ~(decided["s"][:, 1] & (values["a"][:, 0, 0] == 2))

    drawn = sample_all(500, check, tries=30)
    assert (drawn.values["a"][:, 0] != 2).all()
    assert not drawn.values["s"].isnan().any()
    assert drawn.restarted > 0
    assert drawn.rejected == 30 * drawn.restarted


def test_it_gives_up_after_a_bound():
    def never(values, decided):
        return ~decided["a"][:, 1]

    with pytest.raises(ValueError, match=r"5 of 5 .* 3 .* 45"):
        sample_all(5, never, tries=3)
    with pytest.raises(ValueError, match="shown"):
        sample_all(5, lambda values, decided: torch.zeros(5, dtype=torch.bool))
    with pytest.raises(ValueError, match="tries is 0"):
        sample_all(5, None, tries=0)


# --- Answers ---------------------------------------------------------------------------------------------------------


def test_an_answer_holds_the_networks_probabilities():
    window = empty_window(1)
    window.values["a"][:, 0] = 2.0
    mask = tabulate("s[1] | a[0]", ("s", "a"), K).at(None)
    said = answer(model(exact_network), window, mask)
    conditional = JOINT * (OUTCOMES[:, 1] == 2)
    expected = [(conditional[OUTCOMES[:, 2] == value].sum() / conditional.sum()).item() for value in (0, 1)]
    assert said["s"][0].probabilities[0, 1].tolist() == pytest.approx(expected)
    assert said["s"][0].probabilities[0, 0].isnan().all()  # neither shown nor asked
    assert said["a"][0].probabilities[0, 0].tolist() == [0, 0, 1]  # shown, with certainty
    best = said.most_likely("s")
    assert best.shape == (1, K, 1)
    assert best[0, 0].isnan()
    assert best[0, 1].item() == expected.index(max(expected))
    assert said.most_likely("a")[0, 0].item() == 2


def test_a_tokens_numbers_are_answered_together():
    """The likeliest token is not made of the likeliest numbers, and no combination is drawn that has no probability."""
    features = {"s": [Feature("observation.state", 2, [2, 3])], "a": [Feature("action", 1, [2])]}
    factors, B = make_factors(features, joint=True), 2000
    table = torch.tensor([[0.4, 0.0, 0.0], [0.0, 0.3, 0.3]])

    def network(window, mask, cache=None):
        return {"s": [table.flatten().log().expand(B, K, 6)], "a": [torch.zeros(B, K, 2)]}

    window = Window({"s": torch.full((B, K, 2), 1.0), "a": torch.zeros(B, K, 1)}, torch.ones(B, K).bool())
    mask = tabulate("s[1] | s[0]", ("s", "a"), K).at(None, B)
    said = answer(model(network, factors=factors), window, mask)
    first, second = said["s"]
    assert first.probabilities[0].tolist() == [[0, 1], pytest.approx([0.4, 0.6])]  # shown, asked
    assert second.probabilities[0].tolist() == [[0, 1, 0], pytest.approx([0.4, 0.3, 0.3])]
    assert [d.most_likely[0, 1].item() for d in said["s"]] == [1, 0]
    assert said.most_likely("s")[0].tolist() == [[1, 1], [0, 0]]
    drawn = said.draw("s", torch.Generator().manual_seed(0))
    assert (drawn[:, 0] == 1).all()
    counts = factors["s"].outputs[0].combination(drawn[:, 1]).bincount(minlength=6).float()
    statistic, df = chi_square(counts, table.flatten())
    assert (counts[table.flatten() == 0] == 0).all()
    assert statistic < df + 5 * (2 * df) ** 0.5 + 10


def test_continuous_answers_are_in_the_datasets_units():
    features = {"s": [Feature("observation.state", 2)], "a": [Feature("action", 1)]}
    factors = make_factors(features)
    statistics = Statistics(features, factors, 3)
    statistics.fill(
        {"observation.state": {"mean": [10.0, -1.0], "std": [2.0, 4.0]}, "action": {"mean": [5.0], "std": [0.5]}}
    )
    seen = {}

    def network(window, mask, cache=None):
        seen.update(window.values)
        return {"s": [torch.ones(1, 3, 2)], "a": [torch.full((1, 3, 1), -2.0)]}

    window = Window({"s": torch.full((1, 3, 2), 7.0), "a": torch.full((1, 3, 1), 7.0)}, torch.ones(1, 3).bool())
    said = answer(model(network, statistics, factors), window, tabulate("s[2], a[0] | s[0]", ("s", "a"), 3).at(None))
    assert seen["s"][0, 0].tolist() == [-1.5, 2.0]
    assert said.most_likely("s")[0].nan_to_num(-99).tolist() == [[7, 7], [-99, -99], [12, 3]]
    assert said.most_likely("a")[0].nan_to_num(-99).tolist() == [[4], [-99], [-99]]
    assert torch.equal(said["a"][0].draw(None).nan_to_num(-99), said["a"][0].mean.nan_to_num(-99))  # no spread


def test_a_gaussian_head_answers_with_a_mean_and_a_scale():
    features = {"s": [Feature("observation.state", 1)], "a": [Feature("action", 1)]}
    factors = make_factors(features, gaussians=1)
    statistics = Statistics(features, factors, 3)
    statistics.fill({"observation.state": {"mean": [10.0], "std": [2.0]}, "action": {"mean": [0.0], "std": [1.0]}})
    B = 4000
    output = torch.tensor([1.0, 0.5]).expand(B, 3, 2)  # mean and logarithm of the scale

    def network(window, mask, cache=None):
        return {"s": [output], "a": [output]}

    window = Window({name: torch.full((B, 3, 1), 7.0) for name in features}, torch.ones(B, 3).bool())
    said = answer(model(network, statistics, factors), window, tabulate("s[1] | s[0]", ("s", "a"), 3).at(None, B))["s"][
        0
    ]
    scale = 2 * torch.tensor(0.5).exp().item()
    assert said.mean[0, :, 0].nan_to_num(-99).tolist() == [7, 12, -99]
    assert said.scale[0, :, 0].nan_to_num(-99).tolist() == pytest.approx([0, scale, -99])
    assert torch.equal(said.most_likely.nan_to_num(-99), said.mean.nan_to_num(-99))
    drawn = said.draw(torch.Generator().manual_seed(0))
    assert (drawn[:, 0] == 7).all()
    assert drawn[:, 2].isnan().all()
    assert drawn[:, 1].mean().item() == pytest.approx(12, abs=5 * scale / B**0.5)
    assert drawn[:, 1].std().item() == pytest.approx(scale, rel=5 / (2 * B) ** 0.5)


def mixture_answer(B=1):
    """Of a state of three numbers in two columns: two narrow forks, and a wide hill with most of the weight."""
    features = {"s": [Feature("s", 2), Feature("z", 1)], "a": [Feature("a", 1)]}
    factors = make_factors(features, gaussians=3)
    statistics = Statistics(features, factors, 2)
    statistics.fill({key: {"mean": [1.0] * n, "std": [2.0] * n} for key, n in (("s", 2), ("z", 1), ("a", 1))})
    weights = torch.tensor([0.3, 0.2, 0.5])
    means = torch.tensor([[-2.0, -2.0, 0.0], [2.0, 2.0, 1.0], [0.0, 0.0, 0.0]])
    scales = torch.tensor([[0.2, 0.2, 0.3], [0.2, 0.2, 0.3], [1.0, 1.0, 1.0]])
    (output,) = factors["s"].outputs
    prediction = output.pack(weights.log(), means, scales.log())
    other = torch.zeros(B, 2, factors["a"].outputs[0].size)

    def network(window, mask, cache=None):
        return {"s": [prediction.expand(B, 2, -1)], "a": [other]}

    window = Window({"s": torch.full((B, 2, 3), 7.0), "a": torch.zeros(B, 2, 1)}, torch.ones(B, 2).bool())
    mask = tabulate("s[1] | s[0]", ("s", "a"), 2).at(None, B)
    return answer(model(network, statistics, factors), window, mask), weights, 1 + 2 * means, 2 * scales


def test_a_mixture_answers_with_weights_means_and_scales():
    said, weights, means, scales = mixture_answer()
    (joint,) = said.distributions["s"]
    for found, expected in ((joint.weights, weights), (joint.means, means), (joint.scales, scales)):
        torch.testing.assert_close(found[0, 1], expected)
    assert said.most_likely("s")[0, 0].tolist() == [7, 7, 7]  # shown
    assert joint.scale[0, 0].tolist() == [0, 0, 0]
    assert said["a"][0].mean.isnan().all()
    two, one = said["s"]
    assert (two.name, one.name) == ("s", "z")
    torch.testing.assert_close(two.means[0, 1], means[:, :2])
    torch.testing.assert_close(one.scales[0, 1], scales[:, 2:])


def test_a_mixtures_draws_have_its_moments_and_keep_numbers_together():
    B = 6000
    said, weights, means, _ = mixture_answer(B)
    drawn = said.draw("s", torch.Generator().manual_seed(0))
    assert (drawn[:, 0] == 7).all()
    drawn, (joint,) = drawn[:, 1], said.distributions["s"]
    torch.testing.assert_close(drawn.mean(0), joint.mean[0, 1], atol=0.15, rtol=0)
    torch.testing.assert_close(drawn.std(0), joint.scale[0, 1], atol=0.1, rtol=0)
    assert ((drawn[:, 0] < -2) & (drawn[:, 1] > 4)).float().mean() < 0.01  # either fork has both numbers
    for fork, weight in ((means[0], weights[0]), (means[1], weights[1])):
        near = ((drawn - fork).abs() < 3 * 0.6).all(-1).float().mean()
        assert near == pytest.approx(weight.item(), abs=0.06)


def test_a_mixtures_most_likely_value_is_its_highest_mode():
    """By a fine grid, of a mixture whose modes are no Gaussian's mean."""
    said, *_ = mixture_answer()
    (joint,) = said.distributions["s"]
    joint.scales = joint.scales * torch.tensor([1.0, 1.0, 0.2]).view(3, 1) + torch.tensor([1.0, 1.2, 0.0]).view(3, 1)
    axis = torch.linspace(-6, 8, 57)
    grid = torch.cartesian_prod(axis, axis, axis).view(1, -1, 1, 3)
    density = joint.log_density(grid.view(-1, 1, 3).expand(-1, 2, 3))[:, 1]
    mixture = torch.distributions.MixtureSameFamily(
        torch.distributions.Categorical(joint.weights[0, 1]),
        torch.distributions.Independent(torch.distributions.Normal(joint.means[0, 1], joint.scales[0, 1]), 1),
    )
    torch.testing.assert_close(density, mixture.log_prob(grid.view(-1, 3)))
    best = grid.view(-1, 3)[density.argmax()]
    torch.testing.assert_close(joint.most_likely[0, 1], best, atol=0.25, rtol=0)
    assert mixture.log_prob(joint.most_likely[0, 1]) >= density.max()


def test_acting_carries_out_the_median_of_a_mixture():
    """Of each number: half of what may be lies below it. What is shown stays, what is neither is nothing."""
    said, weights, means, scales = mixture_answer()
    value = said.carried_out("s")
    below = (weights.unsqueeze(-1) * torch.distributions.Normal(means, scales).cdf(value[0, 1])).sum(0)
    torch.testing.assert_close(below, torch.full((3,), 0.5), atol=1e-4, rtol=0)
    assert value[0, 0].tolist() == [7, 7, 7]
    assert said.carried_out("a").isnan().all()


# --- Values that a user gives ----------------------------------------------------------------------------------------

GRID = make_factors(
    {
        "s": [Feature("observation.state", 2, [16, 16], ["agent", "key"])],
        "a": [Feature("action", 1, [4])],
        "rtg": [Feature("observation.return_to_go", 1)],
    }
)


def test_given_values_may_be_shared_or_one_for_each_environment():
    given = {"s[-1]": [15, 14], "a[0]": 3, "a[1]": [0, 1, 2], "rtg[0]": [[1.5], [2], [3]], "s[2]": torch.ones(3, 2)}
    tokens = read_given(given, GRID, 5, 3)
    assert {(token.factor, token.step): value.tolist() for token, value in tokens.items()} == {
        ("s", 4): [[15, 14]],
        ("a", 0): [[3]],
        ("a", 1): [[0], [1], [2]],
        ("rtg", 0): [[1.5], [2], [3]],
        ("s", 2): [[1, 1]] * 3,
    }
    assert read_given({"s[0]": [1, 2]}, GRID, 5, 2)[Token("s", 0)].tolist() == [[1, 2]]  # two numbers, two environments


@pytest.mark.parametrize(
    ("token", "value", "message"),
    [
        ("s[0]", [1], "give 2 numbers"),
        ("s[0]", 1, "give 2 numbers"),
        ("s[0]", [[1, 2], [3, 4]], " 3 windows"),
        ("s[0]", [[[1, 2]]], "give 2 numbers"),
        ("rtg[0]", [1, 2], "give 1 number,"),
        ("rtg[0]", float("nan"), "must be finite"),
        ("s[0]", [0, 16], "key is a category from 0 to 15"),
        ("s[0]", [-1, 0], "agent is a category from 0 to 15"),
        ("a[0]", 1.5, "category from 0 to 3"),
        ("a[0]", [0, 1, 4], "category from 0 to 3"),
    ],
)
def test_an_impossible_value_is_refused(token, value, message):
    with pytest.raises(ValueError, match=message) as raised:
        read_given({token: value}, GRID, 5, 3)
    assert str(raised.value).startswith(f"{token} is given ")


@pytest.mark.parametrize("token", ["q[0]", "s[5]", "s[t]", "rtg[1]", "s[0] | a[0]", "s"])
def test_a_value_for_what_is_no_token_is_refused(token):
    with pytest.raises(MaskError):
        read_given({token: [1, 2]}, GRID, 5, 3)


def test_observed_values_win_over_given_ones():
    values = {"s": torch.zeros(2, 3, 2), "a": torch.zeros(2, 3, 1), "rtg": torch.full((2, 3, 2), 0.5)}
    window = Window(values, torch.ones(2, 3, dtype=torch.bool))
    known = {"s": torch.tensor([True, False, False]), "a": torch.zeros(3).bool(), "rtg": torch.zeros(3).bool()}
    given = {"s[0]": [9, 9], "s[2]": [[1, 2], [3, 4]], "rtg[0]": 6}
    tokens = in_window(read_given(given, GRID, 3, 2), 0, 3)
    filled, filled_known = give(window, tokens, known)
    assert filled.values["s"].tolist() == [[[0, 0], [0, 0], [1, 2]], [[0, 0], [0, 0], [3, 4]]]
    assert filled.values["rtg"][:, 0].tolist() == [[6, 0.5], [6, 0.5]]  # the timestep stays as it is
    assert {name: steps.tolist() for name, steps in filled_known.items()} == {
        "s": [True, False, True],
        "a": [False, False, False],
        "rtg": [True, False, False],
    }
    assert values["s"].abs().sum() == 0  # nobody's tensors were written to
    assert known["s"].tolist() == [True, False, False]


def test_what_is_shown_must_be_known():
    mask = tabulate("a[t] | s[:t+1], s[-2:], rtg[0]", tuple(GRID), 5).at(1, 2)
    known = {
        "s": torch.tensor([True, True, False, False, True]),
        "a": torch.zeros(5).bool(),
        "rtg": torch.zeros(5).bool(),
    }
    with pytest.raises(ValueError, match=r"s\[3\], rtg\[0\]") as raised:
        check_known(mask, known, "the question")
    assert "the question" in str(raised.value)
    known["s"][3] = known["rtg"][0] = True
    check_known(mask, known, "the question")


# --- A rollout's memory ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("K", [1, 4, 10])
def test_the_memory_holds_the_last_steps(K):
    """Against the whole history, kept in lists."""
    factors = make_factors({"s": [Feature("s", 2)], "a": [Feature("a", 1)], "rtg": [Feature("rtg", 1)]})
    generator = torch.Generator().manual_seed(0)
    memory = RolloutMemory(factors, K, 3, torch.device("cpu"))
    states, actions, received = [], [], []
    for step in range(9):
        states.append(torch.randn(3, 2, generator=generator))
        received.append(torch.randn(3, generator=generator))
        memory.observe(states[-1], received[-1])
        first, position = max(0, step - K + 1), min(step, K - 1)
        assert (memory.step, memory.position, memory.first_step) == (step, position, first)
        window, known = memory.window(torch.tensor(20.0)), memory.known()
        assert known["s"].tolist() == [k <= position for k in range(K)]
        assert known["a"].tolist() == [k < position for k in range(K)]
        assert not known["rtg"].any()
        for k in range(K):
            if k <= position:
                assert torch.equal(window.values["s"][:, k], states[first + k])
            if k < position:
                assert torch.equal(window.values["a"][:, k], actions[first + k])
        torch.testing.assert_close(window.values["rtg"][:, 0, 1], torch.full((3,), first / 20))
        assert window.valid.all()
        left = memory.remaining(torch.tensor([[5.0]]))
        expected = torch.full((3,), 5.0) if first == 0 else 5 - received[first]
        torch.testing.assert_close(left, expected[:, None])
        actions.append(torch.randn(3, 1, generator=generator))
        memory.act(actions[-1])


def test_a_step_without_an_action_begins_again():
    memory = RolloutMemory(GRID, 2, 1, torch.device("cpu"))
    for step in range(4):
        memory.observe(torch.full((1, 2), 99.0), None)
        memory.observe(torch.full((1, 2), float(step)), None)
        assert memory.step == step
        memory.act(torch.zeros(1, 1))
    assert memory.values["s"][0].tolist() == [[2, 2], [3, 3]]


def test_without_the_return_so_far_only_a_full_episode_can_be_asked_for():
    memory = RolloutMemory(GRID, 2, 1, torch.device("cpu"))
    for step in range(3):
        memory.observe(torch.zeros(1, 2), None)
        if step < 2:
            assert memory.remaining(torch.tensor([[5.0]])).tolist() == [[5.0]]
        memory.act(torch.zeros(1, 1))
    with pytest.raises(ValueError, match=r"observation\.return_so_far"):
        memory.remaining(torch.tensor([[5.0]]))
