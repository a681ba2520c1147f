"""Unsound numbers stop a training before its first step; what can be known of a dataset is not assumed."""

import json
import shutil

import commands
import datasets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import dataset_metadata, factory
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.factory import make_policy

from dataset_builders.maze2d import build_maze2d
from lerobot_unimask import UniMASKConfig
from lerobot_unimask.data import episodes, soundness
from lerobot_unimask.data.episodes import open_dataset, read_info, read_windows

SMALL = {"width": 16, "depth": 1, "heads": 2, "feedforward_width": 16, "device": "cpu", "push_to_hub": False}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return build_maze2d(tmp_path_factory.mktemp("sound") / "maze", episodes=3, progress=False)


@pytest.fixture
def root(built, tmp_path, monkeypatch):
    monkeypatch.setattr(soundness, "SEEN", tmp_path / "seen")
    return shutil.copytree(built, tmp_path / "maze")


def policy_of(root, **settings):
    return make_policy(UniMASKConfig(**SMALL, **settings), ds_meta=LeRobotDatasetMetadata("local/maze", root=root))


def spoil_column(root, key, frame, number, value):
    (path,) = (root / "data").glob("*/*.parquet")
    table = pq.read_table(path)
    column = table.column(key).combine_chunks()
    flat = column.flatten().to_numpy() if pa.types.is_nested(column.type) else column.to_numpy()
    values = flat.reshape(len(table), -1).copy()
    values[frame, number] = value
    array = pa.array(values.ravel())
    if pa.types.is_nested(column.type):
        array = pa.FixedSizeListArray.from_arrays(array, values.shape[1])
    table = table.set_column(table.column_names.index(key), table.schema.field(key), array.cast(column.type))
    pq.write_table(table, path)


def spoil_statistics(root, key, change):
    path = root / "meta" / "stats.json"
    stats = json.loads(path.read_text())
    change(stats, key)
    path.write_text(json.dumps(stats))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("key", "number", "name"),
    [("observation.state", 1, "y"), ("action", 0, "x"), ("observation.return_to_go", 0, "return_to_go")],
)
def test_an_unsound_number_is_named_with_its_place(root, key, number, name, value):
    spoil_column(root, key, frame=437, number=number, value=value)
    with pytest.raises(ValueError, match="not finite") as raised:
        policy_of(root)
    said = str(raised.value)
    assert key in said
    assert "episode 2, frame 37" in said
    assert str(value) in said


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda stats, key: stats[key]["mean"].__setitem__(1, float("nan")), ["nan", "mean", "y"]),
        (lambda stats, key: stats[key]["std"].__setitem__(0, float("inf")), ["inf", "std", "x"]),
        (lambda stats, key: stats[key]["std"].__setitem__(2, -1.0), ["-1.0", "std", "goal_x"]),
        (lambda stats, key: stats[key]["mean"].pop(), ["3 numbers", "4"]),
    ],
    ids=["nan", "inf", "negative", "another length"],
)
def test_an_unsound_statistic_is_named(root, change, words):
    spoil_statistics(root, "observation.state", change)
    with pytest.raises(ValueError, match=r"observation\.state") as raised:
        policy_of(root)
    assert [word for word in words if word not in str(raised.value)] == []


@pytest.mark.parametrize("absent", ["a column", "the file"])
def test_absent_statistics_are_computed(root, absent):
    before = policy_of(root).statistics.state_dict()
    if absent == "the file":
        (root / "meta" / "stats.json").unlink()
    else:
        spoil_statistics(root, "action", lambda stats, key: stats.pop(key))
    after = policy_of(root).statistics.state_dict()
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("fault", [None, "x", [1], {"mode": "x"}, {"mean": [[0.0], [0.0, 1.0]]}, {"std": [None]}])
@pytest.mark.parametrize("key", ["action", "a column that is not read"])
def test_what_are_no_statistics_is_left_out(root, fault, key, caplog):
    """Also ragged ones, which numpy refuses, and those of a column that no policy reads."""
    before = policy_of(root).statistics.state_dict()
    spoil_statistics(root, key, lambda stats, key: stats.update({key: fault}))
    after = policy_of_episodes(root, None).statistics.state_dict()
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, rtol=1e-3, atol=1e-4)
    assert key in caplog.text


