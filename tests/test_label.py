"""`unimask prepare`: the new column is right, everything else is untouched, and LeRobot reads the result."""

import contextlib
import json
import shutil
import threading
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset

import dataset_builders.label
from dataset_builders import folders
from dataset_builders.label import add_label
from dataset_builders.maze2d import build_maze2d
from lerobot_unimask import cli

EPISODES, T = 30, 10
CORNER = "observation.visits_corner"


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def root(doorkey_root, tmp_path):
    return Path(shutil.copytree(doorkey_root, tmp_path / "data"))


def placed(flags):
    """Where the result goes: in the old dataset's place, unless there is an output."""
    return [*flags, *["--replace=true"] * (not any(str(flag).startswith("--output") for flag in flags))]


@pytest.fixture
def refused(capsys):
    """refused("--visits=...") -> the error of `unimask prepare`."""

    def run(*flags):
        with pytest.raises(SystemExit) as ended:
            cli.main(["prepare", *map(str, placed(flags))])
        assert ended.value.code == 2
        return capsys.readouterr().err

    return run


def column(root, name):
    """(E, T) of the stored column."""
    values = np.concatenate([pq.read_table(path)[name].to_numpy() for path in sorted(root.glob("data/*/*.parquet"))])
    return values.reshape(EPISODES, T)


def label(root, *flags):
    cli.main(["prepare", f"--dataset.root={root}", *map(str, placed(flags))])


def test_visits_is_a_category_of_each_episode(root, tmp_path, capsys):
    before = files(root)
    label(root, f"--output={tmp_path / 'new'}", f"--name={CORNER}", "--visits=agent_cell=0")
    assert f"{CORNER} in {tmp_path / 'new'}\n" in capsys.readouterr().out
    assert files(root) == before
    dataset = LeRobotDataset("local/new", root=tmp_path / "new")
    cells = np.stack([dataset[i]["observation.state"].numpy() for i in range(EPISODES * T)]).reshape(EPISODES, T, 2)
    expected = (cells[..., 0] == 0).any(axis=1)
    assert 0 < expected.sum() < EPISODES
    assert (column(tmp_path / "new", CORNER) == expected[:, None]).all()
    assert [dataset[i][CORNER].item() for i in range(0, 300, 10)] == expected.tolist()
    assert dataset.meta.features[CORNER] == {"dtype": "int64", "shape": (1,), "names": None, "categories": [2]}


def test_everything_else_stays_as_it_is(root, tmp_path):
    label(root, f"--output={tmp_path / 'new'}", f"--name={CORNER}", "--visits=key_cell=3")
    old, new = LeRobotDataset("local/old", root=root), LeRobotDataset("local/new", root=tmp_path / "new")
    for i in (0, 17, 299):
        before, after = old[i], new[i]
        assert after.keys() - before.keys() == {CORNER}
        assert all(
            (after[key] == before[key]) for key in before if before[key] is not None and np.ndim(before[key]) == 0
        )
    for path, names in (("data", 1), ("meta/episodes", None)):
        for file in root.glob(f"{path}/*/*.parquet"):
            before, after = pq.ParquetFile(file), pq.ParquetFile(tmp_path / "new" / file.relative_to(root))
            assert before.num_row_groups == after.num_row_groups
            assert after.read().select(before.schema_arrow.names).equals(before.read())
            if names:
                assert len(after.schema_arrow.names) == len(before.schema_arrow.names) + names
    info, added = (json.loads((folder / "meta/info.json").read_text()) for folder in (root, tmp_path / "new"))
    added["features"].pop(CORNER)
    assert added == info
    labels = json.loads((tmp_path / "new/meta/provenance.json").read_text())["labels"]
    assert [(entry["name"], entry["what"]) for entry in labels] == [(CORNER, "visits key_cell=3")]


def test_the_statistics_are_lerobots(root):
    label(root, "--name=observation.clock", f"--function={__name__}:clock_and_cell")
    dataset = LeRobotDataset("local/data", root=root)
    assert dataset.meta.features["observation.clock"]["shape"] == (2,)
    values = np.stack([dataset[i]["observation.clock"].numpy() for i in range(EPISODES * T)])
    feature = {"observation.clock": {"dtype": "float32", "shape": (2,)}}
    episodes = [
        compute_episode_stats({"observation.clock": values[start : start + T]}, feature)
        for start in range(0, EPISODES * T, T)
    ]
    expected = aggregate_stats(episodes)["observation.clock"]
    assert dataset.meta.stats["observation.clock"].keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(dataset.meta.stats["observation.clock"][name], value, rtol=1e-6)
    stored = pq.read_table(next(root.glob("meta/episodes/*/*.parquet")))
    for name, value in episodes[4]["observation.clock"].items():
        np.testing.assert_allclose(stored[f"stats/observation.clock/{name}"][4].as_py(), value, rtol=1e-6)


