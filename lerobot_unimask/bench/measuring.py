"""`unimask bench`: how fast this machine reads, trains, acts, evaluates and builds, each beside its baseline.

Every measurement runs in a process of its own, so that its peak memory is its own. These processes are forked from one
that has imported everything and computed nothing; what such a process occupies is in the record as `imports`. Weights
are untrained, which costs the same. With a GPU, clocks wait for it and its peak memory is recorded too; what a GPU
itself does is measured by `device.py`.
"""

import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
import yaml
from accelerate import Accelerator
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class, make_policy, make_policy_config
from lerobot.scripts import lerobot_train
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.data import default_collate

from dataset_builders.doorkey import build_doorkey
from dataset_builders.maze2d import HORIZON, build_maze2d
from lerobot_unimask import evaluating as lerobot_evaluation
from lerobot_unimask.bench.clock import Stopwatch, alone, circumstances, now, spread
from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.factors import RETURN_SO_FAR
from lerobot_unimask.envs.maze2d.environment import Maze2DEnv
from lerobot_unimask.language.training_masks import TrainingMasks
from lerobot_unimask.modeling_unimask import UniMASKPolicy
from lerobot_unimask.networks.transformer import Transformer
from lerobot_unimask.training import Trainer

WARM_UP = 2  # updates or calls that do not count

CONFIGS = {"doorkey": "doorkey.yaml", "maze2d": "maze2d_k10.yaml"}

POLICIES = ("unimask", "act", "diffusion")


@dataclass(frozen=True)
class Size:
    """How much is measured."""

    episodes: dict[str, int]  # of the data sets
    repeats: int  # of reading and building
    batch_size: int
    updates: int
    slow_updates: int  # of what may take a second for each
    calls: int  # of select_action
    environments: tuple[int, ...]
    rollouts: int
    growth: dict[str, tuple[int, ...]]  # what grows -> its values


FULL = Size(
    episodes={"doorkey": 1500, "maze2d": 1000},
    repeats=5,
    batch_size=100,
    updates=100,
    slow_updates=4,
    calls=100,
    environments=(1, 10, 100),
    rollouts=1000,
    growth={
        "context_length": (5, 10, 20, 50, 100, 200),
        "width": (64, 128, 256, 512),
        "batch_size": (25, 50, 100, 200, 400),
        "episodes": (100, 300, 1000, 3000),
    },
)

QUICK = Size(
    episodes={"doorkey": 60, "maze2d": 8},
    repeats=1,
    batch_size=8,
    updates=3,
    slow_updates=2,
    calls=2,
    environments=(1,),
    rollouts=2,
    growth={"context_length": (5, 10), "width": (16, 32), "batch_size": (8, 16), "episodes": (4, 8)},
)


def bench(configs: Path, *, quick: bool = False) -> dict[str, Any]:
    """Measure everything, in minutes; `quick`, in one, for the sake of a test.

    Args:
        configs: the folder of the DoorKey and Maze2D configs.

    Raises:
        FileNotFoundError: it does not hold them.
    """
    check_configs(configs)
    size = QUICK if quick else FULL
    began = time.monotonic()
    record: dict[str, Any] = {
        "what": "medians and quartiles over repetitions; peak memory of each measurement's own process",
        "quick": quick,
        **circumstances(),
    }
    with tempfile.TemporaryDirectory() as folder:
        roots = {name: Path(folder) / name for name in CONFIGS}
        build_doorkey(roots["doorkey"], episodes=size.episodes["doorkey"], expert="released", progress=False)
        build_maze2d(roots["maze2d"], episodes=size.episodes["maze2d"], progress=False)
        settings = {name: yaml.safe_load((configs / file).read_text()) for name, file in CONFIGS.items()}
        record["imports"] = alone("imports", nothing)
        record["reading"] = {
            who: alone(
                f"reading, {who}",
                reading,
                roots["doorkey"],
                item_by_item=who == "lerobot",
                windows=size.batch_size,
                repeats=size.repeats,
            )
            for who in ("lerobot", "unimask")
        }
        record["training"] = _training(size, configs, roots)
        policy = settings["maze2d"]["policy"], roots["maze2d"]
        record["acting"] = {
            name: {
                str(count): alone(f"acting, {name}, {count} environments", acting, name, *policy, count, size.calls)
                for count in size.environments
            }
            for name in POLICIES
            if name != "diffusion" or find_spec("diffusers")
        }
        record["building"] = {
            who: alone(who, building, who, size.episodes["maze2d"], size.repeats) for who in ("stepping", "building")
        }
        record["evaluating"] = alone("evaluating", evaluating, *policy, size.rollouts)
        record["growth"] = _growth(size, settings["maze2d"]["policy"], Path(folder))
    record["seconds"] = round(time.monotonic() - began)
    return record