def test_time_comes_from_the_metadata_whatever_the_statistics_lack(root):
    for key in ("timestamp", "frame_index"):
        spoil_statistics(root, key, lambda stats, key: stats.pop(key))
    statistics = policy_of(root).statistics
    assert statistics.fps.item() == 100
    assert statistics.horizon.item() == 200


def test_a_dataset_seen_before_is_not_read_again(root, monkeypatch):
    policy_of(root)
    monkeypatch.setattr(soundness, "_numbers", None)  # reading would fail
    policy_of(root)
    (path,) = (root / "data").glob("*/*.parquet")
    path.touch()  # changed, as far as one can tell
    with pytest.raises(TypeError):
        policy_of(root)


def policy_of_episodes(root, episodes):
    """The policy that lerobot-train makes with `--dataset.episodes`."""
    config = TrainPipelineConfig(
        DatasetConfig("local/maze", root=str(root), episodes=episodes), policy=UniMASKConfig(**SMALL)
    )
    dataset = factory.make_dataset(config)
    return make_policy(config.policy, ds_meta=dataset.meta)


def test_an_episode_that_is_not_read_may_hold_what_it_likes(root):
    """Also in the statistics, which LeRobot's writer takes of all episodes."""
    whole = policy_of(root)
    spoil_column(root, "observation.state", frame=437, number=1, value=np.nan)
    spoil_statistics(root, "observation.state", lambda stats, key: stats[key]["mean"].__setitem__(1, float("nan")))
    policy = policy_of_episodes(root, [1, 0])
    (path,) = (root / "data").glob("*/*.parquet")
    states = np.array(pq.read_table(path).column("observation.state").to_pylist())[:400]
    np.testing.assert_allclose(policy.statistics.s_mean, states.mean(0), rtol=1e-5)
    deviations = states.std(0)
    deviations[deviations == 0] = 1  # the goal's x, which both episodes share, is only shifted
    np.testing.assert_allclose(policy.statistics.s_std, deviations, rtol=1e-5)
    assert torch.equal(policy.episode_starts.returns, whole.episode_starts.returns[:2])
    with pytest.raises(ValueError, match="episode 2, frame 37"):  # what was looked through does not cover others
        policy_of_episodes(root, [0, 2])
    with pytest.raises(ValueError, match="episode 2, frame 37"):
        policy_of(root)


def test_what_was_looked_through_covers_its_parts(root, monkeypatch):
    policy_of(root)
    monkeypatch.setattr(soundness, "_numbers", None)  # reading would fail
    policy_of_episodes(root, [1])


def test_a_home_that_cannot_be_written_to_is_named(root, tmp_path, monkeypatch):
    """LeRobot takes a dataset whose tables it cannot keep for one that is not there, and asks the Hub."""
    (tmp_path / "home").write_text("a file")
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / "home" / "datasets")
    with pytest.raises(OSError, match="HF_HOME") as raised:
        policy_of_episodes(root, None)
    assert str(tmp_path / "home" / "datasets") in str(raised.value)
    with pytest.raises(OSError, match="HF_HOME"):
        open_dataset(UniMASKConfig(**SMALL), root)


def spoil_info(root, **entries):
    path = root / "meta" / "info.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **entries}))


def with_column(key, values):
    """Change a table so that a column holds these values, each row the next one, again and again."""
    return lambda table: table.set_column(
        table.column_names.index(key), key, pa.array([values[i % len(values)] for i in range(len(table))])
    )


DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
TASKS = "meta/tasks.parquet"


def spoil_bytes(path):
    content = path.read_bytes()
    path.write_bytes(content[:4] + b"\xff" * 40 + content[44:])


def table_changed(file, change):
    """A damage: a function of a dataset's folder."""
    return lambda root: pq.write_table(change(pq.read_table(root / file).replace_schema_metadata(None)), root / file)


