"""A dataset's episodes as windows: opening a dataset, reading windows of it, and where it came from.

Legend of shapes: B windows, K steps, E episodes.
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from torch.utils.data import default_collate

LOCAL = "local/dataset"  # the name of a dataset that is read from a folder, where nobody gives it one


def check_folder(root: Path) -> None:
    """
    Raises:
        FileNotFoundError: there is no dataset in `root`. (LeRobot would ask the Hub for it.)
    """
    if not (root / "meta" / "info.json").exists():
        raise FileNotFoundError(f"{root} holds no LeRobotDataset: there is no meta/info.json in it.")


def open_dataset(
    config: PreTrainedConfig, root: Path | None, repo_id: str | None = None, *, episodes: list[int] | None = None
) -> LeRobotDataset:
    """A dataset whose items are windows of a policy with this config.

    Args:
        root: the dataset's folder; None: the Hub's cache, by `repo_id`.
        episodes: to load, else all.

    Raises:
        FileNotFoundError: there is no dataset in `root`.
    """
    if root is not None:
        check_folder(root)
    repo_id = repo_id or LOCAL
    meta = LeRobotDatasetMetadata(repo_id, root=root)
    deltas = resolve_delta_timestamps(config, meta)
    return LeRobotDataset(repo_id, root=root, delta_timestamps=deltas, episodes=episodes)


def bounds_of(dataset: LeRobotDataset) -> list[tuple[int, int]]:
    """Each episode's first frame, and the one after its last."""
    episodes = dataset.meta.episodes
    return list(zip(episodes["dataset_from_index"], episodes["dataset_to_index"], strict=True))


def read_windows(dataset: LeRobotDataset, frames: Sequence[int]) -> dict[str, Tensor]:
    """The windows that begin at these frames, as one LeRobot batch, (B, K, ...)."""
    read = getattr(dataset, "__getitems__", None)  # in batches, where `reads` serves this dataset
    return default_collate(read(frames) if read else [dataset[frame] for frame in frames])


def read_window(dataset: LeRobotDataset, episode: int, start: int = 0) -> dict[str, Tensor]:
    """The window at one step of one episode, as a LeRobot batch of one.

    Raises:
        ValueError: there is no such episode or step.
    """
    bounds = bounds_of(dataset)
    if not 0 <= episode < len(bounds):
        raise ValueError(f"There is no episode {episode}: this dataset's are 0 to {len(bounds) - 1}.")
    first, end = bounds[episode]
    if not 0 <= start < end - first:
        raise ValueError(f"Episode {episode} has no step {start}: its steps are 0 to {end - first - 1}.")
    return read_windows(dataset, [first + start])


def first_windows(dataset: LeRobotDataset) -> dict[str, Tensor]:
    """The window at each episode's first step, as one LeRobot batch, (E, K, ...)."""
    return read_windows(dataset, [first for first, _ in bounds_of(dataset)])


def middle_windows(dataset: LeRobotDataset, most: int = 200) -> dict[str, Tensor]:
    """The windows in the middle of the first episodes, as a LeRobot batch."""
    return read_windows(dataset, [(first + end) // 2 for first, end in bounds_of(dataset)[:most]])


def episode_numbers(text: str, count: int) -> list[int]:
    """The episodes that a text names, `0:50` or `3,5,7`, of a dataset of `count`.

    Raises:
        ValueError: another text, or an episode that the dataset does not have.
    """
    if match := re.fullmatch(r"(\d*):(\d*)", text):
        numbers = list(range(int(match[1] or 0), int(match[2] or count)))
    elif re.fullmatch(r"\d+(,\d+)*", text):
        numbers = [int(number) for number in text.split(",")]
    else:
        numbers = []
    if not numbers or max(numbers) >= count:
        raise ValueError(f"episodes is {text!r}; write 0:50 or 3,5,7: this dataset's are 0 to {count - 1}.")
    return numbers


def provenance_of(root: Path) -> dict[str, Any]:
    """How a dataset was built: environment, expert, maze, seed, command, ...; empty where it was not built here."""
    path = root / "meta" / "provenance.json"
    return json.loads(path.read_text()) if path.exists() else {}
