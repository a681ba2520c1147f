"""The return, properties and the task are asked, at step 0: what is trained, answered, drawn, measured, and refused."""

import json
from functools import partial
from itertools import product

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from policies import assert_same_answers, random_question
from test_optimum import enumerate_episodes, row, window_of

from dataset_builders.doorkey import FEATURES
from lerobot_unimask import UniMASKPolicy, query
from lerobot_unimask.asking.sampling import ORDERS
from lerobot_unimask.envs.doorkey import optimum as module
from lerobot_unimask.envs.doorkey.optimum import RETURNS, Optimum
from lerobot_unimask.envs.doorkey.rules import GOAL
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import ASKABLE, Mask, tabulate
from lerobot_unimask.language.training_masks import TrainingMasks

SUCCESS = {"properties": ["observation.success"]}
QUESTION = "rtg[0], success[0] | s[:3], a[:2]"
NETWORKS = {
    "both": {"attention": "both"},
    "stacked": {"attention": "bidirectional", "token_layout": "stacked"},
    "feedforward": {"network": "feedforward"},
}


@pytest.fixture
def batch(doorkey_batch):
    success = torch.tensor([0, 1, 1, 0, 0, 1, 0, 1])
    return doorkey_batch | {"observation.success": success[:, None].expand(-1, 10)}


assert_near = partial(torch.testing.assert_close, equal_nan=True, rtol=1e-4, atol=1e-5)


# --- Training ---------------------------------------------------------------------------------------------------------


def test_random_masks_ask_the_hidden_first_tokens_of_properties_and_change_nothing_else():
    factors, valid, index = ("s", "a", "rtg", "success"), torch.ones(400, 10) > 0, torch.arange(400)
    drawn, plain = (
        TrainingMasks("random_mask", factors, 10, causal_share=0.3, predicted=predicted)(valid, index, seed=0, step=3)
        for predicted in (factors, ASKABLE)
    )
    for name in factors:
        assert torch.equal(drawn.shown[name], plain.shown[name])
    for name in ASKABLE:
        assert torch.equal(drawn.asked[name], plain.asked[name])
    first = torch.arange(10) == 0
    for name in ("rtg", "success"):
        assert torch.equal(drawn.asked[name], ~drawn.shown[name] & first & ~drawn.causal[:, None])
        assert not plain.asked[name].any()


@pytest.mark.parametrize("settings", NETWORKS.values(), ids=NETWORKS)
def test_a_propertys_loss_weighs_as_one_state_of_a_window(settings, tiny_policy, batch):
    policy = tiny_policy(features=FEATURES, **SUCCESS, **settings).train()
    loss, parts = policy(batch)
    expected = parts["loss_s"] + parts["loss_a"] + (parts["loss_rtg"] + parts["loss_success"]) / 10
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    loss.backward()
    assert all(policy.network.heads[name].weight.grad.abs().sum() > 0 for name in ("rtg", "success"))


def test_what_stands_beside_the_paper_is_of_states_and_actions(tiny_policy, batch):
    from lerobot_unimask.validation import task_losses

    asks, asks_not = (tiny_policy(features=FEATURES, **SUCCESS, ask_properties=asked) for asked in (True, False))
    asks_not.load_state_dict(asks.state_dict(), strict=False)
    masks = ("random_mask", "reward_conditioned", "past")
    assert task_losses(asks, batch, masks) == pytest.approx(task_losses(asks_not, batch, masks), rel=1e-6)


# --- Answers ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", NETWORKS.values(), ids=NETWORKS)
def test_an_answer_depends_on_what_is_shown_alone(settings, tiny_policy, batch):
    """Not on the recorded value that is asked for, nor on what else is; nor does it change other answers."""
    policy = tiny_policy(features=FEATURES, **SUCCESS, **settings)
    answer = policy.infer(batch, QUESTION)
    turned = {key: 1 - batch[key] for key in ("observation.success", "observation.return_to_go")}
    other = policy.infer(batch | turned, QUESTION)
    among = policy.infer(batch, "a[2], s[5], " + QUESTION)
    for said in (other, among):
        assert_near(said["success"][0].probabilities, answer["success"][0].probabilities)
        assert_near(said["rtg"][0].mean, answer["rtg"][0].mean)
    alone = policy.infer(batch, "a[2], s[5] | s[:3], a[:2]")
    assert_near(alone["s"][0].probabilities, among["s"][0].probabilities)
    assert_near(alone["a"][0].probabilities, among["a"][0].probabilities)