def clock_and_cell(episode):
    return np.stack([episode["frame_index"] / 10, episode["observation.state"][:, 0]], axis=1)


def test_the_return_to_go_is_that_of_the_builder(root):
    label(root, "--return_to_go", "--name=observation.again")
    assert np.array_equal(column(root, "observation.again"), column(root, "observation.return_to_go"))


def test_a_dataset_without_a_return_gets_one(tmp_path):
    root = build_maze2d(tmp_path / "maze", episodes=2, progress=False)
    expected = pq.read_table(next(root.glob("data/*/*.parquet")))["observation.return_to_go"].to_numpy()
    drop = "observation.return_to_go"
    for path in root.glob("data/*/*.parquet"):
        pq.write_table(pq.read_table(path).drop_columns([drop]), path)
    info = json.loads((root / "meta/info.json").read_text())
    info["features"].pop(drop)
    (root / "meta/info.json").write_text(json.dumps(info))
    stats = json.loads((root / "meta/stats.json").read_text())
    stats.pop(drop)
    (root / "meta/stats.json").write_text(json.dumps(stats))
    for path in root.glob("meta/episodes/*/*.parquet"):
        table = pq.read_table(path)
        pq.write_table(
            table.drop_columns([name for name in table.column_names if name.startswith(f"stats/{drop}/")]), path
        )
    label(root, "--return_to_go")
    actual = pq.read_table(next(root.glob("data/*/*.parquet")))[drop].to_numpy()
    np.testing.assert_allclose(actual, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("labeller", "dtype", "categories", "value"),
    [
        (lambda episode: True, "int64", [2], 1),
        (lambda episode: int(episode["frame_index"].max()), "int64", [10], 9),
        (lambda episode: 0.5, "float32", None, 0.5),
        (lambda episode: np.array([1, 0, 1]), "int64", [2, 2, 2], [1, 0, 1]),
        (lambda episode: episode["frame_index"][:, None], "int64", [10], 3),
    ],
    ids=["bool", "whole", "number", "several", "frames"],
)
def test_what_a_function_may_return(labeller, dtype, categories, value, root):
    add_label(root, "observation.label", labeller, how="a test", progress=False)
    dataset = LeRobotDataset("local/data", root=root)
    feature = dataset.meta.features["observation.label"]
    assert (feature["dtype"], feature.get("categories")) == (dtype, categories)
    assert dataset[13]["observation.label"].tolist() == value


def test_categories_that_do_not_occur_can_be_named(root):
    add_label(root, "observation.label", lambda episode: 1, how="a test", categories=5, progress=False)
    assert LeRobotDataset("local/data", root=root).meta.features["observation.label"]["categories"] == [5]
    with pytest.raises(ValueError, match=r"7 to 7.*0 to 4"):
        add_label(root, "observation.other", lambda episode: 7, how="a test", categories=5, progress=False)


def fails(episode):
    if episode["episode_index"][0] == 7:
        raise ZeroDivisionError("the seventh")
    return 1.0


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--name=observation.x", "--visits=agent=0"], "agent_cell=0 to agent_cell=15, key_cell=0 to key_cell=15"),
        (["--name=observation.x", "--visits=agent_cell=16"], "0 to 15"),
        (["--name=observation.x", "--visits=agent_cell"], "agent_cell=0 to"),
        (["--name=observation.x", "--function=nomodule:f"], "cannot be imported"),
        (["--name=observation.x", f"--function={__name__}:nothing"], "'nothing'"),
        (["--name=observation.x", f"--function={__name__}"], "module:name"),
        (
            ["--name=observation.x", f"--function={__name__}:fails"],
            "episode 7: ZeroDivisionError: the seventh",
        ),
        (["--name=observation.state", "--visits=agent_cell=0"], "observation.state"),
        (["--name=corner", "--visits=agent_cell=0"], "observation.NAME"),
        (["--visits=agent_cell=0"], "--name is missing"),
        (["--return_to_go"], "observation.return_to_go already"),
        (["--name=observation.x"], "add --return_to_go, --visits or --function"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_mistakes_leave_the_dataset_alone(flags, expected, refused, root):
    before = files(root)
    assert expected in refused(f"--dataset.root={root}", *flags)
    assert files(root) == before
    assert list(root.parent.iterdir()) == [root]


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        (lambda episode: "yes", "label"),
        (lambda episode: np.nan, "must be finite"),
        (lambda episode: -1, "For numbers that are not categories return floats"),
        (lambda episode: np.ones(10), r"\(10, 1\)"),
        (lambda episode: np.ones(1 + int(episode["episode_index"][0])), "different sizes"),
    ],
)
def test_bad_labels_are_refused(label, expected, root):
    before = files(root)
    with pytest.raises(ValueError, match=expected):
        add_label(root, "observation.x", label, how="a test", progress=False)
    assert files(root) == before


