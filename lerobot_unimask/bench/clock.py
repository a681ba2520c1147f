"""Clocks, processes of their own, and what machine it is: what every measurement needs.

With a GPU, clocks wait for it, and its peak memory is recorded too.
"""

import functools
import multiprocessing
import os
import resource
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any

import numpy as np
import torch

from lerobot_unimask.machine import describe_machine
from lerobot_unimask.records import commit, versions


def circumstances() -> dict[str, Any]:
    """Where and of what a record is: machine, versions, and the processes that wanted a core as it began: above 0 other
    work disturbs it."""
    load = round(os.getloadavg()[0], 2)
    return {"machine": describe_machine(), "load_at_start": load, "commit": commit(), "versions": versions()}


def alone(label: str, measure: Callable[..., dict[str, Any]], *arguments: Any, **keywords: Any) -> dict[str, Any]:
    """What a function of this module returns in a process of its own, with that process's seconds and peak memory."""
    print(f"{label} ...", file=sys.stderr, flush=True)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["lerobot_policy_unimask", measure.__module__])
    with ProcessPoolExecutor(1, mp_context=context) as process:
        return process.submit(_measured, functools.partial(measure, *arguments, **keywords)).result()


def _measured(measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    began = time.monotonic()
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        record = measure()
    record["seconds"] = round(time.monotonic() - began, 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # KiB; on macOS bytes
    record["peak_memory_mib"] = round(peak / (2**20 if sys.platform == "darwin" else 2**10))
    if torch.cuda.is_initialized():
        record["peak_device_memory_mib"] = round(torch.cuda.max_memory_allocated() / 2**20)
    return record


class Stopwatch:
    """When named pieces of work began and how many seconds they took, every time that they were done."""

    def __init__(self) -> None:
        self.began: dict[str, list[float]] = defaultdict(list)
        self.seconds: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        began = now()
        yield
        self.began[name].append(began)
        self.seconds[name].append(now() - began)

    def wrap(self, owner: Any, attribute: str, name: str) -> None:
        """Time every call of a function from now on, for as long as this process lives."""
        function = getattr(owner, attribute)

        @functools.wraps(function)
        def timed(*arguments: Any, **keywords: Any) -> Any:
            with self(name):
                return function(*arguments, **keywords)

        setattr(owner, attribute, timed)


def now() -> float:
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()


def spread(values: Sequence[float]) -> dict[str, Any]:
    low, median, high = np.quantile(np.asarray(values, dtype=float), [0.25, 0.5, 0.75]).tolist()
    return {"median": median, "quartiles": [low, high], "repeats": len(values)}
