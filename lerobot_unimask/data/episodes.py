"""A dataset's episodes as windows: opening a dataset, reading windows of it, and where it came from.

Legend of shapes: B windows, K steps, E episodes.
"""

import logging
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from string import Formatter
from typing import Any, NoReturn

import datasets
import numpy as np
import pandas as pd
from datasets.features.features import string_to_arrow
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.feature_utils import get_delta_indices
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import DEFAULT_DATA_PATH, DEFAULT_VIDEO_PATH
from lerobot.utils.constants import HF_LEROBOT_HOME
from torch import Tensor
from torch.utils.data import default_collate

from lerobot_unimask.data.factors import TEXTS
from lerobot_unimask.data.reads import read_cameras
from lerobot_unimask.data.soundness import data_files, episode_files, naming, outline, read_table
from lerobot_unimask.records import read_json

logger = logging.getLogger(__name__)

MAX_FPS = 1_000_000
MAX_COUNT = 10**12  # of episodes, frames, numbers: more is a damaged file
TASKS = "meta/tasks.parquet"
FIELDS, OLD_FIELDS = ("chunk_index", "file_index", "video_key"), ("episode_chunk", "episode_index")
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
        ValueError: its info.json, tasks or tables are damaged, or its format is one that LeRobot no longer reads.
    """
    info = read_info(root)
    version = info["codebase_version"]
    if version.startswith("v2.1"):
        raise ValueError(
            f"{root} has LeRobot's format {version}, and LeRobot reads v3.0: `unimask prepare --dataset.root={root} "
            "--output=DIR` writes it anew."
        )
    check_age(root, version)
    if (root / TASKS).exists() and order_of_tasks(root) is not None:
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
    check_tables(root, info)


def check_tables(root: Path, info: Mapping[str, Any], without: Sequence[str] = ()) -> None:
    """
    Args:
        without: columns that need not be there.

    Raises:
        ValueError: a table of the columns or of the episodes cannot be read, lacks a column, or has other rows than the
            metadata count, though no file is missing.
    """
    columns = {key for key, entry in info["features"].items() if entry["dtype"] != "video" and key not in without}
    rows, episodes = 0, sum(outline(path)[0] for path in episode_files(root))
    for path in data_files(root):
        count, names = outline(path)
        rows += count
        lacking = sorted(columns - set(names))
        if lacking:
            raise ValueError(
                f"{path} lacks {', '.join(lacking)}, which meta/info.json names: fetch the file anew, or `unimask "
                f"prepare --dataset.root={root} --drop {lacking[0]} --output=DIR` does without."
            )
    if any(key not in without for key in absent_files(root, info)):
        return
    first, end, lengths = _places(root)
    wrong = np.flatnonzero((first < 0) | (end - first != lengths))
    if len(wrong):
        raise ValueError(
            f"meta/episodes of {root} gives its episode {wrong[0]} the rows from {first[wrong[0]]} up to "
            f"{end[wrong[0]]} and {lengths[wrong[0]]} frames: fetch what is damaged anew."
        )
    frames, last = int(lengths.sum()), end.max(initial=0)
    if rows != frames or last > rows or frames < info["total_frames"] or episodes < info["total_episodes"]:
        raise ValueError(
            f"{root} counts {info['total_frames']} frames of {info['total_episodes']} episodes in meta/info.json, "
            f"{frames} of {episodes} in meta/episodes, and has {rows} in data: these have to agree, so fetch anew what "
            "is damaged."
        )


def _places(root: Path) -> np.ndarray:
    """Each episode's first row, the one after its last, and how many it has, (3, E)."""
    names = ["dataset_from_index", "dataset_to_index", "length"]
    rows = [np.zeros((0, 3), np.int64)]
    for path in episode_files(root):
        there = [name for name in names if name in outline(path)[1]]
        table = read_table(path, there).to_pandas()
        try:
            rows.append(table[names].to_numpy(np.int64))
        except (KeyError, ValueError, TypeError) as error:
            raise ValueError(f"{path} lacks whole numbers as {', '.join(names)}: fetch it anew.") from error
    return np.concatenate(rows).T


