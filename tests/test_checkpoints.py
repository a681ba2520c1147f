"""Checkpoints: saved, loaded, refused, gone on with."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_policy
from policies import CONTINUOUS_FEATURES, CONTINUOUS_STATS, LAYOUTS, SMALL, assert_same_answers, random_question, roll
from safetensors.torch import load_file, save_file

from lerobot_unimask import UniMASKConfig, UniMASKPolicy
from lerobot_unimask.data.checkpoints import checkpoints_of, last_checkpoint
from lerobot_unimask.data.factors import Feature


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
        (lambda w: w.update({"network.positions": torch.zeros(7, 16)}), r"network\.positions has shape \(7, 16\) in"),
        (lambda w: (w.pop("updates"), w.update(surplus=torch.zeros(1))), "missing updates; extra surplus"),
    ],
)
def test_other_weights_are_refused_by_name(tiny_policy, tmp_path, change, message):
    tiny_policy().save_pretrained(tmp_path)
    spoil(tmp_path, change)
    for strict in (True, False):
        with pytest.raises(ValueError, match=message):
            UniMASKPolicy.from_pretrained(tmp_path, strict=strict)


def filled(value, *names, dtype=None):
    """A change of the weights: tensors with a value in their first place, or of another type."""

    def change(weights):
        for name in names:
            tensor = weights[name].clone() if dtype is None else weights[name].to(dtype)
            if value is not None:
                tensor.view(-1)[0] = value
            weights[name] = tensor

    return change


LAYER, STD = "network.norm.weight", "statistics.a_std"
UNSOUND = {
    "NaN": (LAYER, filled(float("nan"), LAYER), "not finite"),
    "infinity": (LAYER, filled(float("inf"), LAYER), "not finite"),
    "minus infinity": (LAYER, filled(float("-inf"), LAYER), "not finite"),
    "too large for float32": (LAYER, filled(1e300, LAYER, dtype=torch.float64), "not finite"),
    "int32": (LAYER, filled(None, LAYER, dtype=torch.int32), "has type torch.int32 instead of torch.float32"),
    "bool": (LAYER, filled(None, LAYER, dtype=torch.bool), "has type torch.bool instead of torch.float32"),
    "complex": (LAYER, filled(None, LAYER, dtype=torch.complex64), "has type torch.complex64"),
    "fractions of an update": ("updates", filled(None, "updates", dtype=torch.float32), "has type torch.float32"),
    "negative updates": ("updates", filled(-1, "updates"), "negative"),
    "a NaN mean": ("statistics.s_mean", filled(float("nan"), "statistics.s_mean"), "not finite"),
    "a deviation of 0": (STD, filled(0, STD), "not positive"),
    "a negative deviation": (STD, filled(-1, STD), "not positive"),
    "a return's deviation of 0": ("statistics.rtg_std", filled(0, "statistics.rtg_std"), "not positive"),
    "a horizon of 0": ("statistics.horizon", filled(0, "statistics.horizon"), "not positive"),
    "no frames a second": ("statistics.fps", filled(0, "statistics.fps"), "not positive"),
}


@pytest.mark.parametrize(("name", "change", "words"), UNSOUND.values(), ids=UNSOUND)
def test_unsound_weights_do_not_load(tiny_policy, tmp_path, name, change, words):
    tiny_policy("gaussian").save_pretrained(tmp_path)
    spoil(tmp_path, change)
    with pytest.raises(ValueError, match=f"{name} .*{words}"):
        UniMASKPolicy.from_pretrained(tmp_path)


@pytest.fixture
def run(tiny_policy, tmp_path):
    """A training run of three checkpoints, `last` pointing to the third; the folders' names sort otherwise as text."""
    for updates in (500000, 900000, 1000000):
        policy = tiny_policy()
        policy.updates.fill_(updates)
        policy.save_pretrained(tmp_path / "checkpoints" / str(updates) / "pretrained_model")
    (tmp_path / "checkpoints" / "last").symlink_to("1000000")
    return tmp_path


