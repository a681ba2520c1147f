"""The least that a user would expect of MetaWorld's arm: a perceptron, squared error, one observation to one action.

Two hidden layers of 256, Adam, 128 frames an update, a rate that falls to 0 along a cosine. `arm_tasks.py` runs it.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as parquet
import torch
from torch import Tensor, nn

from lerobot_unimask.envs.metaworld.environment import HORIZON, MetaWorldEnv


def read(root: Path) -> tuple[Tensor, Tensor]:
    """Observations (N, D) and actions (N, 4) of all frames."""
    columns = ("observation.state", "observation.environment_state", "action")
    table = parquet.read_table(sorted(root.glob("data/**/*.parquet")), columns=list(columns)).to_pydict()
    hand, rest, action = (torch.tensor(table[name], dtype=torch.float32) for name in columns)
    return torch.cat([hand, rest], -1), action


def train(observations: Tensor, actions: Tensor, updates: int, seed: int, rate: float) -> nn.Module:
    """A perceptron from normalised observations to actions."""
    generator = torch.manual_seed(seed)
    size, out = observations.shape[-1], actions.shape[-1]
    network = nn.Sequential(nn.Linear(size, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, out))
    optimizer = torch.optim.Adam(network.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    for _ in range(updates):
        chosen = torch.randint(len(observations), (128,), generator=generator)
        loss = (network(observations[chosen]) - actions[chosen]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network


@torch.no_grad()
def success(network: nn.Module, task: str, episodes: int, seed: int, normalise: Any) -> dict[str, Any]:
    """Share of episodes from unseen starts that succeed."""
    env, successes = MetaWorldEnv(task, render_mode=None), []
    for i in range(episodes):
        observation, _ = env.reset(seed=seed + i)
        for _ in range(HORIZON):
            seen = np.concatenate([observation["agent_pos"], observation["environment_state"]])
            observation, _, succeeded, truncated, _ = env.step(network(normalise(torch.as_tensor(seen))).numpy())
            if succeeded or truncated:
                break
        successes.append(succeeded)
    share = float(np.mean(successes))
    return {"success": share, "standard_error": (share * (1 - share) / episodes) ** 0.5, "episodes": episodes}


def run(root: Path, task: str, seed: int, updates: int, episodes: int, starts: int) -> dict[str, Any]:
    """Train a perceptron on a dataset and roll it out."""
    observations, actions = read(root)
    mean, deviation = observations.mean(0), observations.std(0).clamp_min(1e-6)

    def normalise(x: Tensor) -> Tensor:
        return (x - mean) / deviation

    began = time.process_time()
    network = train(normalise(observations), actions, updates, seed, rate=1e-3)
    seconds = time.process_time() - began
    return {
        "train_processor_seconds": round(seconds, 1),
        **success(network, task, episodes, starts, normalise),
    }