def test_a_dataset_does_not_go_into_itself(root, refused):
    before = files(root)
    flags = (f"--dataset.root={root}", f"--output={root / 'data' / 'new'}", f"--name={CORNER}")
    assert str(root) in refused(*flags, "--visits=agent_cell=0")
    assert files(root) == before


def test_a_commit_of_the_hub_stays_as_it_is(root, refused):
    cached = root.parent / "snapshots" / ("a" * 40)
    cached.parent.mkdir()
    root.rename(cached)
    assert "--output=DIR" in refused(f"--dataset.root={cached}", f"--name={CORNER}", "--visits=agent_cell=0")


@pytest.mark.parametrize("output", [None, "new"])
@pytest.mark.parametrize("moment", ["_label_all", "_write_data", "_write_meta"])
def test_an_interruption_leaves_nothing_half_written(moment, output, root, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    before = files(root)
    monkeypatch.setattr(dataset_builders.label, moment, interrupt)
    flags = [] if output is None else [f"--output={root.parent / output}"]
    with pytest.raises(SystemExit, match="interrupted"):
        cli.main(["prepare", f"--dataset.root={root}", f"--name={CORNER}", "--visits=agent_cell=0", *placed(flags)])
    assert files(root) == before
    assert list(root.parent.iterdir()) == [root]


def test_the_old_dataset_comes_back_if_the_new_one_cannot_take_its_place(root, monkeypatch):
    before, rename = files(root), Path.rename

    def fail(path, target):
        if path.name == "new":
            raise OSError("no")
        return rename(path, target)

    monkeypatch.setattr(folders, "_exchange", lambda new, target: False)  # a disk that cannot
    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(OSError, match="no"):
        add_label(root, CORNER, lambda episode: 1, how="a test", progress=False)
    assert files(root) == before
    assert list(root.parent.iterdir()) == [root]


def test_labels_that_are_added_at_the_same_time_are_all_there(root):
    def label(number):
        add_label(root, f"observation.label{number}", lambda episode: number, how="a test", progress=False)

    threads = [threading.Thread(target=label, args=(number,)) for number in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    features = json.loads((root / "meta/info.json").read_text())["features"]
    assert {f"observation.label{number}" for number in range(3)} <= features.keys()
    assert list(root.parent.iterdir()) == [root]


@pytest.mark.parametrize("left", ["new", "old"])
def test_what_a_killed_run_left_is_tidied_by_the_next(root, left):
    before = files(root)
    work = root.with_name(f".{root.name}.partial")
    if left == "new":  # killed while writing
        (work / "new" / "meta").mkdir(parents=True)
    else:  # killed between two renames, on a disk that cannot exchange folders
        work.mkdir()
        root.rename(work / "old")
    with contextlib.suppress(FileExistsError), folders.written_whole(root):
        pass
    assert files(root) == before
    assert list(root.parent.iterdir()) == [root]


def test_a_folder_that_is_not_empty_is_refused(root, refused, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("three years of work")
    flags = (f"--dataset.root={root}", f"--output={tmp_path / 'full'}", f"--name={CORNER}", "--visits=agent_cell=0")
    assert "folder is not empty" in refused(*flags)
    assert files(tmp_path / "full") == {"thesis.txt": b"three years of work"}
    assert "holds no LeRobotDataset" in refused(f"--dataset.root={tmp_path / 'full'}", *flags[1:])
