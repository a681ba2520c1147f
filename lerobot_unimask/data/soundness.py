"""Whether numbers are sound, a dataset's, a loss, weights: what is not finite is found and said where it stands.

Shapes: N frames, D numbers of a column.
"""

import contextlib
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from lerobot.utils.constants import HF_LEROBOT_HOME
from numpy.typing import ArrayLike
from torch import Tensor

SEEN = HF_LEROBOT_HOME / "unimask" / "sound"  # markers of datasets that have been looked through


def data_files(root: Path) -> list[Path]:
    """A dataset's tables, in the order in which LeRobot reads them."""
    return sorted((root / "data").glob("*/*.parquet"))


def episode_files(root: Path) -> list[Path]:
    """The tables of a dataset's episodes, in the order in which LeRobot reads them."""
    return sorted((root / "meta" / "episodes").glob("*/*.parquet"))


def episode_lengths(root: Path) -> np.ndarray:
    """(E,) numbers of frames."""
    return np.concatenate([pq.read_table(path, columns=["length"]).column("length") for path in episode_files(root)])


def outline(path: Path) -> tuple[int, list[str]]:
    """How many rows a file's table has, and its columns."""
    with naming(path):
        table = pq.read_metadata(path)
        return table.num_rows, table.schema.to_arrow_schema().names


def read_table(path: Path, columns: list[str]) -> pa.Table:
    with naming(path):
        return pq.read_table(path, columns=columns)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """
    Raises:
        ValueError: the file is no whole table.
    """
    try:
        yield
    except (pa.ArrowException, OSError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"{path} cannot be read as a table ({reason}): copy it, or fetch it, anew.") from error


def innermost(array: pa.Array) -> pa.Array:
    """What (nested) lists, or LeRobot's own types, hold, one number after another."""
    while isinstance(array, pa.ExtensionArray) or pa.types.is_nested(array.type):
        array = array.storage if isinstance(array, pa.ExtensionArray) else array.flatten()
    return array


def check_columns(root: Path, columns: Mapping[str, Sequence[str]], episodes: Sequence[int] | None = None) -> None:
    """Look through a dataset's columns once; one whose files have not changed since is not read again.

    Args:
        root: folder of a LeRobotDataset.
        columns: those to look through -> the names of their numbers.
        episodes: those that are read; None: all. Others may hold what they like.

    Raises:
        ValueError: a number is not finite; names the column, the number, and its episode and frame.
    """
    files = data_files(root)
    markers = [SEEN / _fingerprint(root, files, columns, part) for part in {None, _in_order(episodes)}]
    if not files or any(marker.exists() for marker in markers):
        return
    for path in files:
        for key, values, rows in _numbers(path, list(columns), episodes):
            bad = ~np.isfinite(values)
            if bad.any():
                raise ValueError(_describe(path, key, columns[key], bad, values, rows))
    marker = SEEN / _fingerprint(root, files, columns, _in_order(episodes))
    with contextlib.suppress(OSError):  # a home that is read-only only costs the next look
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()


def _in_order(episodes: Sequence[int] | None) -> tuple[int, ...] | None:
    return None if episodes is None else tuple(sorted(episodes))