DAMAGES = {
    "no table": (lambda root: (root / DATA).unlink(), DATA),
    "no episodes": (lambda root: shutil.rmtree(root / "meta" / "episodes"), "meta/episodes"),
    "no tasks": (lambda root: (root / "meta" / "tasks.parquet").unlink(), "meta/tasks.parquet"),
    "a table cut short": (lambda root: (root / DATA).write_bytes((root / DATA).read_bytes()[:-9]), DATA),
    "tasks that are a pointer": (lambda root: (root / "meta" / "tasks.parquet").write_text("version https"), "tasks"),
    "rows cut off": (table_changed(DATA, lambda table: table.slice(0, 590)), "590"),
    "a column cut off": (table_changed(DATA, lambda table: table.drop_columns("action")), "action"),
    "texts for numbers": (table_changed(DATA, with_column("index", ["x"])), "x"),
    "rows of no episode": (table_changed(DATA, with_column("episode_index", [None, 0])), "episode_index"),
    "rows of another episode": (table_changed(DATA, with_column("episode_index", [0, 1, 2])), "episode_index 1"),
    "rows with another index": (table_changed(DATA, with_column("index", [1])), "index 1"),
    "rows in another order": (table_changed(DATA, lambda t: t.take(list(range(599, -1, -1)))), "index 599"),
    "a task before the first": (table_changed(DATA, with_column("task_index", [0, -1])), "task_index -1"),
    "a task after the last": (table_changed(DATA, with_column("task_index", [0, 9])), "task_index 9"),
    "an episode elsewhere": (table_changed(EPISODES, with_column("dataset_from_index", [-7])), "-7"),
    "an episode too long": (table_changed(EPISODES, with_column("length", [200, 99, 200])), "99"),
    "lengths that are none": (table_changed(EPISODES, with_column("length", ["x"])), "length"),
    "no lengths": (table_changed(EPISODES, lambda table: table.drop_columns("length")), "length"),
    "tasks without numbers": (table_changed(TASKS, lambda t: t.drop_columns("task_index")), TASKS),
    "tasks with lists for numbers": (table_changed(TASKS, with_column("task_index", [[1.0]])), TASKS),
    "bytes within a table": (lambda root: spoil_bytes(root / EPISODES), EPISODES),
    "an episode too many": (lambda root: spoil_info(root, total_episodes=4), "4 episodes"),
    "a frame too many": (lambda root: spoil_info(root, total_frames=601), "601 frames"),
    "paths of the old format": (lambda root: spoil_info(root, data_path="{episode_index}.parquet"), "data_path"),
}


