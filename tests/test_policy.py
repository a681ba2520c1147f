"""The policy: LeRobot's contract, questions, acting as a question asked at every step, and checkpoints."""

import copy
import json
import logging
from contextlib import nullcontext

import pytest
import torch
from conftest import CONTINUOUS_FEATURES, CONTINUOUS_STATS
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy, make_policy_config, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.feature_utils import dataset_to_policy_features
from safetensors.torch import load_file, save_file
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from lerobot_unimask import TASKS, MaskError, UniMASKConfig, UniMASKPolicy, Window
from lerobot_unimask.asking.sampling import ORDERS
from lerobot_unimask.language.training_masks import TrainingMasks, mixture

KINDS = ("doorkey", "continuous", "gaussian")
LAYOUTS = {
    "stacked": {"token_layout": "stacked", "attention": "bidirectional"},
    "separate": {"attention": "bidirectional"},
    "both": {"attention": "both"},
}


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(params=LAYOUTS)
def layout(request):
    return request.param


@pytest.fixture
def batch_of(doorkey_batch, continuous_batch):
    return lambda kind: doorkey_batch if kind == "doorkey" else continuous_batch


def assert_unchanged(batch, before):
    assert batch.keys() == before.keys()
    for key, value in before.items():
        assert torch.equal(batch[key], value) if isinstance(value, torch.Tensor) else batch[key] == value, key


def numbers(answer):
    """Everything an answer says, one tensor for each component, NaN replaced so that it can be compared."""
    parts = [part for name in ("s", "a") for d in answer[name] for part in (d.probabilities, d.mean, d.scale)]
    return [part.nan_to_num(-99.0) for part in parts if part is not None]


def assert_same_answers(one, other, exactly=True):
    for a, b in zip(numbers(one), numbers(other), strict=True):
        torch.testing.assert_close(a, b, **({"rtol": 0, "atol": 0} if exactly else {"rtol": 1e-4, "atol": 1e-5}))


# --- LeRobot's contract ----------------------------------------------------------------------------------------------


def test_policy_and_config_are_found_by_name():
    policy_class, config = get_policy_class("unimask"), make_policy_config("unimask", device="cpu")
    assert policy_class is UniMASKPolicy
    assert policy_class.name == config.type == "unimask"
    assert isinstance(config, policy_class.config_class)


def declared_features(features):
    """As LeRobot's own tests of policies set them: (input, output), from a dataset's features."""
    features = dataset_to_policy_features(features)
    output = {key: feature for key, feature in features.items() if feature.type is FeatureType.ACTION}
    return {key: feature for key, feature in features.items() if key not in output}, output


CAMERA = {"dtype": "video", "shape": (84, 84, 3), "names": ["height", "width", "channels"]}
ROBOT = {
    "action": {"dtype": "float32", "shape": (6,), "names": list("abcdef")},
    "observation.state": {"dtype": "float32", "shape": (6,), "names": list("abcdef")},
    "observation.images.laptop": CAMERA,
}


def test_defaults_and_declared_features_alone_make_a_policy(tmp_path):
    """LeRobot's test_policy_defaults and test_save_and_load_pretrained."""
    config = make_policy_config("unimask", device="cpu")
    config.input_features, config.output_features = declared_features(ROBOT)
    policy = UniMASKPolicy(config)
    assert {name: factor.size for name, factor in policy.factors.items()} == {"s": 6, "a": 6}
    policy.to(config.device)
    policy.save_pretrained(tmp_path)
    loaded = UniMASKPolicy.from_pretrained(tmp_path, config=config)
    torch.testing.assert_close(list(policy.parameters()), list(loaded.parameters()), rtol=0, atol=0)
    assert policy.eval().select_action({"observation.state": torch.zeros(2, 6)}).shape == (2, 6)


def test_make_policy_reads_a_datasets_metadata(doorkey, doorkey_batch):
    config = make_policy_config("unimask", device="cpu", width=16, depth=1, heads=2, feedforward_width=16)
    policy = make_policy(config, ds_meta=doorkey.meta)
    assert isinstance(policy, PreTrainedPolicy)
    assert list(policy.factors) == ["s", "a", "rtg"]
    assert [c.categories for c in policy.factors["s"].components] == [16, 16]
    assert (policy.statistics.horizon.item(), policy.statistics.fps.item()) == (10, pytest.approx(10))
    assert policy.statistics.rtg_mean[0].item() == pytest.approx(
        float(doorkey.meta.stats["observation.return_to_go"]["mean"][0])
    )
    preprocessor, _ = make_pre_post_processors(config, dataset_stats=doorkey.meta.stats)
    before = copy.deepcopy(doorkey_batch)
    policy.train()
    loss, parts = policy.forward(preprocessor(doorkey_batch))
    assert_unchanged(doorkey_batch, before)
    assert loss.item() == pytest.approx(parts["loss_s"] + parts["loss_a"], rel=1e-5)
    assert all(type(part) is float for part in parts.values())
    loss.backward()
    for name, parameter in policy.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


