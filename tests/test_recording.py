"""A robot arm's recording, two cameras of 640 x 480 at 30 Hz, made by LeRobot's own writer from noise and ramps: it is
trained on through lerobot-train, resumed, questioned and acted from; other policies read it as without the plugin."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from policies import TRAIN_FLAGS

from lerobot_unimask import UniMASKPolicy
from lerobot_unimask.data import frames, reads
from lerobot_unimask.data.episodes import open_dataset, read_windows

K, LENGTHS = 3, (5, 4)
CAMERAS = ("observation.images.laptop", "observation.images.phone")
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
POLICY = (*TRAIN_FLAGS, f"--policy.context_length={K}", "--policy.image_size=[48, 64]")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    root = tmp_path_factory.mktemp("recording") / "dataset"
    camera = {"dtype": "video", "shape": (480, 640, 3), "names": ["height", "width", "channels"]}
    joints = {"dtype": "float32", "shape": (6,), "names": JOINTS}
    features = {"observation.state": joints, "action": joints, **dict.fromkeys(CAMERAS, camera)}
    dataset = LeRobotDataset.create("local/arm", 30, features, root=root, use_videos=True, robot_type="so100_follower")
    rng = np.random.default_rng(0)
    ramp = np.add.outer(np.arange(480), np.arange(640))[..., None] * np.array([1, 2, 3])
    for length in LENGTHS:
        for step in range(length):
            pictures = {
                key: ((ramp + 9 * step + rng.integers(8, size=ramp.shape)) % 256).astype(np.uint8) for key in CAMERAS
            }
            numbers = {key: rng.normal(size=6).astype(np.float32) for key in ("observation.state", "action")}
            dataset.add_frame({**pictures, **numbers, "task": "pick up the cube"})
        dataset.save_episode()
    dataset.finalize()
    return root


@pytest.fixture
def train(recording, tmp_path, monkeypatch):
    """train(*flags): lerobot-train on the recording in this process, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(frames, "frames_folder", lambda: tmp_path / "frames")

    def run(*flags):
        from lerobot.scripts import lerobot_train

        data = ("--dataset.repo_id=local/arm", f"--dataset.root={recording}", "--batch_size=4", "--num_workers=0")
        monkeypatch.setattr(sys, "argv", ["lerobot-train", *flags, *(data if "--resume=true" not in flags else ())])
        lerobot_train.main()

    return run


def test_it_trains_resumes_is_questioned_and_acts(train, recording, tmp_path, monkeypatch):
    train(*POLICY, "--steps=3", "--save_freq=3", "--output_dir=run", "--dataset.eval_split=0.5", "--eval_steps=2")
    assert len(list((tmp_path / "frames").glob("*.frames"))) == 2  # the parts share the whole dataset's
    train("--resume=true", "--config_path=run/checkpoints/last/pretrained_model/train_config.json", "--steps=5")
    policy = UniMASKPolicy.from_pretrained("run")
    assert int(policy.updates) == 5
    assert {name: camera.shape for name, camera in policy.cameras.items()} == {
        "laptop": [3, 48, 64],
        "phone": [3, 48, 64],
    }

    dataset = open_dataset(policy.config, recording)
    batch = read_windows(dataset, [0, 5])
    assert batch[CAMERAS[0]].shape == (2, K, 3, 48, 64)
    answer = policy.infer(batch, "a[t] | s[:t+1], a[:t]", t=1).most_likely("a")
    shown = {key: batch[key][:, 0] for key in ("observation.state", *CAMERAS)}
    assert policy.select_action(shown).shape == (2, 6)
    whole = {**shown, **{key: frames.resized(torch.rand(2, 3, 480, 640), (480, 640)) for key in CAMERAS}}
    assert policy.predict_action_chunk(whole).shape == (2, 1, 6)
    changed = {**batch, CAMERAS[1]: 255 - batch[CAMERAS[1]]}
    assert not torch.equal(policy.infer(changed, "a[t] | s[:t+1], a[:t]", t=1).most_likely("a")[:, 1], answer[:, 1])


def test_cameras_that_are_not_read_are_not_decoded(train, monkeypatch, tmp_path):
    decoded = []
    original = frames._decode
    monkeypatch.setattr(frames, "_decode", lambda *args: decoded.append(args[1]) or original(*args))
    monkeypatch.setattr("lerobot.datasets.dataset_reader.decode_video_frames", lambda *args, **_: decoded.append(args))
    train(*POLICY, "--policy.cameras=[]", "--steps=2", "--output_dir=blind")
    assert decoded == []
    assert UniMASKPolicy.from_pretrained(tmp_path / "blind").cameras == {}
    train(*POLICY, '--policy.cameras=["observation.images.phone"]', "--steps=2", "--output_dir=one")
    assert set(decoded) == {"observation.images.phone"}


