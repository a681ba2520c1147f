"""The batched read against LeRobot's own, item by item: the same keys, dtypes, shapes and values."""

import copy
import dataclasses
import math
import os
import pickle
import shutil
import time
from pathlib import Path
from types import SimpleNamespace

os.environ["HF_HUB_OFFLINE"] = "1"  # read when huggingface_hub is imported

import datasets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data import DataLoader, Subset, default_collate
from torch.utils.data._utils.pin_memory import pin_memory

from lerobot_unimask import lerobot_patches
from lerobot_unimask.data import reads
from lerobot_unimask.data.reads import Item, Windows

FPS = 10
K = 10
LENGTHS = [12, 1, 5, 10, 23, 3]  # frames per episode: shorter than a window, as long, longer
EPISODES = [1, 3, 4]  # the subset
FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (4,), "names": None},
    "observation.cell": {"dtype": "int64", "shape": (2,), "names": None},
    "observation.precise": {"dtype": "float64", "shape": (2,), "names": None},
    "observation.switches": {"dtype": "bool", "shape": (2,), "names": None},
    "action": {"dtype": "int64", "shape": (1,), "names": None},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}
DELTAS = {
    "none": None,
    "future": {key: range(K) for key in FEATURES},
    "past and future": {"observation.state": [-3, -1, 0, 2], "action": range(-1, 4), "next.done": [0], "index": [5]},
}


@pytest.fixture(autouse=True, scope="module")
def installed():
    lerobot_patches.apply()


