"""A task of MetaWorld's arm from a picture and the hand's four numbers, in LeRobot's own environment: this policy and
`act`, trained for as many processor seconds.

    MUJOCO_GL=egl OMP_NUM_THREADS=1 python tests/measuring/arm_pictures.py --output=docs/results/arm_pictures.json

Pictures are rendered at LeRobot's 480 x 480, without shadows and smoothed edges, which on a processor take most of the
time, and both policies get them at 96 x 96, this one reads them at 64 x 64. Demonstrations are the scripted expert's,
with noise on half of its actions. The time is a training's alone: this policy decodes its pictures once, before it.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from arm_others import train
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

import lerobot_policy_unimask  # noqa: F401
from dataset_builders.videos import camera_feature
from dataset_builders.writer import write_dataset
from lerobot_unimask.data.frames import resized
from lerobot_unimask.envs.metaworld.environment import load_metaworld
from lerobot_unimask.machine import describe_machine
from lerobot_unimask.records import versions, write_json
from lerobot_unimask.training import Trainer

TASK, EPISODES, NOISE, SIDE, SEED = "button-press-topdown-v3", 50, 0.1, 96, 0
ROLLOUTS, STEPS, STARTS = 30, 150, 10_000  # an expert's episode takes 60 to 75 steps
QUESTION = "a[t] | state[:t+1], a[:t], image[0]"  # the button stays where it is: one picture of a window is enough
UNIMASK = {
    "device": "cpu", "training_masks": QUESTION, "inference_mask": QUESTION, "attention": "causal",
    "image_size": [64, 64],
}  # fmt: skip
ACT = {
    "dim_model": 128, "n_heads": 4, "dim_feedforward": 512, "n_encoder_layers": 2, "n_vae_encoder_layers": 2,
    "chunk_size": 20, "n_action_steps": 10, "optimizer_lr": 1e-3, "optimizer_lr_backbone": 1e-3,
    "pretrained_backbone_weights": None,
}  # fmt: skip


def make_arm():
    from lerobot.envs.metaworld import MetaworldEnv

    arm = MetaworldEnv(TASK, obs_type="pixels_agent_pos")
    arm._ensure_env()
    quality = arm._env.model.vis.quality
    quality.shadowsize, quality.offsamples = 0, 0
    return arm


def picture(pixels: np.ndarray) -> torch.Tensor:
    """(480, 480, 3) -> (3, SIDE, SIDE), uint8."""
    return resized(torch.from_numpy(pixels.copy()).permute(2, 0, 1), (SIDE, SIDE))


def build(root: Path) -> None:
    arm, rng = make_arm(), np.random.default_rng(SEED)
    states, actions, pictures, lengths = [], [], [], []
    while len(lengths) < EPISODES:
        start, success = len(states), False
        arm._env.seed(int(rng.integers(2**31)))
        raw, _ = arm._env.reset()
        for _ in range(STEPS):
            action = np.clip(arm.expert_policy.get_action(raw), -1, 1)
            if rng.random() < 0.5:
                action = np.clip(action + NOISE * rng.standard_normal(4), -1, 1)
            states.append(raw[:4])
            actions.append(action)
            pictures.append(picture(arm.render()).permute(1, 2, 0).numpy())
            raw, _, _, _, info = arm._env.step(action.astype(np.float64))
            success = bool(info["success"])
            if success:
                break
        if success:
            lengths.append(len(states) - start)
        else:
            del states[start:], actions[start:], pictures[start:]
    numbers = {"dtype": "float32", "shape": (4,), "names": ["x", "y", "z", "gripper"]}
    seen: Iterator[np.ndarray] = iter(pictures)
    write_dataset(
        root,
        repo_id="local/arm",
        fps=80,
        features={OBS_STATE: numbers, ACTION: numbers, OBS_IMAGE: camera_feature(SIDE, SIDE, use_videos=False)},
        columns={OBS_STATE: np.float32(states), ACTION: np.float32(actions)},
        lengths=np.array(lengths),
        task=arm.task_description,
        robot_type="sawyer",
        provenance={"environment": "lerobot metaworld", "task": TASK, "noise": NOISE, "seed": SEED},
        pictures={OBS_IMAGE: seen},
    )


def success(policy, arms) -> dict[str, float]:
    """The share of the arms that succeed within STEPS from starts of their own."""
    policy.reset()
    torch.manual_seed(SEED)
    seen = [arm.reset(seed=STARTS + i)[0] for i, arm in enumerate(arms)]
    done = [False] * len(arms)
    for _ in range(STEPS):
        batch = {
            OBS_STATE: torch.tensor(np.stack([one["agent_pos"] for one in seen])).float(),
            OBS_IMAGE: torch.stack([picture(one["pixels"]) for one in seen]) / 255,
        }
        for i, action in enumerate(policy.select_action(batch).clamp(-1, 1).numpy()):
            if not done[i]:
                seen[i], _, done[i], _, _ = arms[i].step(action)
        if all(done):
            break
    share = sum(done) / len(done)
    return {"success": share, "standard_error": (share * (1 - share) / len(done)) ** 0.5}


def main(output: Path, root: Path) -> None:
    torch.set_num_threads(1)
    load_metaworld()
    build(root)
    print("built", round(time.process_time()), flush=True)
    arms = [make_arm() for _ in range(ROLLOUTS)]
    trainer = Trainer(UNIMASK, root, seed=SEED, steps=1500, batch_size=64)
    began = time.process_time()
    losses = list(trainer)
    spent = time.process_time() - began
    runs = [{"policy": "unimask", "updates": len(losses), "train_processor_seconds": round(spent, 1)}]
    runs[0]["parameters"] = sum(parameter.numel() for parameter in trainer.policy.parameters())
    runs[0] |= success(trainer.policy.eval(), arms)
    print(runs, losses[-1], round(time.process_time()), flush=True)
    wanted = argparse.Namespace(root=root, policy="act", seed=SEED, seconds=spent, batch_size=32, settings=ACT)
    acting, facts = train(wanted)
    runs.append({"policy": "act", **facts, **success(acting, arms)})
    print(runs, round(time.process_time()), flush=True)
    record = {
        "command": f"MUJOCO_GL=egl OMP_NUM_THREADS=1 python tests/measuring/arm_pictures.py --output={output}",
        "config": {"task": TASK, "episodes": EPISODES, "noise": NOISE, "unimask": UNIMASK, "act": ACT, "seed": SEED},
        "rollouts": ROLLOUTS,
        "starts": STARTS,
        "runs": runs,
        "versions": versions("metaworld"),
        "machine": describe_machine(),
    }
    write_json(output, record)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    with tempfile.TemporaryDirectory() as temporary:
        main(parser.parse_args().output, Path(temporary) / "arm")
