"""Acting: a question asked at every step of a rollout."""

import pytest
import torch
from lerobot.policies.factory import make_policy
from policies import CONTINUOUS_FEATURES, LAYOUTS, Episode, roll

from lerobot_unimask import UniMASKConfig, UniMASKPolicy
from lerobot_unimask.asking.acting import target_return


@pytest.mark.parametrize("K", [1, 4])
@pytest.mark.parametrize("question", ["imitation", "return", "waypoint"])
def test_acting_is_a_question_asked_at_every_step(kind, layout, question, K, tiny_policy):
    """Every action equals the answer of `infer` about the window that a dataset would have recorded by then."""
    T, B = 9, 6
    target, waypoint = 5.0, 2
    mask = {
        "imitation": "behavior_cloning",
        "return": "reward_conditioned",
        "waypoint": f"a[t] | s[:t+1], a[:t], s[{min(waypoint, K - 1)}]",
    }[question]
    place = [[3.0, 4.0 + b] for b in range(B)] if kind == "doorkey" else [[90.0 + b, -5.0, 0.5] for b in range(B)]
    given = {f"s[{min(waypoint, K - 1)}]": place} if question == "waypoint" else {}
    settings = {"target_return": target} if question == "return" else {}
    policy = tiny_policy(kind, context_length=K, **LAYOUTS[layout], inference_mask=mask, given=given, **settings)
    episode = Episode(kind, B, T)
    for step in range(T):
        torch.manual_seed(step)
        sampled = step % 2 == 0  # by turns a draw, in which the whole distribution has a say, and what is most likely
        action = policy.select_action(episode.observation(step), **({"sample": True} if sampled else {}))

        batch, first, position = episode.window(step, K, policy.statistics.fps.item())
        values = {}
        if question == "return":
            left = target - episode.received[first] if first else torch.full((B, 1), target)
            values["rtg[0]"] = left
        if question == "waypoint" and position < min(waypoint, K - 1):
            values = given
        answer = policy.infer(batch, mask, t=position, given=values)
        torch.manual_seed(step)
        expected = [d.draw(None) if sampled else d.most_likely for d in answer["a"]]
        expected = torch.cat(expected, dim=-1)[:, position]
        torch.testing.assert_close(action.float(), expected, rtol=1e-5, atol=1e-5)
        episode.actions.append(action)


def test_whether_actions_are_drawn_is_a_setting_too(tiny_policy):
    state = {"observation.state": torch.tensor([[1.0, 2.0]]).expand(50, 2)}
    by_argument, by_setting = tiny_policy(), tiny_policy(sample_actions=True)
    best = by_argument.select_action(state)
    drawn = []
    for policy, how in ((by_argument, {"sample": True}), (by_setting, {})):
        policy.reset()
        torch.manual_seed(0)
        drawn.append(policy.select_action(state, **how))
    assert torch.equal(*drawn)
    assert len(drawn[0].unique()) > 1
    by_setting.reset()
    assert torch.equal(by_setting.select_action(state, sample=False), best)


def test_resetting_forgets_the_episode(tiny_policy, states):
    policy = tiny_policy("continuous")
    first = roll(policy, states)
    assert torch.equal(roll(policy, states), first)
    assert not torch.equal(policy.select_action({"observation.state": states[0]}), first[0])  # no reset in between


def test_another_number_of_environments_begins_anew(tiny_policy, states):
    policy = tiny_policy("continuous")
    expected = roll(policy, states)
    policy.select_action({"observation.state": states[5]})
    for step in range(6):
        action = policy.select_action({"observation.state": states[step, :2]})
        torch.testing.assert_close(action, expected[step, :2])


def test_an_environments_actions_do_not_depend_on_the_others(tiny_policy, states):
    policy = tiny_policy("continuous")
    together = roll(policy, states)
    for b in range(4):
        torch.testing.assert_close(roll(policy, states[:, b : b + 1])[:, 0], together[:, b], rtol=1e-5, atol=1e-5)


