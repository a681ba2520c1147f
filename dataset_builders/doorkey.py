"""DoorKey datasets: the noisy-rational expert of the paper, rolled out over the rules' tables."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION, DONE, OBS_STATE, REWARD
from tqdm import tqdm

from dataset_builders.folders import refuse_existing
from dataset_builders.videos import CAMERA, camera_feature
from dataset_builders.writer import SUCCESS, SUCCESS_FEATURE, write_dataset
from lerobot_unimask.data.returns import return_to_go
from lerobot_unimask.envs.doorkey.environment import CAMERA_SHAPE, DoorKeyEnv
from lerobot_unimask.envs.doorkey.episodes import Episodes, rollout
from lerobot_unimask.envs.doorkey.expert import Expert
from lerobot_unimask.envs.doorkey.rules import ACTIONS, CELLS, ENV_ID, FPS, GOAL, HORIZON, TASK

CHUNK = 10_000  # episodes rolled out at a time

FEATURES: dict[str, dict[str, Any]] = {
    OBS_STATE: {
        "dtype": "int64",
        "shape": (2,),
        "names": ["agent_cell", "key_cell"],
        "categories": [len(CELLS), len(CELLS)],
    },
    ACTION: {"dtype": "int64", "shape": (1,), "names": ["direction"], "categories": [len(ACTIONS)]},
    "observation.return_to_go": {"dtype": "float32", "shape": (1,), "names": ["return_to_go"]},
    SUCCESS: SUCCESS_FEATURE,
    REWARD: {"dtype": "float32", "shape": (1,), "names": None},
    DONE: {"dtype": "bool", "shape": (1,), "names": None},
}


def frames(episodes: Episodes) -> dict[str, np.ndarray]:
    """The columns of `FEATURES`, (N, ...), of the steps that are stored: the state after the last action is not, and
    may still be the goal."""
    count, horizon = episodes.action.shape
    rewards = episodes.reward.reshape(-1).astype(np.float32)
    return {
        OBS_STATE: np.stack([episodes.agent[:, :-1], episodes.key[:, :-1]], axis=-1).reshape(-1, 2),
        ACTION: episodes.action.reshape(-1, 1),
        "observation.return_to_go": return_to_go(rewards, np.full(count, horizon))[:, None],
        SUCCESS: (episodes.agent == GOAL).any(axis=1).astype(np.int64).repeat(horizon)[:, None],
        REWARD: rewards[:, None],
        DONE: np.tile(np.arange(horizon) == horizon - 1, count)[:, None],
    }


def build_doorkey(
    root: str | Path,
    *,
    episodes: int,
    seed: int = 0,
    expert: Expert = "paper",
    repo_id: str | None = None,
    beta: float = 1.0,
    camera: bool = False,
    use_videos: bool = True,
    progress: bool = True,
) -> Path:
    """Roll out the expert and write a LeRobotDataset.

    The same seed gives the same episodes, and a larger build begins with the episodes of a smaller one.

    Args:
        root: folder of the dataset: new, or an existing empty one.
        episodes: number of episodes, each of 10 steps.
        seed: number that starts and actions follow from.
        expert: "paper" or "released", see `expert_progress`.
        repo_id: name of the dataset, `ME/NAME`; `local/doorkey` if None.
        beta: rationality of the expert.
        camera: whether there is `observation.images.top`, a video of the grid as MiniGrid draws it.
        use_videos: whether it is a video; else pictures in the table.
        progress: whether to show progress bars, on a terminal.

    Returns:
        The dataset's folder.

    Raises:
        FileExistsError: `root` exists and is not an empty folder; it is left as it was.
        ValueError: an argument is out of range.
    """
    root = refuse_existing(root)  # now, rather than after the work
    if episodes < 1 or seed < 0:
        raise ValueError(f"episodes must be at least 1 and seed at least 0, got {episodes} and {seed}.")
    rng = np.random.default_rng(seed)
    chunks = [min(CHUNK, episodes - first) for first in range(0, episodes, CHUNK)]
    bar = tqdm(chunks, desc="Rolling out DoorKey", unit="chunk", disable=None if progress else True)
    parts = [frames(rollout(count, rng, expert=expert, beta=beta)) for count in bar]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in FEATURES}
    provenance: dict[str, Any] = {
        "environment": ENV_ID,
        "expert": expert,
        "beta": beta,
        "seed": seed,
        "episodes": episodes,
        "camera": camera,
    }
    return write_dataset(
        root,
        repo_id=repo_id or "local/doorkey",
        fps=FPS,
        features=FEATURES | ({CAMERA: camera_feature(*CAMERA_SHAPE[:2], use_videos=use_videos)} if camera else {}),
        columns=columns,
        lengths=np.full(episodes, HORIZON),
        task=TASK,
        robot_type="doorkey",
        provenance=provenance,
        progress=progress,
        pictures={CAMERA: _pictures(columns[OBS_STATE], columns[ACTION])} if camera else None,
    )


def _pictures(states: np.ndarray, actions: np.ndarray) -> Iterator[np.ndarray]:
    """What the camera sees before each action of whole episodes, played again: (N, 2) and (N, 1)."""
    env = DoorKeyEnv()
    for step, ((agent, key), action) in enumerate(zip(states.tolist(), actions, strict=True)):
        if step % HORIZON == 0:
            env.reset(options={"agent": agent, "key": key})
        yield env.camera_picture()
        env.step(action)
