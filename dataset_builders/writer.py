"""Writes a whole LeRobotDataset (v3.0) at once, from flat arrays and episode lengths.

LeRobot's own writer takes frames one by one and 75 ms per episode, most of it for statistics and for rewriting the
metadata. Here the columns are complete from the start: statistics are computed over all episodes of equal length
together, and files are written in large row groups. What LeRobot reads from the result (data, tasks, episodes with
their statistics, dataset statistics, info) equals what its writer would have made; a test compares the two.

Shapes: N frames, E episodes, D entries of a feature; inside statistics, E episodes of T steps each.
"""

import contextlib
import importlib.metadata
import json
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import DEFAULT_QUANTILES, RunningQuantileStats, aggregate_feature_stats
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import get_file_size_in_mb, write_info, write_stats
from lerobot.datasets.utils import DEFAULT_EPISODES_PATH, update_chunk_file_indices
from tqdm import tqdm

from dataset_builders.folders import refuse_existing, written_whole
from dataset_builders.videos import encode_pictures, write_videos

PROVENANCE_PATH = "meta/provenance.json"
SUCCESS = "observation.success"  # of an episode; a property, where --policy.properties names it
SUCCESS_FEATURE = {"dtype": "int64", "shape": (1,), "names": ["success"], "categories": [2]}
# LeRobot writes a row group per episode. That is costly when they are short: 20,000 of ten steps take 48 MB and 15 s to
# load, against 5 MB and 1 s this way.
ROW_GROUP_FRAMES = 16_384
ROW_GROUP_EPISODES = 1_024
_QUANTILE_BINS = RunningQuantileStats()._num_quantile_bins

# A column of statistics over episodes: name (min, max, mean, std, count, q01, ...) -> (E, D), count (E, 1)
EpisodeStatistics = dict[str, np.ndarray]


def write_dataset(
    root: str | Path,
    *,
    repo_id: str,
    fps: int,
    features: Mapping[str, dict],
    columns: Mapping[str, np.ndarray],
    lengths: np.ndarray,
    task: str | Sequence[str],
    robot_type: str,
    provenance: Mapping[str, Any],
    progress: bool = False,
    pictures: Mapping[str, Iterator[np.ndarray]] | None = None,
) -> Path:
    """Write a LeRobotDataset into `root`, completely or not at all.

    Args:
        root: folder of the dataset: new, or an existing empty one.
        repo_id: name of the dataset, as in `ME/NAME`.
        fps: steps per second.
        features: LeRobot's description of each column: dtype, shape (D,), names, and `categories` for discrete ones.
        columns: the same keys -> (N, D) arrays of those dtypes, episodes one after another. LeRobot's own columns
            (timestamp, frame_index, episode_index, index, task_index) are added.
        lengths: (E,) steps in each episode; they sum to N.
        task: text of the task, one for all episodes or one for each.
        robot_type: name of what acted.
        provenance: origin of the data, for `meta/provenance.json` (info.json keeps no unknown keys); the package's
            version and the command line are added.
        progress: whether to show a progress bar, on a terminal.
        pictures: feature that is a video or an image -> its N pictures, (H, W, 3) uint8, as they come.

    Returns:
        `root`, as a path.

    Raises:
        FileExistsError: `root` exists and is not an empty folder; it is left as it was.
        ValueError: columns, features and lengths do not fit together, or a value is not finite.
    """
    root = refuse_existing(root)
    lengths = np.asarray(lengths)
    pictures = pictures or {}
    _check_columns({name: feature for name, feature in features.items() if name not in pictures}, columns, lengths)
    with written_whole(root) as new:
        meta = LeRobotDatasetMetadata.create(
            repo_id=repo_id, fps=fps, features=dict(features), robot_type=robot_type, root=new
        )
        tasks = [task] * len(lengths) if isinstance(task, str) else list(task)
        meta.save_episode_tasks(list(dict.fromkeys(tasks)))
        columns = {**columns, **_default_columns(lengths, fps)}
        columns["task_index"] = np.repeat(meta.tasks.loc[tasks, "task_index"].to_numpy(), lengths)[:, None]
        bar = tqdm(total=len(columns) + 3, desc=f"Writing {root.name}", unit="part", disable=None if progress else True)
        with bar:
            _write_all(meta, columns, lengths, tasks, bar, pictures)
        _write_provenance(new, provenance)
        _finish_info(meta, lengths)
    return root


