"""LeRobot's own command lines, unchanged, drive the plugin: train, validate, evaluate, save, resume, fine-tune."""

import json
import logging
import re
import sys

import commands
import pytest
from policies import TRAIN_FLAGS

from lerobot_unimask import UniMASKPolicy


@pytest.fixture(scope="module")
def data(doorkey_root):
    return ["--dataset.repo_id=local/doorkey", f"--dataset.root={doorkey_root}"]


def in_process(script: str, *arguments: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same main function without paying for LeRobot's import again."""
    from lerobot.scripts import lerobot_eval, lerobot_train

    monkeypatch.setattr(sys, "argv", [script, *arguments])
    {"lerobot-train": lerobot_train.main, "lerobot-eval": lerobot_eval.main}[script]()


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    """A run of the real command with LeRobot's own defaults for workers and asynchronous environments, its windows
    weighted, for which LeRobot asks for the loss of each."""
    folder = tmp_path_factory.mktemp("train")
    flags = ["--steps=4", "--batch_size=8", "--dataset.eval_split=0.25", "--eval_steps=2", "--save_freq=2"]
    flags += ["--log_freq=1", "--env.type=doorkey", "--env_eval_freq=4", "--eval.n_episodes=3", "--eval.batch_size=3"]
    flags += ["--sample_weighting.type=uniform"]
    log = commands.check(
        "lerobot-train", *TRAIN_FLAGS, *data, *flags, "--num_workers=1", "--output_dir=run", cwd=folder
    )
    return folder / "run", log


def test_lerobot_train_trains_validates_evaluates_and_saves(trained):
    run, log = trained
    assert log.count("eval_loss=") == log.count("held-out steps acting") == 2
    assert "'n_episodes': 3" in log
    assert [path.name for path in sorted(run.glob("checkpoints/00*"))] == ["000002", "000004"]
    assert len(list(run.glob("eval/videos_step_*/doorkey_0/*.mp4"))) == 3
    policy = UniMASKPolicy.from_pretrained(run / "checkpoints/last/pretrained_model")
    assert int(policy.updates) == 4
    assert policy.config.features["s"][0].categories == [16, 16]


def test_workers_change_no_loss(data, tmp_path):
    """Windows are read in batches, so none are started: they would see another order from the second epoch on."""
    flags = [*TRAIN_FLAGS, *data, "--steps=12", "--batch_size=8", "--log_freq=1", "--save_checkpoint=false"]
    logs = [
        commands.check("lerobot-train", *flags, f"--num_workers={n}", f"--output_dir=run{n}", cwd=tmp_path)
        for n in (0, 2)
    ]
    without, beside = (re.findall(r" loss:(\S+) grdn:(\S+)", log) for log in logs)
    assert len(without) == 12  # an epoch has four
    assert beside == without
    assert "num_workers=0" in logs[1]


def test_lerobot_eval_with_other_questions(trained, tmp_path):
    checkpoint = trained[0] / "checkpoints/last/pretrained_model"
    log = commands.check(
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        "--env.type=doorkey",
        "--eval.n_episodes=4",
        "--eval.batch_size=2",
        "--policy.inference_mask=a[t] | s[:t+1], a[:t], s[-1], rtg[0]",
        "--policy.target_return=5",
        '--policy.given={"s[-1]": [15, 15]}',
        "--output_dir=eval",
        cwd=tmp_path,
    )
    assert "async=True" in log  # LeRobot's default, which the environments answer with synchronous stepping
    info = json.loads((tmp_path / "eval/eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 4
    assert {"pc_success", "avg_sum_reward"} <= info["overall"].keys()
    assert len(list((tmp_path / "eval").rglob("*.mp4"))) == 4
    returns = info["per_task"][0]["metrics"]["sum_rewards"]
    assert all(-10 <= value <= 10 and value == round(value) for value in returns)


def test_a_resumed_run_has_the_losses_of_one_that_was_not_interrupted(data, tmp_path, losses, monkeypatch):
    flags = [*TRAIN_FLAGS, *data, "--policy.dropout=0", "--batch_size=4", "--num_workers=0", "--save_freq=4"]
    run = tmp_path / "run"
    # 30 windows are eight batches: eight updates stay within the first epoch, as far as LeRobot restores the order.
    in_process("lerobot-train", *flags, "--steps=8", f"--output_dir={run}", monkeypatch=monkeypatch)
    whole = losses.copy()
    losses.clear()
    config = run / "checkpoints/000004/pretrained_model/train_config.json"
    (run / "checkpoints/last").unlink()
    (run / "checkpoints/last").symlink_to("000004")
    in_process("lerobot-train", f"--config_path={config}", "--resume=true", monkeypatch=monkeypatch)
    assert len(whole) == 8
    assert losses == whole[4:]


def test_fine_tuning_goes_on_from_the_weights_with_other_masks(trained, data, tmp_path, losses, monkeypatch):
    checkpoint = trained[0] / "checkpoints/last/pretrained_model"
    flags = [f"--policy.path={checkpoint}", "--policy.push_to_hub=false", "--policy.training_masks=past"]
    flags += [*data, "--steps=2", "--batch_size=8", "--num_workers=0", f"--output_dir={tmp_path / 'run'}"]
    in_process("lerobot-train", *flags, monkeypatch=monkeypatch)
    tuned = UniMASKPolicy.from_pretrained(tmp_path / "run/checkpoints/last/pretrained_model")
    assert tuned.config.training_masks == "past"
    assert int(tuned.updates) == 4 + 2
    before = UniMASKPolicy.from_pretrained(checkpoint)
    moved = (tuned.network.positions - before.network.positions).abs().max()
    assert 0 < moved < 0.05  # a fine-tuned model, not a fresh one
    assert len(losses) == 2


def test_bad_settings_end_before_anything_is_written(data, tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.ERROR)
    run = tmp_path / "run"
    flags = [*TRAIN_FLAGS, *data, "--steps=2", "--num_workers=0", f"--output_dir={run}"]
    with pytest.raises(ValueError, match="no factor 'q'"):
        in_process("lerobot-train", *flags, "--policy.training_masks=a[t] | q[0]", monkeypatch=monkeypatch)
    assert not run.exists()


def test_streams_are_refused_with_what_to_use_instead(data, tmp_path, monkeypatch):
    flags = [*TRAIN_FLAGS, *data, "--steps=2", f"--output_dir={tmp_path / 'run'}", "--dataset.streaming=true"]
    with pytest.raises(ValueError, match=r"--dataset\.streaming"):
        in_process("lerobot-train", *flags, monkeypatch=monkeypatch)