def absent_files(root: Path, info: Mapping[str, Any], episodes: Sequence[int] | None = None) -> dict[str, list[str]]:
    """What a dataset's metadata name and its folder lacks: a column of videos, or "" for all others -> paths.

    Args:
        episodes: those whose files count; None: all.
    """
    files, counting = episode_files(root), None if episodes is None else set(episodes)
    absent = {"": [TASKS] * (not (root / TASKS).exists()) + ["meta/episodes"] * (not files)}
    for key in ["", *(key for key, entry in info["features"].items() if entry["dtype"] == "video")] if files else ():
        place, pattern = (f"videos/{key}", "video_path") if key else ("data", "data_path")
        names = [f"{place}/chunk_index", f"{place}/file_index"]
        rows = {
            tuple(row[name] for name in names)
            for path in files
            if set(names) <= set(outline(path)[1])
            for row in read_table(path, ["episode_index", *names]).to_pylist()
            if counting is None or row["episode_index"] in counting
        }
        form = info.get(pattern) or {"data_path": DEFAULT_DATA_PATH, "video_path": DEFAULT_VIDEO_PATH}[pattern]
        paths = [form.format(video_key=key, chunk_index=chunk, file_index=file) for chunk, file in sorted(rows)]
        absent.setdefault(key, []).extend(path for path in paths or [place] if not (root / path).exists())
    return {key: paths for key, paths in absent.items() if paths}