def test_given_values_may_differ_between_environments(tiny_policy, states):
    policy = tiny_policy("continuous")
    goals = [[80.0 + 10 * b, -5.0, 0.5] for b in range(4)]
    together = roll(policy, states, mask="goal_conditioned", given={"s[-1]": goals})
    for b in range(4):
        shared = roll(policy, states, mask="goal_conditioned", given={"s[-1]": goals[b]})
        torch.testing.assert_close(shared[:, b], together[:, b])
        assert not torch.allclose(shared[:, b - 1], together[:, b - 1])


def test_what_has_been_observed_wins_over_what_was_given(tiny_policy, states):
    policy = tiny_policy("continuous")
    mask = "a[t] | s[:t+1], a[:t], s[3]"
    recorded = roll(policy, states, mask=mask, given={"s[3]": states[3]})
    elsewhere = roll(policy, states, mask=mask, given={"s[3]": [0.0, 0.0, 0.0], "s[0]": [7.0, 7.0, 7.0]})
    assert not torch.allclose(recorded[:3], elsewhere[:3])
    # From step 3 on only the observed state counts: the given one has expired. (The actions before are in the past.)
    policy.reset()
    for step in range(6):
        policy.select_action({"observation.state": states[step]}, mask=mask, given={"s[3]": [0.0, 0.0, 0.0]})
        policy._memory.values["a"][:, step] = recorded[step]
        if step >= 3:
            policy._memory.step -= 1
            action = policy.select_action({"observation.state": states[step]}, mask=mask, given={})
            policy._memory.values["a"][:, step] = recorded[step]
            torch.testing.assert_close(action, recorded[step])


def test_a_later_token_must_be_given(tiny_policy, states):
    policy = tiny_policy("continuous", context_length=5)
    for mask, token in (
        ("goal_conditioned", r"s\[4\]"),
        ("reward_conditioned", r"rtg\[0\]"),
        ("waypoint_conditioned", r"s\[3\]"),
    ):
        policy.reset()
        with pytest.raises(ValueError, match=token):
            policy.select_action({"observation.state": states[0]}, mask=mask)
    policy.reset()
    for step in range(6):  # once it has been observed nobody needs to give it
        given = {"s[-1]": [0.0, 0.0, 0.0]} if step < 4 else {}
        policy.select_action({"observation.state": states[step]}, mask="goal_conditioned", given=given)


def test_a_question_can_change_at_every_step(tiny_policy, states):
    policy = tiny_policy("continuous")
    given = {"s[-1]": [150.0, -5.0, 0.5]}
    imitation = roll(policy, states)
    goal = roll(policy, states, mask="goal_conditioned", given=given)
    policy.reset()
    for step in range(2):
        action = policy.select_action({"observation.state": states[step]})
        assert torch.equal(action, imitation[step])
    turned = policy.select_action({"observation.state": states[2]}, mask="goal_conditioned", given=given)
    assert not torch.allclose(turned, imitation[2])
    assert not torch.allclose(goal[0], imitation[0])
    policy.reset()
    assert torch.equal(policy.select_action({"observation.state": states[0]}), imitation[0])  # this step's alone


def test_a_refused_question_does_not_count_as_a_step(tiny_policy, states):
    policy = tiny_policy("continuous", context_length=3)
    expected = roll(policy, states)
    policy.reset()
    for step in range(6):
        for wrong in (
            {"mask": "past"},
            {"mask": "a[t] | s[:t+1], rtg[0]"},
            {"given": {"s[0]": [1.0]}},
            {"given": {"q[0]": 1.0}},
        ):
            with pytest.raises(ValueError):  # noqa: PT011
                policy.select_action({"observation.state": states[step]}, **wrong)
        assert torch.equal(policy.select_action({"observation.state": states[step]}), expected[step])


def test_settings_and_arguments_say_the_same(tiny_policy, states):
    given = {"s[-1]": [150.0, -5.0, 0.5], "rtg[0]": 12.0}
    mask = "a[t] | s[:t+1], a[:t], s[-1], rtg[0]"
    by_argument = roll(tiny_policy("continuous"), states, mask=mask, given=given)
    by_config = tiny_policy("continuous", inference_mask=mask, given=given)
    assert torch.equal(roll(by_config, states), by_argument)
    by_target = tiny_policy("continuous", inference_mask=mask, given={"s[-1]": given["s[-1]"]}, target_return=12.0)
    assert torch.equal(roll(by_target, states), by_argument)


