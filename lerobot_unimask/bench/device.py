"""`unimask bench --device=DEVICE`: updates and actions on one device, a GPU above all, eager and captured by
torch.compile, beside LeRobot's `act` and transformers' Decision Transformer in the same run.

Each measurement runs in a process of its own. The order is that of importance, and what would begin on a GPU after
`Size.seconds` is left out and named, so that the whole ends within eight minutes on a GPU.
"""

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy_config
from lerobot.scripts import lerobot_train
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import nn
from torch.profiler import ProfilerActivity, profile

from dataset_builders.doorkey import build_doorkey
from dataset_builders.maze2d import build_maze2d
from lerobot_unimask.bench.clock import alone, circumstances, now, spread
from lerobot_unimask.bench.contender import transformers_own
from lerobot_unimask.bench.measuring import CONFIGS, WARM_UP, acting, check_configs, run_lerobot_train

STATE, ACTIONS = 4, 2  # numbers of Maze2D's states and actions


@dataclass(frozen=True)
class Size:
    """How much is measured."""

    episodes: int  # of each data set
    updates: int
    profiled: int  # updates
    batches: tuple[int, ...]  # windows of an update, the first for both configs, the others for Maze2D's
    environments: tuple[int, ...]
    calls: int  # of select_action
    seconds: int  # after which nothing more begins


FULL = Size(
    1000, updates=200, profiled=10, batches=(100, 1000, 4000), environments=(1, 100, 1000), calls=50, seconds=400
)
QUICK = Size(12, updates=2, profiled=1, batches=(8, 16), environments=(1, 2), calls=2, seconds=400)


def bench_device(configs: Path, device: str, *, quick: bool = False) -> dict[str, Any]:
    """Measure updates and actions on a device.

    Args:
        configs: the folder of the DoorKey and Maze2D configs.

    Raises:
        FileNotFoundError: it does not hold them.
        ValueError: there is no such device.
    """
    check_configs(configs)
    try:
        torch.empty((), device=device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"There is no device {device!r} here: {str(error).splitlines()[0]}") from None
    size = QUICK if quick else FULL
    began = time.monotonic()
    record: dict[str, Any] = {
        "what": "medians and quartiles over updates or calls; launches, kernels and waits for each update",
        "quick": quick,
        "device": device,
        **circumstances(),
        "updates": {},
        "acting": {},
        "left_out": [],
        "failed": {},
    }
    with tempfile.TemporaryDirectory() as folder:
        roots = {name: Path(folder) / name for name in CONFIGS}
        build_doorkey(roots["doorkey"], episodes=size.episodes, expert="released", progress=False)
        build_maze2d(roots["maze2d"], episodes=size.episodes, progress=False)
        settings = yaml.safe_load((configs / CONFIGS["maze2d"]).read_text())["policy"] | {"device": device}
        for kind, name, count, measure in _measurements(size, configs, roots, settings, device):
            label = f"{kind}, {name}, {count}"
            if device.startswith("cuda") and time.monotonic() - began > size.seconds:
                record["left_out"].append(label)
                continue
            try:
                record[kind].setdefault(name, {})[str(count)] = alone(label, measure)
            except Exception as error:  # the others are worth having all the same
                record["failed"][label] = str(error).strip().split("\n")[0]
    record["seconds"] = round(time.monotonic() - began)
    return record


def _measurements(
    size: Size, configs: Path, roots: Mapping[str, Path], settings: Mapping[str, Any], device: str
) -> Iterator[tuple[str, str, int, Callable[[], dict[str, Any]]]]:
    """Kind, name, number of windows or environments, and what measures it; the most important first."""
    how = {
        "eager, float32": ["--policy.use_amp=false", "--policy.compile_model=false"],
        "captured, float32": ["--policy.use_amp=false", "--policy.compile_model=true"],
        "eager, use_amp": ["--policy.use_amp=true", "--policy.compile_model=false"],
        "captured, use_amp": ["--policy.use_amp=true", "--policy.compile_model=true"],
    }

    def update(config: str, variant: str, batch: int) -> tuple[str, str, int, Callable[[], dict[str, Any]]]:
        arguments = [f"--policy.device={device}", f"--batch_size={batch}", *how[variant]]
        path, root = configs / CONFIGS[config], roots[config]
        return "updates", f"{config}, {variant}", batch, partial(updating, path, root, size, batch, arguments)

    if torch.device(device).type == "cpu":  # where mixed precision steps aside, and larger batches say nothing new
        how, size = dict(list(how.items())[:2]), replace(size, batches=size.batches[:1])
    others = ["act", *(["decision_transformer"] if find_spec("transformers") else [])]
    yield from (update(config, variant, size.batches[0]) for variant in list(how)[:2] for config in CONFIGS)
    for name in others:
        yield "updates", name, size.batches[0], partial(updating_another, name, size, size.batches[0], device)
    for count in size.environments:
        yield "acting", "unimask", count, partial(acting, "unimask", settings, roots["maze2d"], count, size.calls)
        for name in others:
            yield "acting", name, count, partial(acting_another, name, size, count, device)
    for batch in reversed(size.batches[1:]):
        yield from (update("maze2d", variant, batch) for variant in list(how)[:2])
    yield from (update(config, variant, size.batches[0]) for variant in list(how)[2:] for config in CONFIGS)


