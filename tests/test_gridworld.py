"""The gridworld figure's data: trajectories obey the rules, and what is reported is what happened."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from dataset_builders.doorkey import FEATURES, rollout
from lerobot_unimask import UniMASKConfig, UniMASKPolicy
from lerobot_unimask.envs.doorkey import GOAL, HORIZON, START_PAIRS, reward, step
from lerobot_unimask.experiments.gridworld import (
    BACKWARDS,
    ROLLOUTS,
    SHOWN_STATES,
    START,
    backwards_panel,
    five_panels,
    given_states,
    possible_steps,
    predicted_states,
    roll_out,
    rollout_panel,
    state_at,
)

IMITATION, _ = ROLLOUTS["Imitation"]


def make_policy(**settings):
    """A tiny policy that has learned nothing."""
    torch.manual_seed(0)
    config = UniMASKConfig(device="cpu", width=16, depth=1, heads=2, feedforward_width=16, **settings)
    config.set_dataset_feature_metadata(FEATURES)
    return UniMASKPolicy(config)


@pytest.fixture(scope="module")
def policy():
    return make_policy()


@pytest.fixture(scope="module")
def panels(policy):
    return {panel.name: panel for panel in five_panels(policy)}


def test_a_rollout_plays_by_the_rules(policy):
    starts = START_PAIRS[::5]
    played = roll_out(policy, starts, IMITATION, {}, sample=True)
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
    together = roll_out(policy, starts, IMITATION, {})
    for n, start in enumerate(starts):
        np.testing.assert_array_equal(roll_out(policy, [start], IMITATION, {}).action[0], together.action[n])


def test_sampled_rollouts_follow_their_seed_and_leave_the_global_generator(policy):
    before = torch.get_rng_state()
    first, again, other = (
        roll_out(policy, START_PAIRS, IMITATION, {}, sample=True, seed=seed).action for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert torch.equal(torch.get_rng_state(), before)


def test_each_episode_may_be_given_its_own_value(policy):
    question, _ = ROLLOUTS["A wanted return"]
    returns = torch.tensor([0.0, 500.0])
    together = roll_out(policy, [START, START], question, {"rtg[0]": returns})
    for n, wanted in enumerate(returns.tolist()):
        np.testing.assert_array_equal(
            roll_out(policy, [START], question, {"rtg[0]": wanted}).action[0], together.action[n]
        )


def test_the_five_panels_are_the_paper_s_and_fit_into_a_json(panels):
    assert list(panels) == [*ROLLOUTS, BACKWARDS]
    for panel in panels.values():
        assert json.loads(json.dumps(dataclasses.asdict(panel))) == dataclasses.asdict(panel)
        count = 3 if panel.name == BACKWARDS else 1
        assert np.shape(panel.states) == (count, HORIZON, 2)
        assert all(len(values) == count for values in panel.achieved.values() if isinstance(values, list))


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


def test_backwards_samples_end_in_the_given_state_and_the_fewest_impossible_steps_come_first(policy):
    everything, few = (backwards_panel(policy, histories=histories, samples=30) for histories in (30, 2))
    states, actions = np.array(everything.states), np.array(everything.actions)
    assert (states[:, -1] == GOAL).all()
    assert actions.shape == (30, HORIZON - 1)
    wrong = [0] * 30
    for n, t in np.ndindex(actions.shape):
        agent, key, _ = step(*states[n, t], np.array(False), actions[n, t])
        wrong[n] += [int(agent), int(key)] != states[n, t + 1].tolist()
    assert everything.achieved == {"samples": 30, "possible": wrong.count(0), "impossible_steps": sorted(wrong)}
    assert wrong == sorted(wrong)
    assert few.states == everything.states[:2]
    assert few.achieved["possible"] == everything.achieved["possible"]


def test_every_step_of_the_expert_is_possible():
    episodes = rollout(500, np.random.default_rng(0))
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
        five_panels(make_policy(context_length=5))
