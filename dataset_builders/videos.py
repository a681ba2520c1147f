"""Pictures -> the videos of a LeRobotDataset (v3.0), as they come: none but one are in memory. Or PNG pictures in its
table, as LeRobot stores them where it is told to use no videos.

Codec and its settings are LeRobot's own. A file holds whole episodes, one after another, about `FRAMES` in all.

Shapes: E episodes, H and W pixels.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import datasets
import numpy as np
import pyarrow as pa
from lerobot.configs.video import rgb_encoder_defaults
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import get_feature_stats, sample_indices
from lerobot.datasets.utils import update_chunk_file_indices
from PIL import Image

FRAMES = 20_000  # of a file: several are decoded at once

CAMERA = "observation.images.top"


def camera_feature(height: int, width: int, *, use_videos: bool = True) -> dict[str, Any]:
    """LeRobot's description of a column of colour pictures."""
    dtype = "video" if use_videos else "image"
    return {"dtype": dtype, "shape": (height, width, 3), "names": ["height", "width", "channels"]}


def encode_pictures(
    pictures: Iterator[np.ndarray], lengths: np.ndarray
) -> tuple[pa.Array, list[dict[str, np.ndarray]]]:
    """Every picture of one camera as a PNG; for arguments see `write_videos`.

    Returns:
        The column as LeRobot stores it, and the episodes' statistics.
    """
    cells, statistics = [], []
    for length in lengths.tolist():
        sample = _Sample(length)
        for step in range(length):
            picture = next(pictures)
            sample.see(step, picture)
            file = io.BytesIO()
            Image.fromarray(picture).save(file, "PNG")
            cells.append({"bytes": file.getvalue(), "path": f"frame-{step:06d}.png"})
        statistics.append(sample.statistics())
    return pa.array(cells, type=datasets.Image().pa_type), statistics


def write_videos(
    meta: LeRobotDatasetMetadata, key: str, pictures: Iterator[np.ndarray], lengths: np.ndarray
) -> tuple[dict[str, list[int] | list[float]], list[dict[str, np.ndarray]]]:
    """Encode every picture of one camera.

    Args:
        pictures: (H, W, 3) uint8, episodes one after another.
        lengths: (E,) steps of each episode.

    Returns:
        The columns of meta/episodes that say where an episode's frames are, each of E, and LeRobot's statistics of
        each episode, of as many of its pictures as LeRobot takes.
    """
    places: dict[str, list] = {name: [] for name in ("chunk_index", "file_index", "from_timestamp", "to_timestamp")}
    statistics = []
    chunk, file, done, video = 0, 0, 0, None
    for length in lengths.tolist():
        if video is not None and done + length > FRAMES:
            video.close()
            video, done = None, 0
            chunk, file = update_chunk_file_indices(chunk, file, meta.chunks_size)
        if video is None:
            path = meta.root / meta.video_path.format(video_key=key, chunk_index=chunk, file_index=file)
            video = _Video(path, meta.features[key]["shape"], meta.fps)
        sample = _Sample(length)
        for step in range(length):
            picture = next(pictures)
            video.add(picture)
            sample.see(step, picture)
        place = (chunk, file, done / meta.fps, (done + length) / meta.fps)
        for values, value in zip(places.values(), place, strict=True):
            values.append(value)
        statistics.append(sample.statistics())
        done += length
    if video is not None:
        video.close()
    meta.update_video_info(key, rgb_encoder_defaults())
    return {f"videos/{key}/{name}": values for name, values in places.items()}, statistics


class _Sample:
    """As many of an episode's pictures as LeRobot takes statistics of."""

    def __init__(self, length: int):
        self.steps = set(sample_indices(length))
        self.kept: list[np.ndarray] = []

    def see(self, step: int, picture: np.ndarray) -> None:
        if step in self.steps:
            self.kept.append(picture.transpose(2, 0, 1))

    def statistics(self) -> dict[str, np.ndarray]:
        found = get_feature_stats(np.stack(self.kept), axis=(0, 2, 3), keepdims=True)
        return {name: v if name == "count" else (v / 255)[0] for name, v in found.items()}  # (3, 1, 1)


class _Video:
    def __init__(self, path: Path, shape: tuple[int, ...], fps: int):
        path.parent.mkdir(parents=True, exist_ok=True)
        encoder = rgb_encoder_defaults()
        self.file = av.open(str(path), "w")
        self.stream = self.file.add_stream(encoder.vcodec, fps, options=encoder.get_codec_options(as_strings=True))
        self.stream.pix_fmt = encoder.pix_fmt
        self.stream.height, self.stream.width = shape[0], shape[1]

    def add(self, picture: np.ndarray) -> None:
        self.file.mux(self.stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))

    def close(self) -> None:
        self.file.mux(self.stream.encode())
        self.file.close()
