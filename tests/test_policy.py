"""The policy: LeRobot's contract and training."""

import copy
from contextlib import nullcontext

import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.feature_utils import dataset_to_policy_features
from policies import CONTINUOUS_STATS, SMALL, assert_same_answers, assert_unchanged, without_return
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from lerobot_unimask import MaskError, UniMASKPolicy


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
    observation = {"observation.state": torch.zeros(2, 6), "observation.images.laptop": torch.zeros(2, 3, 84, 84)}
    assert policy.eval().select_action(observation).shape == (2, 6)


def test_make_policy_reads_a_datasets_metadata(doorkey, doorkey_batch):
    config = make_policy_config("unimask", device="cpu", **SMALL)
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
    assert loss.item() == pytest.approx(parts["loss_s"] + parts["loss_a"] + parts["loss_rtg"] / 10, rel=1e-5)
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
    expected = 0.25 * parts["loss_s"] + parts["loss_a"] + parts["loss_rtg"] / 10
    assert loss.item() == pytest.approx(expected, rel=1e-5)


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


@pytest.mark.parametrize("masks", ["random_mask", ["multi_task", "random_mask"]])
def test_between_batch_and_gradient_nothing_crosses_between_host_and_device(
    tiny_policy, kind, batch_of, masks, monkeypatch
):
    """On PyTorch's meta device, whose tensors hold no values: reading one on the host is an error there."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # knows no meta device
    policy = tiny_policy(kind, training_masks=masks).to("meta").train()
    batch = {key: value.to("meta") for key, value in batch_of(kind).items() if isinstance(value, torch.Tensor)}
    with OnOneDevice("meta"):
        loss, parts = policy(batch)
        loss.backward()
    assert set(parts) == {"loss_s", "loss_a", "loss_rtg"}
    with pytest.raises(RuntimeError, match="meta"), OnOneDevice("meta"):  # what the test is made to find
        loss.item()


def test_the_parts_of_a_loss_survive_mixed_precisions_wrapper(tiny_policy, doorkey_batch):
    """accelerate makes anew each mapping that a model returns."""
    from accelerate.utils import convert_outputs_to_fp32

    policy = tiny_policy()
    plain, wrapped = policy(doorkey_batch)[1], convert_outputs_to_fp32(policy.forward)(doorkey_batch)[1]
    assert dict(plain) == dict(wrapped)
    assert all(isinstance(part, float) for part in plain.values())


def test_a_policy_with_a_mixture_learns_is_saved_answers_draws_and_acts(tiny_policy, continuous_batch, tmp_path):
    policy = tiny_policy("gaussian", continuous_head="mixture", mixture_components=3)
    policy.train()
    optimiser = torch.optim.Adam(policy.parameters(), lr=1e-2)
    losses = []
    for _ in range(20):
        loss, _ = policy.forward(continuous_batch)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
    policy.save_pretrained(tmp_path)
    loaded = UniMASKPolicy.from_pretrained(tmp_path)
    assert_same_answers(*(one.eval().infer(continuous_batch, "future", t=3) for one in (policy, loaded)))
    drawn = loaded.sample(continuous_batch, "s[3] | s[:3]", samples=2).values["s"][:, 3]
    assert drawn.isfinite().all()
    observation = {"observation.state": continuous_batch["observation.state"][:, 0]}
    assert loaded.select_action(observation).shape == (5, 2)


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


def test_without_a_return_column_there_is_no_return_factor(doorkey, tiny_policy, doorkey_batch):
    policy = tiny_policy(features=without_return(doorkey))
    assert list(policy.factors) == ["s", "a"]
    batch = {key: value for key, value in doorkey_batch.items() if "return" not in key and key != "timestamp"}
    assert policy.forward(batch)[0].isfinite()
    with pytest.raises(ValueError, match="target_return is 5"):
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


@pytest.mark.parametrize(
    "observation", [{}, {"observation.state": torch.zeros(3, 4)}, {"observation.state": torch.zeros(3)}]
)
def test_other_observations_are_refused(tiny_policy, observation):
    with pytest.raises(ValueError, match=r"observation\.state.* 2 "):
        tiny_policy().select_action(observation)


def test_statistics_arrive_on_the_models_device(tiny_policy):
    """The arithmetic of `fill` on another device than the dataset's; `meta` stands in for a GPU."""
    policy = tiny_policy("continuous").to("meta")
    stats = {key: value for key, value in CONTINUOUS_STATS.items() if key not in ("frame_index", "timestamp")}
    policy.statistics.fill(stats)
    assert policy.statistics.get_buffer("s_mean").device.type == "meta"


def test_categories_that_the_data_exceed_are_refused(tiny_policy):
    with pytest.raises(ValueError, match=r"observation\.state.*\[16\.0, 3\.0\]"):
        tiny_policy().statistics.fill({"observation.state": {"max": [16, 3]}})
