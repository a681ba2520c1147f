"""The writer against LeRobot's own, and what it leaves behind when it does not finish."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.io_utils import load_nested_dataset

from dataset_builders import folders, writer
from dataset_builders.writer import episode_statistics, write_dataset

FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": ["x", "y", "z"]},
    "observation.cell": {"dtype": "int64", "shape": (2,), "names": None, "categories": [16, 16]},
    "action": {"dtype": "int64", "shape": (1,), "names": ["direction"], "categories": [4]},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}
TASK = "go there"
LENGTHS = np.array([5, 7, 5, 2, 12, 5, 5, 3, 40, 7, 5, 11, 2])  # more than the ten that LeRobot writes together


def make_columns(lengths, seed=0):
    rng, frames = np.random.default_rng(seed), int(lengths.sum())
    state = rng.normal(size=(frames, 3)).astype(np.float32)
    state[:, 1] = 0.1  # constant: no width for a histogram
    state[:, 2] = 1e4 + 1e-2 * state[:, 2]  # far from zero: float32 cancels
    return {
        "observation.state": state,
        "observation.cell": rng.integers(0, 16, size=(frames, 2)),
        "action": rng.integers(0, 4, size=(frames, 1)),
        "next.reward": rng.integers(-1, 2, size=(frames, 1)).astype(np.float32),
        "next.done": rng.random((frames, 1)) < 0.2,
    }


def write(root, lengths=LENGTHS, **changed):
    arguments = {
        "repo_id": "local/test",
        "fps": 30,
        "features": FEATURES,
        "columns": make_columns(lengths),
        "lengths": lengths,
        "task": TASK,
        "robot_type": "test",
        "provenance": {"seed": 3},
    }
    return write_dataset(root, **(arguments | changed))


def write_with_lerobot(root):
    dataset = LeRobotDataset.create("local/test", fps=30, features=FEATURES, root=root, robot_type="test")
    columns, frame = make_columns(LENGTHS), 0
    for length in LENGTHS:
        for _ in range(length):
            dataset.add_frame({name: column[frame] for name, column in columns.items()} | {"task": TASK})
            frame += 1
        dataset.save_episode()
    dataset.finalize()


@pytest.fixture(scope="module")
def ours_and_lerobots(tmp_path_factory):
    folder = tmp_path_factory.mktemp("writers")
    write(folder / "ours")
    write_with_lerobot(folder / "lerobots")
    return [LeRobotDataset("local/test", root=folder / name) for name in ("ours", "lerobots")]


def test_info_and_tasks_equal_lerobots(ours_and_lerobots):
    ours, lerobots = ours_and_lerobots
    assert ours.meta.info.to_dict() == lerobots.meta.info.to_dict()
    assert ours.meta.features["observation.cell"]["categories"] == [16, 16]
    assert ours.meta.tasks.equals(lerobots.meta.tasks)


def test_frames_equal_lerobots(ours_and_lerobots):
    ours, lerobots = ours_and_lerobots
    assert len(ours) == len(lerobots) == LENGTHS.sum()
    assert ours.hf_dataset.features == lerobots.hf_dataset.features
    for our_frame, lerobot_frame in zip(ours, lerobots, strict=True):
        assert our_frame.keys() == lerobot_frame.keys()
        for name, value in our_frame.items():
            if isinstance(value, torch.Tensor):
                torch.testing.assert_close(value, lerobot_frame[name], rtol=0, atol=0)
            else:
                assert value == lerobot_frame[name]


def test_files_have_lerobots_schema(ours_and_lerobots):
    ours, lerobots = (
        {path.relative_to(dataset.root): pq.read_schema(path) for path in dataset.root.rglob("file-*.parquet")}
        for dataset in ours_and_lerobots
    )
    assert ours.keys() == lerobots.keys()
    for path, schema in ours.items():
        assert set(schema.names) == set(lerobots[path].names)
        assert all(schema.field(name).type.equals(lerobots[path].field(name).type) for name in schema.names)


def test_episodes_and_their_statistics_equal_lerobots(ours_and_lerobots):
    ours, lerobots = (load_nested_dataset(dataset.root / "meta/episodes").to_dict() for dataset in ours_and_lerobots)
    assert ours.keys() == lerobots.keys()
    for name, values in ours.items():
        assert values == lerobots[name], name  # to the last bit


def test_dataset_statistics_equal_lerobots(ours_and_lerobots):
    ours, lerobots = (dataset.meta.stats for dataset in ours_and_lerobots)
    assert ours.keys() == lerobots.keys()
    for feature, statistics in ours.items():
        assert statistics.keys() == lerobots[feature].keys()
        for name, value in statistics.items():
            # LeRobot adds up the episodes one at a time, in float64
            np.testing.assert_allclose(value, lerobots[feature][name], rtol=1e-12, err_msg=f"{feature} {name}")


@pytest.mark.parametrize("dtype", ["float32", "float64", "int64", "bool"])
@pytest.mark.parametrize("width", [1, 3])
def test_episode_statistics_equal_lerobots_to_the_last_bit(dtype, width):
    rng = np.random.default_rng(1)
    lengths = np.array([1, 2, 3, 200, 10, 10, 1, 1000, 200])
    episodes = []
    for length in lengths:
        scale, offset = 10.0 ** rng.integers(-6, 5), rng.choice([0.0, 0.1, -3.0, 1e4])
        values = offset + scale * rng.normal(size=(length, width))
        values[:, 0] = offset if rng.random() < 0.3 else values[:, 0]
        episodes.append((values > offset if dtype == "bool" else values).astype(dtype))
    ours = episode_statistics(np.concatenate(episodes), lengths)
    for number, values in enumerate(episodes):
        array = values[:, 0] if width == 1 else values  # as LeRobot's writer hands them on
        expected = get_feature_stats(array, axis=0, keepdims=width == 1)
        assert ours.keys() == expected.keys()
        for name, value in expected.items():
            np.testing.assert_array_equal(ours[name][number], value, err_msg=f"{name} of {len(values)} steps")


def test_one_episode_has_its_own_statistics(tmp_path):
    lengths = np.array([9])
    dataset = LeRobotDataset("local/test", root=write(tmp_path / "one", lengths))
    expected = get_feature_stats(make_columns(lengths)["observation.state"], axis=0, keepdims=False)
    for name, value in expected.items():
        np.testing.assert_array_equal(dataset.meta.stats["observation.state"][name], value)


def test_large_datasets_are_split_into_files_between_episodes(tmp_path, monkeypatch):
    limit = 0.02
    monkeypatch.setattr("lerobot.datasets.feature_utils.DEFAULT_DATA_FILE_SIZE_IN_MB", limit)
    monkeypatch.setattr(writer, "ROW_GROUP_FRAMES", 100)
    monkeypatch.setattr(writer, "ROW_GROUP_EPISODES", 3)
    monkeypatch.setattr("lerobot.datasets.feature_utils.DEFAULT_CHUNK_SIZE", 2)  # files in a chunk
    lengths = np.full(60, 30)
    root = write(tmp_path / "split", lengths)
    dataset = LeRobotDataset("local/test", root=root)
    files = sorted((root / "data").rglob("*.parquet"))
    assert len(files) > 2
    assert len(list((root / "data").iterdir())) == -(-len(files) // 2)
    for kind, column in (("data", "data"), ("meta/episodes", "meta/episodes")):
        assert len(list((root / kind).rglob("*.parquet"))) > 2
        for path in (root / kind).rglob("*.parquet"):
            chunk, file = int(path.parent.name[-3:]), int(path.stem[-3:])
            for episode in set(pq.read_table(path)["episode_index"].to_pylist()):
                row = dataset.meta.episodes[episode]
                assert (row[f"{column}/chunk_index"], row[f"{column}/file_index"]) == (chunk, file)
    columns = make_columns(lengths)
    stored = dataset.hf_dataset.with_format("numpy")
    np.testing.assert_array_equal(stored["index"][:], np.arange(lengths.sum()))
    np.testing.assert_array_equal(stored["observation.state"][:], columns["observation.state"])


def test_an_empty_folder_is_used(tmp_path):
    (tmp_path / "empty").mkdir()
    assert len(LeRobotDataset("local/test", root=write(tmp_path / "empty"))) == LENGTHS.sum()
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


def test_a_folder_with_something_in_it_is_refused_and_left_as_it_was(tmp_path):
    root = tmp_path / "full"
    root.mkdir()
    (root / "precious").write_text("data")
    with pytest.raises(FileExistsError, match="not empty"):
        write(root)
    assert [path.name for path in root.iterdir()] == ["precious"]
    assert (root / "precious").read_text() == "data"
    assert list(tmp_path.iterdir()) == [root]


def test_what_appears_in_the_folder_meanwhile_is_left_as_it_was(tmp_path, monkeypatch):
    root = tmp_path / "late"
    finish = writer._finish_info

    def finish_late(*arguments):
        finish(*arguments)
        root.mkdir()
        (root / "precious").write_text("data")

    monkeypatch.setattr(writer, "_finish_info", finish_late)
    with pytest.raises(OSError, match="late"):
        write(root)
    assert list(tmp_path.iterdir()) == [root]
    assert [path.name for path in root.iterdir()] == ["precious"]


@pytest.mark.parametrize("stage", ["_default_columns", "write_stats", "_data_table", "_write_episodes", "_finish_info"])
def test_an_interrupted_build_leaves_nothing(tmp_path, monkeypatch, stage):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(writer, stage, interrupt)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "new")
    assert list(tmp_path.iterdir()) == []


def test_a_killed_build_leaves_nothing_that_looks_complete(tmp_path, monkeypatch):
    def kill(*_):
        raise SystemExit

    monkeypatch.setattr(writer, "_finish_info", kill)
    monkeypatch.setattr(folders.shutil, "rmtree", lambda *_, **__: None)  # a killed process cleans nothing up
    with pytest.raises(SystemExit):
        write(tmp_path / "new")
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".new")
    assert left.name.endswith(".partial")
    assert json.loads((left / "new/meta/info.json").read_text())["total_episodes"] == 0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"lengths": np.array([2, 0])}, "lengths"),
        ({"lengths": np.array([2.0, 3.0])}, "lengths"),
        (
            {"lengths": np.array([5, 6]), "columns": make_columns(LENGTHS)},
            r"observation\.state: expected float32 \(11, 3\)",
        ),
        ({"features": FEATURES | {"extra": FEATURES["action"]}}, "differ in .'extra'"),
        ({"columns": make_columns(LENGTHS) | {"action": np.zeros((LENGTHS.sum(), 1))}}, "action: expected int64"),
        (
            {"columns": make_columns(LENGTHS) | {"next.reward": np.full((LENGTHS.sum(), 1), np.nan, np.float32)}},
            r"next\.reward: 109 values are not finite",
        ),
        ({"features": FEATURES | {"action": {"dtype": "int64", "shape": (1, 1), "names": None}}}, "only numbers"),
    ],
)
def test_columns_that_do_not_fit_are_refused(tmp_path, changed, message):
    with pytest.raises(ValueError, match=message):
        write(tmp_path / "new", **changed)
    assert list(tmp_path.iterdir()) == []
