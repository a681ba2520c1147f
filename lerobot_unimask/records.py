"""A grid of runs as an Optuna study: any number of workers, on any number of machines, share what is left to do.

Each run is a trial that is enqueued with its specification; a worker takes the next one, runs it, and stores its
record, JSON, with the trial and as a file. Nothing is run twice: not by a second worker, not after an interruption. A
worker that dies stops its heartbeat, and another takes up what it was doing (Optuna's retry callback). The
storage is an SQLite file, for one machine, or any database that Optuna supports.
"""

import platform
from importlib.metadata import version


def versions() -> dict[str, str]:
    names = ("torch", "lerobot", "lerobot_policy_unimask", "optuna")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}