@pytest.mark.parametrize("with_stats", [True, False])
def test_processors_name_batch_and_place_but_leave_the_numbers(doorkey, tiny_policy, with_stats):
    policy = tiny_policy()
    stats = doorkey.meta.stats if with_stats else None
    preprocessor, postprocessor = make_pre_post_processors(policy.config, dataset_stats=stats)
    item = doorkey[3]
    processed = preprocessor({key: value for key, value in item.items() if key != "task"})
    state = processed["observation.state"].reshape(1, 10, 2)
    assert torch.equal(state.long()[0], item["observation.state"])
    observation = preprocessor({"observation.state": torch.tensor([3.0, 7.0])})
    assert observation["observation.state"].tolist() == [[3, 7]]
    action = policy.select_action(observation)
    assert torch.equal(postprocessor(action), action)


def test_processors_are_saved_and_loaded(tiny_policy, doorkey, tmp_path):
    policy = tiny_policy()
    for processor in make_pre_post_processors(policy.config, dataset_stats=doorkey.meta.stats):
        processor.save_pretrained(tmp_path)
    preprocessor, postprocessor = make_pre_post_processors(policy.config, pretrained_path=str(tmp_path))
    assert preprocessor({"observation.state": torch.tensor([3.0, 7.0])})["observation.state"].tolist() == [[3, 7]]
    assert postprocessor(torch.tensor([[2]])).tolist() == [[2]]


def test_forward_and_acting_leave_the_batch_alone(kind, tiny_policy, batch_of):
    policy, batch = tiny_policy(kind), batch_of(kind)
    before = copy.deepcopy(batch)
    policy.forward(batch)
    window = policy.make_window(batch)
    for value in window.values.values():
        value.zero_()
    assert_unchanged(batch, before)
    observation = {"observation.state": batch["observation.state"][:, 0].float(), "task": ["there"] * 8}
    before = copy.deepcopy(observation)
    with torch.inference_mode():
        for _ in range(12):
            policy.select_action(observation)
    assert_unchanged(observation, before)


def test_an_action_has_the_environments_form(tiny_policy):
    discrete = tiny_policy().select_action({"observation.state": torch.zeros(3, 2)})
    assert (discrete.shape, discrete.dtype) == ((3, 1), torch.int64)
    assert ((discrete >= 0) & (discrete < 4)).all()
    policy = tiny_policy("continuous")
    continuous = policy.select_action({"observation.state": torch.zeros(3, 3)})
    assert (continuous.shape, continuous.dtype) == ((3, 2), torch.float32)
    policy.reset()
    assert torch.equal(policy.predict_action_chunk({"observation.state": torch.zeros(3, 3)}), continuous[:, None])


def test_a_camera_is_ignored_with_one_line(caplog, tiny_policy, doorkey, doorkey_batch):
    features = {**doorkey.meta.features, "observation.images.top": CAMERA}
    config = UniMASKConfig(device="cpu", width=16, depth=1, heads=2, feedforward_width=16)
    config.input_features, config.output_features = declared_features(features)
    config.set_dataset_feature_metadata(features)
    with caplog.at_level(logging.INFO, "lerobot_unimask"):
        policy = UniMASKPolicy(config, dataset_stats=doorkey.meta.stats)
        policy.forward({**doorkey_batch, "observation.images.top": torch.zeros(8, 10, 3, 84, 84)})
        policy.eval().select_action(
            {"observation.state": torch.zeros(1, 2), "observation.images.top": torch.zeros(1, 3, 84, 84)}
        )
    assert list(policy.factors) == ["s", "a", "rtg"]
    (record,) = caplog.records
    assert "observation.images.top" in record.getMessage()
    assert "decodes" in record.getMessage()


def test_updates_are_counted_and_change_the_masks(tiny_policy, doorkey_batch):
    policy = tiny_policy().train()
    losses = []
    for _ in range(3):
        losses.append(policy.forward(doorkey_batch)[0].item())
        assert policy.forward(doorkey_batch)[0].item() == losses[-1]  # asking for a loss is not an update
        policy.update()
    assert policy.updates.item() == 3
    assert len(set(losses)) == 3


def test_validation_masks_are_the_same_at_every_update(tiny_policy, doorkey_batch):
    policy = tiny_policy().eval()
    before = policy.forward(doorkey_batch)[0]
    for _ in range(3):
        policy.update()
    assert torch.equal(policy.forward(doorkey_batch)[0], before)
    policy.train()
    assert not torch.equal(policy.forward(doorkey_batch)[0], before)


