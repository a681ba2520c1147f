"""DoorKey asked by a picture of how things are to stand after nine actions, and the same policy without one.

    python tests/measuring/goal_pictures.py --output=docs/results/doorkey_goal_pictures.json

Each rollout starts where an episode that was not trained on started; asked for is the picture of its last step. Reached
is the pictured state: agent and key in the same cells at that step.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

import torch

import lerobot_policy_unimask  # noqa: F401
from dataset_builders.doorkey import build_doorkey
from lerobot_unimask.data.episodes import first_windows, open_dataset
from lerobot_unimask.envs.doorkey.environment import DoorKeyEnv
from lerobot_unimask.machine import describe_machine
from lerobot_unimask.records import versions, write_json
from lerobot_unimask.training import Trainer

KEY, K = "observation.images.top", 10
GOAL, IMITATION = "a[t] | state[:t+1], a[:t], top[-1]", "a[t] | state[:t+1], a[:t]"
READING = "state[-1] | top[-1]"  # what a picture shows, learnt sooner from its own numbers than from actions
SETTINGS = {
    "device": "cpu", "context_length": K, "image_size": [48, 48], "causal_share": 0.1, "inference_mask": IMITATION,
    "training_masks": {GOAL: 0.8, READING: 0.1, IMITATION: 0.1},
    "width": 128, "depth": 3, "heads": 4, "feedforward_width": 256, "dropout": 0.1,
}  # fmt: skip
EPISODES, UPDATES, BATCH, ROLLOUTS, SEED = 3000, 6000, 64, 500, 0


def reached(policy, states, **question) -> float:
    """The share of rollouts from (B, K, 2) states' first that stand at the last of them after K - 1 actions."""
    policy.reset()
    torch.manual_seed(SEED)
    environments = [DoorKeyEnv(obs_type="pixels_agent_pos") for _ in states]
    starts = [{"agent": int(agent), "key": int(key)} for agent, key in states[:, 0].tolist()]
    seen = [env.reset(options=start)[0] for env, start in zip(environments, starts, strict=True)]
    for _ in range(K - 1):
        observation = {
            "observation.state": torch.tensor([one["agent_pos"].tolist() for one in seen]).float(),
            KEY: torch.stack([torch.from_numpy(one["pixels"]["top"]).permute(2, 0, 1) for one in seen]),
        }
        actions = policy.select_action(observation, **question)
        seen = [env.step(action.numpy())[0] for env, action in zip(environments, actions, strict=True)]
    last = torch.tensor([one["agent_pos"].tolist() for one in seen])
    return (last == states[:, -1].long()).all(1).float().mean().item()


def main(output: Path, folder: Path) -> None:
    began = time.perf_counter()
    build_doorkey(folder / "seen", episodes=EPISODES, seed=SEED, camera=True, progress=False)
    build_doorkey(folder / "unseen", episodes=ROLLOUTS, seed=SEED + 1, camera=True, progress=False)
    trainer = Trainer(SETTINGS, folder / "seen", seed=SEED, steps=UPDATES, batch_size=BATCH)
    losses = list(trainer)
    policy = trainer.policy.eval()
    trained = time.perf_counter() - began
    batch = first_windows(open_dataset(policy.config, folder / "unseen"))
    states, goals = batch["observation.state"], batch[KEY][:, -1]
    shares = {
        "goal picture": reached(policy, states, mask=GOAL, given={"top[-1]": goals}),
        "another episode's goal picture": reached(policy, states, mask=GOAL, given={"top[-1]": goals.roll(1, 0)}),
        "imitation, most likely actions": reached(policy, states, mask=IMITATION),
        "imitation, drawn actions": reached(policy, states, mask=IMITATION, sample=True),
        "goal picture, drawn actions": reached(policy, states, mask=GOAL, given={"top[-1]": goals}, sample=True),
    }
    record = {
        "command": f"python tests/measuring/goal_pictures.py --output={output}",
        "config": {"settings": SETTINGS, "episodes": EPISODES, "updates": UPDATES, "batch": BATCH, "seed": SEED},
        "rollouts": ROLLOUTS,
        "reached": shares,
        "loss": {"first 100": sum(losses[:100]) / 100, "last 100": sum(losses[-100:]) / 100},
        "seconds": {"building and training": round(trained), "all": round(time.perf_counter() - began)},
        "versions": versions(),
        "machine": describe_machine(),
    }
    write_json(output, record)
    print(json.dumps(shares, indent=2))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        main(Path(sys.argv[1].removeprefix("--output=")), Path(temporary))