@pytest.mark.parametrize("order", ORDERS)
def test_properties_are_drawn_with_the_rest(order, tiny_policy, batch):
    policy = tiny_policy(features=FEATURES, **SUCCESS)
    drawn = policy.sample(batch, "rtg[0], success[0], a[:] | s[:]", samples=3, order=order).values
    assert set(drawn["success"][:, 0, 0].tolist()) <= {0.0, 1.0}
    assert drawn["rtg"][:, 0].isfinite().all()
    timestep = policy.make_window(batch).values["rtg"][:, 0, 1]  # computed, and not drawn
    assert torch.equal(drawn["rtg"][:, 0, 1], timestep.repeat_interleave(3))


def test_a_query_tells_and_draws_them(tiny_policy, batch):
    policy = tiny_policy(features=FEATURES, **SUCCESS)
    one = {key: value[:1] for key, value in batch.items() if isinstance(value, torch.Tensor)}
    reply = query.ask(policy, QUESTION, batch=one)
    rows = query.rows(policy, reply)
    assert [(entry["token"], entry["component"], entry["recorded"]) for entry in rows] == [
        ("rtg[0]", "return_to_go", one["observation.return_to_go"][0, 0].item()),
        ("success[0]", "success", 0),
    ]
    answer = policy.infer(one, QUESTION)
    assert rows[0]["mean"] == answer["rtg"][0].mean[0, 0].item()
    figure = query.picture(policy, reply)
    bars = [bar.get_height() for bar in figure.axes[1].patches]
    assert bars == pytest.approx(answer["success"][0].probabilities[0, 0].tolist())
    sampled = query.ask(policy, QUESTION, batch=one, sampling=query.Sampling(20))
    shares = query.rows(policy, sampled)[1]["shares"]
    assert sum(shares) == pytest.approx(1)
    assert query.picture(policy, sampled).axes


# --- Checkpoints ------------------------------------------------------------------------------------------------------


@pytest.fixture
def before(tiny_policy, tmp_path):
    """A checkpoint of format 3, which asks for states and actions alone, and its policy."""
    policy = tiny_policy(features=FEATURES, ask_properties=False)
    policy.save_pretrained(tmp_path)
    content = json.loads((tmp_path / "config.json").read_text())
    del content["ask_properties"]
    (tmp_path / "config.json").write_text(json.dumps(content | {"format_version": 3}))
    return tmp_path, policy


def test_a_checkpoint_of_format_3_answers_as_before_and_refuses_the_return(before, doorkey_batch):
    folder, policy = before
    loaded = UniMASKPolicy.from_pretrained(folder)
    window, mask = random_question(policy, doorkey_batch, 0)
    assert_same_answers(loaded.infer(window, mask), policy.infer(window, mask))
    with pytest.raises(MaskError, match="rtg"):
        loaded.infer(doorkey_batch, "rtg[0] | s[0]")


@pytest.mark.parametrize("properties", [[], ["observation.success"]], ids=["return", "success too"])
def test_a_checkpoint_goes_on_with_questions_about_properties(properties, before, batch):
    """New heads leave all answers as they were; a property that is hidden is one more token that others attend to."""
    folder, policy = before
    config = PreTrainedConfig.from_pretrained(folder)
    config.ask_properties, config.properties = True, properties
    config.set_dataset_feature_metadata(FEATURES)
    loaded = UniMASKPolicy.from_pretrained(folder, config=config).eval()
    for key, value in policy.network.state_dict().items():
        if key != "positions":
            assert torch.equal(loaded.network.state_dict()[key], value)
    assert torch.equal(loaded.network.positions[-20:], policy.network.positions[-20:])
    assert torch.equal(loaded.network.positions[0], policy.network.positions[0])
    if not properties:
        window, mask = random_question(policy, batch, 0)
        assert_same_answers(loaded.infer(window, mask), policy.infer(window, mask))
    assert loaded.infer(batch, "rtg[0] | s[0]")["rtg"][0].mean[:, 0].isfinite().all()