def check_whole(root: Path, episodes: Sequence[int] | None = None, without: Sequence[str] = ()) -> None:
    """
    Raises:
        FileNotFoundError: a file is missing that the metadata name for these episodes, but for columns `without`.
        ValueError: there is no frame of one of these episodes.
    """
    info = read_info(root)
    absent = absent_files(root, info, episodes)
    paths = [path for key, found in absent.items() if key not in without for path in found]
    if paths:
        more = f" and {len(paths) - 1} more files" if len(paths) > 1 else ""
        or_else = f", or `unimask prepare --dataset.root={root} --output=DIR` does without the camera"
        raise FileNotFoundError(
            f"{root} lacks {paths[0]}{more}, which belong to it: copy or fetch them anew"
            f"{'' if absent.get('') else or_else}."
        )
    columns = [read_table(path, ["episode_index"]).column(0).unique() for path in data_files(root)]
    there = {episode for column in columns for episode in column.to_pylist()}
    lacking = sorted(set(range(info["total_episodes"]) if episodes is None else episodes) - there)
    if lacking:
        raise ValueError(
            f"{root} has no frame of episode {lacking[0]}, by their episode_index: fetch its tables anew, or name "
            "others with --dataset.episodes."
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
    if "task_index" not in outline(root / TASKS)[1]:
        raise ValueError(f"{root / TASKS} has no task_index, by which the rows name their task: fetch it anew.")
    with naming(root / TASKS):
        table = pd.read_parquet(root / TASKS)
    texts = table.get("task", table.index)
    numbers = table["task_index"].tolist()
    if not all(isinstance(number, int) for number in numbers):
        raise ValueError(f"{root / TASKS} numbers its texts {str(numbers)[:80]}: fetch it anew.")
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
        known = FIELDS if info["codebase_version"].startswith("v3") else FIELDS + OLD_FIELDS
        if info.get(entry) is not None and not _is_inner_path(info[entry], known):
            refuse(entry, info[entry], f"a path inside the folder, of {', '.join(known)}")
    return info


def _is_count(value: Any, least: int, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _is_inner_path(text: Any, known: Sequence[str]) -> bool:
    """Whether a pattern of file names stays inside its folder, and has none but LeRobot's fields, short ones."""
    try:
        parts = list(Formatter().parse(text))
    except (TypeError, ValueError):
        return False
    fields = {name: form for _, name, form, _ in parts if name is not None}
    plain = all(re.fullmatch(r"(0?\d?d?)?", form or "") for form in fields.values())
    inner = not PurePosixPath(text).is_absolute() and ".." not in PurePosixPath(text.replace("\\", "/")).parts
    return fields.keys() <= set(known) and plain and inner and all(part[3] is None for part in parts)


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
    name = repo_id or LOCAL
    dataset = open_checked(
        lambda: LeRobotDataset(name, root=root, episodes=episodes, return_uint8=True), root, name, episodes
    )
    # The constructor takes seconds, which depend on the metadata; to read these twice takes as long as all the rest.
    dataset.delta_timestamps = resolve_delta_timestamps(config, dataset.meta)
    dataset.reader.delta_indices = get_delta_indices(dataset.delta_timestamps or {}, dataset.fps)
    read_cameras(dataset, config)
    return dataset


def open_checked(
    open_it: Callable[[], LeRobotDataset], root: Path | None, repo_id: str, episodes: Sequence[int] | None
) -> LeRobotDataset:
    """What a function opens, wherever LeRobot finds it: in a folder, by its name in LeRobot's home, or on the Hub.

    Raises:
        FileNotFoundError: files are missing, and cannot be fetched.
        OSError: there is no place to write tables to.
        ValueError: it is damaged, or of a format that LeRobot does not read.
    """
    check_home()
    place = Path(root or HF_LEROBOT_HOME / repo_id)
    there = (place / "meta" / "info.json").exists()
    if there:
        check_format(place)
    try:
        dataset = open_it()
    except (OSError, datasets.exceptions.DatasetGenerationError) as error:
        if there:
            check_whole(place, episodes)
        if type(error) is OSError or not isinstance(error, OSError):  # Arrow's, which name no file
            reason = str(error.__cause__ or error).splitlines()[0]
            raise ValueError(f"{place} has tables that cannot be read as meta/info.json says: {reason}") from error
        raise
    if not there:
        check_format(Path(dataset.root))
    check_rows(dataset)
    return dataset


def check_rows(dataset: LeRobotDataset) -> None:
    """
    Raises:
        ValueError: a row stands elsewhere than its index and the metadata of the episodes say, or names a task that
            there is not. (LeRobot would take other frames, or another text, for what it is to read.)
    """
    rows, episodes = dataset.hf_dataset.data, dataset.meta.episodes
    first, end = (np.asarray(episodes[key]) for key in ("dataset_from_index", "dataset_to_index"))
    numbers = np.arange(len(first)) if dataset.episodes is None else np.unique(dataset.episodes)
    numbers = numbers[np.argsort(first[numbers], kind="stable")]
    lengths = end[numbers] - first[numbers]
    before = np.repeat(np.cumsum(lengths) - lengths, lengths)  # rows of earlier episodes
    expected = {
        "index": np.repeat(first[numbers], lengths) + np.arange(len(before)) - before,
        "episode_index": np.repeat(numbers, lengths),
    }
    for key, there in expected.items():
        found = rows.column(key).to_numpy()
        if not np.array_equal(found, there):
            short = min(len(found), len(there))
            at = next(iter(np.flatnonzero(found[:short] != there[:short])), short)
            has, should = (column[at] if at < len(column) else "none" for column in (found, there))
            raise ValueError(
                f"Row {at} of {dataset.root} has {key} {has}, and by meta/episodes it is {should}: fetch its tables "
                "anew."
            )
    tasks, count = rows.column("task_index").to_numpy(), len(dataset.meta.tasks)
    wrong = np.flatnonzero(~((tasks >= 0) & (tasks < count)))
    if len(wrong):
        raise ValueError(
            f"Row {wrong[0]} of {dataset.root} has task_index {tasks[wrong[0]]}, and {TASKS} has {count} tasks: fetch "
            "what is damaged anew."
        )


def read_statistics(root: Path) -> dict[str, Any]:
    """What a dataset's meta/stats.json holds of each column; empty where it is absent or no mapping."""
    path = root / "meta" / "stats.json"
    found = read_json(path) if path.exists() else {}
    return found if isinstance(found, dict) else {}


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