@pytest.mark.parametrize("named", [False, True], ids=["by its folder", "by its name"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_missing_or_damaged_is_named(root, damage, named, monkeypatch):
    spoil, word = DAMAGES[damage]
    spoil(root)
    if named:
        for module in (episodes, dataset_metadata):
            monkeypatch.setattr(module, "HF_LEROBOT_HOME", root.parent)
    with pytest.raises((FileNotFoundError, ValueError), match=str(root)) as raised:
        open_dataset(UniMASKConfig(**SMALL), None if named else root, root.name)
    assert word in str(raised.value)


def test_rows_that_hold_nothing_do_not_hinder_where_nobody_reads_them(root):
    wind = {"dtype": "float32", "shape": [1], "names": None}
    spoil_info(root, features={**read_info(root)["features"], "wind": wind})
    table_changed(DATA, lambda table: table.append_column("wind", pa.array([None, 1.0] * 300, pa.float32())))(root)
    dataset = open_dataset(UniMASKConfig(**SMALL), root)
    assert "wind" not in read_windows(dataset, [0, 3])


def test_files_that_are_not_read_may_be_missing(root):
    """A dataset of which LeRobot has pulled some episodes."""
    (path,) = (root / "data").glob("*/*.parquet")
    table = pq.read_table(path)
    path.unlink()
    pq.write_table(table.slice(0, 200), path)
    (episodes_path,) = (root / "meta" / "episodes").glob("*/*.parquet")
    rows = pq.read_table(episodes_path)
    at = rows.column_names.index("data/file_index")
    pq.write_table(rows.set_column(at, "data/file_index", pa.array([0, 1, 1])), episodes_path)
    assert len(open_dataset(UniMASKConfig(**SMALL), root, episodes=[0])) == 200
    with pytest.raises(FileNotFoundError, match=r"data/chunk-000/file-001\.parquet"):
        open_dataset(UniMASKConfig(**SMALL), root)


def test_rows_of_different_lengths_are_named(root):
    (path,) = (root / "data").glob("*/*.parquet")
    table = pq.read_table(path)
    rows = table.column("action").to_pylist()
    ragged = pa.array([*rows[:-1], rows[-1][:1]], pa.list_(pa.float32()))
    pq.write_table(table.set_column(table.column_names.index("action"), "action", ragged), path)
    with pytest.raises(ValueError, match=rf"action has 1 numbers in row {len(table) - 1} .* 2 in most"):
        policy_of(root)


@pytest.mark.parametrize("kind", [pa.list_(pa.float32()), pa.list_(pa.float32(), 2)], ids=["a list", "as many each"])
def test_a_row_that_holds_nothing_is_named(root, kind):
    cells = pa.array([None if i % 8 == 7 else [0.0, 1.0] for i in range(600)], kind)
    table_changed(DATA, lambda table: table.set_column(table.column_names.index("action"), "action", cells))(root)
    with pytest.raises(ValueError, match="action has 0 numbers in row 7 "):
        policy_of(root)


def test_a_training_on_an_unsound_dataset_ends_before_its_first_step(root, tmp_path):
    spoil_column(root, "action", frame=3, number=1, value=np.nan)
    flags = [f"--policy.{name}={str(value).lower()}" for name, value in SMALL.items()]
    data = ["--dataset.repo_id=local/maze", f"--dataset.root={root}", "--steps=2", "--batch_size=4"]
    result = commands.run("lerobot-train", "--policy.type=unimask", *flags, *data, "--output_dir=run", cwd=tmp_path)
    assert result.status != 0
    assert "episode 0, frame 3" in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_windows_longer_than_every_episode_are_refused_by_name(root):
    with pytest.raises(ValueError, match="context_length") as raised:
        policy_of(root, context_length=300)
    assert "200" in str(raised.value)


def test_a_loss_that_is_not_finite_ends_the_training_and_is_not_saved(tiny_policy, doorkey_batch, tmp_path):
    policy = tiny_policy().train()
    policy.forward(doorkey_batch)
    policy.update()
    with torch.no_grad():
        next(policy.network.parameters()).fill_(float("nan"))
    policy.forward(doorkey_batch)
    with pytest.raises(FloatingPointError, match="nan after 1 updates"):
        policy.update()
    with pytest.raises(FloatingPointError, match="nothing has been saved"):
        policy.save_pretrained(tmp_path / "checkpoint")
    assert not (tmp_path / "checkpoint" / "model.safetensors").exists()


def test_fine_tuning_says_how_far_another_dataset_lies(tiny_policy, root, tmp_path, caplog):
    from lerobot_unimask import UniMASKPolicy

    policy = policy_of(root)
    policy.save_pretrained(tmp_path / "checkpoint")
    meta = LeRobotDatasetMetadata("local/maze", root=root)
    UniMASKPolicy.from_pretrained(tmp_path / "checkpoint", dataset_stats=meta.stats, dataset_meta=meta)
    assert "deviations away" not in caplog.text
    moved = {key: dict(value) for key, value in meta.stats.items()}
    moved["action"]["mean"] = moved["action"]["mean"] + 3 * moved["action"]["std"]
    UniMASKPolicy.from_pretrained(tmp_path / "checkpoint", dataset_stats=moved, dataset_meta=meta)
    assert "mean of a lies 3 of its standard deviations away" in caplog.text


def test_a_state_of_two_dimensions_is_said_to_be_one(doorkey):
    features = {**doorkey.meta.features, "observation.state": {"dtype": "float32", "shape": (2, 2), "names": None}}
    with pytest.raises(ValueError, match=r"\(2, 2\)") as raised:
        UniMASKConfig(device="cpu").set_dataset_feature_metadata(features)
    assert "unimask prepare" in str(raised.value)


def test_whole_numbers_without_categories_are_pointed_out(doorkey, caplog):
    entry = {name: value for name, value in doorkey.meta.features["action"].items() if name != "categories"}
    UniMASKConfig(device="cpu").set_dataset_feature_metadata({**doorkey.meta.features, "action": entry})
    assert "--categories action=auto" in caplog.text
