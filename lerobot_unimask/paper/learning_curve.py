"""Return against updates: every checkpoint of a run, rolled out with LeRobot's own evaluation."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from lerobot_unimask.data.checkpoints import checkpoints_of, training_settings
from lerobot_unimask.evaluating import rollout
from lerobot_unimask.plots.style import COLOURS, FAINT, SMALL, WIDTH
from lerobot_unimask.records import versions


def learning_curve(
    runs: Sequence[Path], env_type: str, *, episodes: int, last_episodes: int, batch_size: int, seed: int
) -> dict[str, Any]:
    """A JSON record of each run's checkpoints.

    Args:
        episodes: rollouts of each checkpoint, with the same starts for all.
        last_episodes: rollouts of the last one, whose mean is what the run is judged by.
    """
    records = []
    for run in runs:
        checkpoints = checkpoints_of(run)
        points = []
        for path in checkpoints:
            count = last_episodes if path == checkpoints[-1] else episodes
            points.append(rollout(path, env_type, count, batch_size=min(batch_size, count), seed=seed))
            result = "{updates} updates: return {mean_return:.3f} +- {standard_error:.3f} over {episodes}".format(
                **points[-1]
            )
            print(f"{run.name}: {result}, {points[-1]['seconds']} s", flush=True)
        records.append(
            {
                "run": run.name,
                "checkpoints": points,
                "training_seconds_per_update": _seconds_per_update(checkpoints, points),
                "training": training_settings(checkpoints[-1]),
            }
        )
    return {
        "what": "mean return of LeRobot's evaluation, most likely actions unless the settings say otherwise",
        "environment": env_type,
        "seed": seed,
        "runs": records,
        "versions": versions(),
    }


def _seconds_per_update(checkpoints: Sequence[Path], points: Sequence[dict[str, Any]]) -> float | None:
    """Wall time of training from the first checkpoint to the last, evaluations in between included."""
    if len(checkpoints) < 2:
        return None
    first, last = ((path / "model.safetensors").stat().st_mtime for path in (checkpoints[0], checkpoints[-1]))
    return round((last - first) / (points[-1]["updates"] - points[0]["updates"]), 4)


def learning_curves(record: Mapping[str, Any]) -> Figure:
    """Mean return against updates, one line for each run, with bars of one standard error.

    Args:
        record: one of `learning_curve`.
    """
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    axes = figure.subplots()
    for run, colour, marker in zip(record["runs"], cycle(COLOURS), cycle("os^Dvx"), strict=False):
        points = run["checkpoints"]
        axes.errorbar(
            [point["updates"] for point in points],
            [point["mean_return"] for point in points],
            [point["standard_error"] for point in points],
            color=colour,
            marker=marker,
            markersize=4,
            linewidth=1.2,
            capsize=2,
            label=run["run"],
        )
    axes.set_xlabel("updates")
    axes.set_ylabel("mean return")
    axes.grid(color=FAINT)
    axes.legend(fontsize=SMALL)
    return figure