def test_the_loss_is_the_weighted_sum_of_its_parts(tiny_policy, doorkey_batch):
    loss, parts = tiny_policy(loss_weights={"s": 0.25}).forward(doorkey_batch)
    assert loss.item() == pytest.approx(0.25 * parts["loss_s"] + parts["loss_a"], rel=1e-5)


class OnOneDevice(TorchDispatchMode):
    """Fails where an operation reads or makes a tensor that is not on this device."""

    def __init__(self, device):
        super().__init__()
        self.device = device

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        tensors = [leaf for leaf in tree_leaves((args, kwargs, result)) if isinstance(leaf, torch.Tensor)]
        assert all(tensor.device.type == self.device for tensor in tensors), function
        return result


@pytest.mark.parametrize("causal_draw", ["window", "update"])
@pytest.mark.parametrize("masks", ["random_mask", ["multi_task", "random_mask"]])
def test_between_batch_and_gradient_nothing_crosses_between_host_and_device(
    tiny_policy, kind, batch_of, masks, causal_draw, monkeypatch
):
    """On PyTorch's meta device, whose tensors hold no values: reading one on the host is an error there."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # knows no meta device
    policy = tiny_policy(kind, training_masks=masks, causal_draw=causal_draw).to("meta").train()
    batch = {key: value.to("meta") for key, value in batch_of(kind).items() if isinstance(value, torch.Tensor)}
    with OnOneDevice("meta"):
        loss, parts = policy(batch)
        loss.backward()
    assert set(parts) == {"loss_s", "loss_a"}
    with pytest.raises(RuntimeError, match="meta"), OnOneDevice("meta"):  # what the test is made to find
        loss.item()


def test_the_parts_of_a_loss_survive_mixed_precisions_wrapper(tiny_policy, doorkey_batch):
    """accelerate makes anew each mapping that a model returns."""
    from accelerate.utils import convert_outputs_to_fp32

    policy = tiny_policy()
    plain, wrapped = policy(doorkey_batch)[1], convert_outputs_to_fp32(policy.forward)(doorkey_batch)[1]
    assert dict(plain) == dict(wrapped)
    assert all(isinstance(part, float) for part in plain.values())


def test_padding_does_not_matter_to_the_loss(tiny_policy, continuous_batch):
    policy = tiny_policy("continuous").train()
    spoiled = dict(continuous_batch)
    for key in ("observation.state", "action", "observation.return_to_go"):
        spoiled[key] = spoiled[key].clone()
        spoiled[key][4, 4:] = torch.nan
    for _ in range(5):
        loss = policy.forward(spoiled)[0]
        assert torch.equal(loss, policy.forward(continuous_batch)[0])
        loss.backward()
        policy.update()
    assert all(parameter.grad.isfinite().all() for parameter in policy.parameters())


def test_a_split_batch_sees_the_same_masks(tiny_policy, doorkey_batch, monkeypatch):
    """However a batch is split over processes, a window is masked by its frame's index."""
    policy, drawn = tiny_policy().train(), []
    monkeypatch.setattr(
        TrainingMasks,
        "forward",
        lambda self, *args, _f=TrainingMasks.forward, **kwargs: drawn.append(_f(self, *args, **kwargs)) or drawn[-1],
    )
    policy.forward(doorkey_batch)
    policy.forward({key: value[3:5] for key, value in doorkey_batch.items()})
    assert drawn[1].draw(0) == drawn[0].draw(3)
    assert drawn[1].draw(1) == drawn[0].draw(4)
    assert drawn[0].draw(3) != drawn[0].draw(4)


def test_training_lowers_the_loss(tiny_policy, doorkey_batch):
    policy = tiny_policy(training_masks="s[1] | s[0], a[0]").train()
    optimiser = torch.optim.AdamW(policy.get_optim_params(), lr=1e-2)
    losses = []
    for _ in range(60):
        loss, _ = policy.forward(doorkey_batch)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        policy.update()
        losses.append(loss.item())
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])


# --- What does not fit -----------------------------------------------------------------------------------------------


def test_a_dataset_without_actions_or_states_is_refused(doorkey, tiny_policy):
    for key in ("action", "observation.state"):
        features = {name: entry for name, entry in doorkey.meta.features.items() if name != key}
        with pytest.raises(ValueError, match=f"no '{key}'"):
            tiny_policy(features=features)
        config = UniMASKConfig(device="cpu")
        config.input_features, config.output_features = declared_features(features)
        with pytest.raises(ValueError, match=f"no '{key}'"):
            UniMASKPolicy(config)


def without_return(doorkey):
    return {key: entry for key, entry in doorkey.meta.features.items() if key != "observation.return_to_go"}