def test_pictures_are_augmented_as_lerobot_does(train, recording, tmp_path, monkeypatch):
    """Read one by one, at their own size; no frames are decoded beforehand."""
    batches = []
    forward = UniMASKPolicy.forward
    monkeypatch.setattr(UniMASKPolicy, "forward", lambda self, batch: batches.append(batch) or forward(self, batch))
    brighter = '{"brighter": {"type": "ColorJitter", "kwargs": {"brightness": [2.0, 2.0]}}}'
    augmented = ["--dataset.image_transforms.enable=true", f"--dataset.image_transforms.tfs={brighter}"]
    train(*POLICY, f'--policy.cameras=["{CAMERAS[0]}"]', *augmented, "--steps=1", "--output_dir=augmented")
    assert not (tmp_path / "frames").exists()
    plain = LeRobotDataset("local/arm", root=recording)
    for frame, picture in zip(batches[0]["index"].tolist(), batches[0][CAMERAS[0]][:, 0], strict=True):
        expected = (plain[frame][CAMERAS[0]] * 2).clamp_max(1)
        assert picture.shape == expected.shape
        assert (picture.float() / (255 if picture.dtype == torch.uint8 else 1) - expected).abs().max() < 1.5 / 255


@pytest.mark.slow
def test_uncached_it_learns_the_same(train, tmp_path):
    losses = {}
    original = UniMASKPolicy.forward
    for cached in ("true", "false"):
        recorded = losses[cached] = []

        def forward(self, batch, recorded=recorded):
            loss, parts = original(self, batch)
            recorded.append(loss.item())
            return loss, parts

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(UniMASKPolicy, "forward", forward)
            train(*POLICY, f"--policy.cache_frames={cached}", "--steps=2", "--output_dir=cached_" + cached)
    np.testing.assert_allclose(losses["true"], losses["false"], rtol=1e-3)


def test_other_policies_read_what_they_read_without_the_plugin(recording, monkeypatch):
    """act, K = 1 frame of each camera at 640 x 480, item by item: no frames are cached or left out for it."""
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets import factory
    from lerobot.policies.act.configuration_act import ACTConfig

    config = TrainPipelineConfig(
        DatasetConfig("local/arm", root=str(recording)), policy=ACTConfig(device="cpu", chunk_size=3, n_action_steps=3)
    )
    dataset = factory.make_dataset(config)
    plain = factory.make_dataset.__wrapped__(config)
    assert reads.batched_read(dataset) is None
    assert dataset.meta.camera_keys == list(CAMERAS)
    one, other = dataset[3], plain[3]
    assert one.keys() == other.keys()
    for key, value in other.items():
        assert torch.equal(one[key], value) if isinstance(value, torch.Tensor) else one[key] == value, key


WITHOUT = "import sys; sys.modules['lerobot_policy_unimask'] = None; "  # LeRobot's discovery goes on without it
OTHERS = {
    "act": ["--policy.dim_model=32", "--policy.n_heads=4", "--policy.dim_feedforward=32", "--policy.chunk_size=3"],
    "diffusion": ["--policy.down_dims=[16, 32]", "--policy.horizon=4", "--policy.drop_n_last_frames=0"],
}


@pytest.mark.slow
@pytest.mark.parametrize("other", OTHERS)
def test_other_policies_train_as_without_the_plugin(recording, tmp_path, other):
    """In processes of their own; the same losses and gradients, to the bit."""
    here = Path(__file__).parent
    flags = [f"--policy.type={other}", *OTHERS[other], "--policy.n_action_steps=2", "--policy.push_to_hub=false"]
    flags += ["--policy.pretrained_backbone_weights=null", "--policy.device=cpu", "--dataset.repo_id=local/arm"]
    flags += [
        f"--dataset.root={recording}",
        "--steps=3",
        "--batch_size=2",
        "--num_workers=0",
        "--save_checkpoint=false",
    ]
    made = {}
    for kind, first in (("with", ""), ("without", WITHOUT)):
        script = f"{first}import runpy; runpy.run_path({str(here / 'recorded_training.py')!r}, run_name='__main__')"
        words = [sys.executable, "-c", script, str(tmp_path / kind), *flags, "--log_freq=1"]
        done = subprocess.run(
            [*words, f"--output_dir={tmp_path / f'run_{kind}'}"],
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(here.parent)},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr[-3000:]
        made[kind] = torch.load(tmp_path / kind)
    assert len(made["with"]["losses"]) == 3
    for name in ("losses", "gradients"):
        assert torch.equal(made["with"][name], made["without"][name]), name
