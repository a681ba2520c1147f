"""Windows read in batches: LeRobotDataset's `__getitems__`, which PyTorch's DataLoader uses where a dataset has one.

LeRobotDataset reads item by item, 7 to 11 ms for a window of ten steps. Here the columns of a dataset without cameras
are held as arrays and a batch of windows is gathered by index, equal in keys, dtypes, shapes and values to the items
read one by one and collated. `install()` adds this to LeRobotDataset; importing `lerobot_unimask` calls it.
`UNIMASK_BATCHED_READS=0` in the environment turns it off. Oracle: `tests/test_reads.py`.

Shapes: N frames, B windows, K steps (one for each of a key's deltas), E episodes.
"""

import operator
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from weakref import WeakKeyDictionary

import datasets
import numpy as np
import pyarrow as pa
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.io_utils import hf_transform_to_torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data._utils.collate import collate, default_collate_fn_map

ENVIRONMENT_VARIABLE = "UNIMASK_BATCHED_READS"


class Item(dict):
    """One item of `Windows`: a dict like any other, of a type by which default_collate finds `collate_windows`."""


class Windows(Sequence):
    """B windows, gathered together: a sequence of items as LeRobotDataset gives them, which collates at once.

    Items are made when asked for, as views of the batch, and kept: what a caller changes in an item, in place or by
    assignment, is in the collated batch, as it would be with a list.
    """

    def __init__(self, batch: dict[str, torch.Tensor | list[str]], length: int):
        self.batch = batch  # each (B, ...)
        self.length = length
        self._made: dict[int, tuple[Item, dict]] = {}  # the item handed out, and what it held then

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, i: int | slice) -> Item | list[Item]:
        if isinstance(i, slice):
            return [self[j] for j in range(*i.indices(self.length))]
        i = range(self.length)[i]
        if i not in self._made:
            item = {key: values[i] for key, values in self.batch.items()}
            self._made[i] = Item(item), item
        return self._made[i][0]

    def unchanged(self) -> bool:
        """No item handed out has had a key added, removed or assigned."""
        return all(
            list(item) == list(held) and all(map(operator.is_, item.values(), held.values()))
            for item, held in self._made.values()
        )


def collate_windows(batch: Sequence[Item], *, collate_fn_map: dict | None = None) -> dict:
    """What default_collate does with a batch whose first item is an `Item`: nothing, if it was gathered as a batch."""
    if isinstance(batch, Windows) and batch.unchanged():
        return dict(batch.batch)
    return collate([dict(item) for item in batch], collate_fn_map=collate_fn_map)


@dataclass(frozen=True)
class Columns:
    """The numbers of a dataset, as stored: one copy in each process that reads.

    A column that Arrow has in one piece stays memory-mapped; `datasets` cuts columns every 1,000 rows, so most are not.
    """

    arrays: dict[str, np.ndarray]  # each (N, ...), in the order of an item's keys
    dtypes: dict[str, torch.dtype]  # what LeRobot's items have: float32 for a stored float64, int64 for an int32
    starts: np.ndarray  # (E,): the value of `index` at each episode's first frame
    ends: np.ndarray  # (E,): and after its last
    tasks: np.ndarray  # task_index -> str
    ascending: bool  # `index` grows from row to row


def _flat_numbers(column: pa.ChunkedArray) -> np.ndarray | None:
    """An Arrow column of numbers or of (nested) lists of numbers as a 1-D array, row after row; None if any is null."""
    array = column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()
    while not array.null_count:
        if isinstance(array, pa.ExtensionArray):
            array = array.storage
        elif pa.types.is_nested(array.type):
            array = array.flatten()
        else:
            return array.to_numpy(zero_copy_only=False)  # copies booleans alone, which Arrow packs in bits
    return None


def _read_columns(hf_dataset: datasets.Dataset, meta: LeRobotDatasetMetadata) -> Columns | None:
    """The columns of a dataset, or None if one of them is not plain numbers."""
    if len(hf_dataset) == 0 or hf_dataset._indices is not None:  # a selection of rows is not in the table
        return None
    arrays, dtypes = {}, {}
    for key, value in hf_dataset[0].items():  # one row, as LeRobot reads it, tells dtype and shape
        if not isinstance(value, torch.Tensor):
            return None
        numbers = _flat_numbers(hf_dataset.data.column(key))
        if numbers is None or numbers.size != len(hf_dataset) * value.numel():
            return None
        arrays[key] = numbers.reshape(len(hf_dataset), *value.shape)
        dtypes[key] = value.dtype
    return Columns(
        arrays,
        dtypes,
        starts=_flat_numbers(meta.episodes.data.column("dataset_from_index")),
        ends=_flat_numbers(meta.episodes.data.column("dataset_to_index")),
        tasks=meta.tasks.index.to_numpy(dtype=object),
        ascending=bool((arrays["index"][1:] > arrays["index"][:-1]).all()),
    )


