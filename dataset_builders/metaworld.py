"""Builds a LeRobotDataset of MetaWorld tasks: demonstrations by their scripted experts from new starts."""

from pathlib import Path
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION, DONE, OBS_ENV_STATE, OBS_STATE, REWARD
from tqdm import tqdm

from dataset_builders.folders import refuse_existing
from dataset_builders.writer import SUCCESS, SUCCESS_FEATURE, write_dataset
from lerobot_unimask.envs.metaworld.environment import ENV_ID, FPS, HAND, MetaWorldEnv
from lerobot_unimask.envs.metaworld.expert import Demonstration, demonstrate, make_expert
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
    """Roll out the experts and write the dataset; episodes that fail are left out and counted in its provenance.

    Args:
        root: folder of the dataset: new, or an existing empty one.
        task: name of the task, such as `peg-insert-side-v3`; or several, comma-separated, each told in an episode's
            `task` and all observed with as many objects as the one that has most.
        episodes: number of each task's, all successful.
        seed: number that each task's starts and noise follow from.
        noise: standard deviation of the noise on half of the steps.
        repo_id: name of the dataset, `ME/NAME`; `local/` and the first task's name if None.
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
    names = task.split(",")
    objects = max(MetaWorldEnv(name, render_mode=None).objects for name in names)
    envs = [MetaWorldEnv(name, objects, render_mode=None) for name in names]
    demonstrated = [_demonstrate(env, episodes, noise, seed, progress) for env in envs]
    failures = {env.task: count for env, (_, count) in zip(envs, demonstrated, strict=True)}
    # One of each task in turn, so that episodes held out at the end are of all
    found = [one for each in zip(*(of_task for of_task, _ in demonstrated), strict=True) for one in each]
    lengths = np.array([len(one.reward) for one in found])
    places = [f"object{i}_{name}" for i in range(objects) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    places += ["goal_x", "goal_y", "goal_z"]
    features: dict[str, dict[str, Any]] = {
        OBS_STATE: {"dtype": "float32", "shape": (HAND,), "names": list(HAND_NAMES)},
        OBS_ENV_STATE: {"dtype": "float32", "shape": (len(places),), "names": places},
        ACTION: {"dtype": "float32", "shape": (4,), "names": ["dx", "dy", "dz", "grip"]},
        SUCCESS: SUCCESS_FEATURE,
        REWARD: {"dtype": "float32", "shape": (1,), "names": None},
        DONE: {"dtype": "bool", "shape": (1,), "names": None},
    }
    columns = {
        OBS_STATE: np.concatenate([one.hand for one in found]),
        OBS_ENV_STATE: np.concatenate([one.environment for one in found]),
        ACTION: np.concatenate([one.action for one in found]),
        SUCCESS: np.ones((lengths.sum(), 1), np.int64),  # the others are left out
        REWARD: np.concatenate([one.reward for one in found])[:, None],
        DONE: np.isin(np.arange(lengths.sum()), lengths.cumsum() - 1)[:, None],
    }
    return write_dataset(
        root,
        repo_id=repo_id or f"local/{names[0]}",
        fps=FPS,
        features=features,
        columns=columns,
        lengths=lengths,
        task=[env.task_description for env in envs] * episodes,
        robot_type="metaworld_state",
        provenance={
            "environment": ENV_ID,
            "task": task,
            "expert": "scripted",
            "noise": noise,
            "seed": seed,
            "episodes": episodes,
            "failures": failures if len(envs) > 1 else failures[task],
        },
        progress=progress,
    )


def _demonstrate(
    env: MetaWorldEnv, episodes: int, noise: float, seed: int, progress: bool
) -> tuple[list[Demonstration], int]:
    """Successful episodes of one task, and the number of those that failed."""
    expert, rng = make_expert(env.task), np.random.default_rng(seed)
    found: list[Demonstration] = []
    failures = 0
    with tqdm(total=episodes, desc=f"Demonstrating {env.task}", disable=None if progress else True) as bar:
        while len(found) < episodes:
            demonstration = demonstrate(env, expert, noise, rng)
            if demonstration is None:
                failures += 1
                if failures > MOST_FAILURES * episodes:
                    raise ValueError(f"The expert of {env.task} failed {failures} times with noise {noise}: try less.")
                continue
            found.append(demonstration)
            bar.update()
    return found, failures