def test_a_return_over_several_windows_needs_what_was_paid_so_far(tiny_policy, states):
    policy = tiny_policy("continuous", context_length=3, inference_mask="reward_conditioned", target_return=40.0)
    with pytest.raises(ValueError, match=r"observation\.return_so_far"):  # said at the first step already
        policy.select_action({"observation.state": states[0]})


def test_given_and_target_return_cannot_both_name_the_return(tiny_policy):
    with pytest.raises(ValueError, match="both name rtg"):
        tiny_policy(inference_mask="reward_conditioned", target_return=5.0, given={"rtg[0]": 4.0})


@pytest.mark.parametrize(
    "settings",
    [{"target_return": 6.0}, {"given": {"rtg[0]": 6.0}}, {"inference_mask": "a[t] | s[t]", "given": {"rtg[0]": 6.0}}],
)
def test_a_value_that_the_inference_mask_never_shows_is_refused_when_the_policy_is_made(tiny_policy, settings):
    with pytest.raises(ValueError, match="is given"):
        tiny_policy(**settings)


def test_a_value_that_is_observed_before_it_is_shown_is_said_to_change_nothing(tiny_policy, caplog):
    tiny_policy(given={"s[-1]": [15, 15]})  # behaviour cloning shows the last state once it is there
    assert "s[9] is given, but the inference mask shows it once it has been observed" in caplog.text
    caplog.clear()
    tiny_policy(inference_mask="goal_conditioned", given={"s[-1]": [15, 15]})
    assert not caplog.text


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"q[0]": 1}, "no factor 'q'"),
        ({"s[-1]": [1]}, "give 2 numbers"),
        ({"s[-1]": [1, 99]}, "a category from 0 to 15"),
        ({"s[99]": [1, 1]}, "outside the window"),
    ],
)
def test_a_bad_given_is_refused_when_the_policy_is_made(tiny_policy, given, message):
    with pytest.raises(ValueError, match=message):
        tiny_policy(inference_mask="goal_conditioned", given=given)


def test_a_value_given_in_passing_must_be_shown_but_the_configs_may_rest(tiny_policy):
    policy = tiny_policy(inference_mask="goal_conditioned", given={"s[-1]": [15, 15]})
    state = {"observation.state": torch.tensor([[5.0, 0.0]])}
    assert policy.select_action(state, mask="a[t] | s[t]").shape == (1, 1)
    with pytest.raises(ValueError, match="mask does not show it"):
        policy.select_action(state, mask="behavior_cloning", given={"rtg[0]": 3})
    with pytest.raises(ValueError, match="mask does not show it"):
        policy.infer(None, "s[1] | s[0]", given={"s[0]": [5, 0], "s[4]": [5, 0]})


def test_unknown_arguments_of_select_action_are_refused(tiny_policy):
    with pytest.raises(TypeError, match="maks"):
        tiny_policy().select_action({"observation.state": torch.zeros(1, 2)}, maks="past")


@pytest.mark.parametrize("state", [[[16.0, 0.0]], [[float("nan"), 0.0]], [[1.5, 0.0]], [[-1.0, 0.0]]])
def test_an_illegal_observation_is_refused_by_name(tiny_policy, state):
    with pytest.raises(ValueError, match="observed state holds"):
        tiny_policy().select_action({"observation.state": torch.tensor(state)})


def test_the_automatic_target_is_what_the_nearest_training_episode_returned(tiny_policy):
    policy = tiny_policy(inference_mask="reward_conditioned", target_return="auto", target_return_scale=2.0)
    with pytest.raises(ValueError, match="keeps no"):
        policy.select_action({"observation.state": torch.tensor([[5.0, 0.0]])})
    policy.reset()
    policy.episode_starts.fill(torch.tensor([[5.0, 0.0], [12.0, 1.0]]), torch.tensor([3.0, -1.0]))
    policy.select_action({"observation.state": torch.tensor([[11.0, 1.0], [5.0, 1.0]])})
    assert target_return(policy, policy._memory).tolist() == [[-2.0], [6.0]]
    policy.config.target_return = 3.5  # read when acting, as the other settings of acting are
    policy.select_action({"observation.state": torch.tensor([[10.0, 1.0], [4.0, 1.0]])})
    assert target_return(policy, policy._memory).tolist() == [[3.5]]


