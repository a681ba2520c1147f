"""What the machine at hand has, and what training on its processor sets up."""

import ctypes
import os
import platform
import threading
from functools import cache
from pathlib import Path
from typing import Any

import torch

BUSY = 1.5  # processes that wanted a core in the last minute: this one, and another


def has_bfloat16(device: str) -> bool:
    """Whether a device computes in bfloat16. A processor without AVX-512 emulates it, seven times slower."""
    return torch.device(device).type != "cpu" or torch.ops.mkldnn._is_mkldnn_bf16_supported()


@cache
def keep_freed_memory() -> bool:
    """Tell glibc to keep what is freed: otherwise every update gives memory back to the system and takes it again, an
    eighth of its time (docs/speed.md). What the environment says of it is left as it is. Does nothing the second time.

    Returns:
        Whether there is a glibc that was told so.
    """
    if platform.libc_ver()[0] != "glibc" or {"MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"} & os.environ.keys():
        return False
    libc, trim_threshold, mmap_threshold = ctypes.CDLL(None), -1, -3  # as in malloc.h
    return bool(libc.mallopt(mmap_threshold, 2**25) and libc.mallopt(trim_threshold, 10**9))


@cache
def wait_without_spinning() -> bool:
    """Where other processes want the cores too, let PyTorch's threads sleep while they wait for each other. libgomp has
    them spin for milliseconds, while the one waited for may have no core: updates then take many times as long
    (docs/speed.md). With more threads than cores it spins a three-hundredth of that, so here is one more, asleep. What
    the environment says of waiting is left as it is. Does nothing the second time.

    Returns:
        Whether it was done.
    """
    told, maps = {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys(), Path("/proc/self/maps")
    if told or torch.get_num_threads() == 1 or not maps.exists() or "libgomp" not in maps.read_text():
        return False
    if os.getloadavg()[0] < BUSY:
        return False
    started = threading.Event()

    def sleep() -> None:
        torch.zeros(2**20).exp_()  # a thread that computes has threads of its own
        started.set()
        threading.Event().wait()

    threading.Thread(target=sleep, daemon=True).start()
    return started.wait(timeout=10)


def describe_machine() -> dict[str, Any]:
    """Processor, cores, memory and GPU, for a record."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    told = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    flags = told.get("flags", "").split()
    return {
        "processor": told.get("model name", platform.processor()),
        "vectors": [flag for flag in ("avx2", "avx512f", "avx512_bf16", "amx_bf16") if flag in flags],
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "system": platform.platform(),
    }
