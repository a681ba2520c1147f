"""Validation losses of a trained policy, task by task: the rows of the paper's heatmap (paper, appendix F).

A task's loss is the mean cross-entropy of each component (agent cell, key cell, action) over all asked-for tokens of
all windows, the components added up. One window for each episode, from its first step, with t uniform; the windows and
their masks are the same for every policy.
"""

import json
from pathlib import Path

from lerobot_unimask.data.episodes import provenance_of


def checkpoints_of(run: Path) -> list[Path]:
    """A training run's checkpoints in order, or the folder itself if it is a checkpoint.

    Raises:
        FileNotFoundError: it is neither.
    """
    if (run / "config.json").exists():
        return [run]
    found = sorted(path.parent for path in run.glob("checkpoints/*/pretrained_model/config.json"))
    found = [path for path in found if path.parent.name != "last"]  # a link to one of the others
    if not found:
        raise FileNotFoundError(
            f"{run} is neither a checkpoint (a folder with config.json) nor a training run (with checkpoints/)."
        )
    return found


def training_settings(checkpoint: Path) -> dict | None:
    """What lerobot-train saved beside the weights: the policy's settings, the seed, the data and its provenance."""
    path = checkpoint / "train_config.json"
    if not path.exists():
        return None
    config = json.loads(path.read_text())
    root = config["dataset"].get("root")
    keep = ("seed", "batch_size", "steps")
    policy = {
        key: value for key, value in config["policy"].items() if isinstance(value, str | int | float | dict | list)
    }
    for unrelated in ("input_features", "output_features", "features", "normalization_mapping", "pretrained_path"):
        policy.pop(unrelated, None)
    return {**{key: config[key] for key in keep}, "policy": policy, "data": provenance_of(Path(root)) if root else None}
