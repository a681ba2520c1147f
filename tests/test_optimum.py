"""The exact optimum: equal to enumeration, to counting simulated episodes, and consistent with what it is made of."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lerobot_unimask.asking.sampling import sample
from lerobot_unimask.data.factors import make_factors
from lerobot_unimask.data.window import Window
from lerobot_unimask.envs.doorkey import optimum as module
from lerobot_unimask.envs.doorkey.episodes import Episodes, rollout
from lerobot_unimask.envs.doorkey.expert import expert_probabilities
from lerobot_unimask.envs.doorkey.optimum import (
    FACTORS,
    FEATURES,
    Optimum,
    divergences,
    entropies,
    exact_answer,
    mean_over_asked,
    random_mask_divergence,
)
from lerobot_unimask.envs.doorkey.rules import DOOR, GOAL, START_PAIRS, DynamicsCheck, distance_to_goal, reward, step
from lerobot_unimask.language.masks import TASKS, Mask, tabulate
from lerobot_unimask.language.training_masks import TrainingMasks
from lerobot_unimask.networks.layers import by_component
from lerobot_unimask.objective import masked_losses

EXPERTS = ("paper", "released")
# Twenty masks that show little enough for many of a million episodes to agree; four with the return.
QUESTIONS = (
    "s[:], a[:] |",
    "s[:], a[:] | s[0]",
    "s[:], a[:] | s[9]",
    "s[:], a[:] | s[5]",
    "s[:], a[:] | a[0]",
    "s[:], a[:] | a[9]",
    "s[:], a[:] | a[2, 5]",
    "s[:], a[:] | a[0:4]",
    "s[:], a[:] | s[0], s[9]",
    "s[:], a[:] | s[3], a[3]",
    "s[:], a[:] | s[4], a[3]",
    "s[:], a[:] | s[4], a[4, 6]",
    "s[:], a[:] | s[0], a[0]",
    "s[:], a[:] | s[7], s[9]",
    "s[:], a[:] | a[7:]",
    "s[:], a[:] | s[0], s[1]",
    "s[:], a[:] | rtg[0]",
    "s[:], a[:] | rtg[0], s[0]",
    "s[:], a[:] | rtg[0], a[4]",
    "s[:], a[:] | rtg[0], s[9]",
)


def window_of(states: np.ndarray, actions: np.ndarray, returns: np.ndarray, timestep: float = 0.0) -> Window:
    """(B, K, 2), (B, K) and (B,) as a window; the return at the first step alone, NaN at the others."""
    B, K = actions.shape
    rtg = torch.full((B, K, 2), torch.nan)
    rtg[:, 0, 0], rtg[:, 0, 1] = torch.as_tensor(returns), timestep
    values = {"s": torch.as_tensor(states).float(), "a": torch.as_tensor(actions).float()[..., None], "rtg": rtg}
    return Window(values, torch.ones(B, K, dtype=torch.bool))


def enumerate_episodes(horizon: int, expert: str) -> tuple[Episodes, np.ndarray]:
    """Every start with every sequence of actions, and its probability."""
    starts = np.repeat(START_PAIRS, 4**horizon, axis=0)
    actions = np.tile(list(itertools.product(range(4), repeat=horizon)), (len(START_PAIRS), 1))
    agent, key, door = starts[:, 0], starts[:, 1], np.zeros(len(starts), dtype=bool)
    probability = np.full(len(starts), 1 / len(START_PAIRS))
    states = [(agent, key, door)]
    for action in actions.T:
        choices = expert_probabilities(agent, key, door, expert=expert)
        probability = probability * choices[np.arange(len(choices)), action]
        agent, key, door = step(agent, key, door, action)
        states.append((agent, key, door))
    agents, keys, doors = (np.stack(column, axis=1) for column in zip(*states, strict=True))
    return Episodes(agents, keys, doors, actions, reward(agents[:, :-1], agents[:, 1:])), probability


def count(episodes: Episodes, weight: np.ndarray, window: Window, shown: dict, first: int) -> tuple[dict, float]:
    """The weighted shares of each token's values among the episodes that agree with what one window shows."""
    K = window.valid.shape[1]
    agent, key = episodes.agent[:, first : first + K], episodes.key[:, first : first + K]
    action = episodes.action[:, first : first + K]
    returns = episodes.reward[:, first:].sum(axis=1)
    agrees = np.ones(len(action), dtype=bool)
    for k in range(K):
        if shown["s"][0, k]:
            shown_agent, shown_key = window.values["s"][0, k].tolist()
            agrees &= (agent[:, k] == shown_agent) & (key[:, k] == shown_key)
        if shown["a"][0, k]:
            agrees &= action[:, k] == window.values["a"][0, k, 0].item()
    if shown["rtg"][0, 0]:
        agrees &= returns == window.values["rtg"][0, 0, 0].item()
    weight = weight[agrees]
    shares = {
        name: np.stack([np.bincount(column, weight, size) for column in values[agrees].T]) / weight.sum()
        for name, values, size in (("agent", agent, 16), ("key", key, 16), ("action", action, 4))
    }
    return shares, weight.sum()