def updating(config: Path, root: Path, size: Size, batch: int, arguments: Sequence[str]) -> dict[str, Any]:
    """lerobot-train itself, without checkpoints and evaluations: an update from batch to batch, its data included."""
    cycle, began, profiler = lerobot_train.cycle, [], _profiler()

    def watched(loader: Any) -> Iterator[Any]:
        for number, windows in enumerate(cycle(loader)):
            began.append(time.perf_counter())  # lerobot-train has read the last loss by now
            if number == WARM_UP + size.updates:
                profiler.start()
            elif number == WARM_UP + size.updates + size.profiled:
                profiler.stop()
            yield windows

    lerobot_train.cycle = watched
    run_lerobot_train(config, root, WARM_UP + size.updates + size.profiled + 1, arguments)
    return _found(np.diff(began)[WARM_UP : WARM_UP + size.updates], batch, profiler, size.profiled)


def updating_another(name: str, size: Size, batch: int, device: str) -> dict[str, Any]:
    """A plain loop of updates of another policy, on windows of Maze2D's sizes that stay on the device."""
    torch.set_num_threads(1)
    model, loss_of = _another(name, batch, device)
    model.train()
    optimiser = torch.optim.AdamW(model.parameters(), fused=torch.device(device).type in ("cpu", "cuda"))
    began, profiler = [], _profiler()
    for number in range(WARM_UP + size.updates + size.profiled + 1):
        began.append(now())
        if number == WARM_UP + size.updates:
            profiler.start()
        loss = loss_of()
        loss.backward()
        optimiser.step()
        optimiser.zero_grad()
        loss.item()
    profiler.stop()
    found = _found(np.diff(began)[WARM_UP : WARM_UP + size.updates], batch, profiler, size.profiled + 1)
    return {**found, "parameters": sum(parameter.numel() for parameter in model.parameters())}


def acting_another(name: str, size: Size, environments: int, device: str) -> dict[str, Any]:
    """Milliseconds of another policy's forward pass, which it needs for an action."""
    torch.set_num_threads(1)
    model, loss_of = _another(name, environments, device)
    model.eval()
    ends = []
    with torch.inference_mode():
        for _ in range(WARM_UP + size.calls + 1):
            loss_of()
            ends.append(now())
    parameters = sum(parameter.numel() for parameter in model.parameters())
    return {"latency_ms": spread((1000 * np.diff(ends)[WARM_UP:]).tolist()), "parameters": parameters}


def _another(name: str, batch: int, device: str) -> tuple[nn.Module, Callable[[], torch.Tensor]]:
    """A model, and what computes its loss, or in evaluation one number of its answer, for a batch of windows."""
    if name == "act":
        config = make_policy_config(
            "act",
            input_features={OBS_ENV_STATE: PolicyFeature(FeatureType.ENV, (STATE,))},
            output_features={ACTION: PolicyFeature(FeatureType.ACTION, (ACTIONS,))},
            push_to_hub=False,
            device=device,
        )
        policy = get_policy_class("act")(config).to(device)
        chunk = config.chunk_size
        windows = {
            **dict.fromkeys((OBS_STATE, OBS_ENV_STATE), torch.randn(batch, STATE, device=device)),
            ACTION: torch.randn(batch, chunk, ACTIONS, device=device),
            "action_is_pad": torch.zeros(batch, chunk, dtype=torch.bool, device=device),
        }
        observation = {name: windows[name] for name in (OBS_STATE, OBS_ENV_STATE)}

        def run_act() -> torch.Tensor:
            return policy.forward(windows)[0] if policy.training else policy.predict_action_chunk(observation).sum()

        return policy, run_act
    model, draw = transformers_own(STATE, ACTIONS, layers=4, heads=4, device=device)
    return model, draw(batch)


def _profiler() -> profile:
    activities = [ProfilerActivity.CPU]
    return profile(activities=activities + [ProfilerActivity.CUDA] * torch.cuda.is_available())


def _found(seconds: np.ndarray, batch: int, profiler: profile, profiled: int) -> dict[str, Any]:
    """An update's time, and what the profiler counted of it; on a processor there are no launches to count."""
    step = float(np.median(seconds))
    found = {"step_ms": spread((1000 * seconds).tolist()), "windows_per_second": batch / step}
    if torch.cuda.is_initialized():
        rows = profiler.key_averages()
        kernels = sum(row.self_device_time_total for row in rows if str(row.device_type).endswith("CUDA")) / 1e6
        found |= {
            "launches": sum(row.count for row in rows if "Launch" in row.key and row.key.startswith("cu")) / profiled,
            "waits": sum(row.count for row in rows if row.key.endswith("Synchronize")) / profiled,
            "kernel_ms": 1000 * kernels / profiled,
            "kernel_share": kernels / profiled / step,
        }
    return {**found, "threads": torch.get_num_threads()}