def write(root, features=FEATURES, lengths=LENGTHS):
    dataset = LeRobotDataset.create("user/reads", fps=FPS, features=features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for episode, length in enumerate(lengths):
        for _ in range(length):
            frame = {
                key: (9 * rng.random(f["shape"])).astype("uint8" if f["dtype"] == "image" else f["dtype"])
                for key, f in features.items()
            }
            dataset.add_frame({**frame, "task": f"task {episode % 2}"})
        dataset.save_episode()
    dataset.finalize()
    return root


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write(tmp_path_factory.mktemp("reads") / "dataset")


def load(root, deltas="future", episodes=None):
    steps = DELTAS[deltas]
    timestamps = None if steps is None else {key: [step / FPS for step in steps[key]] for key in steps}
    return LeRobotDataset("user/reads", root=root, episodes=episodes, delta_timestamps=timestamps)


def one_by_one(dataset, indices):
    return default_collate([dataset[i] for i in indices])


def assert_same(batch, expected):
    assert isinstance(batch, dict)
    assert list(batch) == list(expected)
    for key, value in expected.items():
        assert type(batch[key]) is type(value), key
        if isinstance(value, torch.Tensor):
            assert (batch[key].dtype, batch[key].shape) == (value.dtype, value.shape), key
            assert torch.equal(batch[key], value), key
        else:
            assert batch[key] == value, key


@pytest.mark.parametrize("episodes", [None, EPISODES])
@pytest.mark.parametrize("deltas", DELTAS)
def test_every_frame_equals_the_item_by_item_read(root, deltas, episodes):
    dataset = load(root, deltas, episodes)
    everything = range(len(dataset))  # so every episode's end is among them
    assert len(dataset) == sum(LENGTHS if episodes is None else [LENGTHS[e] for e in EPISODES])
    batch = default_collate(dataset.__getitems__(everything))
    assert_same(batch, one_by_one(dataset, everything))
    if deltas == "future":
        assert batch["action_is_pad"].any(1).sum() > 0
        assert batch["action"].shape == (len(dataset), K)  # a feature of shape (1,) comes without that axis


def test_matrices_and_small_integers(tmp_path):
    features = {
        "observation.grid": {"dtype": "int32", "shape": (2, 3), "names": None},
        "observation.field": {"dtype": "float64", "shape": (2, 1, 2), "names": None},
        "action": {"dtype": "uint8", "shape": (1,), "names": None},
    }
    root = write(tmp_path / "matrices", features, [3, 2])  # LeRobot's writer fails on a one-frame episode with matrices
    timestamps = {key: [-0.1, 0, 0.1] for key in features}
    dataset = LeRobotDataset("user/reads", root=root, delta_timestamps=timestamps)
    batch = default_collate(dataset.__getitems__(range(5)))
    assert_same(batch, one_by_one(dataset, range(5)))
    assert batch["observation.grid"].shape == (5, 3, 2, 3)


@pytest.mark.parametrize("episodes", [None, EPISODES])
def test_any_order_duplicates_negative_indices_and_other_integers(root, episodes):
    dataset = load(root, episodes=episodes)
    for indices in ([17, 3, 3, -1, 0, 17, -len(dataset)], [5], np.array([4, 2]), torch.tensor([4, 2])):
        expected = one_by_one(dataset, [int(i) for i in indices])
        assert_same(default_collate(dataset.__getitems__(indices)), expected)
    assert list(dataset.__getitems__([])) == []


def test_an_index_that_lerobot_refuses_is_refused(root):
    dataset = load(root)
    for outside in (len(dataset), -len(dataset) - 1):
        with pytest.raises(IndexError):
            dataset[outside]
        with pytest.raises(IndexError, match=str(outside)):
            dataset.__getitems__([0, outside])
    with pytest.raises(TypeError):
        dataset.__getitems__([1.5])


def test_a_window_that_is_not_all_loaded_is_an_error(root):
    dataset = load(root, episodes=[1])
    columns, reader = reads._read_columns(dataset.hf_dataset, dataset.meta), dataset.reader
    longer = dataclasses.replace(columns, ends=columns.ends + 2)  # metadata of an episode with two more frames
    with pytest.raises(KeyError, match="not loaded"):
        reads.gather(longer, reader, [0])


def test_dataloader_and_subset_read_in_batches(root, monkeypatch):
    dataset = load(root, episodes=EPISODES)
    subset = Subset(dataset, [30, 2, 9, 9, 0])
    expected = one_by_one(dataset, [30, 2, 9]), one_by_one(dataset, [9, 0])
    order = torch.randperm(len(dataset), generator=torch.Generator().manual_seed(0)).tolist()
    expected_shuffled = [one_by_one(dataset, order[i : i + 7]) for i in range(0, len(order), 7)]
    monkeypatch.setattr(LeRobotDataset, "__getitem__", lambda self, i: pytest.fail("read item by item"))
    for batch, want in zip(DataLoader(subset, batch_size=3), expected, strict=True):
        assert_same(batch, want)
    for batch, want in zip(DataLoader(dataset, batch_size=7, sampler=order), expected_shuffled, strict=True):
        assert_same(batch, want)


@pytest.mark.slow  # the worker imports LeRobot
def test_a_spawned_worker_reads_in_batches(root):
    """The worker imports nothing of this project but what the pickled dataset brings."""
    dataset = load(root, episodes=EPISODES)
    # copy.copy as collate_fn hands on what the worker's `__getitems__` returned.
    loader = DataLoader(dataset, batch_size=8, num_workers=1, multiprocessing_context="spawn", collate_fn=copy.copy)
    for start, windows in zip(range(0, len(dataset), 8), loader, strict=True):
        assert type(windows) is Windows
        assert_same(default_collate(windows), one_by_one(dataset, range(start, min(start + 8, len(dataset)))))


def test_a_pickled_or_copied_dataset_carries_no_columns(root):
    dataset = load(root)
    before = len(pickle.dumps(dataset))
    default_collate(dataset.__getitems__(range(len(dataset))))
    assert len(pickle.dumps(dataset)) == before
    expected = one_by_one(dataset, [3, 1])
    for other in (pickle.loads(pickle.dumps(dataset)), copy.copy(dataset), copy.deepcopy(dataset)):
        assert_same(default_collate(other.__getitems__([3, 1])), expected)


def test_items_are_dicts_equal_to_the_datasets(root):
    dataset = load(root)
    windows = dataset.__getitems__([11, 40])
    assert len(windows) == 2
    assert isinstance(windows[0], dict)
    for item, i in zip(windows, [11, 40], strict=True):
        assert_same(dict(item), dataset[i])
    assert_same(default_collate(list(windows)), one_by_one(dataset, [11, 40]))  # a plain list of such items
    assert_same(default_collate(windows[1:] + windows[:1]), one_by_one(dataset, [40, 11]))
    assert_same(default_collate([windows[-1], dataset[11]]), one_by_one(dataset, [40, 11]))
    with pytest.raises(IndexError):
        windows[2]


def test_what_a_collate_fn_changes_in_items_is_collated(root):
    dataset = load(root)

    def mark(batch):
        for n, item in enumerate(batch):
            item["extra"] = n
            item["action"] += 100
            item["next.reward"] = -item["next.reward"]
        return default_collate(batch)

    for batch_size in (1, 3):
        batch = next(iter(DataLoader(dataset, batch_size=batch_size, collate_fn=mark)))
        assert_same(batch, mark([dataset[i] for i in range(batch_size)]))


def test_batches_do_not_share_memory_with_the_columns_or_each_other(root):
    dataset = load(root)
    indices = [7, 7, 50]
    expected = one_by_one(dataset, indices)
    batch = default_collate(dataset.__getitems__(indices))
    padding = batch["action_is_pad"].clone()
    for key, value in batch.items():
        if isinstance(value, torch.Tensor) and key != "action_is_pad":
            value[0] = value.new_ones(())
            assert not torch.equal(value, expected[key]) or (expected[key][0] == 1).all(), key
    assert torch.equal(batch["action_is_pad"], padding)  # nor do keys with the same deltas
    assert_same(default_collate(dataset.__getitems__(indices)), expected)


def test_windows_survive_pinning_uncollated(root, monkeypatch):
    """With pin_memory, PyTorch rebuilds sequences of items from their type; ours become plain lists."""
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda self: self.clone())
    dataset = load(root)
    pinned = pin_memory(dataset.__getitems__([11, 40]))
    assert [type(item) for item in pinned] == [Item, Item]
    assert_same(default_collate(pinned), one_by_one(dataset, [11, 40]))


