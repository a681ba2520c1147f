"""Return-to-go. N frames, stored one episode after another; E episodes."""

import numpy as np


def return_to_go(rewards: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Sum of the rewards from each step to the end of its episode, that step's own included.

    Args:
        rewards: (N,) rewards, in the dataset's units.
        lengths: (E,) steps in each episode; they sum to N.

    Returns:
        (N,) float32. Sums run in float64, and each within its own episode.

    Raises:
        ValueError: If `lengths` has an entry below 1 or does not sum to N.
    """
    rewards, lengths = np.asarray(rewards, dtype=np.float64), np.asarray(lengths)
    if rewards.ndim != 1 or lengths.ndim != 1 or (lengths < 1).any() or lengths.sum() != len(rewards):
        raise ValueError(
            f"rewards {rewards.shape} must be one axis of frames, and lengths {lengths.shape}, each at least 1, "
            f"must sum to its {rewards.size}; they sum to {lengths.sum()}."
        )
    starts = np.cumsum(lengths) - lengths  # (E,)
    returns = np.empty(len(rewards), dtype=np.float32)
    for length in np.unique(lengths):
        frames = starts[lengths == length, None] + np.arange(length)  # (episodes of this length, length)
        returns[frames] = rewards[frames][:, ::-1].cumsum(axis=1)[:, ::-1]
    return returns
