"""Cached frames equal what LeRobot decodes, are complete or not there, and are continued after an interruption."""

import errno
import io
import json
import os
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image
from torch.utils.data import default_collate

from lerobot_unimask.data import frames, reads

KEY, SIDE, LENGTHS = "observation.images.top", 64, (7, 5, 70)


@pytest.fixture(scope="module", params=["video", "image"])
def recorded(request, tmp_path_factory):
    """Ramps that move, three episodes, as LeRobot's writer stores them."""
    root = tmp_path_factory.mktemp(request.param) / "dataset"
    features = {
        KEY: {"dtype": request.param, "shape": (SIDE, SIDE, 3), "names": ["height", "width", "channels"]},
        "action": {"dtype": "float32", "shape": (1,), "names": None},
    }
    dataset = LeRobotDataset.create("local/ramps", 10, features, root=root, use_videos=request.param == "video")
    ramp = np.add.outer(np.arange(SIDE), np.arange(SIDE))
    for episode, length in enumerate(LENGTHS):
        for step in range(length):
            picture = np.stack([ramp + 3 * step, ramp + 60 * episode, ramp], axis=-1) % 256
            frame = {KEY: picture.astype(np.uint8), "action": np.zeros(1, np.float32), "task": "look"}
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    return root


def opened(root, **options):
    return LeRobotDataset("local/ramps", root=root, **options)


def read(dataset):
    return torch.stack([(dataset[i][KEY] * 255).round().to(torch.uint8) for i in range(len(dataset))])


@pytest.mark.parametrize("episodes", [None, [0, 2]])
@pytest.mark.parametrize("size", [(SIDE, SIDE), (24, 32)])
def test_equal_to_what_lerobot_reads(recorded, size, episodes, tmp_path):
    dataset = opened(recorded, episodes=episodes)
    cached = frames.cached_frames(dataset, KEY, size, tmp_path)
    expected = frames.resized(read(dataset), size).numpy().astype(int)
    assert cached.dtype == np.uint8
    assert cached.shape == expected.shape
    assert np.abs(cached.astype(int) - expected).max() <= 1


def test_grey_pictures_have_the_channels_that_lerobot_reads(recorded, tmp_path):
    """A video whose description says one channel is read with three; stored pictures of one channel with one."""
    dataset = opened(converted(recorded, tmp_path, "L", 1))
    assert np.array_equal(frames.cached_frames(dataset, KEY, (SIDE, SIDE), tmp_path / "cache"), read(dataset).numpy())


@pytest.mark.parametrize("recorded", ["image"], indirect=True)
@pytest.mark.parametrize(("mode", "channels"), [("I;16", 1), ("I", 1), ("RGBA", 3)])
def test_pictures_of_more_bits_or_channels_are_refused(recorded, tmp_path, mode, channels):
    """As depth that is not said to be depth; it would be read as numbers that have gone round."""
    dataset = opened(converted(recorded, tmp_path, mode, channels))
    with pytest.raises(ValueError, match=rf"{KEY} of episode 0.*8 bits"):
        frames.cached_frames(dataset, KEY, (SIDE, SIDE), tmp_path / "cache")


def converted(recorded, tmp_path, mode, channels):
    """The dataset with stored pictures in another of Pillow's modes."""
    root = shutil.copytree(recorded, tmp_path / "converted")
    info = json.loads((root / "meta/info.json").read_text())
    info["features"][KEY]["shape"] = [SIDE, SIDE, channels]
    (root / "meta/info.json").write_text(json.dumps(info))
    for path in (root / "data").rglob("*.parquet"):
        table = pq.read_table(path)
        if KEY in table.column_names:
            pictures = [png(cell["bytes"], mode) for cell in table[KEY].to_pylist()]
            column = pa.array(pictures, type=table.schema.field(KEY).type)
            pq.write_table(table.set_column(table.column_names.index(KEY), table.schema.field(KEY), column), path)
    return root


def png(data, mode):
    picture, file = Image.open(io.BytesIO(data)), io.BytesIO()
    deep = {"I;16": np.uint16, "I": np.int32}.get(mode)
    picture = Image.fromarray(9 * np.asarray(picture.convert("L")).astype(deep)) if deep else picture.convert(mode)
    picture.save(file, "PNG")
    return {"bytes": file.getvalue(), "path": None}


