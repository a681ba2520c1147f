"""A camera's frames, decoded once: uint8, at one size, memory-mapped, in LeRobot's cache folder.

LeRobot decodes a window's frames each time that it is read. Here all frames of a camera are decoded the first time and
lie in one file, whose name is a hash of what was decoded, so that a changed dataset has another file. A file of that
name is complete: it is written under another name, episode by episode, and renamed at the end. Who is interrupted goes
on where the last whole episode ended. Oracle: `tests/test_frames.py`.

Shapes: N frames loaded, C channels, H and W pixels.
"""

import errno
import hashlib
import json
import os
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from filelock import FileLock
from lerobot.datasets import video_utils
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import HF_LEROBOT_HOME
from torch import Tensor
from torchvision.transforms.v2.functional import resize
from tqdm import tqdm

from lerobot_unimask.data.factors import colour_cameras

FORMAT = 1  # of the files: another number makes others
CHUNK = 64  # frames decoded at once, which bounds the memory
_own = threading.local()  # each thread's decoders: one decoder serves one thread at a time


def frames_folder() -> Path:
    return HF_LEROBOT_HOME / "unimask" / "frames"


def stored_files(folder: Path | None = None) -> list[tuple[Path, int]]:
    """Every file of cached frames, finished or not, and the bytes that it takes on the disk."""
    folder = folder or frames_folder()
    return [(path, path.stat().st_blocks * 512) for path in sorted(folder.glob("*")) if path.is_file()]


def resized(pictures: Tensor, size: tuple[int, int]) -> Tensor:
    """(..., C, H, W) uint8 -> at `size`, which is (height, width); the same pictures where they have it already."""
    if pictures.shape[-2:] == size:
        return pictures
    return resize(pictures, list(size), antialias=True)


def cached_frames(dataset: LeRobotDataset, key: str, size: tuple[int, int], folder: Path | None = None) -> np.ndarray:
    """The frames of camera `key`, one for each row of the dataset as it is loaded: (N, C, H, W) uint8, read-only.

    The first call decodes them, with a progress bar; another process that wants the same waits for it.

    Args:
        size: height and width of the pictures.
        folder: place of the files; None: `frames_folder()`.

    Raises:
        ValueError: no such camera, one that measures depth, or a frame that does not decode.
        OSError: no room on the disk, before or while it is written; nothing is left that loads.
    """
    channels = colour_cameras(dataset.meta.features)
    if key not in channels:
        raise ValueError(f"{key!r} is no colour camera of this dataset; its colour cameras are {list(channels)}.")
    folder = folder or frames_folder()
    folder.mkdir(parents=True, exist_ok=True)
    shape = (len(dataset.hf_dataset), channels[key], *size)
    path = folder / f"{_fingerprint(dataset, key, shape)}.frames"
    if not path.exists():
        with FileLock(path.with_suffix(".lock")):
            if not path.exists():  # somebody else may have made it while this process waited
                _build(dataset, key, shape, path)
    return np.memmap(path, np.uint8, "r", shape=shape)


def _fingerprint(dataset: LeRobotDataset, key: str, shape: tuple[int, ...]) -> str:
    """A hash of what decides the frames: the camera, the shape, the episodes, and the files by size and time."""
    files = set()
    for episode in _episodes(dataset):
        files.add(dataset.meta.get_data_file_path(episode))
        if key in dataset.meta.video_keys:
            files.add(dataset.meta.get_video_file_path(episode, key))
    facts: list = [FORMAT, key, shape, dataset.episodes]
    for file in sorted(map(str, files)):
        stat = (dataset.root / file).stat()
        facts.append([file, stat.st_size, stat.st_mtime_ns])
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:32]


def _episodes(dataset: LeRobotDataset) -> Sequence[int]:
    return range(dataset.meta.total_episodes) if dataset.episodes is None else dataset.episodes


