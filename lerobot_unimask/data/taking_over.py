"""What a policy takes over from its training dataset. What can be known of it is not assumed, and what is unsound in it
stops the run here, before its first step."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_unimask.data.factors import RETURN_TO_GO, Feature, names_of
from lerobot_unimask.data.returns import EpisodeStarts, read_starts
from lerobot_unimask.data.soundness import check_columns
from lerobot_unimask.data.window import Statistics

_read: WeakKeyDictionary[LeRobotDatasetMetadata, Sequence[int]] = WeakKeyDictionary()


def keep_to(meta: LeRobotDatasetMetadata, episodes: Sequence[int] | None) -> None:
    """Note which of a dataset's episodes are read: LeRobot tells a policy its metadata alone, which name all."""
    if episodes is not None:
        _read[meta] = episodes


def take_over(
    meta: LeRobotDatasetMetadata,
    stats: Mapping[str, Mapping[str, Any]],
    features: Mapping[str, Sequence[Feature]],
    statistics: Statistics,
    episode_starts: EpisodeStarts,
    *,
    steps: int,
    dropped: int,
) -> None:
    """Fill what a policy keeps of a dataset.

    Args:
        stats: the dataset's statistics; what they lack is computed from its columns.
        features: the policy's factors, each with its columns.
        statistics, episode_starts: buffers to fill.
        steps: number of a window's.
        dropped: number of frames at an episode's end that start no window.

    Raises:
        ValueError: no episode is long enough for a window, or a number or statistic is not sound.
    """
    root, episodes = Path(meta.root), _read.get(meta)
    lengths = meta.episodes["length"]
    lengths = lengths if episodes is None else [lengths[episode] for episode in episodes]
    if max(lengths) <= dropped:
        which = "No episode" if episodes is None else f"None of the {len(lengths)} episodes that are read"
        raise ValueError(
            f"{which} of {root} has the {steps} steps of a window: the longest has {max(lengths)}. Choose a shorter "
            "context_length, or drop_n_last_frames=0."
        )
    check_columns(root, {f.key: names_of(f) for columns in features.values() for f in columns}, episodes)
    statistics.fill(stats, root=root, episodes=episodes)
    statistics.keep_time(meta.fps, max(lengths))
    if "rtg" in features:
        starts = read_starts(root, [f.key for f in features["s"]], RETURN_TO_GO, episodes)
        if starts is not None:
            episode_starts.fill(*starts)
