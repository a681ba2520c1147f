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
from torch.utils.data._utils.collate import collate

from lerobot_unimask.data.factors import TEXTS
from lerobot_unimask.data.frames import cached_frames


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


def collate_windows(batch: Sequence[Item], *, collate_fn_map: dict | None = None) -> dict:
    """What default_collate does with a batch whose first item is an `Item`: nothing, if it was gathered as a batch."""
    if isinstance(batch, Windows) and batch.unchanged():
        return dict(batch.batch)
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
        size = math.prod(self.shape)
        first = self.offsets[piece] + rows * size
        return self.numbers[first[..., None] + np.arange(size)].reshape(*rows.shape, *self.shape)


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
    """Numbers or (nested) lists of numbers as a 1-D array, row after row; None if any is null."""
    while not array.null_count:
        if isinstance(array, pa.ExtensionArray):
            array = array.storage
        elif pa.types.is_nested(array.type):
            array = array.flatten()
        else:
            return array.to_numpy(zero_copy_only=False)  # copies only booleans, which Arrow packs in bits
    return None


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

    def cameras_of(self, dataset_features: dict[str, dict[str, Any]]) -> list[str]: ...


def read_cameras(dataset: LeRobotDataset, settings: ReadsCameras, whole: LeRobotDataset | None = None) -> None:
    """From here on the dataset has the cameras that a policy reads, and decodes no others; their frames are cached
    where the settings say so and LeRobot does not augment them. Columns of texts go too, which cannot be read in
    batches and which no policy of ours reads.

    Args:
        whole: dataset with more episodes of the same folder whose frames are cached already.

    Raises:
        ValueError, OSError: what `cached_frames` and `cameras_of` raise.
    """
    features = dataset.meta.features
    wanted = settings.cameras_of(features)
    unread = [key for key in dataset.meta.camera_keys if key not in wanted]
    unread += [key for key, entry in features.items() if entry["dtype"] in TEXTS]
    for key in unread:
        del features[key]
        (dataset.reader.delta_indices or {}).pop(key, None)
    if unread:
        hf_dataset = dataset.hf_dataset
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
    steps = {}  # deltas -> rows (B, K), their pieces (B, K), padded (B, K); keys mostly share their deltas
    for deltas in set(deltas_of.values()):
        wanted = index + np.array(deltas)  # (B, K), absolute: counted over all episodes
        absolute = wanted.clip(start, end - 1)
        taken = absolute
        if reader.episodes is not None:  # some episodes are loaded, each of them frame after frame
            taken = (rows[:, None] + absolute - index).clip(0, size - 1)
            if (columns.columns["index"].take(taken, columns.pieces_of(taken)) != absolute).any():
                raise KeyError(
                    "a window reaches a frame of its episode that is not loaded, or not in its place; "
                    "UNIMASK_PATCH_LEROBOT=0 reads frames one by one, wherever they are"
                )
        steps[deltas] = taken, columns.pieces_of(taken), wanted != absolute

    batch: dict[str, Any] = {
        key: torch.from_numpy(np.asarray(pictures[steps[deltas_of[key]][0] if key in deltas_of else rows]))
        for key, pictures in frames.items()
    }
    for key, column in columns.columns.items():
        where = steps[deltas_of[key]][:2] if key in deltas_of else (rows, pieces)
        batch[key] = torch.from_numpy(column.take(*where)).to(column.dtype)
    for key, deltas in deltas_of.items():
        batch[f"{key}_is_pad"] = torch.tensor(steps[deltas][2])  # each key its own copy, should somebody write to it
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