def test_without_a_return_column_there_is_no_return_factor(doorkey, tiny_policy, doorkey_batch):
    policy = tiny_policy(features=without_return(doorkey))
    assert list(policy.factors) == ["s", "a"]
    batch = {key: value for key, value in doorkey_batch.items() if "return" not in key and key != "timestamp"}
    assert policy.forward(batch)[0].isfinite()
    with pytest.raises(ValueError, match=r"target_return is 5.*no return factor"):
        tiny_policy(features=without_return(doorkey), target_return=5)
    for setting in ({"inference_mask": "reward_conditioned"}, {"training_masks": ["past", "reward_conditioned"]}):
        with pytest.raises(MaskError, match="no factor 'rtg'"):
            tiny_policy(features=without_return(doorkey), **setting)


@pytest.mark.parametrize(
    "mask", ["past", "forward_dynamics", "s[t] | a[:t]", "a[t-1] | s[t]", "a[3] | s[0]", "a[t+1] | s[t]"]
)
def test_acting_needs_a_question_about_the_action_now(tiny_policy, mask):
    with pytest.raises(MaskError, match=r"asks for a\[t\]"):
        tiny_policy(inference_mask=mask)
    policy = tiny_policy()
    with pytest.raises(MaskError, match=r"asks for a\[t\]"):
        policy.select_action({"observation.state": torch.zeros(1, 2)}, mask=mask)


def test_only_states_and_actions_have_a_loss(tiny_policy):
    with pytest.raises(ValueError, match=r"loss_weights names rtg"):
        tiny_policy(loss_weights={"rtg": 1.0})


@pytest.mark.parametrize(
    "observation", [{}, {"observation.state": torch.zeros(3, 4)}, {"observation.state": torch.zeros(2)}]
)
def test_other_observations_are_refused(tiny_policy, observation):
    with pytest.raises(ValueError, match=r"observes 'observation\.state' with 2 numbers"):
        tiny_policy().select_action(observation)


# --- Asking ----------------------------------------------------------------------------------------------------------


def random_question(policy, batch, seed):
    """(window, mask): random masking over a batch's windows."""
    window = policy.make_window(batch)
    drawer = TrainingMasks("random_mask", tuple(policy.factors), policy.config.context_length)
    return window, drawer(window.valid, torch.arange(len(window.valid)), seed=0, step=seed)


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
                if distribution.scale is not None:
                    assert (distribution.scale[shown] == 0).all()
                    assert (distribution.scale[asked] > 0).all()
                    assert distribution.scale[~shown & ~asked].isnan().all()
                assert (distribution.scale is not None) == (kind == "gaussian")
                if distribution.probabilities is None:
                    continue
                total = distribution.probabilities.sum(-1)
                torch.testing.assert_close(total[shown | asked], torch.ones_like(total[shown | asked]))
                assert (distribution.probabilities[shown].amax(-1) == 1).all()
                assert (distribution.probabilities[asked] > 0).all()
                assert distribution.probabilities[~shown & ~asked].isnan().all()


def test_a_token_asked_alone_or_among_others_has_the_same_marginal(kind, layout, tiny_policy, batch_of):
    policy, batch = tiny_policy(kind, **LAYOUTS[layout]), batch_of(kind)
    together = policy.infer(batch, "s[1:], a[:] | s[0]")
    for step in range(10):
        alone = policy.infer(batch, f"a[{step}] | s[0]")
        for one, among in zip(alone["a"], together["a"], strict=True):
            for field in ("probabilities", "mean", "scale"):
                if getattr(one, field) is not None:
                    value, other = getattr(one, field)[:, step], getattr(among, field)[:, step]
                    assert torch.equal(value.nan_to_num(-99), other.nan_to_num(-99))


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
    with pytest.raises(ValueError, match=r"shows s\[-1\]|shows s\[9\]"):
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
    with pytest.raises(ValueError, match="key_cell is a category from 0 to 15"):
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


# --- Acting ----------------------------------------------------------------------------------------------------------


class Episode:
    """Observations of B environments over T steps, the return received so far, and what was done at each step."""

    def __init__(self, kind, B, T):
        generator = torch.Generator().manual_seed(3)
        if kind == "doorkey":
            self.states = torch.randint(0, 16, (T, B, 2), generator=generator).float()
        else:
            mean, std = (torch.tensor(CONTINUOUS_STATS["observation.state"][key]) for key in ("mean", "std"))
            self.states = mean + std * torch.randn(T, B, 3, generator=generator)
        self.received = torch.randn(T, B, 1, generator=generator).cumsum(0)
        self.received[0] = 0
        self.action_size = 1 if kind == "doorkey" else 2
        self.actions = []

    def observation(self, step):
        return {"observation.state": self.states[step], "observation.return_so_far": self.received[step]}

    def window(self, step, K, fps):
        """(batch, first step, position of the present): what a dataset would have recorded of the window in which
        `step` is the present, under LeRobot's keys, NaN for all that has not happened."""
        first = max(0, step - K + 1)
        B, D = self.states.shape[1:]
        state = torch.full((B, K, D), torch.nan)
        action = torch.full((B, K, self.action_size), torch.nan)
        for k in range(step - first + 1):
            state[:, k] = self.states[first + k]
            if first + k < step:
                action[:, k] = self.actions[first + k].float()
        batch = {
            "observation.state": state,
            "action": action,
            "observation.return_to_go": torch.full((B, K), torch.nan),
        }
        batch["timestamp"] = torch.full((B,), first / fps)
        return batch, first, step - first


