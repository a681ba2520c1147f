"""A dataset's episodes as windows: opening a dataset, reading windows of it, and where it came from.

Legend of shapes: B windows, K steps, E episodes.
"""

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from string import Formatter
from typing import Any, NoReturn

import datasets
import pandas as pd
from datasets.features.features import string_to_arrow
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.feature_utils import get_delta_indices
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from torch.utils.data import default_collate

from lerobot_unimask.data.factors import TEXTS
from lerobot_unimask.data.reads import read_cameras
from lerobot_unimask.data.soundness import are_statistics
from lerobot_unimask.records import read_json

MAX_FPS = 1_000_000
MAX_COUNT = 10**12  # of episodes, frames, numbers: more is a damaged file
TASKS = "meta/tasks.parquet"
MAX_DIMENSIONS = 5  # of a number of LeRobot's columns
LOCAL = "local/dataset"  # the name of a dataset that is read from a folder, where nobody gives it one


def check_folder(root: Path) -> None:
    """
    Raises:
        FileNotFoundError: there is no dataset in `root`. (LeRobot would ask the Hub for it.)
        ValueError: its info.json is damaged.
    """
    if not (root / "meta" / "info.json").exists():
        raise FileNotFoundError(f"{root} holds no LeRobotDataset: there is no meta/info.json in it.")
    read_info(root)


def check_format(root: Path) -> None:
    """
    Raises:
        FileNotFoundError: it has no texts of tasks.
        ValueError: its info.json, stats.json or tasks are damaged, or its format is one that LeRobot no longer reads.
    """
    info = read_info(root)
    version = info["codebase_version"]
    if version.startswith("v2.1"):
        raise ValueError(
            f"{root} has LeRobot's format {version}, and LeRobot reads v3.0: `unimask prepare --dataset.root={root} "
            "--output=DIR` writes it anew."
        )
    check_age(root, version)
    if not (root / TASKS).exists():
        raise FileNotFoundError(f"{root} lacks {TASKS}, the texts of its tasks: part of the dataset has not arrived.")
    if order_of_tasks(root) is not None:
        raise ValueError(
            f"{root / TASKS} does not list the texts of task_index 0, 1, 2 and so on, in this order, and LeRobot would "
            f"take one for another: `unimask prepare --dataset.root={root} --output=DIR` puts them in order."
        )
    for key, entry in info["features"].items():
        if not is_type(entry["dtype"]) or not 1 <= len(entry["shape"]) <= MAX_DIMENSIONS:
            raise ValueError(
                f"{root / 'meta' / 'info.json'} gives {key} the dtype {entry['dtype']!r} and the shape "
                f"{entry['shape']}, which LeRobot has no column for: `unimask prepare --dataset.root={root} "
                "--output=DIR` makes it one of numbers as they are stored."
            )
    path = root / "meta" / "stats.json"
    for key, known in (read_json(path) if path.exists() else {}).items():
        if not are_statistics(known):
            raise ValueError(
                f"{path} holds for {key} what are no statistics, {str(known)[:80]}: `unimask prepare "
                f"--dataset.root={root} --output=DIR` leaves them out, or recomputes them."
            )


def check_age(root: Path, version: str) -> None:
    """
    Raises:
        ValueError: a format before the one that LeRobot converts.
    """
    if version.startswith(("v1", "v2.0")):
        raise ValueError(
            f"{root} has LeRobot's format {version}; LeRobot reads v3.0 and converts v2.1. LeRobot 0.3 brings it there "
            "with python -m lerobot.datasets.v21.convert_dataset_v20_to_v21, which takes v2.0."
        )


def order_of_tasks(root: Path) -> dict[int, str] | None:
    """task_index -> text, by rising numbers, as a dataset's table of tasks has them; None where the table is as LeRobot
    reads it: its index are the texts, and the n-th row has number n."""
    table = pd.read_parquet(root / TASKS)
    texts = table.get("task", table.index)
    numbers = table["task_index"].tolist()
    if "task" not in table and numbers == list(range(len(numbers))) and all(isinstance(text, str) for text in texts):
        return None
    return dict(sorted(zip(numbers, map(str, texts), strict=True)))


def is_type(dtype: str) -> bool:
    """Whether a column of info.json can have this dtype."""
    try:
        return dtype in ("image", "video", *TEXTS) or bool(string_to_arrow(dtype))
    except ValueError:
        return False