@pytest.mark.parametrize("last", [True, False], ids=["with last", "without last"])
@pytest.mark.parametrize("file", ["model.safetensors", "config.json"])
@pytest.mark.parametrize("written", [None, 0, 100], ids=["absent", "empty", "begun"])
def test_a_checkpoint_that_was_being_written_is_never_taken(run, file, written, last):
    if file == "config.json" and written is not None and not last:
        pytest.skip("LeRobot writes the config before the weights")
    newest = run / "checkpoints" / "1000001" / "pretrained_model"
    shutil.copytree(run / "checkpoints" / "900000" / "pretrained_model", newest)
    content = (newest / file).read_bytes()
    (newest / file).unlink()
    if written is not None:
        (newest / file).write_bytes(content[:written])
    if not last:
        (run / "checkpoints" / "last").unlink()
    assert int(UniMASKPolicy.from_pretrained(run).updates) == 1000000
    if file == "model.safetensors" or written is None:
        assert checkpoints_of(run)[-1].parent.name == "1000000"


def test_last_is_followed_to_an_older_checkpoint(run):
    (run / "checkpoints" / "last").unlink()
    (run / "checkpoints" / "last").symlink_to("900000")
    assert last_checkpoint(run).parent.name == "900000"


def test_a_truncated_or_absent_file_is_refused(tiny_policy, tmp_path):
    tiny_policy().save_pretrained(tmp_path)
    file = tmp_path / "model.safetensors"
    content = file.read_bytes()
    for length in (len(content) - 100, 20, 0):
        file.write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"model\.safetensors"):
            UniMASKPolicy.from_pretrained(tmp_path)
    file.unlink()
    with pytest.raises(ValueError, match=r"model\.safetensors"):
        UniMASKPolicy.from_pretrained(tmp_path)


@pytest.mark.parametrize("find", [lambda run: run, lambda run: checkpoints_of(run)[-1]], ids=["a run", "its last"])
def test_an_adapter_is_said_to_be_one(run, find):
    """LeRobot saves a fine-tuning with --peft so."""
    for weights in run.glob("checkpoints/*/*/model.safetensors"):
        weights.rename(weights.with_name("adapter_model.safetensors"))
    with pytest.raises(ValueError, match=r"PEFT adapter.*merge_and_unload"):
        UniMASKPolicy.from_pretrained(find(run))


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


def test_a_checkpoint_keeps_how_its_training_episodes_began(tmp_path, doorkey_root, tiny_policy):
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

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


# --- Checkpoints of format 1 -----------------------------------------------------------------------------------------

FORMAT_1 = sorted((Path(__file__).parent / "data").glob("format1_*"))


def scores(answer):
    return [getattr(d, "probabilities", getattr(d, "mean", None))[0] for name in ("s", "a") for d in answer[name]]


