"""The gridworld figure's data: trajectories obey the rules, and what is reported is what happened."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from policies import doorkey_policy, few_draws

from lerobot_unimask.envs.doorkey.episodes import rollout as expert_rollout
from lerobot_unimask.envs.doorkey.optimum import Optimum
from lerobot_unimask.envs.doorkey.panels import (
    BACKWARDS,
    ROLLOUTS,
    SHOWN_STATES,
    START,
    backwards_panel,
    five_panels,
    given_states,
    predicted_states,
    rollout,
    rollout_panel,
    state_at,
)
from lerobot_unimask.envs.doorkey.rules import GOAL, HORIZON, START_PAIRS, reward, step
from lerobot_unimask.paper.questions import possible_steps

IMITATION, _ = ROLLOUTS["Imitation"]


@pytest.fixture(scope="module")
def policy():
    return doorkey_policy()


@pytest.fixture(scope="module")
def panels(policy):
    with few_draws():
        return {panel.name: panel for panel in five_panels(policy)}


def test_a_rollout_plays_by_the_rules(policy):
    starts = START_PAIRS[::5]
    played = rollout(policy, starts, IMITATION, {}, sample=True)
    agent, key, door_open = (array[:, :-1] for array in played[:3])
    expected = step(agent, key, door_open, played.action)
    for name, after in zip(("agent", "key", "door_open"), expected, strict=True):
        np.testing.assert_array_equal(getattr(played, name)[:, 1:], after)
    np.testing.assert_array_equal(np.stack([agent[:, 0], key[:, 0]], axis=1), starts)
    np.testing.assert_array_equal(played.reward, reward(agent, played.agent[:, 1:]))
    assert played.agent.shape == (len(starts), HORIZON + 1)
    assert len(np.unique(played.action)) == 4


def test_a_rollout_in_a_batch_is_the_rollout_alone(policy):
    starts = START_PAIRS[:7]
    together = rollout(policy, starts, IMITATION, {})
    for n, start in enumerate(starts):
        np.testing.assert_array_equal(rollout(policy, [start], IMITATION, {}).action[0], together.action[n])


def test_sampled_rollouts_follow_their_seed_and_leave_the_global_generator(policy):
    before = torch.get_rng_state()
    first, again, other = (
        rollout(policy, START_PAIRS, IMITATION, {}, sample=True, seed=seed).action for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert torch.equal(torch.get_rng_state(), before)


def test_each_episode_may_be_given_its_own_value(policy):
    question, _ = ROLLOUTS["A wanted return"]
    returns = torch.tensor([0.0, 500.0])
    together = rollout(policy, [START, START], question, {"rtg[0]": returns})
    for n, wanted in enumerate(returns.tolist()):
        np.testing.assert_array_equal(
            rollout(policy, [START], question, {"rtg[0]": wanted}).action[0], together.action[n]
        )


def test_the_five_panels_are_the_paper_s_and_fit_into_a_json(panels):
    assert list(panels) == [*ROLLOUTS, BACKWARDS]
    for panel in panels.values():
        assert json.loads(json.dumps(dataclasses.asdict(panel))) == dataclasses.asdict(panel)
        if panel.name != BACKWARDS:
            assert np.shape(panel.states) == (1, HORIZON, 2)
            assert all(len(values) == 1 for values in panel.achieved.values())


@pytest.mark.parametrize("name", ROLLOUTS)
def test_a_rollout_panel_reports_what_happened(panels, name):
    panel = panels[name]
    states, actions = np.array(panel.states), np.array(panel.actions)
    assert states[0, 0].tolist() == START
    assert possible_steps(states, actions[:, :-1]).all()
    # The state after the last action is not in the window, but its reward counts.
    last, _, _ = step(states[:, -1, 0], states[:, -1, 1], np.array(False), actions[:, -1])
    agent = np.concatenate([states[..., 0], last[:, None]], axis=1)
    assert panel.achieved["return"] == reward(agent[:, :-1], agent[:, 1:]).sum(axis=1).tolist()
    assert panel.achieved["success"] == (agent == GOAL).any(axis=1).tolist()


def test_a_given_state_counts_as_reached_at_its_step_alone(policy):
    question, _ = ROLLOUTS["A waypoint"]
    ways = {}
    for cell in state_at((1, 2), (1, 2)), state_at((2, 2), (2, 2)), state_at((4, 4), (4, 4)):
        panel = rollout_panel(policy, "A waypoint", question, {"s[3]": cell})
        ways[tuple(cell)] = panel.achieved["s[3] reached"]
        assert ways[tuple(cell)] == [state == cell for state in (states[3] for states in panel.states)]
    assert ways[15, 15] == [False]  # three steps do not lead there


def test_given_states_are_found_by_step():
    given = {"s[-1]": [15, 15], "rtg[0]": 4.0, "s[3]": START, "corner[0]": 1}
    assert given_states(given, HORIZON) == {"s[-1]": (9, [15, 15]), "s[3]": (3, START)}


def test_histories_drawn_backwards_are_possible_and_end_in_the_given_state(monkeypatch):
    policy = doorkey_policy()
    monkeypatch.setattr(policy, "predict", Optimum().predict)  # what a policy that has learnt everything would answer
    panel = backwards_panel(policy, histories=20)
    states, actions = np.array(panel.states), np.array(panel.actions)
    assert states.shape == (20, HORIZON, 2)
    assert possible_steps(states, actions).all()
    assert (states[:, -1] == GOAL).all()
    assert np.isin(states[:, 0, 0] * 16 + states[:, 0, 1], START_PAIRS @ [16, 1]).all()  # whole episodes
    assert panel.achieved["possible histories"] == 20
    assert panel.achieved["tokens drawn"] - panel.achieved["rejected"] >= 20 * (2 * HORIZON - 2)


def test_a_policy_that_draws_nothing_possible_has_an_empty_panel(policy):
    with few_draws():
        panel = backwards_panel(policy)
    assert (panel.states, panel.actions, panel.achieved) == ([], [], {"possible histories": 0})


def test_every_step_of_the_expert_is_possible():
    episodes = expert_rollout(500, np.random.default_rng(0))
    states = np.stack([episodes.agent, episodes.key], axis=-1)
    assert possible_steps(states, episodes.action).all()
    assert not possible_steps(states, (episodes.action + 2) % 4).all()


def test_predicted_states_are_distributions_and_keep_what_is_shown(policy):
    answer = predicted_states(policy)
    for column, distribution in enumerate(answer["s"]):
        assert distribution.probabilities.shape == (1, HORIZON, 16)
        torch.testing.assert_close(distribution.probabilities.sum(-1), torch.ones(1, HORIZON))
        for at, state in SHOWN_STATES.items():
            assert distribution.probabilities[0, at, state[column]] == 1
    assert answer.mask.draw().startswith("s #??#??#???  a ..........")


def test_predicted_states_of_other_states(policy):
    assert predicted_states(policy, {2: START, 9: [GOAL, GOAL]}).mask.draw().startswith("s ??#??????#")


def test_a_window_that_is_not_an_episode_is_refused():
    with pytest.raises(ValueError, match=r"10 steps.*context_length is 5"):
        five_panels(doorkey_policy(context_length=5))
