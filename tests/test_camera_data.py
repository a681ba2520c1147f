"""Environments with a camera: the same picture in the dataset and at evaluation; lerobot-eval shows it to a policy."""

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import env_to_policy_features
from lerobot.envs.factory import make_env_config

from dataset_builders.doorkey import build_doorkey
from dataset_builders.maze2d import build_maze2d
from lerobot_unimask import UniMASKPolicy
from lerobot_unimask.cli import main
from lerobot_unimask.data import frames
from lerobot_unimask.envs.doorkey.environment import DoorKeyEnv
from lerobot_unimask.envs.maze2d.environment import Maze2DEnv
from lerobot_unimask.envs.maze2d.maze import parse_maze
from lerobot_unimask.envs.maze2d.rendering import camera_picture
from lerobot_unimask.evaluating import rollout
from lerobot_unimask.training import Trainer

KEY = "observation.images.top"
SMALL = {"width": 16, "depth": 1, "heads": 2, "feedforward_width": 16, "device": "cpu", "context_length": 4}


@pytest.fixture(scope="module")
def maze_root(tmp_path_factory):
    root = tmp_path_factory.mktemp("maze") / "dataset"
    return build_maze2d(root, episodes=2, maze="umaze", camera=True, hide_goal=True, progress=False)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(frames, "frames_folder", lambda: tmp_path / "frames")


def seen(dataset, frame):
    return (dataset[frame][KEY] * 255).round().int().permute(1, 2, 0).numpy()


def test_mazes_pictures_are_those_of_the_environment(maze_root):
    dataset = LeRobotDataset("local/maze2d", root=maze_root)
    plain = build_maze2d(maze_root.parent / "plain", episodes=2, maze="umaze", progress=False)
    states = LeRobotDataset("local/maze2d", root=plain).hf_dataset["observation.state"]
    env = Maze2DEnv("umaze", obs_type="pixels_agent_pos", hide_goal=True)
    for frame in (0, 250, 399):
        x, y, goal_x, goal_y = states[frame].tolist()
        observation, _ = env.reset(options={"position": (x, y), "velocity": (0, 0), "goal": (int(goal_x), int(goal_y))})
        assert dataset[frame]["observation.state"].tolist() == observation["agent_pos"].tolist() == [x, y]
        difference = np.abs(seen(dataset, frame) - observation["pixels"]["top"].astype(int))
        assert difference.mean() < 6  # the video is lossy
    statistics = dataset.meta.stats[KEY]
    assert statistics["mean"].shape == (3, 1, 1)
    assert 0 < statistics["mean"].min() < statistics["mean"].max() < 1


def test_doorkeys_pictures_are_those_of_the_environment(tmp_path):
    root = build_doorkey(tmp_path / "doorkey", episodes=3, camera=True, progress=False)
    dataset, env = LeRobotDataset("local/doorkey", root=root), DoorKeyEnv(obs_type="pixels_agent_pos")
    for episode in range(3):
        agent, key = dataset[10 * episode]["observation.state"].tolist()
        observation, _ = env.reset(options={"agent": agent, "key": key})
        for step in range(10):
            item = dataset[10 * episode + step]
            assert item["observation.state"].tolist() == observation["agent_pos"].tolist()
            difference = np.abs(seen(dataset, 10 * episode + step) - observation["pixels"]["top"].astype(int))
            assert difference.mean() < 6
            observation = env.step(item["action"].item())[0]


def test_pictures_in_place_of_a_video_are_exact(maze_root, tmp_path):
    root = build_maze2d(
        tmp_path / "maze", episodes=2, maze="umaze", camera=True, use_videos=False, hide_goal=True, progress=False
    )
    dataset, video = (LeRobotDataset("local/maze2d", root=folder) for folder in (root, maze_root))
    assert dataset.meta.image_keys == [KEY]
    assert not list(root.rglob("*.mp4"))
    for name, value in video.meta.stats[KEY].items():  # of the pictures as they were drawn, both
        np.testing.assert_array_equal(dataset.meta.stats[KEY][name], value)
    maze = parse_maze("umaze")
    plain = build_maze2d(tmp_path / "plain", episodes=2, maze="umaze", progress=False)
    states = LeRobotDataset("local/maze2d", root=plain).hf_dataset["observation.state"]
    for frame in (0, 250):
        x, y, goal_x, goal_y = states[frame].tolist()
        assert np.array_equal(seen(dataset, frame), camera_picture(maze, (int(goal_x), int(goal_y)), (x, y)))
    cached = frames.cached_frames(dataset, KEY, (70, 70))
    assert np.array_equal(cached[250].transpose(1, 2, 0), seen(dataset, 250))


@pytest.mark.parametrize(
    ("kind", "shape", "settings"),
    [
        ("maze2d", (3, 112, 112), {"hide_goal": True}),
        ("maze2d", (3, 70, 70), {"maze": "umaze"}),
        ("doorkey", (3, 96, 96), {}),
    ],
)
def test_what_lerobot_is_told_is_what_the_environment_observes(kind, shape, settings):
    config = make_env_config(kind, obs_type="pixels_agent_pos", **settings)
    declared = env_to_policy_features(config)
    assert declared[KEY].shape == shape
    env = {"maze2d": Maze2DEnv, "doorkey": DoorKeyEnv}[kind](**config.gym_kwargs)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert declared["observation.state"].shape == observation["agent_pos"].shape
    with pytest.raises(ValueError, match="pixels_agent_pos"):
        make_env_config(kind, obs_type="pixels")


def test_a_policy_is_trained_on_pictures_and_acts_from_them(maze_root, tmp_path):
    trainer = Trainer(SMALL | {"image_size": [24, 24]}, maze_root, seed=0, steps=2, batch_size=4)
    assert all(np.isfinite(loss) for loss in trainer)
    trainer.policy.save_pretrained(tmp_path / "policy")
    assert list(UniMASKPolicy.from_pretrained(tmp_path / "policy").cameras) == ["top"]
    environment = {"maze": "umaze", "hide_goal": True, "obs_type": "pixels_agent_pos"}
    result = rollout(tmp_path / "policy", "maze2d", 2, batch_size=2, seed=0, environment=environment)
    assert result["episodes"] == 2
    with pytest.raises(ValueError, match=f"looks at camera '{KEY}'"):
        rollout(
            tmp_path / "policy", "maze2d", 1, batch_size=1, seed=0, environment={"maze": "umaze", "hide_goal": True}
        )


def test_decoded_frames_are_counted_and_removed(maze_root, tmp_path, capsys):
    dataset = LeRobotDataset("local/maze2d", root=maze_root)
    frames.cached_frames(dataset, KEY, (24, 24), tmp_path / "frames")
    main(["frames"])
    assert "frames of 1 cameras, 0.00069" in capsys.readouterr().out  # 400 x 3 x 24 x 24 bytes
    main(["frames", "--remove=true"])
    assert "removed" in capsys.readouterr().out
    assert frames.stored_files() == []