@pytest.mark.parametrize("K", [1, 4, 20])
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
        sampled = kind != "continuous"  # so that the whole distribution has a say in what happens
        action = policy.select_action(episode.observation(step), sample=sampled)

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


def test_the_most_likely_action_is_the_default(tiny_policy):
    policy = tiny_policy()
    state = torch.tensor([[1.0, 2.0], [7.0, 3.0]])
    action = policy.select_action({"observation.state": state})
    batch = {
        "observation.state": torch.zeros(2, 10, 2),
        "action": torch.zeros(2, 10),
        "observation.return_to_go": torch.zeros(2, 10),
    }
    batch["observation.state"][:, 0] = state
    probabilities = policy.infer(batch, "behavior_cloning", t=0)["a"][0].probabilities[:, 0]
    assert action[:, 0].tolist() == probabilities.argmax(-1).tolist()


def test_actions_can_be_sampled(tiny_policy):
    state = {"observation.state": torch.tensor([[1.0, 2.0]]).expand(4000, 2)}
    policy = tiny_policy()
    best = policy.select_action(state)
    assert (best == best[0]).all()
    policy.reset()
    torch.manual_seed(0)
    drawn = policy.select_action(state, sample=True)[:, 0]
    policy.reset()
    answer = policy.infer(None, "behavior_cloning", t=0, given={"s[0]": [1, 2]})
    expected = 4000 * answer["a"][0].probabilities[0, 0]
    counts = drawn.bincount(minlength=4).float()
    assert ((counts - expected).square() / expected).sum() < 35  # three degrees of freedom
    by_config = tiny_policy(sample_actions=True)
    torch.manual_seed(0)
    assert torch.equal(by_config.select_action(state)[:, 0], drawn)
    by_config.reset()
    assert torch.equal(by_config.select_action(state, sample=False), best)


def roll(policy, states, **how):
    policy.reset()
    return torch.stack([policy.select_action({"observation.state": state}, **how) for state in states])


@pytest.fixture
def states():
    """Six steps of four environments."""
    return Episode("continuous", 4, 6).states


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
        with pytest.raises(ValueError, match=rf"shows {token}.*neither observed nor given"):
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


def test_the_target_shrinks_by_what_was_received_before_the_window(tiny_policy):
    policy = tiny_policy("continuous", context_length=3, inference_mask="reward_conditioned", target_return=40.0)
    episode = Episode("continuous", 4, 7)
    for step in range(7):
        action = policy.select_action(episode.observation(step))
        window = policy._memory.window(policy.statistics.horizon)
        assert policy._memory.first_step == max(0, step - 2)
        torch.testing.assert_close(
            window.values["rtg"][:, 0, 1], torch.full((4,), max(0, step - 2) / policy.statistics.horizon.item())
        )
        assert action.isfinite().all()
    policy.reset()
    for step in range(3):  # the whole episode is in the window: what was received is not needed yet
        policy.select_action({"observation.state": episode.states[step]})
    with pytest.raises(ValueError, match=r"observation\.return_so_far"):
        policy.select_action({"observation.state": episode.states[3]})


# --- Checkpoints -----------------------------------------------------------------------------------------------------


def test_a_loaded_policy_gives_the_same_answers(kind, layout, tiny_policy, batch_of, tmp_path, states):
    policy, batch = tiny_policy(kind, **LAYOUTS[layout], training_masks=["multi_task", "random_mask"]), batch_of(kind)
    for _ in range(5):
        policy.update()
    policy.save_pretrained(tmp_path)
    loaded = UniMASKPolicy.from_pretrained(tmp_path)
    assert not loaded.training
    assert loaded.updates.item() == 5
    assert loaded.config.features == policy.config.features
    assert_same_answers(loaded.infer(batch, "future", t=3), policy.infer(batch, "future", t=3))
    if kind != "doorkey":
        assert torch.equal(roll(loaded, states), roll(policy, states))
    assert torch.equal(loaded.train().forward(batch)[0], policy.train().forward(batch)[0])  # the masks go on, too


