"""`unimask prepare`: datasets as others record them, made into ones that train, resume and can be asked."""

import json
import os
import shutil

import commands
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import factory
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from policies import SMALL_FLAGS

from dataset_builders.prepare import make_plan, prepare
from lerobot_unimask import UniMASKConfig, UniMASKPolicy, cli, query
from lerobot_unimask.data.episodes import check_format, open_dataset, read_window
from lerobot_unimask.data.factors import flat_names
from lerobot_unimask.records import read_json

JOINTS = ["shoulder", "elbow"]
LENGTHS = [12, 15, 11]


def record(root, features, frames, **settings):
    """A dataset as LeRobot's own recorder writes it; `frames(episode, step)` -> one frame."""
    videos = any(entry["dtype"] == "video" for entry in features.values())
    dataset = LeRobotDataset.create("me/robot", fps=30, features=features, root=root, use_videos=videos, **settings)
    for episode, length in enumerate(LENGTHS):
        for step in range(length):
            dataset.add_frame({"task": "wave", **frames(episode, step)})
        dataset.save_episode()
    dataset.finalize()
    return root


def waves(episode, step):
    angle = 0.1 * step + episode
    return np.array([np.sin(angle), np.cos(angle)], dtype=np.float32)


@pytest.fixture(scope="module")
def renamed(tmp_path_factory):
    """Columns `state`, of two dimensions, and `actions`, names nested one deep."""
    features = {
        "state": {"dtype": "float32", "shape": (2, 1), "names": [JOINTS, ["angle"]]},
        "actions": {"dtype": "float32", "shape": (2,), "names": {"motors": JOINTS}},
        "choice": {"dtype": "int64", "shape": (1,), "names": None},
    }
    return record(
        tmp_path_factory.mktemp("renamed") / "data",
        features,
        lambda episode, step: {
            "state": waves(episode, step)[:, None],
            "actions": waves(episode, step + 1),
            "choice": np.array([step % 3]),
        },
    )


@pytest.fixture(scope="module")
def blind(tmp_path_factory):
    """Format v3.0 with a camera whose files are gone."""
    root = record(
        tmp_path_factory.mktemp("blind") / "data",
        {
            "observation.state": {"dtype": "float32", "shape": (2,), "names": JOINTS},
            "action": {"dtype": "float32", "shape": (2,), "names": JOINTS},
        },
        lambda episode, step: {"observation.state": waves(episode, step), "action": waves(episode, step + 1)},
    )
    info = json.loads((root / "meta" / "info.json").read_text())
    info["features"]["observation.images.front"] = {"dtype": "video", "shape": [48, 64, 3], "names": ["h", "w", "c"]}
    info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return root


@pytest.fixture(scope="module")
def pictured(tmp_path_factory):
    """After the LIBERO and DROID datasets: cameras that are not named as observations, one a video, one in the table,
    without statistics; texts; several tasks."""
    camera = {"shape": (32, 32, 3), "names": ["height", "width", "channel"]}
    root = record(
        tmp_path_factory.mktemp("pictured") / "data",
        {
            "image": {"dtype": "video", **camera},
            "wrist_image": {"dtype": "image", **camera},
            "state": {"dtype": "float32", "shape": (2,), "names": {"motors": JOINTS}},
            "actions": {"dtype": "float32", "shape": (2,), "names": JOINTS},
            "instruction": {"dtype": "string", "shape": (1,), "names": None},
        },
        lambda episode, step: {
            "image": np.full((32, 32, 3), 10 * step, np.uint8),
            "wrist_image": np.full((32, 32, 3), 100 + step, np.uint8),
            "state": waves(episode, step),
            "actions": waves(episode, step + 1),
            "instruction": "wave",
            "task": f"wave {episode % 2}",
        },
    )
    path = root / "meta" / "stats.json"
    stats = json.loads(path.read_text())
    path.write_text(json.dumps({key: value for key, value in stats.items() if "image" not in key}))
    return root