def check_home() -> None:
    """
    Raises:
        OSError: there is no place to write tables to. (LeRobot would take the dataset for one that is not there.)
    """
    folder = Path(datasets.config.HF_DATASETS_CACHE)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(
            f"{folder} cannot be written to ({error.strerror}), and a dataset's tables are kept there: set HF_HOME or "
            "HF_DATASETS_CACHE to a folder that can."
        ) from error


def read_info(root: Path) -> dict[str, Any]:
    """A dataset's meta/info.json, its entries of the types and sizes that they can have.

    Raises:
        ValueError: names the entry that has another, or a path that leads out of the folder.
    """
    path = root / "meta" / "info.json"
    info = read_json(path)
    if not isinstance(info, dict):
        raise ValueError(f"{path} holds a {type(info).__name__}; it is a mapping of entries.")

    def refuse(entry: str, value: Any, wanted: str) -> NoReturn:
        raise ValueError(f"{path} has {entry} {str(value)[:80]!r}; it is {wanted}.")

    fps, features = info.get("fps"), info.get("features")
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 < fps <= MAX_FPS:
        refuse("fps", fps, f"a number above 0, at most {MAX_FPS}")
    if not isinstance(features, dict):
        refuse("features", features, "a mapping of columns")
    for key, feature in features.items():
        shape = feature.get("shape") if isinstance(feature, dict) else None
        if not isinstance(shape, list) or not all(_is_count(size, 1, MAX_COUNT) for size in shape):
            refuse(f"features.{key}", feature, "a mapping with a dtype and a shape, a list of sizes from 1 on")
        if not isinstance(feature.get("dtype"), str):
            refuse(f"features.{key}.dtype", feature.get("dtype"), "a text")
        if feature["dtype"] in ("image", "video") and len(shape) != 3:
            refuse(f"features.{key}.shape", shape, "a picture's height, width and channels, as in [480, 640, 1]")
    for entry in ("total_episodes", "total_frames"):
        if not _is_count(info.get(entry), 0, MAX_COUNT):
            refuse(entry, info.get(entry), f"a whole number from 0 to {MAX_COUNT}")
    for entry in ("chunks_size", "data_files_size_in_mb", "video_files_size_in_mb"):
        if entry in info and not _is_count(info[entry], 1, MAX_COUNT):
            refuse(entry, info[entry], f"a whole number from 1 to {MAX_COUNT}")
    if not isinstance(info.get("codebase_version"), str):
        refuse("codebase_version", info.get("codebase_version"), "a text, such as v3.0")
    for entry in ("data_path", "video_path"):
        if info.get(entry) is not None and not _is_inner_path(info[entry]):
            refuse(entry, info[entry], "a path inside the folder, of {chunk_index:03d}, {file_index:03d}, {video_key}")
    return info


def _is_count(value: Any, least: int, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _is_inner_path(text: Any) -> bool:
    """Whether a pattern of file names stays inside its folder, and has none but LeRobot's fields, short ones."""
    try:
        parts = list(Formatter().parse(text))
    except (TypeError, ValueError):
        return False
    fields = {name: form for _, name, form, _ in parts if name is not None}
    known = {"chunk_index", "file_index", "video_key", "episode_chunk", "episode_index"}
    plain = all(re.fullmatch(r"(0?\d?d?)?", form or "") for form in fields.values())
    inner = not PurePosixPath(text).is_absolute() and ".." not in PurePosixPath(text.replace("\\", "/")).parts
    return fields.keys() <= known and plain and inner and all(part[3] is None for part in parts)


def open_dataset(
    config: Any, root: Path | None, repo_id: str | None = None, *, episodes: list[int] | None = None
) -> LeRobotDataset:
    """A dataset whose items are windows of a policy with this `UniMASKConfig`, its cameras those that it reads.

    Args:
        root: folder of the dataset; None: the Hub's cache, by `repo_id`.
        episodes: numbers of those to load; None: all.

    Raises:
        FileNotFoundError: there is no dataset in `root`.
    """
    if root is not None:
        check_folder(root)
        check_format(root)
    check_home()
    repo_id = repo_id or LOCAL
    dataset = LeRobotDataset(repo_id, root=root, episodes=episodes, return_uint8=True)
    # The constructor takes seconds, which depend on the metadata; to read these twice takes as long as all the rest.
    dataset.delta_timestamps = resolve_delta_timestamps(config, dataset.meta)
    dataset.reader.delta_indices = get_delta_indices(dataset.delta_timestamps or {}, dataset.fps)
    read_cameras(dataset, config)
    return dataset


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
    return read_json(path) if path.exists() else {}
