"""What ten million frames cost: the memory and time of `lerobot-train`, and windows trained on and read per
second, beside a dataset a thousand times smaller.

    OMP_NUM_THREADS=1 uv run python tests/measuring/scale.py --output=docs/results/scale.json

builds both datasets in a temporary folder (2 GB with the caches; building takes minutes and 4 GB of memory) and
measures each in a process of its own, with warm caches; with `--look` it measures the look for numbers that are not
finite alone. `test_scale.py` holds the figures to what is promised.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from lerobot_unimask.machine import describe_machine
from lerobot_unimask.records import read_json, versions, write_json

STEPS = 200  # of an episode
BATCH = 100
UPDATES = 200
POLICY = ["--policy.type=unimask", "--policy.push_to_hub=false", "--policy.device=cpu", "--policy.width=16"]
POLICY += ["--policy.context_length=10", "--policy.depth=1", "--policy.heads=2", "--policy.feedforward_width=16"]


def build(root: Path, frames: int) -> None:
    """A dataset with Maze2D's columns, of noise."""
    import numpy as np

    from dataset_builders.writer import write_dataset

    def numbers(size: int, dtype: str = "float32") -> dict:
        return {"dtype": dtype, "shape": (size,), "names": None}

    features = {"observation.state": numbers(4), "action": numbers(2), "observation.return_to_go": numbers(1)}
    features |= {"next.reward": numbers(1), "next.done": numbers(1, "bool")}
    generator = np.random.default_rng(0)
    columns = {
        key: generator.standard_normal((frames, *feature["shape"]), dtype=np.float32)
        for key, feature in features.items()
        if key != "next.done"
    }
    columns["next.done"] = (np.arange(frames) % STEPS == STEPS - 1)[:, None]
    write_dataset(
        root,
        repo_id="local/scale",
        fps=10,
        features=features,
        columns=columns,
        lengths=np.full(frames // STEPS, STEPS),
        task="none",
        robot_type="none",
        provenance={},
    )


def memory() -> dict[str, int]:
    """Megabytes resident now: the peak so far, and of what is resident what is memory-mapped from files."""
    lines = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    kilobytes = {name: int(lines[name].split()[0]) for name in ("VmRSS", "VmHWM", "RssFile")}
    return {
        "now": kilobytes["VmRSS"] // 1000,
        "peak": kilobytes["VmHWM"] // 1000,
        "mapped": kilobytes["RssFile"] // 1000,
    }


def measure(root: Path) -> dict:
    """Train for a few updates with LeRobot's own command, then read on; in a process that has done nothing else."""
    import torch
    from lerobot.datasets import factory
    from lerobot.scripts import lerobot_train
    from lerobot.utils.utils import cycle

    import lerobot_unimask

    torch.set_num_threads(1)
    seconds, megabytes, loaders = {}, {"imports": memory()}, []

    def note(name: str) -> None:
        if name not in seconds:
            seconds[name], megabytes[name] = time.perf_counter() - started, memory()

    def make_dataset(cfg):
        nonlocal started
        started = time.perf_counter()
        dataset = lerobots_make_dataset(cfg)
        note("opened")  # LeRobot's own share: nothing of this project has read yet
        return dataset

    def forward(self, batch):
        note("first_batch")
        return policy_forward(self, batch)

    def keep(loader):
        loaders.append(loader)
        return cycle(loader)

    started = time.perf_counter()
    lerobots_make_dataset, factory.make_dataset = factory.make_dataset, make_dataset
    policy_forward, lerobot_unimask.UniMASKPolicy.forward = lerobot_unimask.UniMASKPolicy.forward, forward
    lerobot_train.cycle = keep
    with TemporaryDirectory() as folder:
        data = ["--dataset.repo_id=local/scale", f"--dataset.root={root}", f"--batch_size={BATCH}", "--num_workers=0"]
        run = [f"--steps={UPDATES}", "--save_checkpoint=false", f"--output_dir={folder}/run"]
        sys.argv = ["lerobot-train", *POLICY, *data, *run]
        lerobot_train.main()
    note("trained")

    batches, rates = cycle(loaders[0]), []
    for _ in range(20):
        now = time.perf_counter()
        for _ in range(50):
            next(batches)
        rates.append(50 * BATCH / (time.perf_counter() - now))
    note("read")
    return {
        "frames": loaders[0].dataset.num_frames,
        "seconds": {name: round(value, 2) for name, value in seconds.items()},
        "megabytes": megabytes,
        "megabytes_beyond_imports": megabytes["read"]["peak"] - megabytes["imports"]["now"],
        "windows_trained_per_second": round((UPDATES - 1) * BATCH / (seconds["trained"] - seconds["first_batch"])),
        "windows_read_per_second": round(max(rates)),
    }


def record(frames: int) -> dict:
    """The figures of a dataset of so many frames and of one a thousand times smaller, each from a fresh process."""
    results = {}
    with TemporaryDirectory() as folder:
        environment = os.environ | {
            "HF_DATASETS_CACHE": f"{folder}/cache",
            "HF_HUB_OFFLINE": "1",
            "OMP_NUM_THREADS": "1",
        }

        def run(*arguments: str) -> str:
            command = [sys.executable, __file__, *arguments]
            done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=1800)
            if done.returncode:
                raise RuntimeError(done.stderr[-3000:])
            return done.stdout

        for name, size in {"small": frames // 1000, "large": frames}.items():
            root = f"{folder}/{name}"
            run("--build", root, f"--frames={size}")
            run("--measure", root)  # fills datasets' cache
            results[name] = json.loads(run("--measure", root).splitlines()[-1])
    rates = ("windows_trained_per_second", "windows_read_per_second")
    return {
        **results,
        "large_over_small": {rate: round(results["large"][rate] / results["small"][rate], 3) for rate in rates},
        "machine": describe_machine(),
        "versions": versions("datasets", "pyarrow", "numpy"),
    }


def look(frames: int) -> dict:
    """Seconds of the look for numbers that are not finite, at the columns that an arm's policy reads, 13 numbers a
    frame: five times anew, in warm files, and once at a dataset that has been looked through."""
    import numpy as np
    import pyarrow as pa
    import pyarrow.parquet as pq

    with TemporaryDirectory() as folder:
        os.environ["HF_LEROBOT_HOME"] = folder
        from lerobot_unimask.data import soundness

        sizes, root = {"observation.state": 7, "action": 6}, Path(folder) / "data"
        path = root / "data" / "chunk-000" / "file-000.parquet"
        path.parent.mkdir(parents=True)
        generator = np.random.default_rng(0)
        columns = {
            key: pa.FixedSizeListArray.from_arrays(generator.standard_normal(frames * size, dtype=np.float32), size)
            for key, size in sizes.items()
        }
        pq.write_table(pa.table({**columns, "episode_index": np.arange(frames) // STEPS}), path)
        del columns
        found = []
        for _ in range(6):
            wall, processor = time.perf_counter(), time.process_time()
            soundness.check_columns(root, {key: [""] * size for key, size in sizes.items()})
            found.append((time.perf_counter() - wall, time.process_time() - processor))
            if len(found) < 5:
                for marker in soundness.SEEN.iterdir():
                    marker.unlink()
    wall, processor = zip(*((round(a, 4), round(b, 4)) for a, b in found), strict=True)
    return {
        "frames": frames,
        "numbers": sum(sizes.values()),
        "wall_seconds": wall[:5],
        "processor_seconds": processor[:5],
        "again_wall_seconds": wall[5],
        "machine": describe_machine(),
        "versions": versions("pyarrow", "numpy"),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10_000_000)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--look", action="store_true", help="measure the look for unsound numbers, and nothing else")
    parser.add_argument("--build", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.build:
        build(arguments.build, arguments.frames)
    elif arguments.measure:
        print(json.dumps(measure(arguments.measure)))
    else:
        before = read_json(arguments.output) if arguments.output and arguments.output.exists() else {}
        result = {**before, "command": "python tests/measuring/scale.py"}
        result |= {"look": look(arguments.frames)} if arguments.look else record(arguments.frames)
        print(json.dumps(result, indent=2))
        if arguments.output:
            write_json(arguments.output, result)
