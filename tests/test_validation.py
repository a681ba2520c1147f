"""Validation losses: equal to a slow computation through `infer`, the same questions for everybody, a full record."""

import json
import math
import sys
from pathlib import Path

import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from policies import without_return

from dataset_builders.doorkey import build_doorkey
from lerobot_unimask import TASKS, UniMASKPolicy
from lerobot_unimask.data.checkpoints import checkpoints_of, episodes_trained_on
from lerobot_unimask.data.episodes import first_windows, open_dataset
from lerobot_unimask.language.masks import RANDOM_MASK
from lerobot_unimask.language.training_masks import VALIDATION_STEP, TrainingMasks
from lerobot_unimask.validation import summary, task_losses, validate

ALL = (*TASKS, RANDOM_MASK)
EPISODES = 30  # of the dataset in conftest


@pytest.fixture(scope="module")
def batch(tiny_policy, doorkey_root):
    return first_windows(open_dataset(tiny_policy().config, doorkey_root))


def scaled(policy: UniMASKPolicy, scale: float) -> UniMASKPolicy:
    """The same policy with other weights."""
    with torch.no_grad():
        for parameter in policy.network.parameters():
            parameter.mul_(scale)
    return policy


# --- The windows -----------------------------------------------------------------------------------------------------


def test_there_is_one_window_for_each_episode_from_its_first_step(batch, doorkey):
    assert batch["index"].tolist() == [10 * episode for episode in range(EPISODES)]
    assert batch["frame_index"].eq(0).all()
    for episode, state in enumerate(batch["observation.state"]):
        torch.testing.assert_close(state, doorkey[10 * episode]["observation.state"])


# --- The losses ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings",
    [
        {"token_layout": "stacked", "attention": "bidirectional"},
        {"token_layout": "separate", "attention": "bidirectional"},
        {"attention": "both"},
    ],
)
def test_a_loss_is_the_mean_surprise_at_the_asked_for_tokens(tiny_policy, batch, settings):
    """Window by window and token by token, through `infer`, which shares neither batching nor the loss."""
    policy = scaled(tiny_policy(**settings), 3.0)  # far from uniform
    losses = task_losses(policy, batch, ALL)
    truth = {"s": batch["observation.state"], "a": batch["action"].reshape(EPISODES, -1, 1)}
    for text in ALL:
        draw = TrainingMasks(text, tuple(policy.factors), policy.config.context_length)
        surprises: dict[tuple[str, int], list[float]] = {}
        for episode in range(EPISODES):
            one = {key: value[episode : episode + 1] for key, value in batch.items() if torch.is_tensor(value)}
            mask = draw(torch.ones(1, 10, dtype=torch.bool), one["index"], seed=0, step=VALIDATION_STEP)
            answer = policy.infer(one, mask)
            for name in ("s", "a"):
                for step in mask.asked[name][0].nonzero().flatten().tolist():
                    for d, part in enumerate(answer[name]):
                        category = int(truth[name][episode, step, d])
                        surprises.setdefault((name, d), []).append(-math.log(part.probabilities[0, step, category]))
        expected = sum(sum(values) / len(values) for values in surprises.values())
        assert losses[text] == pytest.approx(expected, rel=1e-4), text


def test_every_policy_gets_the_same_windows_and_masks(tiny_policy, batch):
    def asked_of(policy: UniMASKPolicy, masks) -> dict[str, list]:
        """mask text -> all values and all shown tokens that the policy was given."""
        given = []
        predict = policy.predict

        def record(window, mask):
            given.append((window, mask.shown))
            return predict(window, mask)

        policy.predict = record
        task_losses(policy, batch, masks)
        return dict(zip(masks, given, strict=True))

    trained = scaled(tiny_policy(mask_seed=7, training_masks="past"), 2.0)
    trained.updates += 1234
    torch.manual_seed(1)
    one = asked_of(tiny_policy(), ALL)
    torch.manual_seed(2)
    other = asked_of(trained, ALL[::-1])  # in another order too
    for text in ALL:
        (window, shown), (other_window, other_shown) = one[text], other[text]
        for name in shown:
            assert torch.equal(shown[name], other_shown[name])
            assert torch.equal(window.values[name], other_window.values[name])