def marginals(window: Window, shown: dict, **settings) -> dict[str, np.ndarray]:
    """The first window's, (K, categories) each."""
    predictions = by_component(Optimum(**settings).predict(window, showing(shown)), FACTORS)
    (agent, key), (action,) = predictions["s"], predictions["a"]
    return {name: part[0].exp().numpy() for name, part in (("agent", agent), ("key", key), ("action", action))}


def showing(shown: dict) -> Mask:
    """A mask that shows these tokens; what it asks for changes no prediction."""
    return Mask(shown, {name: ~tokens for name, tokens in shown.items()})


def row(window: Window, b: int) -> Window:
    return Window({name: value[b : b + 1] for name, value in window.values.items()}, window.valid[b : b + 1])


# --- Against enumeration ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("expert", EXPERTS)
@pytest.mark.parametrize(("horizon", "first", "K"), [(1, 0, 1), (3, 0, 3), (4, 0, 4), (4, 0, 2), (4, 1, 3), (4, 2, 1)])
def test_marginals_equal_enumeration(monkeypatch, expert, horizon, first, K):
    """In short episodes, for windows from any step that end before the episode or with it; returns in every second."""
    monkeypatch.setattr(module, "HORIZON", horizon)
    episodes, probability = enumerate_episodes(horizon, expert)
    assert probability.sum() == pytest.approx(1, abs=1e-12)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(probability), size=60, p=probability)
    states = np.stack([episodes.agent, episodes.key], axis=-1)[chosen, first : first + K]
    returns = episodes.reward[chosen, first:].sum(axis=1)
    windows = window_of(states, episodes.action[chosen, first : first + K], returns, first / horizon)
    shown = {name: torch.from_numpy(rng.random((60, K)) < rng.random((60, 1))) for name in ("s", "a")}
    shown["rtg"] = (torch.arange(60)[:, None] % 2 == 0) & (torch.arange(K) == 0)
    together = by_component(Optimum(expert, first_step=first).predict(windows, showing(shown)), FACTORS)
    for b in range(60):
        one = {name: value[b : b + 1] for name, value in shown.items()}
        expected, _ = count(episodes, probability, row(windows, b), one, first)
        for name, part in zip(("agent", "key", "action"), (*together["s"], *together["a"]), strict=True):
            np.testing.assert_allclose(part[b].exp().numpy(), expected[name], atol=1e-9, rtol=0)


@pytest.mark.parametrize("expert", [EXPERTS[0], pytest.param(EXPERTS[1], marks=pytest.mark.slow)])
def test_marginals_equal_the_shares_of_many_episodes(expert):
    """Each frequency within five of its standard errors (with some room for small counts), for twenty masks."""
    episodes = Episodes(*(c.astype(np.int8) for c in rollout(1_000_000, np.random.default_rng(0), expert=expert)))
    ones = np.ones(len(episodes.action))
    for number, text in enumerate(QUESTIONS):
        one = slice(number, number + 1)  # an episode, so that what is shown can happen
        states = np.stack([episodes.agent, episodes.key], axis=-1)[one, :10]
        window = window_of(states, episodes.action[one], episodes.reward[one].sum(axis=1))
        shown = tabulate(text, tuple(FACTORS), 10).at(None).shown
        shares, matches = count(episodes, ones, window, shown, 0)
        assert matches > 100, text
        for name, exact in marginals(window, shown, expert=expert).items():
            error = np.sqrt((exact * (1 - exact)).clip(0) / matches)
            assert (np.abs(shares[name] - exact) <= 5 * error + 5 / matches).all(), (text, name)
            assert (shares[name][exact == 0] == 0).all(), (text, name)


# --- What it must keep -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded():
    """Sixty windows of the paper's expert."""
    episodes = rollout(60, np.random.default_rng(3))
    states = np.stack([episodes.agent, episodes.key], axis=-1)[:, :10]
    return window_of(states, episodes.action, episodes.reward.sum(axis=1))