def test_training_masks_after_a_restart_are_those_of_an_uninterrupted_run(tiny_policy, doorkey_batch, tmp_path):
    def losses(policy, count):
        optimiser = torch.optim.SGD(policy.parameters(), lr=0.1)
        policy.train()
        seen = []
        for _ in range(count):
            loss, _ = policy.forward(doorkey_batch)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            policy.update()
            seen.append(loss.item())
        return seen

    uninterrupted = losses(tiny_policy(), 6)
    policy = tiny_policy()
    first = losses(policy, 3)
    policy.save_pretrained(tmp_path)
    torch.manual_seed(99)
    assert first + losses(UniMASKPolicy.from_pretrained(tmp_path), 3) == uninterrupted


def spoil(folder, change):
    weights = load_file(folder / "model.safetensors")
    change(weights)
    save_file(weights, folder / "model.safetensors")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w: w.pop("network.norm.weight"), r"missing network\.norm\.weight"),
        (lambda w: w.pop("statistics.a_mean"), r"missing statistics\.a_mean"),
        (lambda w: w.update(surplus=torch.zeros(1)), "extra surplus"),
        (
            lambda w: w.update({"network.positions": torch.zeros(7, 16)}),
            r"network\.positions has shape \(7, 16\) instead of",
        ),
    ],
)
def test_other_weights_are_refused_by_name(tiny_policy, tmp_path, change, message):
    tiny_policy().save_pretrained(tmp_path)
    spoil(tmp_path, change)
    for strict in (True, False):
        with pytest.raises(ValueError, match=message):
            UniMASKPolicy.from_pretrained(tmp_path, strict=strict)


def test_every_fault_of_the_weights_is_named_at_once(tiny_policy, tmp_path):
    tiny_policy().save_pretrained(tmp_path)
    spoil(tmp_path, lambda w: (w.pop("updates"), w.update(surplus=torch.zeros(1))))
    with pytest.raises(ValueError, match=r"missing updates; extra surplus"):
        UniMASKPolicy.from_pretrained(tmp_path)


def test_a_truncated_or_absent_file_is_refused(tiny_policy, tmp_path):
    tiny_policy().save_pretrained(tmp_path)
    file = tmp_path / "model.safetensors"
    content = file.read_bytes()
    for length in (len(content) - 100, 20, 0):
        file.write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"model\.safetensors cannot be read"):
            UniMASKPolicy.from_pretrained(tmp_path)
    file.unlink()
    with pytest.raises(ValueError, match=r"model\.safetensors cannot be read"):
        UniMASKPolicy.from_pretrained(tmp_path)


RESCALED = {
    key: {name: [10 * number for number in numbers] for name, numbers in entry.items()}
    for key, entry in CONTINUOUS_STATS.items()
}


def test_fine_tuning_takes_the_new_datasets_statistics(tiny_policy, tmp_path, continuous_batch):
    policy = tiny_policy("continuous")
    policy.save_pretrained(tmp_path)
    kept = UniMASKPolicy.from_pretrained(tmp_path)
    assert torch.equal(kept.statistics.s_mean, policy.statistics.s_mean)
    stats = RESCALED | {"frame_index": {"max": [49.0]}, "timestamp": {"max": [4.9]}}
    tuned = UniMASKPolicy.from_pretrained(tmp_path, dataset_stats=stats)
    torch.testing.assert_close(tuned.statistics.s_mean, 10 * policy.statistics.s_mean)
    torch.testing.assert_close(tuned.statistics.a_std, 10 * policy.statistics.a_std)
    # The same windows in other units have the same answers in those units. (A constant is not scaled.)
    rescaled = {key: 10 * value if key in CONTINUOUS_FEATURES else value for key, value in continuous_batch.items()}
    rescaled["observation.state"][..., 2] = 5.0 + (continuous_batch["observation.state"][..., 2] - 0.5)
    before = policy.infer(continuous_batch, "a[:] | s[0], s[-1], rtg[0]").most_likely("a")
    after = tuned.infer(rescaled, "a[:] | s[0], s[-1], rtg[0]").most_likely("a")
    torch.testing.assert_close(after.nan_to_num(0), 10 * before.nan_to_num(0), rtol=1e-4, atol=1e-3)


def test_make_policy_goes_on_from_a_checkpoint(tiny_policy, doorkey, tmp_path):
    tiny_policy().save_pretrained(tmp_path)
    config = UniMASKConfig.from_pretrained(tmp_path)
    config.pretrained_path = tmp_path
    policy = make_policy(config, ds_meta=doorkey.meta)
    assert policy.config.features == tiny_policy().config.features
    assert torch.equal(policy.network.positions, tiny_policy().network.positions)