@pytest.mark.parametrize("attention", ["causal", "bidirectional"])
def test_training_on_what_is_not_predicted_is_refused(attention, tiny_policy):
    settings = {"ask_properties": False} if attention == "bidirectional" else {}
    with pytest.raises(MaskError, match="rtg"):
        tiny_policy(attention=attention, training_masks="rtg[0] | s[:t+1], a[:t+1]", **settings)


# --- The exact optimum ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("horizon", "first", "K"), [(3, 0, 3), (4, 0, 2), (4, 1, 3)])
def test_the_optimums_returns_and_properties_equal_enumeration(monkeypatch, horizon, first, K):
    """In short episodes, with starts beside the goal so that some succeed; each shown in some windows."""
    monkeypatch.setattr(module, "HORIZON", horizon)
    episodes, probability = enumerate_episodes(horizon, "paper")
    has = {
        "success": (episodes.agent[:, 1:] == GOAL).any(1).astype(int),
        "visits_corner": (episodes.agent[:, :-1] == 0).any(1).astype(int),
    }
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(probability), size=40, p=probability)
    states = np.stack([episodes.agent, episodes.key], axis=-1)
    returns = episodes.reward[:, first:].sum(axis=1)
    windows = window_of(
        states[chosen, first : first + K], episodes.action[chosen, first : first + K], returns[chosen], first / horizon
    )
    for name, label in has.items():
        windows.values[name] = torch.as_tensor(label[chosen]).float()[:, None, None].expand(-1, K, 1)
    start = torch.arange(K) == 0
    shown = {name: torch.from_numpy(rng.random((40, K)) < 0.4) for name in ASKABLE}
    shown |= {name: (torch.arange(40)[:, None] % n == 0) & start for name, n in (("rtg", 2), ("visits_corner", 3))}
    shown["success"] = torch.zeros(40, K, dtype=torch.bool)
    asked = {name: ~tokens & (start | (name in ASKABLE)) for name, tokens in shown.items()}
    found = Optimum(first_step=first, properties=list(has)).predict(windows, Mask(shown, asked))
    weights = module.FACTORS["rtg"].outputs[0].unpack(found["rtg"][0])[0].softmax(-1)[:, 0]  # (B, R)
    for b in range(40):
        agrees = np.ones(len(probability), dtype=bool)
        one = row(windows, b).values
        for k, name in product(range(K), ASKABLE):
            if shown[name][b, k]:
                recorded = states[:, first + k] if name == "s" else episodes.action[:, first + k, None]
                agrees &= (recorded == one[name][0, k].numpy()).all(axis=-1)
        for name, label in (("rtg", returns), ("visits_corner", has["visits_corner"])):
            if shown[name][b, 0]:
                agrees &= label == one[name][0, 0, 0].item()
        weight = probability[agrees] / probability[agrees].sum()
        if asked["rtg"][b, 0]:
            expected = np.bincount(returns[agrees] - RETURNS[0].item(), weight, len(RETURNS))
            np.testing.assert_allclose(weights[b].numpy(), expected, atol=1e-9)
        for name in ("success", "visits_corner"):
            if asked[name][b, 0]:
                expected = np.bincount(has[name][agrees], weight, 2)
                np.testing.assert_allclose(found[name][0][b, 0].softmax(-1).numpy(), expected, atol=1e-9)


def test_the_optimum_says_what_it_does_not_know():
    nothing = window_of(np.zeros((1, 10, 2)), np.zeros((1, 10), dtype=int), np.zeros(1))
    mask = tabulate("a[0] | s[0], mood[0]", ("s", "a", "rtg", "mood"), 10).at(None)
    with pytest.raises(ValueError, match="knows nothing of mood"):
        Optimum().predict(nothing, mask)
    with pytest.raises(ValueError, match="success"):
        Optimum(properties=["mood"])
