"""`unimask bench --beside`: processor time of updates and actions beside other models of the same size, in one run.

Each model works in a process of its own, on one thread, and they take turns at every repeat, so that what else the
machine does falls on all of them alike. `contender.py` says what the models are.
"""

import os
import subprocess
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import lerobot_unimask
from lerobot_unimask.bench import contender
from lerobot_unimask.bench.clock import circumstances, spread

WORKS = {
    "random": f"update on random masks, {contender.BATCH} windows",
    "imitation": f"update on imitation, {contender.BATCH} windows",
    "1": "action, 1 environment",
    "50": "action, 50 environments",
}
WARM_UP = 3  # repeats that do not count
OLD = {"ATEN_CPU_CAPABILITY": "avx2", "MKL_ENABLE_INSTRUCTIONS": "AVX2", "ONEDNN_MAX_CPU_ISA": "AVX2"}


def bench_beside(before: Path | None = None, *, avx2: bool = False, repeats: int = 21) -> dict[str, Any]:
    """Measure what each model takes.

    Args:
        before: folder of an older checkout of this package, which is one more model.
        avx2: whether to compute as a processor does that has AVX2 and nothing newer.

    Raises:
        FileNotFoundError: there is no package in `before`.
    """
    if before is not None and not (before / "lerobot_unimask").is_dir():
        raise FileNotFoundError(f"{before} holds no lerobot_unimask.")
    here = Path(lerobot_unimask.__file__).parents[1]
    models = {
        "unimask": ("unimask", here),
        **({"before": ("unimask", before)} if before else {}),
        "masked_autoencoder": ("masked_autoencoder", here),
        **({"decision_transformer": ("decision_transformer", here)} if find_spec("transformers") else {}),
    }
    record: dict[str, Any] = {
        "what": "milliseconds of processor time, one thread; medians and quartiles of repeats that take turns",
        "sizes": {
            name: getattr(contender, name) for name in ("STATE", "ACTIONS", "CONTEXT", "WIDTH", "HEADS", "INNER")
        },
        "avx2": avx2,
        **circumstances(),
        "ms": {},
    }
    with ExitStack() as stack:
        processes = {name: stack.enter_context(_start(*model, OLD if avx2 else {})) for name, model in models.items()}
        for name, process in processes.items():
            _await(name, process)
        for work, title in WORKS.items():
            able = {name: one for name, one in processes.items() if (work, name) != ("random", "decision_transformer")}
            seconds: dict[str, list[float]] = {name: [] for name in able}
            for _ in range(WARM_UP + repeats):
                for name, process in able.items():
                    seconds[name].append(_turn(process, work))
            record["ms"][title] = {
                name: spread([1000 * one for one in measured[WARM_UP:]]) | {"least": 1000 * min(measured[WARM_UP:])}
                for name, measured in seconds.items()
            }
        for process in processes.values():
            process.terminate()
    return record


def _start(model: str, package: Path, environment: Mapping[str, str]) -> "subprocess.Popen[str]":
    paths = os.pathsep.join([str(package.resolve()), os.environ.get("PYTHONPATH", "")])
    one_thread = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "PYTHONPATH": paths}
    return subprocess.Popen(
        [sys.executable, "-P", contender.__file__, model],
        env={**os.environ, **one_thread, **environment},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def _await(name: str, process: "subprocess.Popen[str]") -> None:
    assert process.stdout is not None
    while (line := process.stdout.readline()) != "ready\n":
        if not line:
            raise RuntimeError(f"{name} did not start.")


def _turn(process: "subprocess.Popen[str]", work: str) -> float:
    assert process.stdout is not None
    print(work, file=process.stdin, flush=True)
    return float(process.stdout.readline())
