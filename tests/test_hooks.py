"""LeRobot's other hooks: losses of windows, recorded evaluations, renamed columns, adapters, other environments."""

import json
import logging
import re
import sys

import commands
import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch
from accelerate import Accelerator
from lerobot.datasets import video_utils
from lerobot.scripts import lerobot_train
from policies import CONTINUOUS_FEATURES, CONTINUOUS_STATS, TRAIN_FLAGS
from torch import nn

from lerobot_unimask import UniMASKPolicy, lerobot_patches
from lerobot_unimask.envs.configs import GymnasiumEnvConfig
from lerobot_unimask.envs.returns import ReportReturn

TOP = {"dtype": "image", "shape": (32, 32, 3), "names": ["height", "width", "channels"]}


@pytest.mark.parametrize("masks", ["random_mask", "past"])
def test_the_mean_over_windows_is_the_loss(tiny_policy, batch_of, kind, masks):
    policy = tiny_policy(kind, training_masks=masks).train()
    loss, parts = policy.forward(batch_of(kind))
    each, same_parts = policy.forward(batch_of(kind), reduction="none")
    assert each.shape == (len(batch_of(kind)["action"]),)
    torch.testing.assert_close(each.mean(), loss, rtol=1e-5, atol=1e-6)
    assert dict(same_parts) == pytest.approx(dict(parts), rel=1e-4)


def test_a_windows_part_is_its_own(tiny_policy, doorkey_batch):
    """What is recorded in another window does not matter to it."""
    policy = tiny_policy(training_masks="a[t] | s[t]").train()
    before, _ = policy.forward(doorkey_batch, reduction="none")
    changed = {**doorkey_batch, "action": doorkey_batch["action"].clone()}
    changed["action"][0] = 3 - changed["action"][0]
    after, _ = policy.forward(changed, reduction="none")
    assert after[0] != before[0]
    assert torch.equal(after[1:], before[1:])


def test_another_reduction_is_refused(tiny_policy, doorkey_batch):
    with pytest.raises(ValueError, match=r"sum.*mean or none"):
        tiny_policy().forward(doorkey_batch, reduction="sum")


