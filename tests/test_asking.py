"""Questions put to a policy: marginals and samples."""

import copy

import pytest
import torch
from policies import LAYOUTS, PARTS, assert_same_answers, assert_unchanged, numbers, random_question

from lerobot_unimask import TASKS, MaskError, Window
from lerobot_unimask.asking.answers import ContinuousDistribution
from lerobot_unimask.asking.sampling import ORDERS
from lerobot_unimask.language.masks import tabulate


def test_answers_are_distributions_shown_values_come_back_and_hidden_ones_are_nan(kind, layout, tiny_policy, batch_of):
    policy = tiny_policy(kind, **LAYOUTS[layout])
    for seed in range(10):
        window, mask = random_question(policy, batch_of(kind), seed)
        answer = policy.infer(window, mask)
        for name in ("s", "a"):
            shown, asked = mask.shown[name], mask.asked[name]
            best = answer.most_likely(name)
            assert torch.equal(best[shown], window.values[name][shown])
            assert best[asked].isfinite().all()
            assert best[~shown & ~asked].isnan().all()
            for distribution in answer[name]:
                if isinstance(distribution, ContinuousDistribution):
                    assert (distribution.scale is not None) == (kind == "gaussian")
                    if distribution.scale is None:
                        continue
                    assert (distribution.scale[shown] == 0).all()
                    assert (distribution.scale[asked] > 0).all()
                    assert distribution.scale[~shown & ~asked].isnan().all()
                    continue
                total = distribution.probabilities.sum(-1)
                torch.testing.assert_close(total[shown | asked], torch.ones_like(total[shown | asked]))
                assert (distribution.probabilities[shown].amax(-1) == 1).all()
                assert (distribution.probabilities[asked] > 0).all()
                assert distribution.probabilities[~shown & ~asked].isnan().all()


def test_a_token_asked_alone_or_among_others_has_the_same_marginal(kind, layout, tiny_policy, batch_of):
    """To float rounding: some processors multiply few rows by another kernel than many."""
    policy, batch = tiny_policy(kind, **LAYOUTS[layout]), batch_of(kind)
    together = policy.infer(batch, "s[1:], a[:] | s[0]")
    for step in range(10):
        alone = policy.infer(batch, f"a[{step}] | s[0]")
        for one, among in zip(alone["a"], together["a"], strict=True):
            for field in PARTS:
                if getattr(one, field, None) is not None:
                    value, other = getattr(one, field)[:, step], getattr(among, field)[:, step]
                    torch.testing.assert_close(value, other, equal_nan=True)


@pytest.mark.parametrize("task", TASKS)
def test_hidden_values_and_the_future_change_no_answer(kind, layout, tiny_policy, batch_of, task):
    policy = tiny_policy(kind, **LAYOUTS[layout])
    window = policy.make_window(batch_of(kind))
    answer = policy.infer(window, task, t=4)
    values = {
        name: torch.where(answer.mask.shown[name].unsqueeze(-1), value, torch.nan)
        for name, value in window.values.items()
    }
    assert_same_answers(policy.infer(Window(values, window.valid), task, t=4), answer)


def test_padding_is_neither_shown_nor_asked(tiny_policy, continuous_batch):
    policy = tiny_policy("continuous")
    answer = policy.infer(continuous_batch, "s[1:], a[1:] | s[0], a[0], s[-1]")
    valid = policy.make_window(continuous_batch).valid
    for name in ("s", "a"):
        assert not (answer.mask.shown[name] & ~valid).any()
        assert torch.equal(answer.most_likely(name).isnan().all(-1), ~valid)


def test_a_question_without_a_window(tiny_policy, doorkey_batch):
    policy = tiny_policy()
    given = {"s[0]": [0, 9], "s[-1]": [15, 15], "rtg[0]": 2}
    answer = policy.infer(None, "s[1:-1], a[:] | s[0], s[-1], rtg[0]", given=given)
    assert answer.most_likely("s")[0, [0, -1]].tolist() == [[0, 9], [15, 15]]
    batch = {key: value[:1].clone() for key, value in doorkey_batch.items() if isinstance(value, torch.Tensor)}
    batch["observation.state"][:, 0] = torch.tensor([0, 9])
    batch["observation.state"][:, -1] = torch.tensor([15, 15])
    batch["observation.return_to_go"][:, 0] = 2
    assert_same_answers(policy.infer(batch, "s[1:-1], a[:] | s[0], s[-1], rtg[0]"), answer)
    with pytest.raises(ValueError, match=r"s\[-1\]|s\[9\]"):
        policy.infer(None, "s[1:-1] | s[0], s[-1]", given={"s[0]": [0, 9]})