def test_decoded_once_and_again_for_another_content(recorded, tmp_path, monkeypatch):
    root = shutil.copytree(recorded, tmp_path / "copy")
    frames.cached_frames(opened(root), KEY, (16, 16), tmp_path / "cache")
    decoded = []
    original = frames._decode
    monkeypatch.setattr(frames, "_decode", lambda *args: decoded.append(args[2]) or original(*args))
    frames.cached_frames(opened(root), KEY, (16, 16), tmp_path / "cache")
    assert decoded == []
    for path in root.rglob("*.parquet"):
        os.utime(path, (1, 1))
    frames.cached_frames(opened(root), KEY, (16, 16), tmp_path / "cache")
    assert set(decoded) == {0, 1, 2}


def test_interrupted_is_not_there_and_continued(recorded, tmp_path, monkeypatch):
    dataset, original, decoded = opened(recorded), frames._decode, []

    def stopping(*args):
        if args[2] == 2:
            raise KeyboardInterrupt
        return original(*args)

    monkeypatch.setattr(frames, "_decode", stopping)
    monkeypatch.setattr(frames.os, "cpu_count", lambda: 1)
    with pytest.raises(KeyboardInterrupt):
        frames.cached_frames(dataset, KEY, (16, 16), tmp_path)
    assert not list(tmp_path.glob("*.frames"))
    monkeypatch.setattr(frames, "_decode", lambda *args: decoded.append(args[2]) or original(*args))
    cached = frames.cached_frames(dataset, KEY, (16, 16), tmp_path)
    assert set(decoded) == {2}
    assert np.array_equal(cached, frames.cached_frames(dataset, KEY, (16, 16), tmp_path / "whole"))


def test_full_disk_leaves_nothing(recorded, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(frames.os, "posix_fallocate", full)
    with pytest.raises(OSError, match="cache_frames=false"):
        frames.cached_frames(opened(recorded), KEY, (16, 16), tmp_path)
    assert not list(tmp_path.glob("*.frames"))
    assert not list(tmp_path.glob("*.partial"))


def test_damaged_video_is_refused(recorded, tmp_path):
    root = shutil.copytree(recorded, tmp_path / "copy")
    videos = list(root.rglob("*.mp4"))
    if not videos:
        pytest.skip("pictures lie in the table, which LeRobot reads as it opens the dataset")
    for path in videos:
        path.write_bytes(b"not a video")
    with pytest.raises(ValueError, match="episode 0"):
        frames.cached_frames(opened(root), KEY, (16, 16), tmp_path / "cache")
    assert not list((tmp_path / "cache").glob("*.frames"))


def test_another_camera_names_those_there_are(recorded, tmp_path):
    with pytest.raises(ValueError, match=KEY):
        frames.cached_frames(opened(recorded), "observation.images.side", (16, 16), tmp_path)


def test_stored_files_tell_their_bytes(recorded, tmp_path):
    frames.cached_frames(opened(recorded), KEY, (16, 16), tmp_path)
    sizes = {path.suffix: size for path, size in frames.stored_files(tmp_path)}
    assert sizes[".frames"] >= sum(LENGTHS) * 3 * 16 * 16


def test_batched_windows_equal_single_items(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(frames, "frames_folder", lambda: tmp_path)
    steps = [step / 10 for step in range(4)]
    dataset = opened(recorded, delta_timestamps={KEY: steps, "action": steps})
    assert reads.batched_read(dataset) is None
    chosen = [0, 5, 11, 40, 81, 6, -1]
    expected = default_collate([dataset[i] for i in chosen])
    reads.serve_frames(dataset, [KEY], (SIDE, SIDE))
    batch = reads.batched_read(dataset)(chosen).batch
    assert set(batch) == set(expected)
    assert batch[KEY].shape == (len(chosen), 4, 3, SIDE, SIDE)
    assert (batch[KEY] / 255 - expected[KEY]).abs().max() < 1.01 / 255
    for key in set(batch) - {KEY, "task"}:
        assert torch.equal(batch[key], expected[key]), key


def test_cameras_that_nobody_reads_are_left_out(recorded):
    dataset = opened(recorded, delta_timestamps={KEY: [0.0, 0.1], "action": [0.0, 0.1]})
    reads.serve_frames(dataset, [], (SIDE, SIDE))
    batch = reads.batched_read(dataset)([0, 3]).batch
    assert not [key for key in batch if key.startswith(KEY)]
    assert batch["action"].shape == (2, 2)  # LeRobot stores a single number as a number