def test_at_evaluation_the_environment_does_not_change_the_model(tiny_policy, tmp_path):
    from lerobot_unimask.envs.configs import DoorKeyEnvConfig

    tiny_policy().save_pretrained(tmp_path)
    config = UniMASKConfig.from_pretrained(tmp_path)
    config.pretrained_path = tmp_path
    policy = make_policy(config, env_cfg=DoorKeyEnvConfig())
    assert list(policy.factors) == ["s", "a", "rtg"]
    assert policy.config.output_features["action"] == PolicyFeature(FeatureType.ACTION, (1,))
    assert policy.select_action({"observation.state": torch.zeros(2, 2)}).dtype == torch.int64


def test_a_checkpoint_says_what_it_is_in_plain_json(tiny_policy, tmp_path):
    tiny_policy(training_masks={"past": 2.0, "random_mask": 1.0}).save_pretrained(tmp_path)
    stored = json.loads((tmp_path / "config.json").read_text())
    assert stored["type"] == "unimask"
    assert stored["training_masks"] == {"past": 2.0, "random_mask": 1.0}
    assert stored["features"]["s"] == [
        {"key": "observation.state", "size": 2, "categories": [16, 16], "names": ["agent_cell", "key_cell"]}
    ]


# --- What is given and what is asked belong together -----------------------------------------------------------------


def test_given_and_target_return_cannot_both_name_the_return(tiny_policy):
    with pytest.raises(ValueError, match="both name rtg"):
        tiny_policy(inference_mask="reward_conditioned", target_return=5.0, given={"rtg[0]": 4.0})


@pytest.mark.parametrize(
    "settings",
    [
        {"target_return": 6.0},
        {"given": {"rtg[0]": 6.0}},
        {"inference_mask": "a[t] | s[t]", "given": {"rtg[0]": 6.0}},
    ],
)
def test_a_value_that_the_inference_mask_never_shows_is_refused_when_the_policy_is_made(tiny_policy, settings):
    with pytest.raises(ValueError, match=r"is given, but the mask does not show it"):
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


def test_samples_of_a_window_stand_together_and_given_rows_make_a_batch(tiny_policy):
    policy = tiny_policy()
    drawn = policy.sample(None, "s[1], a[0] | s[0]", given={"s[0]": [[5, 0], [9, 4]]}, samples=3)
    assert drawn.values["s"][:, 0].tolist() == [[5, 0]] * 3 + [[9, 4]] * 3
    assert not drawn.values["s"][:, 1].isnan().any()
    assert drawn.values["s"][:, 2].isnan().all()


def test_the_automatic_target_is_what_the_nearest_training_episode_returned(tiny_policy):
    policy = tiny_policy(inference_mask="reward_conditioned", target_return="auto", target_return_scale=2.0)
    with pytest.raises(ValueError, match="keeps no"):
        policy.select_action({"observation.state": torch.tensor([[5.0, 0.0]])})
    policy.reset()
    policy.episode_starts.fill(torch.tensor([[5.0, 0.0], [12.0, 1.0]]), torch.tensor([3.0, -1.0]))
    policy.select_action({"observation.state": torch.tensor([[11.0, 1.0], [5.0, 1.0]])})
    assert policy._memory.target_return.tolist() == [[-2.0], [6.0]]
    policy.reset()
    policy.target_return = lambda state: state.sum(1)
    policy.select_action({"observation.state": torch.tensor([[11.0, 1.0], [5.0, 1.0]])})
    assert policy._memory.target_return.tolist() == [[12.0], [6.0]]


def test_a_checkpoint_keeps_how_its_training_episodes_began(tmp_path, doorkey_root, tiny_policy):
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.policies.factory import make_policy

    meta = LeRobotDatasetMetadata("local/doorkey", root=doorkey_root)
    config = tiny_policy(target_return="auto", inference_mask="reward_conditioned").config
    config.features = {}
    make_policy(config, ds_meta=meta).save_pretrained(tmp_path)
    loaded = UniMASKPolicy.from_pretrained(tmp_path)
    dataset = LeRobotDataset("local/doorkey", root=doorkey_root)
    firsts = [dataset[start] for start in meta.episodes["dataset_from_index"]]
    torch.testing.assert_close(
        loaded.episode_starts.states, torch.stack([f["observation.state"] for f in firsts]).float()
    )
    torch.testing.assert_close(
        loaded.episode_starts.returns, torch.stack([f["observation.return_to_go"] for f in firsts]).flatten()
    )


# --- What an independent reviewer broke ------------------------------------------------------------------------------


def test_acting_goes_on_outside_inference_mode(tiny_policy):
    policy, state = tiny_policy(context_length=2), {"observation.state": torch.tensor([[5.0, 0.0]])}
    with torch.inference_mode():
        policy.select_action(state)
        policy.select_action(state)
    assert policy.select_action(state).shape == (1, 1)
    with torch.inference_mode():
        assert policy.select_action(state).shape == (1, 1)


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