def mask_of(text: str, t: int | None = None, B: int = 60) -> Mask:
    return tabulate(text, tuple(FACTORS), 10).at(t, B)


def test_what_is_hidden_changes_nothing(recorded):
    mask = mask_of("goal_conditioned", 4)
    hidden = {
        name: torch.where(mask.shown[name].unsqueeze(-1), value, torch.nan) for name, value in recorded.values.items()
    }
    before, after = Optimum().predict(recorded, mask), Optimum().predict(Window(hidden, recorded.valid), mask)
    assert all(torch.equal(p, q) for name in before for p, q in zip(before[name], after[name], strict=True))


def test_answers_do_not_depend_on_the_batch(recorded, monkeypatch):
    mask = mask_of("reward_conditioned", 3)
    whole = Optimum().predict(recorded, mask)
    monkeypatch.setattr(module, "_CHUNK", 7)
    parts = Optimum().predict(recorded, mask)
    for name in whole:
        for p, q in zip(whole[name], parts[name], strict=True):
            torch.testing.assert_close(p, q, rtol=0, atol=1e-12)


def test_behaviour_cloning_with_all_states_is_the_expert_itself(recorded):
    """The states so far tell whether the door is open, so the optimum is the policy."""
    for t in (0, 4, 9):
        mask = mask_of("behavior_cloning", t)
        answer = exact_answer(recorded, mask)
        agent, key = recorded.values["s"].long().numpy()[:, : t + 1].transpose(2, 0, 1)
        opened = (agent == DOOR).any(axis=1)
        expected = expert_probabilities(agent[:, t], key[:, t], opened)
        np.testing.assert_allclose(answer["a"][0].probabilities[:, t].numpy(), expected, atol=1e-6, rtol=0)


def test_an_answer_says_what_a_policys_does(recorded):
    """Shown values with certainty, NaN where nothing is asked, in each place probabilities that sum to one."""
    mask = mask_of("s[1:9] | s[0], s[-1], rtg[0]")
    answer = exact_answer(recorded, mask)
    agent, key = answer["s"]
    assert [agent.name, key.name, answer["a"][0].name] == ["agent_cell", "key_cell", "direction"]
    assert answer["a"][0].probabilities.isnan().all()
    torch.testing.assert_close(agent.probabilities.sum(-1), torch.ones(60, 10))
    torch.testing.assert_close(answer.most_likely("s")[:, [0, 9]], recorded.values["s"][:, [0, 9]])


def test_what_cannot_be_is_refused(recorded):
    impossible = window_of(np.full((3, 10, 2), [GOAL, 0]), np.zeros((3, 10), dtype=int), np.zeros(3))
    impossible.values["s"][:2] = recorded.values["s"][:2]
    with pytest.raises(ValueError, match="window 2 "):  # at the goal, and the key left behind
        exact_answer(impossible, mask_of("a[:] | s[3]", B=3))
    far = window_of(np.zeros((1, 10, 2)), np.zeros((1, 10), dtype=int), np.array([100.0]))
    with pytest.raises(ValueError, match="window 0 "):
        exact_answer(far, mask_of("a[:] | rtg[0]", B=1))
    with pytest.raises(ValueError, match="step 2"):
        exact_answer(recorded, mask_of("a[:] | rtg[0]"), first_step=2)
    with pytest.raises(ValueError, match="first_step is 10"):
        Optimum(first_step=10)
    with pytest.raises(ValueError, match="'paper' or 'released'"):
        Optimum("other")


def test_steps_past_the_episodes_end_are_not_seen(recorded):
    """A window that starts at step 7 has three steps; what stands at the others is padding."""
    episodes = rollout(20, np.random.default_rng(5))
    states = np.stack([episodes.agent, episodes.key], axis=-1)[:, 7:10]
    returns = episodes.reward[:, 7:].sum(axis=1)
    short = window_of(states, episodes.action[:, 7:], returns, 0.7)
    padded = Window(
        {name: torch.cat([v, torch.full((20, 7, v.shape[-1]), torch.nan)], 1) for name, v in short.values.items()},
        torch.arange(10).expand(20, 10) < 3,
    )
    mask = mask_of("a[:] | s[:2], rtg[0]", B=20).within(padded.valid)
    one = Optimum(first_step=7).predict(short, showing({name: tokens[:, :3] for name, tokens in mask.shown.items()}))
    other = Optimum(first_step=7).predict(padded, mask)
    torch.testing.assert_close(one["a"][0], other["a"][0][:, :3])