def _check_columns(features: Mapping[str, dict], columns: Mapping[str, np.ndarray], lengths: np.ndarray) -> None:
    if lengths.ndim != 1 or not len(lengths) or lengths.dtype.kind not in "iu" or (lengths < 1).any():
        raise ValueError(f"lengths must be (E,) whole numbers, each at least 1, got {lengths.dtype} {lengths.shape}.")
    if set(features) != set(columns):
        raise ValueError(f"Features and columns differ in {sorted(set(features) ^ set(columns))}.")
    frames = int(lengths.sum())
    for name, feature in features.items():
        dtype, shape = np.dtype(feature["dtype"]), (frames, *feature["shape"])
        if len(shape) != 2 or dtype.kind not in "biuf":
            raise ValueError(f"{name}: only numbers of shape (D,) can be written, got {dtype} {shape[1:]}.")
        column = columns[name]
        if column.dtype != dtype or column.shape != shape:
            raise ValueError(f"{name}: expected {dtype} {shape}, got {column.dtype} {column.shape}.")
        if not np.isfinite(column).all():
            raise ValueError(f"{name}: {(~np.isfinite(column)).sum()} values are not finite.")


def _default_columns(lengths: np.ndarray, fps: int) -> dict[str, np.ndarray]:
    """LeRobot's own columns, each (N, 1), in the dtypes over which LeRobot computes their statistics."""
    frames, starts = int(lengths.sum()), np.cumsum(lengths) - lengths
    index = np.arange(frames)
    frame_index = index - np.repeat(starts, lengths)
    columns = {
        "timestamp": frame_index / fps,  # float64 until it is stored
        "frame_index": frame_index,
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "index": index,
    }
    return {name: column[:, None] for name, column in columns.items()}


# --- Statistics -------------------------------------------------------------------------------------------------------


def episode_statistics(column: np.ndarray, lengths: np.ndarray) -> EpisodeStatistics:
    """LeRobot's statistics (`compute_stats.get_feature_stats`) of each episode, all of equal length at once.

    Args:
        column: (N, D) numbers or booleans.
        lengths: (E,) steps in each episode.

    Returns:
        min, max, mean and std, (E, D) in LeRobot's precision, the quantiles, (E, D) float64, and count, (E, 1) int64.
    """
    # LeRobot's precision; with it and its order of summation the results are the same to the last bit.
    column = column.astype(np.result_type(column.dtype, np.float32), copy=False)
    starts = np.cumsum(lengths) - lengths
    statistics = {"count": lengths[:, None].astype(np.int64)}
    for length in np.unique(lengths):
        episodes = np.flatnonzero(lengths == length)
        values = column[starts[episodes, None] + np.arange(length)]  # (E, T, D)
        for name, value in _statistics_of_equal_length(values).items():
            empty = np.empty((len(lengths), column.shape[1]), dtype=value.dtype)
            statistics.setdefault(name, empty)[episodes] = value
    return statistics


def _statistics_of_equal_length(values: np.ndarray) -> EpisodeStatistics:
    """(E, T, D) -> statistics over T, each (E, D)."""
    low, high, mean = values.min(axis=1), values.max(axis=1), _mean(values)
    if values.shape[1] == 1:  # LeRobot takes no quantiles of a single value
        quantiles = dict.fromkeys(_QUANTILE_NAMES, mean.astype(np.float64))
        return {"min": low, "max": high, "mean": mean, "std": mean * 0, **quantiles}
    std = np.sqrt(np.maximum(0, _mean(values**2) - mean**2))
    return {"min": low, "max": high, "mean": mean, "std": std, **_quantiles(values, low, high)}


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean over T of (E, T, D), adding in the order in which numpy adds one episode's (T, D)."""
    return values[..., 0].mean(axis=1)[:, None] if values.shape[2] == 1 else values.mean(axis=1)


_QUANTILE_NAMES = [f"q{int(quantile * 100):02d}" for quantile in DEFAULT_QUANTILES]