def test_given_values_replace_recorded_ones_in_a_question(tiny_policy, doorkey_batch):
    policy = tiny_policy()
    changed = {key: value.clone() for key, value in doorkey_batch.items() if isinstance(value, torch.Tensor)}
    changed["observation.state"][:, 9] = torch.tensor([1, 2])
    changed["action"][:, 0] = torch.arange(8) % 4
    expected = policy.infer(changed, "s[1:9] | s[0], s[-1], a[0]")
    given = {"s[-1]": [1, 2], "a[0]": [[b % 4] for b in range(8)]}
    before = copy.deepcopy(doorkey_batch)
    assert_same_answers(policy.infer(doorkey_batch, "s[1:9] | s[0], s[-1], a[0]", given=given), expected)
    assert_unchanged(doorkey_batch, before)
    with pytest.raises(ValueError, match=r"key_cell.*15"):
        policy.infer(doorkey_batch, "s[1] | s[0]", given={"s[0]": [0, 16]})


def test_a_question_about_a_step_must_say_which(tiny_policy, doorkey_batch):
    policy = tiny_policy()
    with pytest.raises(MaskError, match="say which"):
        policy.infer(doorkey_batch, "past")
    with pytest.raises(MaskError, match="cannot be asked at t=0"):
        policy.infer(doorkey_batch, "past", t=0)
    with pytest.raises(MaskError, match="no factor 'q'"):
        policy.infer(doorkey_batch, "q[0] | s[0]")


def test_answers_have_no_dropout_and_leave_the_mode_as_it_was(tiny_policy, doorkey_batch):
    policy = tiny_policy(dropout=0.5).train()
    assert_same_answers(policy.infer(doorkey_batch, "future", t=3), policy.infer(doorkey_batch, "future", t=3))
    policy.select_action({"observation.state": torch.zeros(1, 2)})
    policy.sample(doorkey_batch, "future", t=3)
    assert all(module.training for module in policy.modules())
    network, policy.network = policy.network, None
    with pytest.raises(TypeError):
        policy.infer(doorkey_batch, "future", t=3)
    policy.network = network
    assert all(module.training for module in policy.modules())
    policy.eval().infer(doorkey_batch, "future", t=3)
    assert not any(module.training for module in policy.modules())


def test_mixed_precision_still_answers_in_distributions(kind, tiny_policy, batch_of):
    policy, batch = tiny_policy(kind), batch_of(kind)
    exact = policy.infer(batch, "s[1:], a[:] | s[0]")
    with torch.autocast("cpu", torch.bfloat16):
        answer = policy.infer(batch, "s[1:], a[:] | s[0]")
        assert policy.forward(batch)[0].isfinite()
    for part, expected in zip(numbers(answer), numbers(exact), strict=True):
        assert part.dtype == torch.float32
        assert not torch.equal(part, expected)  # or autocast did nothing
        if kind == "doorkey":
            torch.testing.assert_close(part.sum(-1), expected.sum(-1))  # one, or the same number of NaNs


def test_asking_builds_no_graph_and_moves_no_global_generator(tiny_policy, doorkey_batch):
    policy = tiny_policy()
    state = torch.get_rng_state()
    answer = policy.infer(doorkey_batch, "s[1:], a[:] | s[0]")
    drawn = policy.sample(doorkey_batch, "s[1:3] | s[0]", seed=1)
    assert not any(part.requires_grad for part in [*numbers(answer), *drawn.values.values()])
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("order", ORDERS)
def test_samples_keep_what_is_shown_and_fill_what_is_asked(kind, layout, order, tiny_policy, batch_of):
    policy = tiny_policy(kind, **LAYOUTS[layout])
    window, mask = random_question(policy, batch_of(kind), seed=2)
    before = copy.deepcopy(window)
    drawn = policy.sample(window, mask, order=order, seed=4)
    again = policy.sample(window, mask, order=order, seed=4)
    for name in ("s", "a"):
        shown, asked = mask.shown[name], mask.asked[name]
        assert torch.equal(drawn.values[name][shown], window.values[name][shown])
        assert drawn.values[name][~shown & ~asked].isnan().all()
        assert torch.equal(drawn.values[name].nan_to_num(-99), again.values[name].nan_to_num(-99))
        value = drawn.values[name][asked]
        assert value.isfinite().all()
        for component in policy.factors[name].components:
            if component.discrete:
                category = value[..., component.dims]
                assert ((category >= 0) & (category < component.categories) & (category == category.round())).all()
        assert torch.equal(window.values[name], before.values[name])
    if kind != "continuous":
        other = policy.sample(window, mask, order=order, seed=5)
        assert not torch.equal(drawn.values["s"].nan_to_num(-99), other.values["s"].nan_to_num(-99))