@pytest.mark.parametrize("order", ["forward", "backward", "random"])
def test_its_draws_are_possible_histories_in_any_order(order):
    """A state is drawn as one token, so nothing need be checked; how often it occurs does not depend on the order."""
    B = 400
    nothing = Window(
        {name: torch.full((B, 10, f.size), torch.nan) for name, f in FACTORS.items()}, torch.ones(B, 10) > 0
    )
    generator = torch.Generator().manual_seed(0)
    drawn = sample(Optimum(), nothing, mask_of("s[:], a[:] |", B=B), order=order, generator=generator)
    decided = {name: torch.ones(B, 10, dtype=torch.bool) for name in ("s", "a")}
    assert DynamicsCheck()(drawn.values, decided).all()
    played = rollout(20_000, np.random.default_rng(2))
    cells = FACTORS["s"].outputs[0]
    for k in (1, 5, 9):
        found = cells.combination(drawn.values["s"][:, k]).bincount(minlength=256) / B
        state = torch.from_numpy(np.stack([played.agent[:, k], played.key[:, k]], axis=-1))
        expected = cells.combination(state).bincount(minlength=256) / 20_000
        assert (found - expected).abs().max() < 0.1


# --- The measures ----------------------------------------------------------------------------------------------------


def test_its_loss_is_the_entropy_in_expectation_and_no_answer_is_better():
    """Over many windows the loss of the exact posterior is its mean entropy; a model at a distance of KL loses KL
    more."""
    episodes = rollout(4000, np.random.default_rng(8))
    states = np.stack([episodes.agent, episodes.key], axis=-1)[:, :10]
    window = window_of(states, episodes.action, episodes.reward.sum(axis=1))
    for text in TASKS:
        mask = TrainingMasks(text, tuple(FACTORS), 10)(window.valid, torch.arange(4000) * 10, seed=0, step=-1)
        exact = by_component(Optimum().predict(window, mask), FACTORS)
        apart = make_factors(FEATURES)
        loss = sum(part.item() for part in masked_losses(exact, window, mask.asked, apart).values())
        expected = mean_over_asked(entropies(exact), mask.asked)
        assert math.isfinite(loss)
        assert loss == pytest.approx(expected, abs=0.05)
        softer = {name: [part.clamp_min(-8) / 2 for part in parts] for name, parts in exact.items()}
        distance = mean_over_asked(divergences(exact, softer), mask.asked)
        other = sum(part.item() for part in masked_losses(softer, window, mask.asked, apart).values())
        assert distance > 0
        assert other - loss == pytest.approx(distance, abs=0.05)


def test_divergence_is_zero_from_itself_and_the_textbooks_otherwise():
    p, q = torch.tensor([[[0.5, 0.25, 0.25]]]), torch.tensor([[[0.25, 0.25, 0.5]]])
    assert divergences({"a": [p.log()]}, {"a": [p.log()]})["a"][0].item() == 0
    apart = divergences({"a": [p.log()]}, {"a": [q.log() + 3]})["a"][0]  # logits mean the same with any offset
    assert apart.item() == pytest.approx(0.5 * math.log(2) + 0.25 * math.log(0.5))


def test_random_masks_are_measured_by_kind_and_by_what_they_hide(recorded):
    index = torch.arange(60) * 10

    def uniform(window: Window, mask: Mask) -> dict:
        return {"s": [torch.zeros(60, 10, 16)] * 2, "a": [torch.zeros(60, 10, 4)]}

    exact = random_mask_divergence(Optimum(), Optimum(), recorded, recorded, index, draws=2)
    model = SimpleNamespace(predict=uniform, factors=make_factors(FEATURES))
    found = random_mask_divergence(Optimum(), model, recorded, recorded, index, draws=2)
    assert found.keys() == exact.keys() == {"agent_cell", "key_cell", "direction"}
    for label, size in (("agent_cell", 16), ("key_cell", 16), ("direction", 4)):
        assert set(found[label]) == {"0-0.2", "0.2-0.4", "0.4-0.6", "0.6-0.8", "0.8-1", "all"}
        assert all(value == 0 for value in exact[label].values())
        assert all(0 < value <= math.log(size) for value in found[label].values())
    # The less is hidden, the more certain the optimum is, and the further from uniform.
    assert found["agent_cell"]["0-0.2"] > found["agent_cell"]["0.8-1"]


def test_the_return_is_the_distance_walked():
    """What lets the return be known from the first and the last state."""
    episodes = rollout(200, np.random.default_rng(1))
    walked = distance_to_goal(episodes.agent[:, 0]) - distance_to_goal(episodes.agent[:, -1])
    np.testing.assert_array_equal(walked, episodes.reward.sum(axis=1))
