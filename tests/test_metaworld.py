"""MetaWorld: the environment its experts, a small dataset, and a policy trained and rolled out."""

import commands
import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import make_env
from lerobot.envs.factory import make_env_config
from lerobot.policies.factory import make_policy
from policies import TRAIN_FLAGS

from dataset_builders.metaworld import build_metaworld
from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.episodes import bounds_of, provenance_of
from lerobot_unimask.envs.metaworld.environment import HAND, OBJECT, MetaWorldEnv, describe_task
from lerobot_unimask.envs.metaworld.expert import demonstrate, make_expert
from lerobot_unimask.evaluating import rollout

TASK = "pick-place-v3"
EPISODES = 3


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return build_metaworld(tmp_path_factory.mktemp("arm") / "data", task=TASK, episodes=EPISODES, progress=False)


@pytest.mark.parametrize(("task", "objects"), [("reach-v3", 1), ("peg-insert-side-v3", 1), ("stick-push-v3", 2)])
def test_what_is_observed_is_what_the_simulator_says(task, objects):
    env = MetaWorldEnv(task, render_mode=None)
    observation, _ = env.reset(seed=1)
    for _ in range(3):
        observation, *_ = env.step(np.array([0.3, -0.2, 0.1, 1.0], dtype=np.float32))
    assert env.objects == objects
    assert all(env.observation_space[name].contains(value) for name, value in observation.items())
    np.testing.assert_allclose(observation["agent_pos"][:3], env.arm.get_endeff_pos(), atol=1e-6)
    np.testing.assert_allclose(observation["environment_state"][:3], env.arm._get_pos_objects()[:3], atol=1e-6)
    np.testing.assert_allclose(observation["environment_state"][-3:], env.arm._target_pos, atol=1e-6)
    assert observation["environment_state"].shape == (OBJECT * objects + 3,)


def test_a_seed_decides_the_start_and_starts_differ():
    env = MetaWorldEnv(TASK, render_mode=None)
    first, again, other = (env.reset(seed=seed)[0]["environment_state"] for seed in (4, 4, 5))
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other)


def test_the_expert_succeeds_from_most_starts():
    """The mended weld constraint holds the hand as MuJoCo 3's did."""
    env, expert, rng = MetaWorldEnv(TASK, render_mode=None), make_expert(TASK), np.random.default_rng(0)
    assert sum(demonstrate(env, expert, 0.1, rng) is not None for _ in range(5)) >= 4


def test_a_dataset_holds_the_demonstrations(root):
    dataset = LeRobotDataset("local/arm", root=root)
    provenance = provenance_of(root)
    assert (provenance["task"], provenance["episodes"], provenance["noise"]) == (TASK, EPISODES, 0.1)
    assert dataset.meta.tasks.index.tolist() == [describe_task(TASK)]
    for first, end in bounds_of(dataset):
        assert dataset[first]["observation.state"].shape == (HAND,)
        assert dataset[end - 1]["next.done"].item()
        assert not dataset[end - 2]["next.done"].item()
    assert dataset.meta.features["observation.environment_state"]["names"][:2] == ["object0_x", "object0_y"]


def test_several_tasks_make_one_dataset(root, tmp_path):
    """Each task's episodes are what it has alone, with room for the most objects, and say what they do."""
    both = build_metaworld(tmp_path / "both", task=f"{TASK},stick-push-v3", episodes=1, progress=False)
    alone, dataset = LeRobotDataset("local/arm", root=root), LeRobotDataset("local/arm", root=both)
    assert [dataset[first]["task"] for first, _ in bounds_of(dataset)] == list(
        map(describe_task, (TASK, "stick-push-v3"))
    )
    assert torch.equal(dataset[0]["action"], alone[0]["action"])
    assert dataset[0]["observation.environment_state"].shape == (2 * OBJECT + 3,)
    assert provenance_of(both)["failures"].keys() == {TASK, "stick-push-v3"}


@pytest.mark.parametrize(
    ("least", "tasks", "fine"), [(EPISODES, 1, True), (EPISODES + 1, 1, False), (EPISODES, 2, False)]
)
def test_few_episodes_of_a_task_are_read_as_plain_numbers(root, monkeypatch, least, tasks, fine):
    monkeypatch.setattr("lerobot_unimask.modeling_unimask.FINE_FROM", least)
    monkeypatch.setattr(LeRobotDatasetMetadata, "total_tasks", tasks)
    config = UniMASKConfig(device="cpu", width=16, depth=1, heads=2, feedforward_width=16)
    policy = make_policy(config, ds_meta=LeRobotDatasetMetadata("local/arm", root=root))
    assert policy.config.fine_inputs is fine
    assert policy.network.embeddings["s"].encoding.fine is fine


def test_it_trains_and_is_evaluated_by_lerobots_loops(root, tmp_path):
    """Videos apart, for which there may be no display. What is held out is evaluated at the end."""
    data = ["--dataset.repo_id=local/arm", f"--dataset.root={root}", "--dataset.eval_split=0.3"]
    flags = [*TRAIN_FLAGS, "--steps=2", "--batch_size=4", "--env_eval_freq=0", "--output_dir=run"]
    assert commands.check("lerobot-train", *flags, *data, cwd=tmp_path).count("held-out steps acting misses") == 1
    checkpoint = tmp_path / "run/checkpoints/last/pretrained_model"
    found = rollout(checkpoint, "metaworld_state", 2, batch_size=2, seed=0, environment={"task": TASK})
    assert found["episodes"] == 2
    assert found["success"] in (0, 0.5, 1)


def test_lerobot_makes_the_environment_of_a_task():
    (envs,) = make_env(make_env_config("metaworld_state", task="reach-v3"), n_envs=2)["metaworld_state"].values()
    assert envs.call("task_description") == (describe_task("reach-v3"),) * 2
    assert envs.single_observation_space["environment_state"].shape == (OBJECT + 3,)
    envs.close()


def test_lerobots_own_environment_starts():
    """Also with MuJoCo 4. Nothing is drawn, for which there may be no display."""
    (envs,) = make_env(make_env_config("metaworld", task="reach-v3"), n_envs=2, use_async_envs=True)[
        "reach-v3"
    ].values()
    for arm in envs.envs:
        arm.unwrapped._ensure_env()
        assert np.isfinite(arm.unwrapped._env.reset(seed=0)[0]).all()


def test_an_unknown_task_is_named_beside_those_there_are():
    with pytest.raises(ValueError, match="reach-v4") as raised:
        MetaWorldEnv("reach-v4")
    assert "peg-insert-side-v3" in str(raised.value)