def test_acting_goes_on_outside_inference_mode(tiny_policy):
    policy, state = tiny_policy(context_length=2), {"observation.state": torch.tensor([[5.0, 0.0]])}
    with torch.inference_mode():
        policy.select_action(state)
        policy.select_action(state)
    assert policy.select_action(state).shape == (1, 1)
    with torch.inference_mode():
        assert policy.select_action(state).shape == (1, 1)


def test_an_inference_mask_that_needs_values_says_so_when_the_policy_is_made(tiny_policy, caplog):
    tiny_policy(inference_mask="reward_conditioned")
    assert "shows rtg[0] before a rollout has observed it" in caplog.text
    caplog.clear()
    tiny_policy(inference_mask="reward_conditioned", target_return=3.0)
    assert not caplog.text


def test_a_config_that_was_used_makes_a_policy_without_memories(tiny_policy, doorkey_root):
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    config = tiny_policy().config
    config.features = {}
    make_policy(config, ds_meta=LeRobotDatasetMetadata("local/doorkey", root=doorkey_root))
    assert len(UniMASKPolicy(config).episode_starts.states) == 0


@pytest.mark.parametrize("state", [torch.tensor([[1.0], [2.0]]), torch.tensor([1.0, 2.0])])
def test_a_one_number_state_comes_with_or_without_its_axis(state):
    config = UniMASKConfig(device="cpu", width=16, depth=1, heads=2, feedforward_width=16)
    config.set_dataset_feature_metadata(
        {key: {"dtype": "float32", "shape": (1,), "names": None} for key in ("observation.state", "action")}
    )
    assert UniMASKPolicy(config).select_action({"observation.state": state}).shape == (2, 1)


def test_one_environments_columns_come_with_or_without_its_axis():
    """LeRobot's processor makes a batch of `observation.state` alone."""
    numbers = {"observation.state": 3, "observation.velocity": 3, "observation.gripper": 1, "action": 2}
    config = UniMASKConfig(device="cpu", width=16, depth=1, heads=2, feedforward_width=16, states=list(numbers)[:-1])
    config.set_dataset_feature_metadata(
        {key: {"dtype": "float32", "shape": (size,), "names": None} for key, size in numbers.items()}
    )
    policy = UniMASKPolicy(config).eval()
    batched = {key: torch.arange(size).float()[None] for key, size in numbers.items()}
    expected = policy.select_action(batched)
    policy.reset()
    velocity, gripper = (batched[f"observation.{name}"].squeeze() for name in ("velocity", "gripper"))
    found = policy.select_action({**batched, "observation.velocity": velocity, "observation.gripper": gripper})
    assert torch.equal(found, expected)


WITH_CORNER = {
    **CONTINUOUS_FEATURES,
    "observation.corner": {"dtype": "int64", "shape": (1,), "names": None, "categories": [2]},
}


def test_a_property_is_read_from_the_batch_shown_and_asked(tiny_policy, continuous_batch):
    policy = tiny_policy("continuous", features=WITH_CORNER, properties=["observation.corner"])
    corner = torch.tensor([0, 1, 0, 1, 1])
    batch = continuous_batch | {"observation.corner": corner[:, None].expand(-1, 10)}
    assert list(policy.factors) == ["s", "a", "rtg", "corner"]
    assert torch.equal(policy.make_window(batch).values["corner"][:, 0, 0], corner.float())
    loss, parts = policy.train().forward(batch)
    loss.backward()
    assert parts.keys() == {"loss_s", "loss_a", "loss_rtg", "loss_corner"}
    policy.eval()
    asked = policy.infer(batch, "a[1] | s[0], corner[0]").most_likely("a")[:, 1]
    turned = policy.infer(batch, "a[1] | s[0], corner[0]", given={"corner[0]": (1 - corner)[:, None]})
    assert not torch.allclose(asked, turned.most_likely("a")[:, 1])
    said = policy.infer(batch, "corner[0] | s[0], rtg[0]")["corner"][0].probabilities  # (5, 10, 2)
    torch.testing.assert_close(said[:, 0].sum(-1), torch.ones(5))
    assert said[:, 1:].isnan().all()