@pytest.fixture(scope="module")
def old(blind, tmp_path_factory):
    """The same recording in format v2.1, as LeRobot wrote it before."""
    root = tmp_path_factory.mktemp("old") / "data"
    table = pa.concat_tables([pq.read_table(path) for path in sorted((blind / "data").glob("*/*.parquet"))])
    info = json.loads((blind / "meta" / "info.json").read_text())
    info["features"].pop("observation.images.front")
    info |= {
        "codebase_version": "v2.1",
        "total_videos": 0,
        "total_chunks": 1,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": None,
    }
    (root / "meta").mkdir(parents=True)
    (root / "data" / "chunk-000").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(info))
    (root / "meta" / "tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": "wave"}) + "\n")
    episodes, statistics = [], []
    for episode, length in enumerate(LENGTHS):
        rows = table.filter(pa.compute.equal(table["episode_index"], episode))
        pq.write_table(rows, root / "data" / "chunk-000" / f"episode_{episode:06d}.parquet")
        episodes.append({"episode_index": episode, "tasks": ["wave"], "length": length})
        stats = {}
        for key in info["features"]:
            values = np.array(rows[key].to_pylist(), dtype=float).reshape(length, -1)
            kinds = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
            stats[key] = {kind: value.tolist() for kind, value in kinds.items()} | {"count": [length]}
        statistics.append({"episode_index": episode, "stats": stats})
    for name, lines in (("episodes", episodes), ("episodes_stats", statistics)):
        (root / "meta" / f"{name}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return root


def files(root):
    return {path.relative_to(root): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("form", ["renamed", "blind", "pictured", "old"])
def test_a_recording_of_others_trains_and_is_asked(form, request, tmp_path, capsys):
    found = request.getfixturevalue(form)
    before = files(found)
    cli.main(["prepare", f"--dataset.root={found}", f"--output={tmp_path / 'data'}"])
    assert files(found) == before
    assert str(tmp_path / "data") in capsys.readouterr().out
    data = ["--dataset.repo_id=me/robot", f"--dataset.root={tmp_path / 'data'}"]
    flags = ["--policy.type=unimask", "--policy.push_to_hub=false", *SMALL_FLAGS, "--batch_size=4", "--save_freq=2"]
    flags.append("--policy.image_size=[32, 32]")
    commands.check("lerobot-train", *flags, *data, "--steps=2", "--output_dir=run", cwd=tmp_path)
    if form == "pictured":  # the others resume as every dataset does
        config = "--config_path=run/checkpoints/last/pretrained_model/train_config.json"
        commands.check("lerobot-train", config, "--resume=true", "--steps=4", cwd=tmp_path)
    policy = UniMASKPolicy.from_pretrained(tmp_path / "run")
    assert int(policy.updates) == (4 if form == "pictured" else 2)
    assert policy.statistics.fps.item() == 30
    assert policy.statistics.horizon.item() == max(LENGTHS)
    assert policy.number_names["a"] == JOINTS
    dataset = open_dataset(policy.config, tmp_path / "data")
    window = policy.make_window(read_window(dataset, 1))
    expected = np.stack([waves(1, step) for step in range(10)])
    np.testing.assert_allclose(window.values["s"][0], expected, atol=1e-5)
    reply = query.ask(policy, "a[0] | s[0]", batch=read_window(dataset, 1))
    assert {row["factor"] for row in query.rows(policy, reply)} == {"a"}
    picture = query.picture(policy, reply)
    assert picture.axes[0].get_ylabel().startswith("a")


def test_without_an_output_it_says_what_it_would_do_and_why(renamed, blind, old, capsys):
    for root, words in (
        (renamed, ["--rename state=observation.state", "--rename actions=action", "(2, 1)", "nested"]),
        (blind, ["--drop observation.images.front"]),
        (old, ["v2.1", "v3.0"]),
    ):
        before = files(root)
        cli.main(["prepare", f"--dataset.root={root}"])
        said = capsys.readouterr().out
        assert [word for word in words if word not in said] == []
        assert files(root) == before


def test_an_old_format_is_refused_with_the_command_that_brings_it_up_to_date(old):
    with pytest.raises(ValueError, match=r"v2\.1.*unimask prepare"):
        open_dataset(UniMASKConfig(device="cpu"), old)
    config = TrainPipelineConfig(DatasetConfig("me/robot", root=str(old)), policy=UniMASKConfig(device="cpu"))
    with pytest.raises(ValueError, match=r"v2\.1.*unimask prepare"):
        factory.make_dataset(config)


@pytest.fixture
def sound(blind, tmp_path):
    """A dataset that needs nothing, and may be written to."""
    copy = shutil.copytree(blind, tmp_path / "sound")
    info = read_json(copy / "meta" / "info.json")
    del info["features"]["observation.images.front"]
    (copy / "meta" / "info.json").write_text(json.dumps(info))
    return copy


@pytest.mark.parametrize("names", [{"motors": JOINTS}, [JOINTS]])
def test_nested_names_alone_need_nothing_and_become_plain_beside_other_steps(sound, tmp_path, names):
    info = read_json(sound / "meta" / "info.json")
    info["features"]["action"]["names"] = names
    (sound / "meta" / "info.json").write_text(json.dumps(info))
    assert make_plan(sound).why == []
    made = prepare(sound, make_plan(sound, drop=["observation.state"]), output=tmp_path / "made")
    assert read_json(made / "meta" / "info.json")["features"].keys() & {"action", "observation.state"} == {"action"}
    assert read_json(made / "meta" / "info.json")["features"]["action"]["names"] == JOINTS


def test_a_link_that_leads_nowhere_is_no_statistics(sound, tmp_path):
    statistics = read_json(sound / "meta" / "stats.json")["action"]["std"]
    (sound / "meta" / "stats.json").unlink()
    (sound / "meta" / "stats.json").symlink_to("nowhere.json")
    made = prepare(sound, make_plan(sound), output=tmp_path / "made")
    np.testing.assert_allclose(read_json(made / "meta" / "stats.json")["action"]["std"], statistics, rtol=1e-5)
    assert not (sound / "meta" / "nowhere.json").exists()


def test_videos_that_are_links_lead_to_the_same_files(pictured, tmp_path):
    """As in a snapshot of the Hub's cache, whose files are links to others."""
    found = shutil.copytree(pictured, tmp_path / "found")
    for number, path in enumerate(found.glob("videos/*/*/*.mp4")):
        path.rename(tmp_path / f"{number}.blob")
        path.symlink_to(os.path.relpath(tmp_path / f"{number}.blob", path.parent))
    made = prepare(found, make_plan(found), output=tmp_path / "deep" / "er" / "made")
    dataset, before = LeRobotDataset("me/robot", root=made), LeRobotDataset("me/robot", root=pictured)
    assert torch.equal(dataset[17]["observation.images.image"], before[17]["image"])


def test_joint_names_are_kept(renamed, blind, tmp_path):
    made = prepare(renamed, make_plan(renamed), output=tmp_path / "made")
    features = json.loads((made / "meta" / "info.json").read_text())["features"]
    assert features["action"]["names"] == JOINTS
    assert features["observation.state"]["shape"] == [2]


def test_cameras_get_names_that_policies_are_handed(pictured, tmp_path):
    with pytest.raises(ValueError, match=r"unimask prepare.* observation\.images\.image"):
        UniMASKConfig(device="cpu").cameras_of(read_json(pictured / "meta" / "info.json")["features"])
    made = prepare(pictured, make_plan(pictured), output=tmp_path / "made")
    dataset, before = LeRobotDataset("me/robot", root=made), LeRobotDataset("me/robot", root=pictured)
    assert dataset.meta.camera_keys == ["observation.images.image", "observation.images.wrist_image"]
    for key in ("image", "wrist_image"):
        assert torch.equal(dataset[17][f"observation.images.{key}"], before[17][key])
    assert dataset[17]["instruction"] == "wave"
    kept = prepare(pictured, make_plan(pictured, drop=["image"]), output=tmp_path / "kept")
    assert LeRobotDataset("me/robot", root=kept).meta.camera_keys == ["observation.images.wrist_image"]


def test_texts_are_not_in_the_way_of_reading_in_batches(pictured, tmp_path):
    made = prepare(pictured, make_plan(pictured), output=tmp_path / "made")
    dataset = open_dataset(UniMASKConfig(device="cpu", cameras=[]), made)
    batch = dataset.__getitems__([3, 30]).batch
    assert "instruction" not in batch
    assert batch["task"] == ["wave 0", "wave 0"]
    np.testing.assert_allclose(batch["action"][1, 0], waves(2, 4), atol=1e-6)


def test_statistics_are_those_of_the_numbers(renamed, tmp_path):
    made = prepare(renamed, make_plan(renamed), output=tmp_path / "made")
    values = np.concatenate([[waves(e, t) for t in range(n)] for e, n in enumerate(LENGTHS)])
    stats = json.loads((made / "meta" / "stats.json").read_text())["observation.state"]
    np.testing.assert_allclose(stats["mean"], values.mean(0), atol=1e-6)
    np.testing.assert_allclose(stats["std"], values.std(0), atol=1e-6)


@pytest.mark.parametrize(
    "fault", [{"std": [float("nan"), 1.0]}, {"mode": "x"}, {"q01": [[0.0], [0.0, 1.0]]}, {"count": None}, None]
)
def test_statistics_that_are_unsound_are_computed(blind, tmp_path, fault):
    copy = shutil.copytree(blind, tmp_path / "data")
    path = copy / "meta" / "stats.json"
    stats = json.loads(path.read_text())
    path.write_text(json.dumps({**stats, "action": fault and {**stats["action"], **fault}, "episode_index": {}}))
    plan = make_plan(copy)
    assert plan.statistics == ["action", "episode_index"]
    made = prepare(copy, plan, output=tmp_path / "made")
    check_format(made)
    again = json.loads((made / "meta" / "stats.json").read_text())["action"]
    np.testing.assert_allclose(again["std"], stats["action"]["std"], rtol=1e-5)


@pytest.mark.parametrize("entry", [{"dtype": "bfloat16"}, {"shape": []}, {"shape": [1] * 6}])
def test_a_column_that_lerobot_has_no_type_for_becomes_numbers_as_they_are_stored(blind, tmp_path, entry):
    copy = shutil.copytree(blind, tmp_path / "data")
    info = read_json(copy / "meta" / "info.json")
    size = int(np.prod(entry.get("shape", [2])))
    info["features"]["extra"] = {**info["features"]["action"], "names": None, "shape": [size], **entry}
    (copy / "meta" / "info.json").write_text(json.dumps(info))
    for path in (copy / "data").glob("*/*.parquet"):
        table = pq.read_table(path).replace_schema_metadata(None)
        column = table["action"] if size == 2 else pa.compute.list_element(table["action"], 0)
        pq.write_table(table.append_column("extra", column), path)
    with pytest.raises(ValueError, match=r"extra.*unimask prepare"):
        check_format(copy)
    made = prepare(copy, make_plan(copy), output=tmp_path / "made")
    item = LeRobotDataset("me/robot", root=made)[20]
    assert item["extra"].dtype == torch.float32
    assert torch.equal(item["extra"].reshape(-1), item["action"][:size])


@pytest.mark.parametrize(
    "change",
    [
        lambda tasks: tasks.reset_index(),
        lambda tasks: tasks.reset_index().rename_axis("number"),
        lambda tasks: tasks.iloc[::-1],
        lambda tasks: tasks.assign(task_index=[3, 7]),
    ],
    ids=["texts in a column", "the same, named", "in another order", "numbers that are not there"],
)
def test_texts_of_tasks_get_the_places_where_lerobot_looks_for_them(pictured, tmp_path, change):
    copy = shutil.copytree(pictured, tmp_path / "data")
    tasks = pd.read_parquet(copy / "meta" / "tasks.parquet")
    changed = change(tasks)
    changed.to_parquet(copy / "meta" / "tasks.parquet")
    numbers = dict(zip(tasks["task_index"], sorted(changed["task_index"]), strict=True))
    for path in (copy / "data").glob("*/*.parquet"):
        table = pq.read_table(path)
        at = table.column_names.index("task_index")
        stored = pa.array([numbers[number] for number in table["task_index"].to_pylist()])
        pq.write_table(table.set_column(at, "task_index", stored), path)
    with pytest.raises(ValueError, match=r"tasks\.parquet.*unimask prepare"):
        check_format(copy)
    made = prepare(copy, make_plan(copy), output=tmp_path / "made")
    check_format(made)
    dataset = LeRobotDataset("me/robot", root=made)
    assert [dataset[sum(LENGTHS[:episode])]["task"] for episode in range(3)] == ["wave 0", "wave 1", "wave 0"]


@pytest.mark.parametrize("name", ["tasks", "episodes", "episodes_stats"])
def test_what_the_converter_misses_is_named_before_anything_is_converted(old, tmp_path, name):
    copy = shutil.copytree(old, tmp_path / "data")
    (copy / "meta" / f"{name}.jsonl").unlink()
    with pytest.raises(FileNotFoundError, match=rf"meta/{name}\.jsonl.*fetch it anew"):
        make_plan(copy)


@pytest.mark.parametrize("version", ["v1.6", "v2.0"])
def test_a_format_that_lerobot_does_not_convert_is_named(blind, tmp_path, version):
    copy = shutil.copytree(blind, tmp_path / "data")
    info = read_json(copy / "meta" / "info.json")
    (copy / "meta" / "info.json").write_text(json.dumps({**info, "codebase_version": version}))
    for ask in (check_format, make_plan):
        with pytest.raises(ValueError, match=version):
            ask(copy)


@pytest.mark.parametrize("gone", ["action", "observation.state"])
def test_a_column_that_a_policy_needs_is_missed(blind, sound, gone):
    assert gone not in " ".join(make_plan(blind).why)
    info = read_json(sound / "meta" / "info.json")
    info["features"][gone] |= {"dtype": "string", "shape": [1], "names": None}
    (sound / "meta" / "info.json").write_text(json.dumps(info))
    assert f"--rename OLD={gone}" in " ".join(make_plan(sound).why)
    assert f"--rename OLD={gone}" in " ".join(make_plan(blind, drop=[gone]).why)


@pytest.mark.parametrize(("given", "count"), [("auto", 3), ("5", 5)])
def test_whole_numbers_become_categories(renamed, tmp_path, given, count):
    plan = make_plan(renamed, rename={"choice": "action"}, drop=["actions"], categories={"action": given})
    made = prepare(renamed, plan, output=tmp_path / "made")
    features = json.loads((made / "meta" / "info.json").read_text())["features"]
    assert features["action"]["categories"] == [count]
    assert "actions" not in features
    item = LeRobotDataset("me/robot", root=made)[4]
    assert item["action"].dtype == torch.int64
    assert item["action"].item() == 1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rename": {"nothing": "action"}}, "nothing"),
        ({"rename": {"state": "choice"}}, "already"),
        ({"drop": ["nothing"]}, "nothing"),
        ({"categories": {"nothing": "auto"}}, "nothing"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_written(renamed, changes, words):
    with pytest.raises(ValueError, match="has") as raised:
        make_plan(renamed, **changes)
    assert words in str(raised.value)


def test_numbers_that_are_no_choices_are_refused_and_nothing_is_left(renamed, tmp_path):
    plan = make_plan(renamed, categories={"actions": "auto"})
    with pytest.raises(ValueError, match="action"):
        prepare(renamed, plan, output=tmp_path / "made")
    assert list(tmp_path.iterdir()) == []


def test_it_replaces_where_it_is_told_to(renamed, tmp_path):
    copy = shutil.copytree(renamed, tmp_path / "data")
    cli.main(["prepare", f"--dataset.root={copy}", "--replace=true"])
    assert make_plan(copy).rename == {}
    assert list(tmp_path.iterdir()) == [copy]


@pytest.mark.parametrize(
    ("names", "flat"),
    [
        ({"motors": ["a", "b"]}, ["a", "b"]),
        ({"motors": {"a": 0, "b": 1}}, ["a", "b"]),
        ({"left": ["j0", "j1"], "right": ["j0", "j1"]}, ["left.j0", "left.j1", "right.j0", "right.j1"]),
        ({"left": ["left_j0"], "right": ["right_j0"]}, ["left_j0", "right_j0"]),
        ([["a", "b"], ["c"]], ["a", "b", "c"]),
        ({"a": 0, "b": 1}, ["a", "b"]),
        (None, []),
    ],
)
def test_nested_names_are_read_as_they_are_meant(names, flat):
    assert flat_names(names) == flat