# Per process and per loaded table: LeRobot loads another table, never changes one.
_columns: WeakKeyDictionary[datasets.Dataset, Columns | None] = WeakKeyDictionary()


def gather(columns: Columns, reader: DatasetReader, indices: Iterable[int]) -> Windows:
    """The items `indices`, any order, negative ones from the end, as `DatasetReader.get_item` would read each.

    Steps outside the episode are copies of its nearest frame, flagged in `<key>_is_pad` (B, K).

    Raises:
        IndexError: an index outside the dataset.
        KeyError: a step that the metadata place in an episode is not among the loaded frames.
    """
    index, size = columns.arrays["index"], len(columns.arrays["index"])
    rows = np.fromiter(map(operator.index, indices), dtype=np.int64)  # (B,)
    outside = rows[(rows < -size) | (rows >= size)]
    if len(outside):
        raise IndexError(f"index {outside[0]} is out of bounds for a dataset of {size} frames")
    rows = np.where(rows < 0, rows + size, rows)

    episode = columns.arrays["episode_index"][rows]
    start, end = columns.starts[episode, None], columns.ends[episode, None]  # (B, 1)
    deltas_of = {key: tuple(deltas) for key, deltas in (reader.delta_indices or {}).items()}
    steps = {}  # deltas -> rows (B, K), padded (B, K); keys mostly share their deltas
    for deltas in set(deltas_of.values()):
        wanted = index[rows, None] + np.array(deltas)  # (B, K), absolute: counted over all episodes
        absolute = wanted.clip(start, end - 1)
        taken = absolute
        if reader.episodes is not None:  # some episodes are loaded: the row is where `index` has that value
            taken = np.searchsorted(index, absolute)
            if (index.take(taken, mode="clip") != absolute).any():
                raise KeyError("a window reaches a frame of its episode that is not loaded")
        steps[deltas] = taken, wanted != absolute

    batch = {}
    for key, array in columns.arrays.items():
        taken = steps[deltas_of[key]][0] if key in deltas_of else rows
        batch[key] = torch.from_numpy(array.take(taken, axis=0)).to(columns.dtypes[key])
    for key, deltas in deltas_of.items():
        batch[f"{key}_is_pad"] = torch.tensor(steps[deltas][1])  # each key its own copy, should somebody write to it
    batch["task"] = columns.tasks[columns.arrays["task_index"][rows]].tolist()
    return Windows(batch, len(rows))


def batched_read(dataset: LeRobotDataset) -> Callable[[Iterable[int]], Windows] | None:
    """`dataset.__getitems__`, or None where items must be read one by one, which PyTorch then does.

    That is: turned off by the environment; a subclass that reads items its own way; a dataset being recorded; one with
    cameras or any other column that is not plain numbers; one whose frames the user has given another transform; deltas
    that LeRobot refuses.
    """
    if os.environ.get(ENVIRONMENT_VARIABLE) == "0" or type(dataset).__getitem__ is not LeRobotDataset.__getitem__:
        return None
    if (dataset.writer is not None and not dataset._is_finalized) or dataset.meta.camera_keys:
        return None
    hf_dataset = dataset.hf_dataset  # loads it if need be
    if hf_dataset.format["format_kwargs"].get("transform") is not hf_transform_to_torch:
        return None
    if hf_dataset not in _columns:
        _columns[hf_dataset] = _read_columns(hf_dataset, dataset.meta)
    columns, reader = _columns[hf_dataset], dataset.reader
    if columns is None or (reader.episodes is not None and not columns.ascending):
        return None
    if reader.delta_indices is not None and not reader.delta_indices.keys() <= columns.arrays.keys() - {"task_index"}:
        return None
    return partial(gather, columns, reader)


class _InstallWhereUnpickled:
    """Travels in a pickled dataset: spawned DataLoader workers import no plugin, but unpickle the dataset."""

    def __reduce__(self):
        return install, ()


def install() -> None:
    """Give LeRobotDataset a `__getitems__`, here and in processes that its datasets are pickled to.

    Does nothing the second time, or where LeRobot has a `__getitems__` of its own.
    """
    if hasattr(LeRobotDataset, "__getitems__"):
        return
    state_of = LeRobotDataset.__getstate__
    LeRobotDataset.__getitems__ = property(batched_read)
    LeRobotDataset.__getstate__ = lambda self: {**state_of(self), "_batched_read": _InstallWhereUnpickled()}
    default_collate_fn_map[Item] = collate_windows