def test_continuous_samples_are_means_given_what_was_drawn_before(tiny_policy, continuous_batch):
    """The L2 head has no spread, so that the chain rule can be followed by hand."""
    policy = tiny_policy("continuous")
    drawn = policy.sample(continuous_batch, "s[1:3] | s[0]")
    first = policy.infer(continuous_batch, "s[1] | s[0]").most_likely("s")[:, 1]
    torch.testing.assert_close(drawn.values["s"][:, 1], first)
    second = policy.infer(continuous_batch, "s[2] | s[:2]", given={"s[1]": first}).most_likely("s")[:, 2]
    torch.testing.assert_close(drawn.values["s"][:, 2], second)
    backward = policy.sample(continuous_batch, "s[1:3] | s[0]", order="backward")
    last = policy.infer(continuous_batch, "s[2] | s[0]").most_likely("s")[:, 2]
    torch.testing.assert_close(backward.values["s"][:, 2], last)


def test_samples_of_a_window_stand_together_and_given_rows_make_a_batch(tiny_policy):
    policy = tiny_policy()
    drawn = policy.sample(None, "s[1], a[0] | s[0]", given={"s[0]": [[5, 0], [9, 4]]}, samples=3)
    assert drawn.values["s"][:, 0].tolist() == [[5, 0]] * 3 + [[9, 4]] * 3
    assert not drawn.values["s"][:, 1].isnan().any()
    assert drawn.values["s"][:, 2].isnan().all()


def test_a_question_needs_no_columns_that_it_does_not_show(tiny_policy, doorkey_batch):
    policy = tiny_policy()
    keys = ("observation.state", "action")
    part = {key: doorkey_batch[key] for key in (*keys, *(f"{key}_is_pad" for key in keys))}
    whole = policy.infer(doorkey_batch, "forward_dynamics", t=0)
    torch.testing.assert_close(
        policy.infer(part, "forward_dynamics", t=0)["s"][0].probabilities, whole["s"][0].probabilities, equal_nan=True
    )
    with pytest.raises(ValueError, match=r"shows rtg\[0\]"):
        policy.infer(part, "reward_conditioned", t=0)
    with pytest.raises(KeyError, match="return_to_go"):
        policy.forward(part)


def test_a_sample_can_be_asked_about_where_it_was_drawn_and_nowhere_else(tiny_policy):
    policy = tiny_policy()
    drawn = policy.sample(None, "s[1] | s[0]", given={"s[0]": [5, 0]})
    assert policy.infer(drawn, "s[2] | s[0], s[1]")["s"][0].probabilities[0, 2].sum() == pytest.approx(1)
    with pytest.raises(ValueError, match=r"shows s\[3\]"):
        policy.infer(drawn, "s[2] | s[3]")


def test_a_model_that_attends_causally_alone_refuses_what_it_has_not_learnt(tiny_policy, doorkey_batch):
    policy = tiny_policy(attention="causal", training_masks=["behavior_cloning", "reward_conditioned"])
    answer = policy.infer(doorkey_batch, "reward_conditioned", t=3)["a"][0].probabilities[:, 3]
    assert torch.equal(answer.isfinite().all(1), policy.make_window(doorkey_batch).valid[:, 3])
    with pytest.raises(MaskError, match="behavior_cloning, reward_conditi"):
        policy.infer(doorkey_batch, "goal_conditioned", t=3)
    with pytest.raises(MaskError, match="behavior_cloning"):
        tiny_policy(attention="causal", training_masks="past")


def test_both_directions_train_the_same_weights_and_answer_with_them(tiny_policy, doorkey_batch):
    """The next action of a full history comes from the causal reading, everything else from the other."""
    policy = tiny_policy(attention="both")
    window = policy.make_window(doorkey_batch)
    full = window.valid.all(1)
    window = Window({name: value[full] for name, value in window.values.items()}, window.valid[full])
    normalised = policy.statistics.normalise(window)
    for task, causal in (("behavior_cloning", True), ("goal_conditioned", False)):
        mask = tabulate(task, tuple(policy.factors), policy.config.context_length).at(3, len(window.valid))
        logits = policy.network(normalised, mask.shown, causal)["a"][0][:, 3]
        answer = policy.infer(window, task, t=3)["a"][0].probabilities[:, 3]
        torch.testing.assert_close(answer, logits.softmax(-1))
