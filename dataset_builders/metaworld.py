"""Builds a LeRobotDataset of a MetaWorld task: demonstrations by its scripted expert from new starts."""

from pathlib import Path
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION, DONE, OBS_ENV_STATE, OBS_STATE, REWARD
from tqdm import tqdm

from dataset_builders.writer import refuse_existing, write_dataset
from lerobot_unimask.envs.metaworld.environment import ENV_ID, FPS, HAND, MetaWorldEnv
from lerobot_unimask.envs.metaworld.expert import demonstrate, make_expert
from lerobot_unimask.envs.metaworld.record import HAND_NAMES

MOST_FAILURES = 10  # for each episode wanted


def build_metaworld(
    root: str | Path,
    *,
    task: str,
    episodes: int = 100,
    seed: int = 0,
    noise: float = 0.1,
    repo_id: str | None = None,
    progress: bool = True,
) -> Path:
    """Roll out the expert and write the dataset; episodes that fail are left out and counted in its provenance.

    Args:
        root: folder of the dataset: new, or an existing empty one.
        task: name of the task, such as `peg-insert-side-v3`.
        episodes: number of them, all successful.
        seed: number that starts and noise follow from.
        noise: standard deviation of the noise on half of the steps.
        repo_id: name of the dataset, `ME/NAME`; `local/TASK` if None.
        progress: whether to show a progress bar, on a terminal.

    Returns:
        The dataset's folder.

    Raises:
        FileExistsError: `root` exists and is not an empty folder; it is left as it was.
        ValueError: an argument out of range, no such task, or an expert that almost never succeeds.
    """
    root = refuse_existing(root)  # now, rather than after the work
    if episodes < 1 or seed < 0 or not noise >= 0:
        raise ValueError(f"episodes is {episodes}, seed {seed}, noise {noise}; the least are 1, 0 and 0.")
    env, expert, rng = MetaWorldEnv(task, render_mode=None), make_expert(task), np.random.default_rng(seed)
    found: list[Any] = []
    failures = 0
    with tqdm(total=episodes, desc=f"Demonstrating {task}", disable=None if progress else True) as bar:
        while len(found) < episodes:
            demonstration = demonstrate(env, expert, noise, rng)
            if demonstration is None:
                failures += 1
                if failures > MOST_FAILURES * episodes:
                    raise ValueError(f"The expert of {task} failed {failures} times with noise {noise}: try less.")
                continue
            found.append(demonstration)
            bar.update()
    lengths = np.array([len(one.reward) for one in found])
    places = [f"object{i}_{name}" for i in range(env.objects) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    names = [*places, "goal_x", "goal_y", "goal_z"]
    features: dict[str, dict[str, Any]] = {
        OBS_STATE: {"dtype": "float32", "shape": (HAND,), "names": list(HAND_NAMES)},
        OBS_ENV_STATE: {"dtype": "float32", "shape": (env.numbers,), "names": names},
        ACTION: {"dtype": "float32", "shape": (4,), "names": ["dx", "dy", "dz", "grip"]},
        REWARD: {"dtype": "float32", "shape": (1,), "names": None},
        DONE: {"dtype": "bool", "shape": (1,), "names": None},
    }
    columns = {
        OBS_STATE: np.concatenate([one.hand for one in found]),
        OBS_ENV_STATE: np.concatenate([one.environment for one in found]),
        ACTION: np.concatenate([one.action for one in found]),
        REWARD: np.concatenate([one.reward for one in found])[:, None],
        DONE: np.isin(np.arange(lengths.sum()), lengths.cumsum() - 1)[:, None],
    }
    return write_dataset(
        root,
        repo_id=repo_id or f"local/{task}",
        fps=FPS,
        features=features,
        columns=columns,
        lengths=lengths,
        task=env.task_description,
        robot_type="metaworld_state",
        provenance={
            "environment": ENV_ID,
            "task": task,
            "expert": "scripted",
            "noise": noise,
            "seed": seed,
            "episodes": episodes,
            "failures": failures,
        },
        progress=progress,
    )