@pytest.mark.parametrize("folder", FORMAT_1, ids=lambda folder: folder.name)
def test_a_checkpoint_of_format_1_gives_the_answers_that_it_gave(folder, tmp_path):
    """Made at commit 48cf38f; saved again, it is one of today's."""
    policy = UniMASKPolicy.from_pretrained(folder)
    policy.save_pretrained(tmp_path)
    again = UniMASKPolicy.from_pretrained(tmp_path)
    for question, expected in json.loads((folder / "answers.json").read_text()).items():
        for loaded in (policy, again):
            answer = loaded.infer(None, question, given=expected["given"])
            for said, before in zip(scores(answer), expected["scores"], strict=True):
                before = torch.tensor([[float("nan") if v is None else v for v in row] for row in before])
                torch.testing.assert_close(said, before, equal_nan=True, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("folder", FORMAT_1, ids=lambda folder: folder.name)
def test_a_checkpoint_of_format_1_acts_with_all_that_its_window_holds(folder):
    """LeRobot's default for n_obs_steps, 1, stands in its config, which nothing read then."""
    policy = UniMASKPolicy.from_pretrained(folder)
    assert policy.config.n_obs_steps is None
    size = policy.factors["s"].size
    states = [torch.full((1, size), value) for value in (1.0, 3.0, 2.0)]
    actions = [policy.select_action({"observation.state": state}, mask="behavior_cloning") for state in states]
    given = {f"s[{k}]": state[0].tolist() for k, state in enumerate(states)}
    given |= {f"a[{k}]": action[0].tolist() for k, action in enumerate(actions[:2])}
    expected = policy.infer(None, "a[2] | s[:3], a[:2]", given=given).most_likely("a")[:, 2]
    torch.testing.assert_close(actions[2].float(), expected, rtol=1e-4, atol=1e-5)


def test_lerobots_own_commands_say_how_to_bring_format_1_up_to_date():
    with pytest.raises(Exception, match="save_pretrained") as raised:
        PreTrainedConfig.from_pretrained(FORMAT_1[0])
    assert "format 1" in str(raised.value)


def test_a_checkpoint_of_format_2_predicts_a_tokens_numbers_separately(tiny_policy, doorkey_batch, tmp_path):
    """It says nothing of discrete heads; LeRobot's own commands read it too."""
    policy = tiny_policy(discrete_head="separate")
    policy.save_pretrained(tmp_path)
    content = json.loads((tmp_path / "config.json").read_text())
    assert content.pop("discrete_head") == "separate"
    (tmp_path / "config.json").write_text(json.dumps(content | {"format_version": 2}))
    loaded = UniMASKPolicy.from_pretrained(tmp_path)
    window, mask = random_question(policy, doorkey_batch, 0)
    assert_same_answers(loaded.infer(window, mask), policy.infer(window, mask))
    config = PreTrainedConfig.from_pretrained(tmp_path)
    assert (config.discrete_head, config.format_version) == ("separate", loaded.config.format_version)
    assert [output.size for output in tiny_policy().factors["s"].outputs] == [256]


@pytest.mark.parametrize("network", ["transformer", "feedforward"])
def test_separate_heads_go_on_as_joint_ones_that_answer_the_same(network, tiny_policy, doorkey_batch, tmp_path):
    policy = tiny_policy(discrete_head="separate", network=network)
    policy.save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    config.discrete_head = "joint"
    loaded = UniMASKPolicy.from_pretrained(tmp_path, config=config).eval()
    assert [output.size for output in loaded.factors["s"].outputs] == [256]
    window, mask = random_question(policy, doorkey_batch, 0)
    assert_same_answers(loaded.infer(window, mask), policy.infer(window, mask), exactly=False)


def test_separate_heads_go_on_as_a_chain_that_answers_the_same(tmp_path):
    features = {"s": [Feature("observation.state", 3, [40, 3, 20])], "a": [Feature("action", 1, [4])]}
    policy = UniMASKPolicy(UniMASKConfig(**SMALL, features=features, discrete_head="separate")).eval()
    policy.save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    config.discrete_head = "joint"
    loaded = UniMASKPolicy.from_pretrained(tmp_path, config=config).eval()
    assert [output.chained for output in loaded.factors["s"].outputs] == [True]
    question = {"mask": "s[1], a[2] | s[0], a[0]", "given": {"s[0]": [39, 1, 5], "a[0]": 3}}
    assert_same_answers(loaded.infer(None, **question), policy.infer(None, **question), exactly=False)


@pytest.mark.parametrize("network", ["transformer", "feedforward"])
def test_gaussians_go_on_as_a_mixture_whose_parts_begin_at_their_means(network, tiny_policy, batch_of, tmp_path):
    """The widest as wide as they are, no two the same."""
    policy = tiny_policy("gaussian", network=network)
    policy.save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    config.continuous_head, config.mixture_components = "mixture", 3
    loaded = UniMASKPolicy.from_pretrained(tmp_path, config=config).eval()
    window, mask = random_question(policy, batch_of("gaussian"), 0)
    before, after = policy.infer(window, mask), loaded.infer(window, mask)
    for name in "sa":
        (mixture,) = after.distributions[name]
        asked = mask.asked[name]
        one = torch.cat([part.means[asked][:, 0] for part in before[name]], dim=-1)  # (M, D)
        wide = torch.cat([part.scales[asked][:, 0] for part in before[name]], dim=-1)
        torch.testing.assert_close(mixture.means[asked], one.unsqueeze(1).expand(-1, 3, -1))
        torch.testing.assert_close(mixture.scales[asked][:, 0], wide)
        assert (mixture.scales[asked].diff(dim=1) < 0).all()
