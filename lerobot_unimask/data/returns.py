"""Return-to-go, and the return to ask for at evaluation.

Legend of shapes: N frames, stored one episode after another; E episodes; B environments; D dimensions of a state.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.dataset
import torch
from torch import Tensor, nn


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


class EpisodeStarts(nn.Module):
    """How each training episode began and what it returned, as buffers, so that a downloaded checkpoint has them too.

    `states` is (E, D), `returns` (E,), both in the dataset's units.
    """

    states: Tensor
    returns: Tensor

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("states", torch.zeros(0, size))
        self.register_buffer("returns", torch.zeros(0))

    def fill(self, states: Tensor, returns: Tensor) -> None:
        self.states, self.returns = states.to(self.states), returns.to(self.returns)

    def make_room(self, episodes: int) -> None:
        """Get room for as many episodes as a checkpoint holds."""
        self.fill(self.states.new_zeros(episodes, self.states.shape[1]), self.returns.new_zeros(episodes))

    def nearest_return(self, state: Tensor) -> Tensor:
        """The return of the training episode whose first state is nearest, (B, D) -> (B, 1) (paper, appendix
        "Maze2D experiments": Euclidean distance, the goal being part of the state).

        Raises:
            ValueError: no episode is kept.
        """
        if len(self.states) == 0:
            raise ValueError(
                "target_return=auto asks for what the nearest training episode returned, and this checkpoint keeps no "
                "episodes: it was trained without 'observation.return_to_go' or by streaming. Give a number."
            )
        return self.returns[torch.cdist(state, self.states).argmin(dim=1)].unsqueeze(-1)


def read_starts(
    root: Path, state_keys: Sequence[str], return_key: str, episodes: Sequence[int] | None = None
) -> tuple[Tensor, Tensor] | None:
    """First states (E, D) and returns (E,) of a LeRobotDataset's episodes; None if its data is not there.

    Args:
        episodes: those that are read; None: all. Those that `--dataset.eval_split` holds out are among them.
    """
    if not (root / "data").is_dir():
        return None
    data = pyarrow.dataset.dataset(root / "data", format="parquet")
    wanted = pyarrow.dataset.field("frame_index") == 0
    if episodes is not None:
        wanted &= pyarrow.dataset.field("episode_index").isin(list(episodes))
    first = data.to_table([*state_keys, return_key], filter=wanted)
    columns = [torch.tensor(np.array(first[key].to_pylist(), dtype=np.float32)) for key in (*state_keys, return_key)]
    count = len(first)
    return torch.cat([column.view(count, -1) for column in columns[:-1]], dim=1), columns[-1].view(count)