@pytest.mark.parametrize("K", [3, 10])
def test_a_property_holds_for_the_whole_rollout(K, tiny_policy, states):
    """Also once the window slides: it stays at the window's first position, from the config as from the call."""
    mask = "a[t] | s[:t+1], a[:t], corner[0]"
    settings = {"features": WITH_CORNER, "properties": ["observation.corner"], "context_length": K}
    policy = tiny_policy("continuous", **settings)
    asked, not_asked = (roll(policy, states, mask=mask, given={"corner[0]": corner}) for corner in (1, 0))
    assert all(not torch.allclose(*pair) for pair in zip(asked, not_asked, strict=True))
    by_config = tiny_policy("continuous", inference_mask=mask, given={"corner[0]": 1}, **settings)
    assert torch.equal(roll(by_config, states), asked)


def test_a_given_token_of_a_short_window_expires_for_good(tiny_policy, states):
    """Positions are the episode's steps until the window is full; then all is observed and nothing given counts."""
    policy = tiny_policy("continuous", context_length=3)
    mask = "a[t] | s[:t+1], a[:t], s[-1]"
    goals = ([150.0, -5.0, 0.5], [50.0, -4.0, 0.5])
    first, second = [], []
    for actions, goal in ((first, goals[0]), (second, goals[1])):
        policy.reset()
        for step, state in enumerate(states):
            actions.append(policy.select_action({"observation.state": state}, mask=mask, given={"s[-1]": goal}))
            policy._memory.values["a"][:, policy._memory.position] = float(step)  # the same past for both
            policy._memory.cache = type(policy._memory.cache)()
    same = [torch.equal(*pair) for pair in zip(first, second, strict=True)]
    assert same == [False, False, True, True, True, True]


def test_a_question_changed_in_the_settings_takes_effect_at_the_next_step(tiny_policy, states):
    policy = tiny_policy("continuous")
    goal = {"s[-1]": [150.0, -5.0, 0.5]}
    by_call = []
    policy.reset()
    for step, state in enumerate(states):
        how = {"mask": "goal_conditioned", "given": goal} if step >= 3 else {}
        by_call.append(policy.select_action({"observation.state": state}, **how))
    policy.reset()
    for step, state in enumerate(states):
        if step == 3:
            policy.config.inference_mask, policy.config.given = "goal_conditioned", goal
        assert torch.equal(policy.select_action({"observation.state": state}), by_call[step])


@pytest.mark.parametrize("mask", ["behavior_cloning", "a[t] | s[:t+1]"])
@pytest.mark.parametrize("attention", ["both", "causal", "bidirectional"])
def test_what_a_sliding_window_keeps_changes_no_action(attention, mask, tiny_policy):
    asked = {"attention": attention, "training_masks": mask, "inference_mask": mask}
    policy = tiny_policy("gaussian", context_length=6, **asked)
    states, actions = Episode("gaussian", 8, 16).states, []
    for keeps in (True, False):
        policy.reset()
        for step, state in enumerate(states):
            if not keeps and step:
                policy._memory.cache = type(policy._memory.cache)()
            actions.append(policy.select_action({"observation.state": state}))
    torch.testing.assert_close(torch.stack(actions[16:]), torch.stack(actions[:16]), rtol=1e-5, atol=1e-5)


def test_past_actions_that_are_not_shown_change_no_action(tiny_policy):
    mask = "a[t] | s[:t+1]"
    policy = tiny_policy("gaussian", context_length=6, attention="causal", training_masks=mask, inference_mask=mask)
    states, actions = Episode("gaussian", 8, 16).states, []
    for past in (0.0, 5.0):
        policy.reset()
        for state in states:
            actions.append(policy.select_action({"observation.state": state}))
            policy._memory.values["a"][:, policy._memory.position] = past
    assert torch.equal(torch.stack(actions[:16]), torch.stack(actions[16:]))