def _fingerprint(
    root: Path, files: Sequence[Path], columns: Mapping[str, Sequence[str]], episodes: tuple[int, ...] | None
) -> str:
    stats = [(str(path.relative_to(root)), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    facts = [str(root.resolve()), stats, sorted(columns), *([] if episodes is None else [episodes])]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


def _numbers(
    path: Path, keys: Sequence[str], episodes: Sequence[int] | None = None
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Each column of a file, of some episodes, as (N, D), NaN where there is no number, and which rows these are, (N,).

    Raises:
        ValueError: a column's rows have different lengths.
    """
    found = [key for key in keys if key in pq.read_schema(path).names]
    table = pq.read_table(path, columns=list({*found, "episode_index"}), memory_map=True)
    rows: np.ndarray = np.arange(len(table))
    if episodes is not None:
        rows = rows[np.isin(table.column("episode_index").to_numpy(), list(episodes))]
        table = table.take(rows)
    for key in found if len(table) else ():
        cells = table.column(key).combine_chunks()
        column, variable = innermost(cells), pa.types.is_list(cells.type) or pa.types.is_large_list(cells.type)
        if variable or (cells.null_count and pa.types.is_fixed_size_list(cells.type)):
            lengths = pc.fill_null(pc.list_value_length(cells), 0).to_numpy(zero_copy_only=False)
            odd = np.flatnonzero(lengths != np.median(lengths))
            if len(odd):
                raise ValueError(
                    f"{key} has {lengths[odd[0]]} numbers in row {rows[odd[0]]} of {path}, and {np.median(lengths):g} "
                    "in most: mend the data."
                )
        if column.null_count:  # NaN, where Arrow would make objects of whole numbers and booleans
            column = column.cast(pa.float64())
        if len(column) % len(table):
            raise ValueError(f"{key} has rows of different lengths, or empty ones, in {path}: mend the data.")
        yield key, column.to_numpy(zero_copy_only=False).reshape(len(table), -1), rows


def _describe(path: Path, key: str, names: Sequence[str], bad: np.ndarray, values: np.ndarray, rows: np.ndarray) -> str:
    row, number = np.argwhere(bad)[0]
    place = pq.read_table(path, columns=["episode_index", "frame_index"]).slice(int(rows[row]), 1).to_pylist()[0]
    name = names[number] if number < len(names) else str(number)
    return (
        f"{key} holds {values[row, number]} for {name!r} in episode {place['episode_index']}, frame "
        f"{place['frame_index']}, and {int(bad.sum()) - 1} more in this file that are not finite: mend the data, or "
        "leave these episodes out with --dataset.episodes or lerobot-edit-dataset, delete_episodes."
    )


def are_statistics(known: Any) -> bool:
    """Whether a column's entry in stats.json maps names to numbers, or (nested) lists of as many numbers each."""
    try:
        return isinstance(known, Mapping) and all(np.asarray(value).dtype.kind in "biuf" for value in known.values())
    except ValueError:  # lists of different lengths
        return False


def check_statistics(key: str, names: Sequence[str], known: Mapping[str, ArrayLike]) -> None:
    """
    Args:
        known: `mean` and `std` of a column, (D,) each.

    Raises:
        ValueError: they are not as many as the column's numbers, not finite, or a deviation is negative.
    """
    for kind in ("mean", "std"):
        values = np.asarray(known[kind], dtype=np.float64).ravel()
        if len(values) != len(names):
            raise ValueError(
                f"The dataset's statistics give {key} {len(values)} numbers as {kind}, and it has {len(names)}: "
                "`unimask prepare` recomputes them."
            )
        wrong = ~np.isfinite(values) | ((values < 0) if kind == "std" else False)
        if wrong.any():
            at = int(wrong.argmax())
            raise ValueError(
                f"The dataset's statistics (meta/stats.json) give {values[at]} as the {kind} of {key}'s {names[at]!r}: "
                "`unimask prepare` recomputes them."
            )


def compute_statistics(root: Path, key: str, episodes: Sequence[int] | None = None) -> dict[str, np.ndarray]:
    """Mean and standard deviation of a column that the dataset's statistics lack, (D,) each, over some episodes."""
    parts = [values for path in data_files(root) for _, values, _ in _numbers(path, [key], episodes)]
    if not parts:
        raise ValueError(f"The dataset's statistics lack {key!r}, and it is no column of numbers in {root / 'data'}.")
    values = np.concatenate(parts).astype(np.float64)
    return {"mean": values.mean(0), "std": values.std(0)}


def check_loss(loss: Tensor, updates: Tensor | int) -> None:
    """
    Raises:
        FloatingPointError: the loss is no longer finite. The last checkpoint is whole: it was saved before.
    """
    if not loss.isfinite():
        raise FloatingPointError(
            f"The loss is {loss.item()} after {int(updates)} updates: training ends here, and the last checkpoint is "
            "from before. A lower optimizer_lr, or optimizer_grad_clip_norm, may help."
        )


def check_saved(weights: Mapping[str, Tensor]) -> None:
    """
    Raises:
        FloatingPointError: a weight is not finite.
    """
    broken = [name for name, tensor in weights.items() if not tensor.isfinite().all()]
    if broken:
        raise FloatingPointError(f"{broken[0]} holds numbers that are not finite, so nothing has been saved.")