def _build(dataset: LeRobotDataset, key: str, shape: tuple[int, ...], path: Path) -> None:
    """Decode every episode into `path`, which exists once all of them are in it."""
    partial, done_path = path.with_suffix(".partial"), path.with_suffix(".done")
    numbers = dataset.hf_dataset.data.column("episode_index").to_numpy()  # (N,)
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    ends = np.append(starts[1:], len(numbers))
    done = set(done_path.read_text().split()) if partial.exists() and done_path.exists() else set()
    _reserve(partial, int(np.prod(shape)))
    pictures = np.memmap(partial, np.uint8, "r+", shape=shape)
    files: dict[str, list[tuple[int, int, int]]] = {}  # one thread for each video: its episodes follow one another
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        episode = int(numbers[start])
        if str(episode) not in done:
            video = key in dataset.meta.video_keys
            file = str(dataset.meta.get_video_file_path(episode, key)) if video else str(episode)
            files.setdefault(file, []).append((episode, start, end))

    lock = threading.Lock()
    stopped = threading.Event()
    bar = tqdm(
        total=sum(end - start for runs in files.values() for _, start, end in runs), unit="frame", desc=f"{key}, once"
    )

    def decode_file(runs: list[tuple[int, int, int]]) -> None:
        for episode, start, end in runs:
            for first in range(start, end, CHUNK):
                if stopped.is_set():
                    return
                rows = range(first, min(first + CHUNK, end))
                pictures[rows.start : rows.stop] = _decode(dataset, key, episode, rows, (shape[-2], shape[-1])).numpy()
                bar.update(len(rows))
            with lock:
                pictures.flush()  # on the disk before it is called done
                with done_path.open("a") as file:
                    file.write(f"{episode}\n")

    with bar, ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            list(pool.map(decode_file, files.values()))  # raises what one of them raised
        except BaseException:
            stopped.set()
            raise
    os.replace(partial, path)
    done_path.unlink(missing_ok=True)


def _reserve(path: Path, size: int) -> None:
    """A file of this many bytes, all of them there: a disk that fills later would kill whoever writes to the map."""
    with path.open("ab") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            path.unlink()
            path.with_suffix(".done").unlink(missing_ok=True)
            if error.errno not in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT):
                raise
            raise OSError(
                error.errno,
                f"The decoded frames take {size / 1e9:.3g} GB, which {path.parent} has no room for; "
                "policy.cache_frames=false decodes them at each read instead",
            ) from error


def _decode(dataset: LeRobotDataset, key: str, episode: int, rows: range, size: tuple[int, int]) -> Tensor:
    """The frames of these rows, all of one episode, as LeRobot reads them: (rows, C, H, W) uint8, at `size`."""
    stored, place = key in dataset.meta.image_keys, f"{key} of episode {episode} in {dataset.root}"
    try:
        if stored:
            frames = torch.stack(list(dataset.hf_dataset[rows.start : rows.stop][key]))  # float32 in [0, 1]
        else:
            frames = _decode_video(dataset, key, episode, rows)
    except Exception as error:  # torchcodec, PyAV and Pillow each raise their own
        reason = str(error).strip().splitlines()[:1] or [type(error).__name__]
        raise ValueError(
            f"{place} does not decode ({reason[0][:200]}): fetch its file anew, or leave the episode out with "
            "--dataset.episodes."
        ) from error
    channels = colour_cameras(dataset.meta.features)[key]
    if frames.shape[1] not in (1, channels) or (stored and not (frames.is_floating_point() and frames.max() <= 1)):
        raise ValueError(
            f"{place} has pictures of {frames.shape[1]} channels, {frames.dtype}, up to {frames.max():g}, and read are "
            f"{channels} channels of 8 bits: leave the camera out, with --policy.cameras or `unimask prepare --drop`. "
            'Depth is not read where the column\'s "info" in meta/info.json has "is_depth_map": true.'
        )
    return resized((frames * 255).round().to(torch.uint8) if stored else frames, size)


def _decode_video(dataset: LeRobotDataset, key: str, episode: int, rows: range) -> Tensor:
    times = dataset.hf_dataset.data.column("timestamp")[rows.start : rows.stop].to_numpy()
    begin = dataset.meta.episodes[episode][f"videos/{key}/from_timestamp"]
    path = dataset.root / dataset.meta.get_video_file_path(episode, key)
    wanted = [begin + float(time) for time in times]
    if dataset._video_backend != "torchcodec":
        return video_utils.decode_video_frames_pyav(path, wanted, dataset.tolerance_s, return_uint8=True)
    if not hasattr(_own, "decoders"):
        _own.decoders = video_utils.VideoDecoderCache(max_size=1)
    return video_utils.decode_video_frames_torchcodec(
        path, wanted, dataset.tolerance_s, decoder_cache=_own.decoders, return_uint8=True
    )
