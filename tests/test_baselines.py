"""The paper's other networks: hidden values change nothing, the future changes no past, what each refuses, acting."""

import math

import pytest
import torch
from policies import without_return
from torch.utils.data import default_collate

from lerobot_unimask.configuration_unimask import NETWORKS, UniMASKConfig
from lerobot_unimask.data.window import Window
from lerobot_unimask.envs.doorkey.environment import DoorKeyEnv
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import Mask
from lerobot_unimask.paper import heatmap

K = 10
ARCHITECTURES = {"transformer": {}, **heatmap.ARCHITECTURES}
CAUSAL = ("decision_gpt", "decision_transformer")


def flat(predictions):
    return torch.cat([output.flatten(1) for outputs in predictions.values() for output in outputs], dim=1)  # (B, ...)


def outputs_at(predictions, name: str, k: int):
    return torch.cat([output[:, k] for output in predictions[name]], dim=1)


@pytest.fixture
def policy(tiny_policy):
    """policy(network, **settings), trained on what all networks can be."""

    def make(network, **settings):
        settings = {"training_masks": ["behavior_cloning", "reward_conditioned"]} | settings
        return tiny_policy(**ARCHITECTURES[network], **settings)

    return make


def window_and_shown(policy, batch, seed=0):
    """A normalised window, and tokens shown at random; of the return the first, in every second window."""
    window = policy.statistics.normalise(policy.make_window(batch))
    generator = torch.Generator().manual_seed(seed)
    shown = {name: torch.rand(window.valid.shape, generator=generator) < 0.5 for name in policy.factors}
    shown["rtg"] = (torch.arange(len(window.valid))[:, None] % 2 == 0) & (torch.arange(K) == 0)
    return window, Mask(shown, shown).within(window.valid).shown


# --- What the Decision Transformer must keep; the others: test_networks.py -------------------------------------------


def test_a_hidden_value_changes_nothing_not_even_a_nan(policy, doorkey_batch):
    """A Decision Transformer reads the later returns where the first is shown: those are shown with it."""
    tested = policy("decision_transformer")
    window, shown = window_and_shown(tested, doorkey_batch)
    read = shown | {"rtg": shown["rtg"][:, :1].expand(-1, K)}
    before = flat(tested.network(window, shown))
    assert before.isfinite().all()
    for wrong in (math.nan, math.inf, -1e9, 1.0):
        values = {name: torch.where(read[name].unsqueeze(-1), value, wrong) for name, value in window.values.items()}
        values["rtg"][..., -1] = window.values["rtg"][..., -1]  # the timestep is read also where the return is hidden
        changed = Window(values, window.valid)
        torch.testing.assert_close(flat(tested.network(changed, shown)), before, rtol=0, atol=0)
        tested.zero_grad()
        flat(tested.network(changed, shown)).square().mean().backward()
        assert all(p.grad is None or p.grad.isfinite().all() for p in tested.network.parameters())


def test_windows_do_not_see_each_other(policy, doorkey_batch):
    tested = policy("decision_transformer")
    window, shown = window_and_shown(tested, doorkey_batch)
    together = flat(tested.network(window, shown))
    for b in range(len(window.valid)):
        alone = Window({name: value[b : b + 1] for name, value in window.values.items()}, window.valid[b : b + 1])
        output = flat(tested.network(alone, {name: tokens[b : b + 1] for name, tokens in shown.items()}))
        torch.testing.assert_close(output[0], together[b], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("network", ["feedforward", *CAUSAL])
def test_training_lowers_the_loss_and_a_checkpoint_answers_the_same(policy, doorkey_batch, network, tmp_path):
    tested = policy(network).train()
    optimiser = torch.optim.Adam(tested.parameters(), lr=1e-2)
    losses = []
    for _ in range(60):
        loss, _ = tested(doorkey_batch)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert sum(losses[-5:]) < 0.7 * sum(losses[:5])
    tested.eval().save_pretrained(tmp_path)
    again = type(tested).from_pretrained(tmp_path)
    assert again.config.network == tested.config.network
    for task in ("behavior_cloning", "reward_conditioned"):
        one, other = (p.infer(doorkey_batch, task, t=1)["a"][0].probabilities for p in (tested, again))
        torch.testing.assert_close(one, other, equal_nan=True)


# --- The causal ones -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("network", CAUSAL)
def test_the_future_changes_no_past(policy, doorkey_batch, network):
    """Everything shown; a value changed at one token changes the predictions of later tokens and of no others."""
    tested = policy(network)
    window, _ = window_and_shown(tested, doorkey_batch)
    everything = {name: torch.ones_like(window.valid) for name in tested.factors}
    everything["rtg"] = everything["rtg"] & (torch.arange(K) == 0)
    window = Window({name: value[:6] for name, value in window.values.items()}, window.valid[:6])
    everything = {name: shown[:6] for name, shown in everything.items()}
    before = tested.network(window, everything, True)
    order = [(name, k) for k in range(K) for name in ("s", "a")]
    for place, (name, k) in enumerate(order):
        values = {other: value.clone() for other, value in window.values.items()}
        values[name][:, k, 0] = (values[name][:, k, 0] + 1) % 4
        after = tested.network(Window(values, window.valid), everything, True)
        for other_place, (other, j) in enumerate(order):
            same = torch.equal(outputs_at(before, other, j), outputs_at(after, other, j))
            assert same == (other_place <= place), (name, k, other, j)


@pytest.mark.parametrize("network", CAUSAL)
def test_a_question_that_needs_the_future_is_refused(policy, doorkey_batch, network):
    tested = policy(network)
    for question in ("goal_conditioned", "past", "s[1:9] | s[0], s[-1]"):
        with pytest.raises(MaskError, match="attends causally alone"):
            tested.infer(doorkey_batch, question, t=4 if question in ("goal_conditioned", "past") else None)
    with pytest.raises(MaskError, match="attends causally alone"):
        policy(network).__class__(
            UniMASKConfig(**ARCHITECTURES[network], training_masks="past", features=tested.config.features)
        )


@pytest.mark.parametrize("network", ["transformer", "feedforward", "decision_transformer"])
def test_each_attends_as_it_can(network):
    assert UniMASKConfig(network=network).attention == NETWORKS[network][0]
    with pytest.raises(
        ValueError, match=f"with network={network}" if network != "transformer" else "attention is 'up'"
    ):
        UniMASKConfig(network=network, attention="up" if network == "transformer" else "both")
    with pytest.raises(ValueError, match=r"'mlp'.* transformer, feedforward"):
        UniMASKConfig(network="mlp")


# --- The return at every step ----------------------------------------------------------------------------------------


def played(policy, actions=(0, 0, 0, 1, 1, 1, 0, 3, 2, 2), target=6.0):
    """What a Decision Transformer's network is given at each step of an episode, and the rewards."""
    env = DoorKeyEnv(render_mode=None)
    observation, _ = env.reset(options={"agent": 0, "key": 1})
    seen, rewards = [], []
    policy.network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs))
    policy.reset()
    for action in actions:
        batch = {
            "observation.state": torch.from_numpy(observation["agent_pos"])[None],
            "observation.return_so_far": torch.from_numpy(observation["return_so_far"])[None],
        }
        policy.select_action(batch, mask="reward_conditioned", given={"rtg[0]": target})
        observation, reward, *_ = env.step(action)
        rewards.append(reward)
    return seen, rewards


