"""Windows read in batches: LeRobotDataset's `__getitems__`, which PyTorch's DataLoader uses where a dataset has one.

LeRobotDataset reads item by item, 7 to 11 ms for a window of ten steps. Here a batch of windows is gathered by index
from the columns, which stay in the files that `datasets` has memory-mapped; it is equal in keys, dtypes, shapes and
values to the items read one by one and collated. `lerobot_patches.py` adds this to LeRobotDataset. Oracle:
`tests/test_reads.py`. A dataset with cameras is read so after `serve_frames`: its pictures are uint8 then, at one size.

Shapes: N frames, in P pieces; B windows, K steps (one for each of a key's deltas), E episodes.
"""

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import datasets
import numpy as np
import pyarrow as pa
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.io_utils import hf_transform_to_torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import DEFAULT_FEATURES
from torch.utils.data._utils.collate import collate

from lerobot_unimask.data.factors import ACTION, ENVIRONMENT_STATE, RETURN_TO_GO, STATE, TEXTS
from lerobot_unimask.data.frames import cached_frames
from lerobot_unimask.data.soundness import innermost


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

    def __getitem__(self, i: Any) -> Any:
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


class Batch(dict):
    """A batch like any other, whose columns go to another device together: one copy, where each column of its own would
    be a wait. PyTorch's DataLoader calls `pin_memory` where it is to pin, and accelerate calls `to`."""

    buffer: torch.Tensor | None = None  # bytes, of which the columns that were pinned are views
    pinned: Mapping[str, torch.Tensor] | None = None

    def pin_memory(self) -> "Batch":
        """The columns side by side in memory that a GPU reads while the processor goes on."""
        return self._side_by_side(pinned=True)

    def to(self, device: torch.device | str, non_blocking: bool = False) -> "Batch":
        """Every tensor on a device; what is none stays as it is."""
        if torch.device(device).type == "cpu":
            return Batch({key: value.to(device) for key, value in self._tensors().items()} | self._others())
        on_gpu = torch.device(device).type == "cuda"
        beside = self if self._is_pinned() else self._side_by_side(pinned=on_gpu)
        assert beside.buffer is not None
        moved = beside.buffer.to(device, non_blocking=on_gpu)  # of memory that is pinned and not written to again
        return beside._views(moved)

    def _tensors(self) -> dict[str, torch.Tensor]:
        return {key: value for key, value in self.items() if isinstance(value, torch.Tensor)}

    def _others(self) -> dict[str, Any]:
        return {key: value for key, value in self.items() if not isinstance(value, torch.Tensor)}

    def _is_pinned(self) -> bool:
        """Whether the columns are those that were pinned, and nobody has replaced one."""
        tensors, pinned = self._tensors(), self.pinned or {}
        return bool(pinned) and tensors.keys() == pinned.keys() and all(tensors[key] is pinned[key] for key in pinned)

    def _side_by_side(self, *, pinned: bool) -> "Batch":
        """The batch with its tensors as views of one buffer."""
        sizes = [-(-value.nbytes // ALIGNED) * ALIGNED for value in self._tensors().values()]
        batch = self._views(torch.empty(sum(sizes), dtype=torch.uint8, pin_memory=pinned))
        batch.pinned = batch._tensors()
        for key, value in batch.pinned.items():
            value.copy_(self[key])
        return batch

    def _views(self, buffer: torch.Tensor) -> "Batch":
        """The batch with its tensors, of their shapes, in a buffer that holds one after another."""
        batch, start = Batch(self), 0
        for key, value in self._tensors().items():
            batch[key] = buffer[start : start + value.nbytes].view(value.dtype).view(value.shape)
            start += -(-value.nbytes // ALIGNED) * ALIGNED
        batch.buffer = buffer
        return batch


ALIGNED = 64  # bytes; a GPU's kernels read from multiples of 16


def collate_windows(batch: Sequence[Item], *, collate_fn_map: dict | None = None) -> dict:
    """What default_collate does with a batch whose first item is an `Item`: nothing, if it was gathered as a batch."""
    if isinstance(batch, Windows) and batch.unchanged():
        return Batch(batch.batch)
    return collate([dict(item) for item in batch], collate_fn_map=collate_fn_map)


@dataclass(frozen=True)
class Column:
    """The numbers of a column where Arrow has them, in a memory-mapped file: they are read there and not copied.

    `datasets` stores a table in pieces of at most 1,000 rows, one after another in one or more files. `numbers` reaches
    from the lowest address of a piece to the highest; other columns, and nothing at all, lie between the pieces: it is
    only ever read at `offsets[piece] + row * size`.
    """

    numbers: np.ndarray  # 1-D
    offsets: np.ndarray  # (P,): where row 0 would be if all rows were in that piece
    shape: tuple[int, ...]  # of a row
    dtype: torch.dtype  # what LeRobot's items have: float32 for a stored float64, int64 for an int32

    def take(self, rows: np.ndarray, piece: np.ndarray) -> np.ndarray:
        """(...) rows, none outside the table, and the piece that each is in -> (..., *shape), a copy."""
        return self._from(rows, piece, 1).reshape(*rows.shape, *self.shape)

    def take_runs(self, rows: np.ndarray, piece: np.ndarray, length: int) -> np.ndarray:
        """`length` rows from each of (B,) on, all in one piece -> (B, length, *shape), a copy."""
        return self._from(rows, piece, length).reshape(len(rows), length, *self.shape)

    def _from(self, rows: np.ndarray, piece: np.ndarray, length: int) -> np.ndarray:
        """The numbers of `length` rows from each of (...) on: (..., length * size), a copy. Read as runs and not number
        by number, which takes several times as long."""
        size = math.prod(self.shape)
        starts = self.offsets[piece] + rows * size
        step, width = self.numbers.itemsize, length * size
        if not starts.size:  # there may be fewer numbers than a run has
            return np.empty((*starts.shape, width), self.numbers.dtype)
        runs: np.ndarray = np.ndarray(
            (self.numbers.size - width + 1, width), self.numbers.dtype, self.numbers, 0, (step, step)
        )
        return runs[starts]


@dataclass(frozen=True)
class Columns:
    """The columns of a dataset, as stored. Only their booleans are in memory, and what tells where the rest is."""

    columns: dict[str, Column]  # in the order of an item's keys
    pieces: np.ndarray  # (P,): the rows up to the end of each piece, the same in all columns
    starts: np.ndarray  # (E,): the value of `index` at each episode's first frame
    ends: np.ndarray  # (E,): and after its last
    tasks: np.ndarray  # task_index -> str

    def __len__(self) -> int:
        return int(self.pieces[-1])

    def pieces_of(self, rows: np.ndarray) -> np.ndarray:
        return np.searchsorted(self.pieces, rows, side="right")


def _flat_numbers(array: pa.Array) -> np.ndarray | None:
    """Numbers or (nested) lists of numbers as a 1-D array, row after row; None if one of them is null."""
    flat = innermost(array)
    if array.null_count or flat.null_count:
        return None
    return flat.to_numpy(zero_copy_only=False)  # copies only booleans, which Arrow packs in bits


def _make_column(pieces: list[np.ndarray], ends: np.ndarray, row: torch.Tensor) -> Column:
    """Pieces of a column, each 1-D, the rows up to the end of each, and one row as LeRobot reads it."""
    size = row.numel()
    starts = np.concatenate([[0], ends[:-1]])
    if pieces[0].dtype == bool:  # unpacked already
        return Column(np.concatenate(pieces), np.zeros(len(pieces), np.int64), tuple(row.shape), row.dtype)
    addresses = np.array([piece.__array_interface__["data"][0] for piece in pieces])
    low, high = addresses.min(), max(address + piece.nbytes for address, piece in zip(addresses, pieces, strict=True))
    numbers = np.frombuffer(pa.foreign_buffer(low, high - low, base=pieces), pieces[0].dtype)
    # Arrow aligns what it stores to 8 bytes, so the pieces are a whole number of numbers apart.
    return Column(numbers, (addresses - low) // numbers.itemsize - starts * size, tuple(row.shape), row.dtype)


def _read_columns(hf_dataset: datasets.Dataset, meta: LeRobotDatasetMetadata) -> Columns | None:
    """The columns of a dataset, or None if one of them is not plain numbers."""
    if len(hf_dataset) == 0 or hf_dataset._indices is not None:  # a selection of rows is not in the table
        return None
    batches = [batch for batch in hf_dataset.data.to_batches() if len(batch)]
    ends = np.cumsum([len(batch) for batch in batches])
    columns = {}
    for key, row in hf_dataset[0].items():  # one row, as LeRobot reads it, tells dtype and shape
        if key in meta.camera_keys:
            continue  # an image, which `serve_frames` decodes
        if not isinstance(row, torch.Tensor) or row.numel() == 0:
            return None
        numbers = [_flat_numbers(batch.column(key)) for batch in batches]
        pieces = [
            p for p, batch in zip(numbers, batches, strict=True) if p is not None and len(p) == len(batch) * row.numel()
        ]
        if len(pieces) < len(batches):
            return None
        columns[key] = _make_column(pieces, ends, row)
    return Columns(
        columns,
        ends,
        starts=meta.episodes.data.column("dataset_from_index").to_numpy(),
        ends=meta.episodes.data.column("dataset_to_index").to_numpy(),
        tasks=meta.tasks.index.to_numpy(dtype=object),
    )


# Per process and per loaded table: LeRobot loads another table, never changes one.
_columns: WeakKeyDictionary[datasets.Dataset, Columns | None] = WeakKeyDictionary()


@dataclass(frozen=True)
class Rows:
    """Some frames of a camera, in another order, without copying them."""

    frames: "np.ndarray | Rows"  # (N, C, H, W)
    rows: np.ndarray

    def __getitem__(self, index: np.ndarray) -> np.ndarray:
        return self.frames[self.rows[index]]


# The frames of each dataset's cameras that a policy reads, by key: (N, C, H, W) uint8 each.
_frames: WeakKeyDictionary[LeRobotDataset, Mapping[str, np.ndarray | Rows]] = WeakKeyDictionary()


class ReadsCameras(Protocol):
    """Settings of a policy that reads some of a dataset's cameras."""

    image_size: list[int]
    cache_frames: bool
    states: list[str] | None
    properties: list[str]

    def cameras_of(self, dataset_features: dict[str, dict[str, Any]]) -> list[str]: ...


def read_cameras(dataset: LeRobotDataset, settings: ReadsCameras, whole: LeRobotDataset | None = None) -> None:
    """From here on the dataset has the cameras that a policy reads, and decodes no others; their frames are cached
    where the settings say so and LeRobot does not augment them. Other columns that cannot be read in batches go too,
    of texts or with rows that hold nothing.

    Args:
        whole: dataset with more episodes of the same folder whose frames are cached already.

    Raises:
        ValueError, OSError: what `cached_frames` and `cameras_of` raise, and a row that does not say where it belongs.
    """
    features, hf_dataset = dataset.meta.features, dataset.hf_dataset
    wanted = settings.cameras_of(features)
    unread = [key for key in dataset.meta.camera_keys if key not in wanted]
    unread += [key for key, entry in features.items() if entry["dtype"] in TEXTS]
    read = {STATE, ENVIRONMENT_STATE, ACTION, RETURN_TO_GO, *(settings.states or ()), *settings.properties}
    for key in set(hf_dataset.column_names) - {*dataset.meta.camera_keys, *unread, *read}:
        if any(chunk.null_count or innermost(chunk).null_count for chunk in hf_dataset.data.column(key).chunks):
            if key in DEFAULT_FEATURES:
                raise ValueError(f"{key} is empty in rows of {dataset.root}, which nothing else places: fetch it anew.")
            unread.append(key)
    for key in unread:
        del features[key]
        (dataset.reader.delta_indices or {}).pop(key, None)
    if unread:
        stored = [key for key in unread if key in hf_dataset.column_names]
        dataset.reader.hf_dataset = hf_dataset.remove_columns(stored)
    if not wanted or not settings.cache_frames or dataset.image_transforms is not None:
        return
    if whole is not None and whole in _frames:
        index, of_whole = (one.hf_dataset.data.column("index").to_numpy() for one in (dataset, whole))
        rows = np.searchsorted(of_whole, index)
        _frames[dataset] = {key: Rows(frames, rows) for key, frames in _frames[whole].items()}
    else:
        serve_frames(dataset, wanted, (settings.image_size[0], settings.image_size[1]))


def serve_frames(dataset: LeRobotDataset, cameras: Sequence[str], size: tuple[int, int]) -> None:
    """From here on the dataset's batched reads hold these cameras' pictures, uint8 at this size, and no other camera's.

    The first call for a dataset decodes them: see `cached_frames`, which also says what it raises.
    """
    _frames[dataset] = {key: cached_frames(dataset, key, size) for key in cameras}


@dataclass(frozen=True)
class Steps:
    """Which frames make up B windows of K steps."""

    rows: np.ndarray  # (B, K)
    padded: np.ndarray  # (B, K): outside the episode
    whole: np.ndarray  # (B,): the window's frames follow each other in one piece
    pieces: np.ndarray  # (B,) of its first frame
    others: np.ndarray  # (B', K), pieces of the frames of windows that are not whole

    def of(self, column: Column) -> np.ndarray:
        """(B, K, *shape) of a column."""
        whole, length = self.whole, self.rows.shape[1]
        if whole.all():
            return column.take_runs(self.rows[:, 0], self.pieces, length)
        taken = np.empty((*self.rows.shape, *column.shape), column.numbers.dtype)
        taken[whole] = column.take_runs(self.rows[whole, 0], self.pieces[whole], length)
        taken[~whole] = column.take(self.rows[~whole], self.others)
        return taken


def _steps(
    columns: Columns,
    reader: DatasetReader,
    rows: np.ndarray,
    index: np.ndarray,
    wanted: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
) -> Steps:
    """The frames of windows around `rows` (B,), whose `index`, (B, 1), counts over all episodes, as do the `wanted`
    frames, (B, K), of which those outside the window's episode, `start` to `end`, (B, 1), become its nearest.

    Raises:
        KeyError: as `gather`.
    """
    absolute = wanted.clip(start, end - 1)
    taken = absolute
    if reader.episodes is not None:  # some episodes are loaded, each of them frame after frame
        taken = (rows[:, None] + absolute - index).clip(0, len(columns) - 1)
    first, last = columns.pieces_of(taken[:, 0]), columns.pieces_of(taken[:, -1])
    whole = (first == last) & (taken[:, 1:] == taken[:, :-1] + 1).all(1)
    steps = Steps(taken, wanted != absolute, whole, first, columns.pieces_of(taken[~whole]))
    if reader.episodes is not None and (steps.of(columns.columns["index"]) != absolute).any():
        raise KeyError(
            "a window reaches a frame of its episode that is not loaded, or not in its place; "
            "UNIMASK_PATCH_LEROBOT=0 reads frames one by one, wherever they are"
        )
    return steps


def gather(
    columns: Columns,
    reader: DatasetReader,
    indices: Iterable[int],
    frames: Mapping[str, np.ndarray | Rows] | None = None,
) -> Windows:
    """The items `indices`, any order, negative ones from the end, as `DatasetReader.get_item` would read each.

    Steps outside the episode are copies of its nearest frame, flagged in `<key>_is_pad` (B, K).

    Raises:
        IndexError: an index outside the dataset.
        KeyError: a step that the metadata place in an episode is not among the loaded frames, or not in its place.
    """
    rows = np.fromiter(map(operator.index, indices), dtype=np.int64)  # (B,)
    size = len(columns)
    outside = rows[(rows < -size) | (rows >= size)]
    if len(outside):
        raise IndexError(f"index {outside[0]} is out of bounds for a dataset of {size} frames")
    rows = np.where(rows < 0, rows + size, rows)
    pieces = columns.pieces_of(rows)

    index = columns.columns["index"].take(rows, pieces)[:, None]  # (B, 1)
    episode = columns.columns["episode_index"].take(rows, pieces)[:, None]
    start, end = columns.starts[episode], columns.ends[episode]
    frames = frames or {}
    deltas_of = {
        key: tuple(deltas)
        for key, deltas in (reader.delta_indices or {}).items()
        if key in columns.columns or key in frames  # not of a camera that nobody reads
    }
    steps = {  # keys mostly share their deltas
        deltas: _steps(columns, reader, rows, index, index + np.array(deltas), start, end)
        for deltas in set(deltas_of.values())
    }
    batch: dict[str, Any] = {
        key: torch.from_numpy(np.asarray(pictures[steps[deltas_of[key]].rows if key in deltas_of else rows]))
        for key, pictures in frames.items()
    }
    for key, column in columns.columns.items():
        taken = steps[deltas_of[key]].of(column) if key in deltas_of else column.take(rows, pieces)
        batch[key] = torch.from_numpy(taken).to(column.dtype)
    for key, deltas in deltas_of.items():
        batch[f"{key}_is_pad"] = torch.tensor(steps[deltas].padded)  # a copy for each key
    batch["task"] = columns.tasks[batch["task_index"].numpy()].tolist()
    return Windows(batch, len(rows))


def batched_read(dataset: LeRobotDataset) -> Callable[[Iterable[int]], Windows] | None:
    """`dataset.__getitems__`, or None where items must be read one by one, which PyTorch then does.

    That is: a subclass that reads items its own way; a dataset being recorded; one with cameras that `serve_frames` has
    not been called for, or whose pictures LeRobot augments; one with any other column that is not plain numbers; one
    whose frames the user has given another transform; deltas that LeRobot refuses.
    """
    if type(dataset).__getitem__ is not LeRobotDataset.__getitem__:
        return None
    if dataset.writer is not None and not dataset._is_finalized:
        return None
    frames = _frames.get(dataset)
    if dataset.meta.camera_keys and (frames is None or dataset.image_transforms is not None):
        return None
    hf_dataset = dataset.hf_dataset  # loads it if need be
    if hf_dataset.format["format_kwargs"].get("transform") is not hf_transform_to_torch:
        return None
    if hf_dataset not in _columns:
        _columns[hf_dataset] = _read_columns(hf_dataset, dataset.meta)
    columns, reader = _columns[hf_dataset], dataset.reader
    if columns is None:
        return None
    known = (columns.columns.keys() | set(dataset.meta.camera_keys)) - {"task_index"}
    if reader.delta_indices is not None and not reader.delta_indices.keys() <= known:
        return None
    return partial(gather, columns, reader, frames=frames)