def test_a_batch_moves_in_one_copy(root, monkeypatch):
    copies = []
    copy_to = torch.Tensor.to

    def to(tensor, *arguments, **keywords):
        copies.append(tensor.dtype)
        return copy_to(tensor, *arguments, **keywords)

    dataset = load(root)
    batch = default_collate(dataset.__getitems__([11, 40, 3]))
    beside = batch._side_by_side(pinned=False)
    assert_same(beside, batch)
    assert all(value.data_ptr() % 16 == 0 for value in beside.values() if isinstance(value, torch.Tensor))
    assert beside._is_pinned()
    monkeypatch.setattr(torch.Tensor, "to", to)
    moved = beside.to("meta")
    assert copies == [torch.uint8]
    assert {key: value.shape for key, value in moved.items() if key != "task"} == {
        key: value.shape for key, value in batch.items() if key != "task"
    }
    assert moved["task"] == batch["task"]
    assert_same(beside._views(beside.buffer.clone()), batch)
    changed = beside["action"] = -beside["action"]
    assert not beside._is_pinned()
    assert torch.equal(beside._side_by_side(pinned=False)["action"], changed)
    assert_same(batch.to("cpu"), batch)


def assert_read_item_by_item(dataset):
    assert dataset.__getitems__ is None
    for source in (dataset, Subset(dataset, [0, 1])):
        assert next(iter(DataLoader(source, batch_size=2, collate_fn=type))) is list


def test_the_environment_turns_it_off(root, monkeypatch):
    monkeypatch.setattr(LeRobotDataset, "__getitems__", None)
    assert_read_item_by_item(load(root))


def test_steps_aside_for_cameras_and_for_words(tmp_path):
    camera = {"dtype": "image", "shape": (4, 4, 3), "names": ["height", "width", "channels"]}
    assert_read_item_by_item(
        load(write(tmp_path / "camera", {**FEATURES, "observation.images.top": camera}, [3]), "none")
    )
    root = tmp_path / "words"
    words = {"action": FEATURES["action"], "note": {"dtype": "string", "shape": (1,), "names": None}}
    dataset = LeRobotDataset.create("user/reads", fps=FPS, features=words, root=root, use_videos=False)
    for i in range(3):
        dataset.add_frame({"action": np.array([i]), "note": "left", "task": "task"})
    dataset.save_episode()
    with pytest.raises(RuntimeError, match="being recorded"):  # LeRobot's own error
        next(iter(DataLoader(dataset)))
    dataset.finalize()
    assert_read_item_by_item(load(root, "none"))


def test_steps_aside_where_the_item_is_not_lerobots(root):
    class Doubled(LeRobotDataset):
        def __getitem__(self, i):
            item = super().__getitem__(i)
            return {**item, "action": 2 * item["action"]}

    assert_read_item_by_item(Doubled("user/reads", root=root))
    dataset = load(root, "none")
    assert dataset.__getitems__ is not None
    dataset.hf_dataset.set_transform(lambda rows: {key: [torch.tensor(x) for x in rows[key]] for key in rows})
    assert_read_item_by_item(dataset)
    selected = load(root, "none")
    selected.reader.hf_dataset = selected.hf_dataset.select([5, 3, 8])
    assert_read_item_by_item(selected)