@pytest.mark.parametrize("context_length", [10, 4])
def test_in_a_rollout_each_step_has_the_return_that_is_left(policy, load_doorkey, context_length):
    """6 is asked for; at step t what is left is 6 minus the rewards before it, also once the window slides."""
    tested = policy("decision_transformer", context_length=context_length)
    seen, rewards = played(tested)
    mean, std = tested.statistics.rtg_mean[0], tested.statistics.rtg_std[0]
    left = [6.0 - sum(rewards[:step]) for step in range(10)]
    for step, (window, shown, *_) in enumerate(seen):
        first = max(0, step - context_length + 1)
        now = step - first
        returns = window.values["rtg"][0, :, 0] * std + mean
        torch.testing.assert_close(returns[: now + 1], torch.tensor(left[first : step + 1]))
        timesteps = window.values["rtg"][0, : now + 1, 1] * 10
        torch.testing.assert_close(timesteps, torch.arange(first, step + 1.0))
        assert shown["rtg"][0].tolist() == [True] + [False] * (context_length - 1)


def test_acting_and_a_recorded_window_agree(policy, doorkey):
    """The same episode played through select_action and read from the dataset: the same answers at every step."""
    tested = policy("decision_transformer", sample_actions=False)
    recorded = default_collate([doorkey[20]])
    rewards = recorded["observation.return_to_go"][0, :-1] - recorded["observation.return_to_go"][0, 1:]
    target = recorded["observation.return_to_go"][0, 0].item()
    so_far = torch.cat([torch.zeros(1), rewards.cumsum(0)])
    tested.reset()
    for t in range(10):
        batch = {
            "observation.state": recorded["observation.state"][:, t],
            "observation.return_so_far": so_far[t].reshape(1, 1),
        }
        acted = tested.select_action(batch, mask="reward_conditioned", given={"rtg[0]": target})
        expected = tested.infer(recorded, "reward_conditioned", t=t).most_likely("a")[:, t]
        assert acted.tolist() == expected.long().tolist()
        tested._memory.act(recorded["action"][:, t].reshape(1, 1).float())  # go on as recorded


def test_a_later_return_that_nobody_knows_is_asked_for(policy):
    tested = policy("decision_transformer")
    given = {"s[0]": [0, 1], "rtg[0]": 5}
    tested.infer(None, "reward_conditioned", t=0, given=given)  # needs no later one
    with pytest.raises(ValueError, match=r"decision_transformer|return-to-go"):
        tested.infer(None, "reward_conditioned", t=1, given={**given, "s[1]": [1, 1], "a[0]": 0})
    tested.infer(None, "behavior_cloning", t=1, given={"s[0]": [0, 1], "s[1]": [1, 1], "a[0]": 0})


def test_a_decision_transformer_needs_returns(doorkey, policy):
    with pytest.raises(ValueError, match=r"decision_transformer|return"):
        policy("decision_transformer", features=without_return(doorkey), training_masks="behavior_cloning")


def test_the_returns_that_are_read_matter(policy, doorkey_batch):
    tested = policy("decision_transformer")
    window, _ = window_and_shown(tested, doorkey_batch)
    everything = {name: torch.ones_like(window.valid) for name in tested.factors}
    other = Window({name: value.clone() for name, value in window.values.items()}, window.valid)
    other.values["rtg"][:, 5, 0] += 1
    cloning = everything | {"rtg": torch.zeros_like(window.valid)}
    for shown, same in ((everything, False), (cloning, True)):
        before, after = tested.network(window, shown), tested.network(other, shown)
        assert torch.equal(outputs_at(before, "a", 4), outputs_at(after, "a", 4))
        assert torch.equal(outputs_at(before, "a", 5), outputs_at(after, "a", 5)) == same