def test_statistics_arrive_on_the_models_device(tiny_policy):
    """The arithmetic of `fill` on another device than the dataset's; `meta` stands in for a GPU."""
    policy = tiny_policy("continuous").to("meta")
    stats = {key: value for key, value in CONTINUOUS_STATS.items() if key not in ("frame_index", "timestamp")}
    policy.statistics.fill(stats)
    assert policy.statistics.get_buffer("s_mean").device.type == "meta"


def test_categories_that_the_data_exceed_are_refused(tiny_policy):
    with pytest.raises(ValueError, match=r"observation\.state reaches \[16\.0, 3\.0\]"):
        tiny_policy().statistics.fill({"observation.state": {"max": [16, 3]}})


def test_an_inference_mask_that_needs_values_says_so_when_the_policy_is_made(tiny_policy, caplog):
    tiny_policy(inference_mask="reward_conditioned")
    assert "shows rtg[0] before a rollout has observed it" in caplog.text
    caplog.clear()
    tiny_policy(inference_mask="reward_conditioned", target_return=3.0)
    assert not caplog.text


def test_multi_task_goes_without_the_return_where_there_is_none():
    assert len(mixture("multi_task", ("s", "a", "rtg"))) == 8
    weights = mixture("multi_task", ("s", "a"))
    assert "reward_conditioned" not in weights
    assert sum(weights.values()) == pytest.approx(1)
    with pytest.raises(MaskError, match="no factor 'rtg'"):
        TrainingMasks("reward_conditioned", ("s", "a"), 4)


def test_a_config_that_was_used_makes_a_policy_without_memories(tiny_policy, doorkey_root):
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.policies.factory import make_policy

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


# --- Attention -------------------------------------------------------------------------------------------------------


def test_a_model_that_attends_causally_alone_refuses_what_it_has_not_learnt(tiny_policy, doorkey_batch):
    policy = tiny_policy(attention="causal", training_masks=["behavior_cloning", "reward_conditioned"])
    answer = policy.infer(doorkey_batch, "reward_conditioned", t=3)["a"][0].probabilities[:, 3]
    assert torch.equal(answer.isfinite().all(1), policy.make_window(doorkey_batch).valid[:, 3])
    with pytest.raises(MaskError, match=r"attends causally alone\. It was trained on behavior_cloning, reward_conditi"):
        policy.infer(doorkey_batch, "goal_conditioned", t=3)
    with pytest.raises(MaskError, match="trained on questions that ask for one token"):
        tiny_policy(attention="causal", training_masks="past")


def test_both_directions_train_the_same_weights_and_answer_with_them(tiny_policy, doorkey_batch):
    """The next action of a full history comes from the causal reading, everything else from the other."""
    policy = tiny_policy(attention="both")
    window = policy.make_window(doorkey_batch)
    full = window.valid.all(1)
    window = Window({name: value[full] for name, value in window.values.items()}, window.valid[full])
    normalised = policy.statistics.normalise(window)
    for task, causal in (("behavior_cloning", True), ("goal_conditioned", False)):
        mask = policy._table(task).at(3, len(window.valid))
        logits = policy.network(normalised, mask.shown, causal)["a"][0][:, 3]
        answer = policy.infer(window, task, t=3)["a"][0].probabilities[:, 3]
        torch.testing.assert_close(answer, logits.softmax(-1))


# --- Properties and given tokens in rollouts -------------------------------------------------------------------------

WITH_CORNER = {
    **CONTINUOUS_FEATURES,
    "observation.corner": {"dtype": "int64", "shape": (1,), "names": None, "categories": [2]},
}


def test_a_property_is_read_from_the_batch_and_never_predicted(tiny_policy, continuous_batch):
    policy = tiny_policy("continuous", features=WITH_CORNER, properties=["observation.corner"])
    corner = torch.tensor([0, 1, 0, 1, 1])
    batch = continuous_batch | {"observation.corner": corner[:, None].expand(-1, 10)}
    assert list(policy.factors) == ["s", "a", "rtg", "corner"]
    assert torch.equal(policy.make_window(batch).values["corner"][:, 0, 0], corner.float())
    loss, parts = policy.train().forward(batch)
    loss.backward()
    assert parts.keys() == {"loss_s", "loss_a"}
    policy.eval()
    asked = policy.infer(batch, "a[1] | s[0], corner[0]").most_likely("a")[:, 1]
    turned = policy.infer(batch, "a[1] | s[0], corner[0]", given={"corner[0]": (1 - corner)[:, None]})
    assert not torch.allclose(asked, turned.most_likely("a")[:, 1])
    with pytest.raises(MaskError, match="can be shown but never asked"):
        policy.infer(batch, "corner[0] | s[0]")


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