def check_configs(configs: Path) -> None:
    """
    Raises:
        FileNotFoundError: the folder does not hold the configs that are measured.
    """
    missing = [name for name in CONFIGS.values() if not (configs / name).exists()]
    if missing:
        raise FileNotFoundError(
            f"{configs} holds no {' and no '.join(missing)}: give the repository's folder of configs."
        )


def _training(size: Size, configs: Path, roots: Mapping[str, Path]) -> dict[str, Any]:
    """lerobot-train with both configs as they are, and with one thing changed."""
    variants: dict[str, tuple[str, list[str], dict[str, bool]]] = {
        "doorkey": ("doorkey", [], {}),
        "doorkey, LeRobot's reads": ("doorkey", [], {"batched_reads": False}),
        "maze2d": ("maze2d", [], {}),
        "maze2d, float32": ("maze2d", ["--policy.use_amp=false"], {}),
        "maze2d, float32, explicit attention": ("maze2d", ["--policy.use_amp=false"], {"explicit_attention": True}),
    }
    found = {}
    for name, (config, arguments, changes) in variants.items():
        updates = size.slow_updates if "batched_reads" in changes else size.updates
        arguments = [f"--batch_size={size.batch_size}", *arguments]
        path, root = configs / CONFIGS[config], roots[config]
        found[name] = alone(f"training, {name}", training, path, root, updates, arguments, **changes)
    return found


def _growth(size: Size, policy: Mapping[str, Any], folder: Path) -> dict[str, list[dict[str, Any]]]:
    """An update's time and memory while one thing grows and all else is as in the Maze2D config."""
    found: dict[str, list[dict[str, Any]]] = {}
    for what, values in size.growth.items():
        for value in values:
            root, batch_size, settings = folder / "maze2d", size.batch_size, dict(policy)
            if what == "episodes":
                root = folder / f"maze2d_{value}"
                build_maze2d(root, episodes=value, progress=False)
            elif what == "batch_size":
                batch_size = value
            else:
                settings[what] = value
            if what == "width":
                settings["feedforward_width"] = 4 * value
            cost = alone(f"{what} = {value}", updating, settings, root, batch_size, size.slow_updates)
            found.setdefault(what, []).append({what: value, **cost})
    return found


def nothing() -> dict[str, Any]:
    """What importing alone occupies."""
    return {}


def reading(root: Path, *, item_by_item: bool, windows: int, repeats: int, context_length: int = 10) -> dict[str, Any]:
    """Windows read and collated per second, in batches."""
    meta = LeRobotDatasetMetadata("local/dataset", root=root)
    seconds = [step / meta.fps for step in range(context_length)]
    keys = (OBS_STATE, ACTION, "observation.return_to_go")
    dataset = LeRobotDataset("local/dataset", root=root, delta_timestamps=dict.fromkeys(keys, seconds))
    watch = Stopwatch()
    for draw in range(repeats + 1):
        indices = np.random.default_rng(draw).integers(len(dataset), size=windows).tolist()
        with watch("batch"):
            default_collate([dataset[i] for i in indices] if item_by_item else dataset.__getitems__(indices))
    return {"windows_per_second": spread([windows / s for s in watch.seconds["batch"][1:]])}