def _quantiles(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> EpisodeStatistics:
    """Quantiles over T of (E, T, D) as LeRobot estimates them: by interpolation in a histogram of 5,000 bins.

    The histogram is never made. Sorted, the values' bins give every cumulative count that the interpolation reads.
    """
    edges = _BinEdges(low[:, None], high[:, None])
    bins = np.sort(edges.bin_of(values), axis=1)  # (E, T, D)
    steps = values.shape[1]
    quantiles = {}
    for name, quantile in zip(_QUANTILE_NAMES, DEFAULT_QUANTILES, strict=True):
        target = quantile * steps
        hit = bins[:, [int(np.ceil(target)) - 1]]  # (E, 1, D): the first bin whose cumulative count reaches the target
        before = (bins < hit).sum(axis=1, keepdims=True)
        fraction = (target - before) / (bins == hit).sum(axis=1, keepdims=True)
        left, right = edges.edge(hit), edges.edge(hit + 1)
        quantiles[name] = np.where(hit == 0, left, left + fraction * (right - left))[:, 0]
    return quantiles


class _BinEdges:
    """The edges np.linspace(low - 1e-10, high + 1e-10, bins + 1), evaluated only where asked, in low's precision."""

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        self.start, self.stop = low - 1e-10, high + 1e-10  # (E, 1, D)
        self.delta = self.stop - self.start
        self.step = self.delta / _QUANTILE_BINS

    def edge(self, k: np.ndarray) -> np.ndarray:
        """Edge k, 0 to bins; shapes that broadcast with (E, 1, D)."""
        number = k.astype(self.start.dtype)
        # numpy's own case distinction, for steps that underflow
        offset = np.where(self.step == 0, number / _QUANTILE_BINS * self.delta, number * self.step)
        return np.where(k == _QUANTILE_BINS, self.stop, offset + self.start)

    def bin_of(self, values: np.ndarray) -> np.ndarray:
        """The bin of each value, the last one whose left edge is not above it, by bisection; (E, T, D)."""
        first, last = np.zeros(values.shape, dtype=np.int64), np.full(values.shape, _QUANTILE_BINS - 1)
        for _ in range(_QUANTILE_BINS.bit_length()):
            middle = (first + last + 1) // 2
            above = self.edge(middle) > values
            first, last = np.where(above, first, middle), np.where(above, middle - 1, last)
        return first


def dataset_statistics(statistics: EpisodeStatistics) -> dict[str, np.ndarray]:
    """LeRobot's aggregation of one feature's statistics over all episodes: each (D,)."""
    episodes = [
        dict(zip(statistics, rows, strict=True)) for rows in zip(*statistics.values(), strict=True)
    ]  # LeRobot wants a dict for each episode
    return episodes[0] if len(episodes) == 1 else aggregate_feature_stats(episodes)


# --- Files ------------------------------------------------------------------------------------------------------------


def _write_all(
    meta: LeRobotDatasetMetadata,
    columns: dict[str, np.ndarray],
    lengths: np.ndarray,
    tasks: list[str],
    bar: tqdm,
    pictures: Mapping[str, Iterator[np.ndarray]],
) -> None:
    """Statistics, data and episodes; only info.json, which makes it a dataset, still says that it is empty."""
    statistics = {}
    for name, column in columns.items():
        statistics[name] = episode_statistics(column, lengths)
        bar.update()
    videos: dict[str, list] = {}
    stored: dict[str, pa.Array] = {}
    whole = {name: dataset_statistics(values) for name, values in statistics.items()}
    for key, frames in pictures.items():
        if key in meta.video_keys:
            places, found = write_videos(meta, key, frames, lengths)
            videos |= places
        else:
            stored[key], found = encode_pictures(frames, lengths)
        whole[key] = aggregate_feature_stats(found)
        videos |= {f"stats/{key}/{name}": [each[name].tolist() for each in found] for name in found[0]}
    write_stats(whole, meta.root)
    bar.update()
    chunk, file = _write_tables(meta, meta.data_path, _data_table(meta, columns, stored), lengths, ROW_GROUP_FRAMES)
    bar.update()
    episodes = _episode_columns(lengths, tasks, chunk, file, statistics)
    _write_episodes(meta, episodes | {name: pa.array(values) for name, values in videos.items()})
    bar.update()


def as_cells(column: np.ndarray, kind: pa.DataType) -> pa.Array:
    """(N, D) as LeRobot stores it, as `kind`: numbers where D = 1, lists of D numbers otherwise."""
    flat = pa.array(column.ravel())
    return (flat if column.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, column.shape[1])).cast(kind)


def statistics_columns(name: str, statistics: EpisodeStatistics) -> dict[str, pa.Array]:
    """The columns of meta/episodes that hold a column's statistics."""
    columns = {}
    for statistic, values in statistics.items():  # (E, D)
        values = values if statistic == "count" else values.astype(np.float64)
        offsets = np.arange(len(values) + 1, dtype=np.int32) * values.shape[1]
        columns[f"stats/{name}/{statistic}"] = pa.ListArray.from_arrays(offsets, pa.array(values.ravel()))
    return columns