def test_a_reloaded_table_is_read_anew(root):
    dataset = load(root)
    default_collate(dataset.__getitems__([0]))
    dataset.reader.episodes = EPISODES
    dataset.reader.load_and_activate()
    assert_same(default_collate(dataset.__getitems__([0, 20])), one_by_one(dataset, [0, 20]))


def test_a_dataset_just_recorded_is_read_in_batches(tmp_path):
    dataset = LeRobotDataset.create("user/reads", fps=FPS, features=FEATURES, root=tmp_path / "new", use_videos=False)
    for i in range(4):
        frame = {key: np.full(f["shape"], i, f["dtype"]) for key, f in FEATURES.items()}
        dataset.add_frame({**frame, "task": "task"})
    assert dataset.__getitems__ is None
    dataset.save_episode()
    dataset.finalize()
    assert_same(default_collate(dataset.__getitems__([3, 0])), one_by_one(dataset, [3, 0]))


def test_lerobots_own_getitems_stays(monkeypatch):
    own = SimpleNamespace(__getitems__="LeRobot's own")
    monkeypatch.setattr(reads, "LeRobotDataset", own)
    lerobot_patches.apply()
    assert vars(own) == {"__getitems__": "LeRobot's own"}


@pytest.fixture
def in_pieces(root, tmp_path, monkeypatch):
    """The dataset in two parquet files, which `datasets` caches in pieces of 7 rows, in several files of its own."""
    folder = tmp_path / "pieces"
    shutil.copytree(root, folder)
    file = folder / "data/chunk-000/file-000.parquet"
    table = pq.read_table(file)
    first = sum(LENGTHS[:4])
    pq.write_table(table[:first], file)
    pq.write_table(table[first:], file.with_name("file-001.parquet"))
    monkeypatch.setattr(datasets.config, "DEFAULT_MAX_BATCH_SIZE", 7)
    monkeypatch.setattr(datasets.config, "MAX_SHARD_SIZE", 1)  # byte
    return folder


@pytest.mark.parametrize("episodes", [None, EPISODES])
def test_pieces_in_several_files_are_read_where_they_are(in_pieces, episodes):
    dataset = load(in_pieces, episodes=episodes)
    everything = range(len(dataset))
    assert_same(default_collate(dataset.__getitems__(everything)), one_by_one(dataset, everything))
    columns = reads._columns[dataset.hf_dataset]
    assert len(dataset.hf_dataset.cache_files) > 1
    assert len(columns.pieces) > len(dataset) // 7
    files = [Path(file["filename"]).name for file in dataset.hf_dataset.cache_files]
    mapped = [line.split() for line in Path("/proc/self/maps").read_text().splitlines() if line.endswith(tuple(files))]
    ranges = [[int(bound, 16) for bound in line[0].split("-")] for line in mapped]
    for key, column in columns.columns.items():
        if column.numbers.dtype == bool:  # unpacked
            continue
        base, size = column.numbers.__array_interface__["data"][0], column.numbers.itemsize
        for row, piece in zip(everything, columns.pieces_of(np.array(everything)), strict=True):
            address = base + size * (column.offsets[piece] + row * math.prod(column.shape))
            assert any(low <= address < high for low, high in ranges), key


def test_numbers_are_not_copied_and_nulls_are_refused():
    values = np.arange(12, dtype=np.float32)
    pairs = pa.FixedSizeListArray.from_arrays(pa.array(values), 2)
    assert np.shares_memory(reads._flat_numbers(pairs), values)
    assert np.array_equal(reads._flat_numbers(pairs[4:]), [8, 9, 10, 11])
    assert reads._flat_numbers(pa.array([1, None])) is None
    assert reads._flat_numbers(pa.array([[1, 2], None])) is None
    assert reads._flat_numbers(pa.array([[1, 2], [3, None]])) is None


def test_fifty_times_as_many_windows_a_second(root):
    dataset = load(root)
    batches = torch.randint(len(dataset), (50, 100), generator=torch.Generator().manual_seed(0)).tolist()
    default_collate(dataset.__getitems__(batches[0]))  # the columns are read once

    started = time.perf_counter()
    one_by_one(dataset, batches[0][:20])
    slow = 20 / (time.perf_counter() - started)
    started = time.perf_counter()
    for _ in DataLoader(dataset, batch_sampler=batches):
        pass
    fast = 5000 / (time.perf_counter() - started)
    print(f"\nwindows a second: {slow:.0f} item by item, {fast:.0f} in batches of 100 ({fast / slow:.0f} times)")
    assert fast >= 50 * slow