def training(
    config: Path,
    root: Path,
    updates: int,
    arguments: Sequence[str],
    *,
    batched_reads: bool = True,
    explicit_attention: bool = False,
) -> dict[str, Any]:
    """lerobot-train itself, without checkpoints and evaluations: an update's time and what it is spent on.

    `data` is the wait for the next batch; `forward` excludes the drawing of masks; `optimiser` is the rest of LeRobot's
    update: clipping, stepping, reading the loss; `rest` is LeRobot's loop around it: moving the batch, logging.
    """
    watch = Stopwatch()
    watch.wrap(lerobot_train, "update_policy", "update")
    watch.wrap(UniMASKPolicy, "forward", "forward")
    watch.wrap(TrainingMasks, "forward", "masks")
    watch.wrap(Accelerator, "backward", "backward")
    cycle = lerobot_train.cycle

    def timed_cycle(loader: Any) -> Iterator[Any]:
        batches = cycle(loader)
        while True:
            with watch("data"):
                batch = next(batches)
            yield batch

    lerobot_train.cycle = timed_cycle
    if not batched_reads:
        LeRobotDataset.__getitems__ = None  # in this process, which measures nothing else
    with sdpa_kernel(SDPBackend.MATH) if explicit_attention else nullcontext():
        run_lerobot_train(config, root, updates + WARM_UP + 1, arguments)  # the last one's end is not seen
    step = np.diff(watch.began["data"])
    piece = {name: np.array(seconds[: len(step)]) for name, seconds in watch.seconds.items()}
    pieces = {
        "data": piece["data"],
        "masks": piece["masks"],
        "forward": piece["forward"] - piece["masks"],
        "backward": piece["backward"],
        "optimiser": piece["update"] - piece["forward"] - piece["backward"],
        "rest": step - piece["data"] - piece["update"],
    }
    counted = step[WARM_UP:]
    return {
        "step_ms": spread((1000 * counted).tolist()),
        "steps_per_second": 1 / np.median(counted),
        "share": {name: seconds[WARM_UP:].sum() / counted.sum() for name, seconds in pieces.items()},
        "threads": torch.get_num_threads(),
    }


def run_lerobot_train(config: Path, root: Path, steps: int, arguments: Sequence[str]) -> None:
    """lerobot-train's own function in this process, without checkpoints and evaluations."""
    with tempfile.TemporaryDirectory() as folder:
        overrides = {
            "dataset.root": root,
            "dataset.eval_split": 0,
            "steps": steps,
            "eval_steps": 0,
            "env_eval_freq": 0,
            "save_checkpoint": "false",
            "output_dir": Path(folder) / "run",
        }
        flags = [f"--{name}={value}" for name, value in overrides.items()]
        lerobot_train.train(draccus.parse(TrainPipelineConfig, config, args=[*flags, *arguments]))


def acting(name: str, settings: Mapping[str, Any], root: Path, environments: int, calls: int) -> dict[str, Any]:
    """Milliseconds of `select_action` on one thread, each policy asked anew at every step, after a window's worth of
    calls.

    LeRobot's own by default ask once for a chunk of actions and hand out one of them at each call; how many is in the
    record. Diffusion denoises in so many passes: one is measured, and multiplied.
    """
    torch.set_num_threads(1)
    passes, chunk = 1, 1
    if name == "unimask":
        policy = _maze_policy(settings, root)
        lead = policy.config.context_length
    else:
        numbers = {OBS_STATE: 4, OBS_ENV_STATE: 4} if name == "diffusion" else {OBS_ENV_STATE: 4}
        config = make_policy_config(
            name,
            input_features={key: PolicyFeature(FeatureType.ENV if key == OBS_ENV_STATE else FeatureType.STATE, (size,))
                            for key, size in numbers.items()},
            output_features={ACTION: PolicyFeature(FeatureType.ACTION, (2,))},
            push_to_hub=False,
        )  # fmt: skip
        chunk, config.n_action_steps, lead = config.n_action_steps, 1, WARM_UP
        if name == "diffusion":
            passes, config.num_inference_steps = config.num_train_timesteps, 1
            calls = min(calls, 4)
        policy = get_policy_class(name)(config).to(config.device).eval()
    observation = torch.zeros(environments, 4, device=policy.config.device)
    batch = {OBS_STATE: observation, OBS_ENV_STATE: observation, RETURN_SO_FAR: observation[:, :1]}
    watch = Stopwatch()
    policy.reset()
    with torch.inference_mode(), _autocast(policy.config):
        for _ in range(lead + calls):
            with watch("call"):
                policy.select_action(dict(batch))
    return {
        "latency_ms": spread([1000 * passes * seconds for seconds in watch.seconds["call"][lead:]]),
        "passes": passes,
        "actions_per_chunk": chunk,
        "parameters": sum(parameter.numel() for parameter in policy.parameters()),
    }