def test_validation_changes_neither_the_batch_nor_the_weights(tiny_policy, batch):
    policy = tiny_policy(dropout=0.5).train()
    weights = {name: value.clone() for name, value in policy.state_dict().items()}
    before = {key: value.clone() for key, value in batch.items() if torch.is_tensor(value)}
    assert task_losses(policy, batch, ALL) == task_losses(policy, batch, ALL)
    assert all(torch.equal(batch[key], value) for key, value in before.items())
    assert all(torch.equal(policy.state_dict()[name], value) for name, value in weights.items())


# --- Runs ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runs(tiny_policy, tmp_path_factory):
    """Two folders as lerobot-train leaves them, three checkpoints each, and data; all paths relative."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("runs"))
        patch.setattr(sys, "argv", ["unimask", "build", "doorkey", "--episodes=25", "--root=data"])
        yield make_runs(tiny_policy)


def make_runs(tiny_policy) -> tuple[list[Path], Path]:
    data = Path("data")
    build_doorkey(data, episodes=25, seed=5, progress=False)
    folders = [Path("outputs/one"), Path("outputs/two")]
    for seed, run in enumerate(folders):
        for updates, scale in ((5, 4.0), (10, 0.1 + seed / 4), (15, 2.5)):  # the second is nearest to uniform
            path = run / "checkpoints" / f"{updates:06}" / "pretrained_model"
            policy = scaled(tiny_policy(), scale)
            policy.updates += updates
            policy.save_pretrained(path)
            dataset = DatasetConfig("local/doorkey", root=str(data))
            TrainPipelineConfig(dataset, policy=policy.config, seed=seed, steps=15)._save_pretrained(path)
        (run / "checkpoints/last").symlink_to("000015")
    return folders, data


@pytest.fixture(scope="module")
def record(runs):
    return validate(*runs, exact="paper")


def test_of_each_run_the_checkpoint_with_the_lowest_random_mask_loss_counts(runs, record):
    folders, data = runs
    for run, result in zip(folders, record["runs"], strict=True):
        by_updates = {}
        for path in checkpoints_of(run):
            policy = UniMASKPolicy.from_pretrained(path)
            by_updates[int(policy.updates)] = task_losses(policy, first_windows(open_dataset(policy.config, data)), ALL)
        assert result["random_mask_loss_by_updates"] == {
            updates: losses[RANDOM_MASK] for updates, losses in by_updates.items()
        }
        assert result["updates"] == 10 == min(by_updates, key=lambda updates: by_updates[updates][RANDOM_MASK])
        assert result["losses"] == by_updates[10]
    for task in ALL:
        first, second = (result["losses"][task] for result in record["runs"])
        assert record["mean"][task] == pytest.approx((first + second) / 2)
        assert record["spread"][task] == pytest.approx(abs(first - second))


def test_the_record_is_complete_and_names_no_place_on_this_machine(record):
    assert '"/' not in json.dumps(record, allow_nan=False)
    assert record.keys() == {
        "what",
        "units",
        "validation_episodes",
        "validation_data",
        "mean",
        "spread",
        "optimum",
        "runs",
        "versions",
    }
    assert record["validation_episodes"] == 25
    assert record["validation_data"]["seed"] == 5
    assert record["versions"].keys() == {"python", "torch", "lerobot", "lerobot_policy_unimask"}
    for seed, result in enumerate(record["runs"]):
        training = result["training"]
        assert (training["seed"], training["steps"], training["batch_size"]) == (seed, 15, 8)
        assert training["data"] == record["validation_data"]
        assert training["policy"]["training_masks"] == "random_mask"
        assert {"width", "depth", "heads", "dropout", "optimizer_lr", "loss_weights"} <= training["policy"].keys()


def test_the_optimum_stands_beside_the_runs(runs, record):
    """The exact losses are below the models', and a model's loss exceeds the expected optimum by its divergence."""
    optimum = record["optimum"]
    assert optimum["expert"] == "paper"
    assert optimum["losses"].keys() == optimum["expected_losses"].keys() == set(ALL)
    assert optimum["losses"]["forward_dynamics"] == pytest.approx(0, abs=1e-9)
    for result in record["runs"]:
        for task in ALL:
            assert result["divergence"][task] > 0
            assert result["above_optimum"][task] == result["losses"][task] - optimum["losses"][task] > 0
        for said, best in zip(result["foretold"]["rtg"], optimum["foretold"]["rtg"], strict=True):
            assert said["mean_absolute_error"] > best["mean_absolute_error"]
        for kind in ("agent_cell", "key_cell", "direction"):
            assert result["random_mask_divergence"][kind]["all"] > 0
    with pytest.raises(ValueError, match=r"'paper'.*'released'"):
        validate(*runs, exact="released")


def test_a_model_that_answers_some_tasks_alone_is_validated_on_those(tiny_policy, doorkey_root, tmp_path):
    causal = {"attention": "causal", "token_layout": "separate"}
    tiny_policy(training_masks="behavior_cloning", **causal).save_pretrained(tmp_path)
    (result,) = validate([tmp_path], doorkey_root, exact="paper")["runs"]
    assert result["losses"].keys() == result["divergence"].keys() == {"behavior_cloning"}
    assert "random_mask_divergence" not in result


@pytest.mark.parametrize(
    ("trained_on", "seen"),
    [
        ({"root": "here", "repo_id": "me/data", "episodes": None}, 30),
        ({"root": "here", "repo_id": "me/data", "episodes": [3, 1, 2, 99]}, 3),
        ({"root": "elsewhere", "repo_id": "local/dataset", "episodes": None}, 0),
        ({"root": None, "repo_id": "local/dataset", "episodes": None}, 30),
        ({"root": None, "repo_id": "me/data", "episodes": None}, 0),
        (None, 0),
    ],
)
def test_validating_on_episodes_that_were_trained_on_says_so(doorkey_root, tiny_policy, tmp_path, trained_on, seen):
    tiny_policy().save_pretrained(tmp_path)
    if trained_on is not None:
        place = {"here": str(doorkey_root), "elsewhere": str(tmp_path)}.get(trained_on["root"])
        settings = {"seed": 0, "batch_size": 1, "steps": 1, "policy": {}, "dataset": {**trained_on, "root": place}}
        (tmp_path / "train_config.json").write_text(json.dumps(settings))
    policy = UniMASKPolicy.from_pretrained(tmp_path)
    assert len(episodes_trained_on(policy.folder, doorkey_root, "local/dataset", 30)) == seen


def test_one_checkpoint_is_validated_by_itself_and_says_how_many_episodes_it_was_trained_on(runs):
    folders, data = runs
    (result,) = validate([folders[0] / "checkpoints/000005/pretrained_model"], data)["runs"]
    assert (result["updates"], result["trained_on_episodes"]) == (5, 25)


def test_a_model_without_returns_is_validated_on_the_tasks_that_it_has(tiny_policy, doorkey, doorkey_root, tmp_path):
    tiny_policy(features=without_return(doorkey)).save_pretrained(tmp_path)
    (result,) = validate([tmp_path], doorkey_root)["runs"]
    assert result["losses"].keys() == set(ALL) - {"reward_conditioned"}
    assert result["training"] is None  # nothing but the weights and their config is there


def test_what_is_foretold_is_summed_up_without_an_optimum_too():
    foretold = {"task": [{"t": 3, "error": 0.25, "log_loss": 0.5}]}
    record = {"mean": {"past": 1.0}, "spread": {"past": 0.0}, "runs": [{"foretold": foretold}]}
    said = summary(record)
    assert "t=3: error 0.2500, log loss 0.5000" in said
    assert "optimum" not in said
