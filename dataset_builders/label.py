"""Adds a column to a LeRobotDataset: a label of whole episodes, or a value for each frame, such as the return-to-go.

LeRobot's own tool (`dataset_tools.add_features`) leaves the new column without statistics, which training needs, and
rewrites the data in its row groups of one episode. Here files keep their layout, everything that is not about the new
column stays as it is, and the labelled dataset appears whole or not at all.

Shapes: N frames, E episodes, T steps of one episode, D numbers of the label.
"""

import contextlib
import importlib
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.feature_utils import get_hf_features_from_features
from tqdm import tqdm

from dataset_builders.folders import refuse_existing, written_whole
from dataset_builders.writer import (
    PROVENANCE_PATH,
    EpisodeStatistics,
    as_cells,
    dataset_statistics,
    episode_statistics,
    provenance_of_now,
    statistics_columns,
)
from lerobot_unimask.data.episodes import check_folder, check_format, check_whole, read_info
from lerobot_unimask.data.factors import is_numeric
from lerobot_unimask.data.returns import return_to_go
from lerobot_unimask.data.soundness import data_files, episode_files, innermost
from lerobot_unimask.sharing.hub import commit_of

Episode = dict[str, np.ndarray]  # a dataset's columns of numbers: (T,) where D = 1, else (T, D)
# One episode -> its label: a number or (D,) for all of it, or (T, D) with one row for each frame
Labeller = Callable[[Episode], Any]


# --- What to add ------------------------------------------------------------------------------------------------------


def remaining_return(episode: Episode) -> np.ndarray:
    """The return-to-go of each frame, (T, 1), from next.reward.

    Raises:
        ValueError: the dataset has no rewards.
    """
    if "next.reward" not in episode:
        raise ValueError("The return-to-go is summed up from 'next.reward', which this dataset does not have.")
    rewards = episode["next.reward"]
    return return_to_go(rewards, np.array([len(rewards)]))[:, None]


def visits(root: Path, condition: str) -> Labeller:
    """Whether some step's state has a category, as in `agent_cell=0`.

    Raises:
        ValueError: the state has no such component or category.
    """
    features = read_info(root)["features"]
    known = {}  # component -> (column, which of its numbers, how many categories)
    for key in ("observation.state", "observation.environment_state"):
        entry = features.get(key, {})
        for i, count in enumerate(entry.get("categories") or []):
            names = entry.get("names") or [f"{key.removeprefix('observation.')}.{j}" for j in range(entry["shape"][0])]
            known[names[i]] = key, i, count
    name, equals, category = condition.partition("=")
    if not equals or name not in known:
        choices = ", ".join(f"{name}=0 to {name}={count - 1}" for name, (_, _, count) in known.items())
        raise ValueError(f"visits is {condition!r}; this dataset's discrete states allow {choices or 'none at all'}.")
    key, i, count = known[name]
    if not category.isdecimal() or int(category) >= count:
        raise ValueError(f"visits is {condition!r}; {name} is a category from 0 to {count - 1}.")
    return lambda episode: bool((episode[key].reshape(len(episode[key]), -1)[:, i] == int(category)).any())


def load_function(text: str) -> Labeller:
    """A Python function by `module:name`; modules of the current folder are found too.

    Raises:
        ValueError: there is none.
    """
    module, colon, name = text.partition(":")
    if not colon:
        raise ValueError(f"function is {text!r}; write it as module:name.")
    sys.path.insert(0, os.getcwd())
    try:
        function = getattr(importlib.import_module(module), name, None)
    except ImportError as error:
        raise ValueError(f"function is {text!r}, but the module {module} cannot be imported: {error}") from error
    finally:
        sys.path.remove(os.getcwd())
    if not callable(function):
        raise ValueError(f"function is {text!r}, but the module {module} has no function {name!r}.")
    return function


# --- Adding it --------------------------------------------------------------------------------------------------------