def evaluating(settings: Mapping[str, Any], root: Path, rollouts: int) -> dict[str, Any]:
    """lerobot-eval, videos apart, on Maze2D with 100 environments side by side: milliseconds of a rollout, and of what.

    `forward` is the network, `acting` what this package does around it, `environment` its own `step` methods, `lerobot`
    the rest: gymnasium's vector environments, LeRobot's processors, bookkeeping and progress bars.
    """
    policy = _maze_policy(settings, root)
    watch = Stopwatch()
    watch.wrap(Transformer, "forward", "forward")
    watch.wrap(UniMASKPolicy, "select_action", "acting")
    watch.wrap(Maze2DEnv, "step", "environment")
    watch.wrap(lerobot_evaluation, "eval_policy_all", "evaluation")
    count = min(100, rollouts)
    with tempfile.TemporaryDirectory() as folder, _autocast(policy.config):
        policy.save_pretrained(folder)
        lerobot_evaluation.rollout(Path(folder), "maze2d", rollouts, batch_size=count, seed=0)
    total, acting, forward, environment = (
        1000 * sum(watch.seconds[name]) / rollouts for name in ("evaluation", "acting", "forward", "environment")
    )
    parts = {"forward": forward, "acting": acting - forward, "environment": environment}
    return {
        "rollouts": rollouts,
        "environments": count,
        "rollouts_per_second": 1000 / total,
        "ms_per_rollout": {"total": total, **parts, "lerobot": total - sum(parts.values())},
        "threads": torch.get_num_threads(),
    }


def building(what: str, episodes: int, repeats: int) -> dict[str, Any]:
    """Milliseconds of a Maze2D episode: `stepping` the environment in a plain loop, or `building` a dataset."""
    measure = stepping_seconds if what == "stepping" else building_seconds
    return {
        "ms_per_episode": spread([1000 * measure(episodes) / episodes for _ in range(repeats)]),
        "episodes": episodes,
        "steps": episodes * HORIZON,
    }


def stepping_seconds(episodes: int) -> float:
    """Of a plain loop of `env.step`, with actions drawn beforehand and a reset for each episode."""
    env = Maze2DEnv()
    actions = np.random.default_rng(0).uniform(-1, 1, (episodes, HORIZON, 2)).astype(np.float32)
    start = time.perf_counter()
    for seed, episode in enumerate(actions):
        env.reset(seed=seed)
        for action in episode:
            env.step(action)
    return time.perf_counter() - start


def building_seconds(episodes: int) -> float:
    """Of `build_maze2d`, files included, into a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        build_maze2d(Path(folder) / "maze2d", episodes=episodes, progress=False)
        return time.perf_counter() - start


def updating(settings: Mapping[str, Any], root: Path, batch_size: int, updates: int) -> dict[str, Any]:
    """Milliseconds of an update, read, drawn and made."""
    settings = {name: value for name, value in settings.items() if name != "type"}
    trainer = Trainer(settings, root, seed=0, steps=updates + WARM_UP, batch_size=batch_size)
    ends = [now() for _ in trainer]
    return {"step_ms": spread((1000 * np.diff(ends)[WARM_UP - 1 :]).tolist())}


def _maze_policy(settings: Mapping[str, Any], root: Path) -> UniMASKPolicy:
    """An untrained policy of the Maze2D config."""
    config = UniMASKConfig(**{name: value for name, value in settings.items() if name != "type"})
    return make_policy(config, ds_meta=LeRobotDatasetMetadata("local/dataset", root=root)).eval()


def _autocast(config: PreTrainedConfig) -> torch.autocast:
    """As lerobot-eval has it."""
    return torch.autocast(torch.device(config.device).type, enabled=config.use_amp)