def _data_table(
    meta: LeRobotDatasetMetadata, columns: dict[str, np.ndarray], stored: Mapping[str, pa.Array]
) -> pa.Table:
    """The columns as LeRobot stores them: (N,) where D = 1, lists of D numbers otherwise; `stored` ones as they are."""
    schema = get_hf_features_from_features(meta.features).arrow_schema
    arrays = [
        stored[field.name] if field.name in stored else as_cells(columns[field.name], field.type) for field in schema
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def _episode_columns(
    lengths: np.ndarray,
    tasks: list[str],
    chunk: np.ndarray,
    file: np.ndarray,
    statistics: dict[str, EpisodeStatistics],
) -> dict[str, pa.Array]:
    """meta/episodes' columns, but for those that say which of its files a row is in."""
    ends = np.cumsum(lengths)
    columns = {
        "episode_index": pa.array(np.arange(len(lengths))),
        "tasks": pa.array([[task] for task in tasks]),
        "length": pa.array(lengths.astype(np.int64)),
        "data/chunk_index": pa.array(chunk),
        "data/file_index": pa.array(file),
        "dataset_from_index": pa.array(ends - lengths),
        "dataset_to_index": pa.array(ends),
    }
    for feature, values in statistics.items():
        columns |= statistics_columns(feature, values)
    return columns


def _write_episodes(meta: LeRobotDatasetMetadata, columns: dict[str, pa.Array]) -> None:
    """Write meta/episodes. Each row says which file it is in, which is known only after its size is."""
    table = pa.table(columns)
    rows = np.ones(len(table), dtype=np.int64)
    location = ("meta/episodes/chunk_index", "meta/episodes/file_index")
    _write_tables(meta, DEFAULT_EPISODES_PATH, table, rows, ROW_GROUP_EPISODES, location)


def _write_tables(
    meta: LeRobotDatasetMetadata,
    path: str,
    table: pa.Table,
    lengths: np.ndarray,
    row_group: int,
    location: tuple[str, str] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Write a table into chunk-xxx/file-xxx.parquet files, no episode divided, none much above LeRobot's size limit.

    Args:
        path: pattern of the files' names, with the fields chunk_index and file_index.
        lengths: (E,) rows of each episode.
        row_group: number of a row group's rows; at least one episode's.
        location: names of two columns to add that say which chunk and file a row is in.

    Returns:
        The chunk index and the file index of each episode, both (E,) int64.
    """
    chunk, file = 0, 0
    chunks, files = np.empty((2, len(lengths)), dtype=np.int64)
    with contextlib.ExitStack() as stack:
        writer, target, start_of_file = None, None, 0
        for episodes, rows in _row_groups(lengths, row_group):
            if writer is not None:
                size = get_file_size_in_mb(target)
                if (
                    size + size / (rows.start - start_of_file) * (rows.stop - rows.start)
                    >= meta.info.data_files_size_in_mb
                ):
                    writer.close()
                    writer, start_of_file = None, rows.start
                    chunk, file = update_chunk_file_indices(chunk, file, meta.chunks_size)
            part = table.slice(rows.start, rows.stop - rows.start)
            for name, index in zip(location or (), (chunk, file), strict=False):
                part = part.append_column(name, pa.array(np.full(len(part), index)))
            if writer is None:
                target = meta.root / path.format(chunk_index=chunk, file_index=file)
                target.parent.mkdir(parents=True, exist_ok=True)
                writer = stack.enter_context(pq.ParquetWriter(target, part.schema, compression="snappy"))
            writer.write_table(part)
            chunks[episodes], files[episodes] = chunk, file
    return chunks, files


def _row_groups(lengths: np.ndarray, row_group: int) -> Iterator[tuple[slice, slice]]:
    """Slices of episodes, and of their rows, with about `row_group` rows each."""
    ends = np.cumsum(lengths)
    first = 0
    while first < len(lengths):
        start = int(ends[first] - lengths[first])
        last = max(int(np.searchsorted(ends, start + row_group, side="right")), first + 1)
        yield slice(first, last), slice(start, int(ends[last - 1]))
        first = last


def provenance_of_now() -> dict[str, str]:
    """What wrote a dataset: the package's version and the command line."""
    return {
        "package_version": importlib.metadata.version("lerobot_policy_unimask"),
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    }


def _write_provenance(root: Path, provenance: Mapping[str, Any]) -> None:
    record = {**provenance, **provenance_of_now()}
    (root / PROVENANCE_PATH).write_text(json.dumps(record, indent=4) + "\n")


def _finish_info(meta: LeRobotDatasetMetadata, lengths: np.ndarray) -> None:
    meta.info.total_episodes, meta.info.total_frames = len(lengths), int(lengths.sum())
    meta.info.total_tasks = len(meta.tasks)
    meta.info.splits = {"train": f"0:{len(lengths)}"}
    write_info(meta.info, meta.root)