def add_label(
    root: str | Path,
    name: str,
    labeller: Labeller,
    *,
    how: str,
    output: str | Path | None = None,
    categories: int | None = None,
    progress: bool = True,
) -> Path:
    """Add a column to a LeRobotDataset, with its statistics, completely or not at all.

    Booleans and whole numbers become categories (int64), other numbers stay numbers (float32).

    Args:
        root: folder of the dataset.
        name: name of the column, `observation.NAME`: LeRobot reads windows of no other.
        labeller: function of an episode that returns its label.
        how: description of the label, for the dataset's `meta/provenance.json`.
        output: folder for the labelled dataset, new or empty; None: the old one's place.
        categories: number of categories, where not all of them occur.
        progress: whether to show a progress bar, on a terminal.

    Returns:
        The labelled dataset's folder.

    Raises:
        FileNotFoundError: There is no dataset in `root`.
        FileExistsError: `output` exists and is not an empty folder; it is left as it was.
        ValueError: The column exists, the labels do not make one, `output` lies inside `root`, or there is none and
            `root` is what the Hub's client keeps of a commit.
    """
    root = Path(root).expanduser().resolve()
    check_folder(root)
    check_format(root)
    check_whole(root)
    if not re.fullmatch(r"observation\.[\w.]+", name):
        raise ValueError(f"name is {name!r}; a label is named observation.NAME, or LeRobot reads no windows of it.")
    if output is None and (commit := commit_of(root)):
        raise ValueError(f"{root} is commit {commit} of a Hub dataset, which stays as it is: give --output=DIR.")
    target = root if output is None else refuse_existing(output)
    if root in target.parents:
        raise ValueError(f"output is {target}, a folder inside the dataset itself; choose one beside it.")
    with written_whole(target, replacing=output is None) as new:
        info = read_info(root)  # now that nobody else adds a label
        if name in info["features"]:
            raise ValueError(f"{root} has a column {name} already; choose another name.")
        column, lengths = _label_all(root, info, labeller, progress)
        feature, column = _feature(column, categories)
        copy_rest(root, new)
        info["features"][name] = feature
        statistics = episode_statistics(column, lengths)
        _write_data(root, new, info, name, column)
        _write_episodes(root, new, name, statistics)
        _write_meta(new, info, name, dataset_statistics(statistics), how)
    return target


def _label_all(
    root: Path, info: Mapping[str, Any], labeller: Labeller, progress: bool
) -> tuple[np.ndarray, np.ndarray]:
    """The labels of all frames, (N, D), and the episodes' lengths, (E,)."""
    features = info["features"]
    keys = [key for key, entry in features.items() if is_numeric(entry) and entry["shape"]]
    table = pa.concat_tables([pq.read_table(path, columns=keys) for path in data_files(root)])
    columns = {}  # (N,), or (N, D) where a row is a list
    for key in keys:
        flat, size = flat_numbers(table.column(key)), features[key]["shape"][0]
        columns[key] = flat.reshape(-1, size) if pa.types.is_nested(table.schema.field(key).type) else flat
    starts = np.flatnonzero(np.diff(columns["episode_index"], prepend=-1))
    lengths = np.diff(starts, append=len(table))
    parts = []
    episodes = zip(starts, lengths, strict=True)
    for number, (start, length) in enumerate(
        tqdm(episodes, desc="Labelling", total=len(starts), unit="episode", disable=None if progress else True)
    ):
        episode = {key: array[start : start + length] for key, array in columns.items()}
        parts.append(_rows_of(labeller, episode, number, int(length)))
        if parts[-1].shape[1] != parts[0].shape[1]:
            raise ValueError(
                f"The labels have different sizes: {parts[0].shape[1]} numbers in episode 0, {parts[-1].shape[1]} in "
                f"episode {number}."
            )
    return np.concatenate(parts), lengths


def flat_numbers(column: pa.ChunkedArray) -> np.ndarray:
    """The numbers of a column, one row's after another's."""
    array = column.combine_chunks()
    array = pa.concat_arrays(array.chunks) if isinstance(array, pa.ChunkedArray) else array
    return innermost(array).to_numpy(zero_copy_only=False)


def _rows_of(labeller: Labeller, episode: Episode, number: int, length: int) -> np.ndarray:
    """One episode's label, (T, D)."""
    try:
        label = np.asarray(labeller(episode))
    except ValueError:
        raise
    except Exception as error:  # the user's own function
        raise ValueError(f"The label failed on episode {number}: {type(error).__name__}: {error}") from error
    if label.dtype.kind not in "biuf" or not np.isfinite(label).all():
        raise ValueError(f"The label of episode {number} is {label!r}; it must be finite numbers or booleans.")
    if label.ndim == 2 and len(label) == length:
        return label
    if label.ndim > 1 or label.size == 0 or (label.ndim == 1 and len(label) == length > 1):
        raise ValueError(
            f"The label of episode {number} has shape {label.shape}, and the episode {length} steps: return one number "
            f"or (D,) for the episode, or (T, D), here ({length}, 1), for its frames."
        )
    return np.tile(label.reshape(1, -1), (length, 1))