def test_lerobot_train_learns_from_what_makes_progress_alone(doorkey_root, tmp_path, monkeypatch):
    """RA-BC: every other episode makes progress, which its windows are weighted with, the others none."""
    frames = pd.DataFrame({"index": range(300), "episode_index": np.arange(300) // 10})
    direction = np.where(frames["episode_index"] % 2, -0.1, 0.1)
    frames["progress_sparse"] = 0.5 + direction * (frames["index"] % 10) / 2
    frames.to_parquet(tmp_path / "progress.parquet")
    losses, learnt = [], []
    forward, backward = UniMASKPolicy.forward, Accelerator.backward

    def recording_forward(self, batch, reduction="mean"):
        each, parts = forward(self, batch, reduction)
        losses.append(each.detach()[batch["index"] // 10 % 2 == 0].mean())
        return each, parts

    def recording_backward(self, loss, **settings):
        learnt.append(loss.detach())
        backward(self, loss, **settings)

    monkeypatch.setattr(UniMASKPolicy, "forward", recording_forward)
    monkeypatch.setattr(Accelerator, "backward", recording_backward)
    flags = [
        *TRAIN_FLAGS,
        "--dataset.repo_id=local/doorkey",
        f"--dataset.root={doorkey_root}",
        "--steps=3",
        "--batch_size=8",
    ]
    flags += ["--sample_weighting.type=rabc", f"--sample_weighting.progress_path={tmp_path / 'progress.parquet'}"]
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *flags, "--num_workers=0", f"--output_dir={tmp_path / 'run'}"])
    lerobot_train.main()
    assert len(learnt) == 3
    torch.testing.assert_close(torch.stack(learnt), torch.stack(losses), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("network", "cameras"),
    [
        ("transformer", {}),
        ("transformer", {"observation.images.top": TOP}),
        ("feedforward", {}),
        ("decision_transformer", {}),
    ],
)
def test_adapters_go_to_every_linear_layer(tiny_policy, network, cameras):
    features = {**CONTINUOUS_FEATURES, **cameras}
    policy = tiny_policy("continuous", network=network, attention=None, features=features, image_size=[32, 32])
    pattern = policy._get_default_peft_targets()["target_modules"]
    linear = {name for name, module in policy.named_modules() if isinstance(module, nn.Linear)}
    assert {name for name, _ in policy.named_modules() if re.fullmatch(pattern, name)} == linear


def test_an_evaluation_records_doorkeys_integers(tiny_policy, tmp_path):
    tiny_policy().save_pretrained(tmp_path / "policy")
    commands.check(
        "lerobot-eval",
        "--policy.path=policy",
        "--env.type=doorkey",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        "--eval.recording=true",
        "--output_dir=eval",
        cwd=tmp_path,
    )
    (info,) = (tmp_path / "eval").rglob("meta/info.json")
    assert json.loads(info.read_text())["total_episodes"] == 1


@pytest.fixture
def pendulum_policy(tiny_policy):
    features = {
        "observation.angle": {"dtype": "float32", "shape": (3,), "names": None},
        "action": {"dtype": "float32", "shape": (1,), "names": None},
        "observation.return_to_go": {"dtype": "float32", "shape": (1,), "names": None},
    }
    stats = {
        key: {"mean": [0.0] * entry["shape"][0], "std": [1.0] * entry["shape"][0]} for key, entry in features.items()
    }
    return tiny_policy(
        "gaussian",
        features=features,
        stats=stats | {"frame_index": {"max": [199.0]}, "timestamp": {"max": [6.6]}},
        states=["observation.angle"],
        context_length=4,
        target_return=-100.0,
        inference_mask="reward_conditioned",
    )


def test_any_gymnasium_environment_reports_its_return_and_columns_are_renamed(pendulum_policy, tmp_path):
    pendulum_policy.save_pretrained(tmp_path / "policy")
    commands.check(
        "lerobot-eval",
        "--policy.path=policy",
        "--env.type=gymnasium",
        "--env.task=Pendulum-v1",
        '--rename_map={"observation.state": "observation.angle"}',
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--eval.recording=true",  # and so no videos
        "--output_dir=eval",
        cwd=tmp_path,
    )
    info = json.loads((tmp_path / "eval/eval_info.json").read_text())
    assert len(info["per_task"][0]["metrics"]["sum_rewards"]) == 2


def test_without_it_a_return_cannot_be_asked_for_and_the_first_step_says_so(pendulum_policy):
    with pytest.raises(ValueError, match="return_so_far"):
        pendulum_policy.select_action({"observation.angle": torch.zeros(1, 3)})


def test_the_return_so_far_is_the_sum_of_rewards():
    env = ReportReturn(gym.make("Pendulum-v1"))
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    paid = 0.0
    for _ in range(5):
        assert observation["return_so_far"] == pytest.approx(np.array([paid]))
        observation, reward, *_ = env.step(np.array([0.5], np.float32))
        paid += reward
    assert env.reset(seed=0)[0]["return_so_far"] == 0


@pytest.mark.parametrize("states", [None, ["observation.state"]])
def test_going_on_with_a_column_of_another_name_is_refused_with_the_command_that_renames_it(tiny_policy, states):
    """What is kept of a dataset is read from its files."""
    policy = tiny_policy("gaussian", states=states)
    renamed = {key.replace("state", "qpos"): entry for key, entry in CONTINUOUS_FEATURES.items()}
    with pytest.raises(ValueError, match=r"unimask prepare --rename OLD=observation\.state"):
        policy.config.set_dataset_feature_metadata(renamed)


def test_a_training_with_other_names_is_refused_with_the_command_that_gives_them(tiny_policy, doorkey_root, tmp_path):
    tiny_policy(states=["observation.state"]).save_pretrained(tmp_path / "policy")
    result = commands.run(
        "lerobot-train",
        "--policy.path=policy",
        "--policy.push_to_hub=false",
        "--dataset.repo_id=local/doorkey",
        f"--dataset.root={doorkey_root}",
        '--rename_map={"observation.qpos": "observation.state"}',
        "--output_dir=run",
        cwd=tmp_path,
    )
    assert result.status != 0
    assert "unimask prepare --dataset.root=DIR --rename observation.qpos=observation.state" in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(("task", "message"), [(None, "env.task"), ("CartPole-v1", "continuous")])
def test_an_environment_that_does_not_fit_is_refused(task, message):
    with pytest.raises(ValueError, match=message):
        GymnasiumEnvConfig(task=task)


# --- Which columns make up the state ---------------------------------------------------------------------------------

COLUMNS = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": None},
    "observation.velocity": {"dtype": "float32", "shape": (2,), "names": None},
    "observation.current": {"dtype": "float32", "shape": (1,), "names": None},
    "action": {"dtype": "float32", "shape": (2,), "names": None},
}


def test_states_are_made_up_of_the_columns_that_are_named(tiny_policy):
    stats = {key: {"mean": [1.0] * e["shape"][0], "std": [2.0] * e["shape"][0]} for key, e in COLUMNS.items()}
    policy = tiny_policy(
        "gaussian", features=COLUMNS, stats=stats, states=["observation.velocity", "observation.state"]
    )
    assert policy.factors["s"].size == 5
    observed = {"observation.velocity": torch.ones(1, 2), "observation.state": torch.full((1, 3), 7.0)}
    assert policy.select_action(observed).shape == (1, 2)
    assert policy._memory.values["s"][0, 0].tolist() == [1, 1, 7, 7, 7]
    assert tiny_policy("gaussian", features=COLUMNS, stats=CONTINUOUS_STATS).factors["s"].size == 3


@pytest.mark.parametrize("states", [["observation.speed"], ["action"], ["observation.state"] * 2, []])
def test_columns_that_cannot_be_states_are_refused(tiny_policy, states):
    with pytest.raises(ValueError, match=r"states|observation\.state"):
        tiny_policy("gaussian", features=COLUMNS, stats=CONTINUOUS_STATS, states=states)


def test_lerobots_page_about_ffmpeg_is_one_line_said_once_where_a_video_is_read(caplog, tmp_path):
    caplog.set_level(logging.WARNING)
    for _ in range(2):
        logging.getLogger("lerobot.utils.import_utils").warning(
            "A page.\nOf it.\nIt reads by pyav (see the error above)."
        )
        assert "A page" not in caplog.text
        for _ in range(2):
            with pytest.raises(FileNotFoundError):
                video_utils.decode_video_frames_pyav(tmp_path / "none.mp4", [0.0], 0.1)
    assert [line for line in caplog.messages if "reads by pyav" in line] == ["It reads by pyav."]


def raised_by(code, name):
    """The error that a piece of code raises, as one of a file of this name."""
    try:
        exec(compile(code, name, "exec"))
    except Exception as error:
        return type(error), error, error.__traceback__.tb_next


@pytest.mark.parametrize(
    ("command", "error", "file", "expected"),
    [
        ("bin/lerobot-train", "ValueError", lerobot_patches.__file__, "lerobot-train: error: x\n"),
        ("lerobot_eval.py", "FloatingPointError", lerobot_patches.__file__, "lerobot_eval.py: error: x\n"),
        ("bin/lerobot-train", "TypeError", lerobot_patches.__file__, "Traceback"),
        ("bin/lerobot-train", "ValueError", "other.py", "Traceback"),
        ("mine.py", "ValueError", lerobot_patches.__file__, "Traceback"),
    ],
)
def test_lerobots_commands_end_in_a_sentence_of_ours(command, error, file, expected, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [command])
    sys.excepthook(*raised_by(f"raise {error}('x')", file))
    assert capsys.readouterr().err.startswith(expected)