def _feature(column: np.ndarray, categories: int | None) -> tuple[dict[str, Any], np.ndarray]:
    """The feature's entry in info.json, and the column as it is stored."""
    size = column.shape[1]
    if column.dtype.kind == "f":
        if categories is not None:
            raise ValueError(f"categories is {categories}, but the labels are {column.dtype}: return whole numbers.")
        return {"dtype": "float32", "shape": [size], "names": None}, column.astype(np.float32)
    low, high = int(column.min()), int(column.max())
    count = categories or (2 if column.dtype.kind == "b" else high + 1)
    if low < 0 or high >= count:
        raise ValueError(
            f"The labels run from {low} to {high}; categories are numbered from 0 to {max(count, 1) - 1}. For numbers "
            "that are not categories return floats."
        )
    feature = {"dtype": "int64", "shape": [size], "names": None, "categories": [count] * size}
    return feature, column.astype(np.int64)


# --- Files ------------------------------------------------------------------------------------------------------------


def copy_rest(root: Path, partial: Path, without: Sequence[str] = ()) -> None:
    """Everything that is not rewritten; large files that never change as links where the disk allows it.

    Args:
        without: cameras whose files stay behind, as links that lead nowhere do.
    """
    rewritten = {*data_files(root), *episode_files(root)}

    def copy(source: str, target: str) -> None:
        if Path(source) in rewritten:
            return
        if Path(source).relative_to(root).parts[0] in ("videos", "images"):
            try:
                os.link(os.path.realpath(source), target)  # a link may lead elsewhere from there
                return
            except OSError:
                pass
        shutil.copy2(source, target)

    def left_out(folder: str, names: list[str]) -> list[str]:
        in_videos = Path(folder).relative_to(root).parts == ("videos",)
        return [name for name in names if (in_videos and name in without) or not Path(folder, name).exists()]

    shutil.copytree(root, partial, copy_function=copy, ignore=left_out)


def stored_schema(features: Mapping[str, Mapping[str, Any]]) -> pa.Schema:
    """The schema of a dataset's tables, from its info.json's features."""
    tuples = {key: {**entry, "shape": tuple(entry["shape"])} for key, entry in features.items()}
    return get_hf_features_from_features(tuples).arrow_schema


def _write_data(root: Path, partial: Path, info: Mapping[str, Any], name: str, column: np.ndarray) -> None:
    schema = stored_schema(info["features"])
    field, row = schema.field(name), 0

    def with_label(table: pa.Table) -> pa.Table:
        nonlocal row
        part = column[row : row + len(table)]
        row += len(table)
        return table.append_column(field, as_cells(part, field.type)).replace_schema_metadata(schema.metadata)

    for path in data_files(root):
        rewrite(path, partial / path.relative_to(root), with_label)


def _write_episodes(root: Path, partial: Path, name: str, statistics: EpisodeStatistics) -> None:
    for path in episode_files(root):
        rewrite(path, partial / path.relative_to(root), lambda table: with_statistics(table, {name: statistics}))


def with_statistics(table: pa.Table, found: Mapping[str, EpisodeStatistics]) -> pa.Table:
    """The episodes' metadata with the statistics of more columns."""
    rows = table.column("episode_index").to_numpy()
    for name, statistics in found.items():
        chosen = {statistic: values[rows] for statistic, values in statistics.items()}
        for column, cells in statistics_columns(name, chosen).items():
            table = table.append_column(column, cells)
    return table


def rewrite(source: Path, target: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """A parquet file with each of its row groups changed: the new file has the old one's layout."""
    with contextlib.ExitStack() as stack:
        old, writer = stack.enter_context(pq.ParquetFile(source)), None
        for i in range(old.num_row_groups):
            table = change(old.read_row_group(i))
            if writer is None:
                writer = stack.enter_context(pq.ParquetWriter(target, table.schema, compression="snappy"))
            writer.write_table(table)


def _write_meta(
    partial: Path, info: Mapping[str, Any], name: str, statistics: Mapping[str, np.ndarray], how: str
) -> None:
    stats = partial / "meta" / "stats.json"
    known = json.loads(stats.read_text()) if stats.exists() else {}
    known[name] = {statistic: value.tolist() for statistic, value in statistics.items()}
    stats.write_text(json.dumps(known, indent=4))
    (partial / "meta" / "info.json").write_text(json.dumps(info, indent=4))
    path = partial / PROVENANCE_PATH
    record = json.loads(path.read_text()) if path.exists() else {}
    record.setdefault("labels", []).append({"name": name, "what": how, **provenance_of_now()})
    path.write_text(json.dumps(record, indent=4) + "\n")
