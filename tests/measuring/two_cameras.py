"""Memory and waiting of lerobot-train on a recording of two cameras of 640 x 480 at 30 Hz, by LeRobot's own writer.

    OMP_NUM_THREADS=1 uv run python tests/measuring/two_cameras.py --output=docs/results/two_cameras.json

Noise and ramps, the policy's settings at their defaults; twice: the frames are decoded in the first run.
"""

import argparse
import os
import re
import resource
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
FOLDER = tempfile.TemporaryDirectory()
os.environ.update(HF_LEROBOT_HOME=FOLDER.name + "/home", HF_HUB_OFFLINE="1")

import commands  # noqa: E402
import numpy as np  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402

import lerobot_policy_unimask  # noqa: E402, F401
from lerobot_unimask.data.frames import stored_files  # noqa: E402
from lerobot_unimask.machine import describe_machine  # noqa: E402
from lerobot_unimask.records import versions, write_json  # noqa: E402

CAMERAS = ("observation.images.front", "observation.images.wrist")
JOINTS = [f"{joint}.pos" for joint in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")]


def record(root: Path, episodes: int, steps: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = {"dtype": "video", "shape": (480, 640, 3), "names": ["height", "width", "channels"]}
    joints = {"dtype": "float32", "shape": (6,), "names": [*JOINTS, "gripper.pos"]}
    features = {"observation.state": joints, "action": joints, **dict.fromkeys(CAMERAS, camera)}
    dataset = LeRobotDataset.create("local/arm", 30, features, root=root, use_videos=True, robot_type="so101_follower")
    ramp = np.add.outer(np.arange(480), np.arange(640))[..., None] * np.array([1, 2, 3])
    noise = rng.integers(8, size=(16, *ramp.shape))
    for _ in range(episodes):
        for step in range(steps):
            pictures = {key: ((ramp + 9 * step + noise[step % 16]) % 256).astype(np.uint8) for key in CAMERAS}
            numbers = {key: rng.normal(size=6).astype(np.float32) for key in ("observation.state", "action")}
            dataset.add_frame({**pictures, **numbers, "task": "pick up the cube"})
        dataset.save_episode()
    dataset.finalize()


def train(root: Path, run: str, steps: int, batch: int) -> dict[str, Any]:
    """One training in a forked process: its seconds, and of its updates and their waiting for data the medians."""
    began, before = time.perf_counter(), os.times()
    flags = ["--policy.type=unimask", "--policy.push_to_hub=false", "--policy.device=cpu", "--num_workers=0"]
    flags += ["--policy.context_length=10"]
    data = ["--dataset.repo_id=local/arm", f"--dataset.root={root}", f"--steps={steps}", f"--batch_size={batch}"]
    log = commands.check(
        "lerobot-train",
        *flags,
        *data,
        "--log_freq=1",
        "--save_checkpoint=false",
        f"--output_dir={run}",
        cwd=root.parent,
    )
    after = os.times()
    found = [tuple(map(float, pair)) for pair in re.findall(r"updt_s:(\S+) data_s:(\S+)", log)][2:]
    updates, waits = zip(*found, strict=True)
    return {
        "seconds": time.perf_counter() - began,
        "processor_seconds": sum(after[2:4]) - sum(before[2:4]),
        "update_seconds": statistics.median(updates),
        "data_seconds": statistics.median(waits),
        "share_of_waiting": sum(waits) / (sum(waits) + sum(updates)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--steps", type=int, default=300, help="of an episode; default: %(default)s")
    parser.add_argument("--updates", type=int, default=40)
    parser.add_argument("--batch_size", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    commands.SECONDS = 3000
    root = Path(FOLDER.name) / "arm"
    if os.fork() == 0:  # what encoding takes is not the training's
        record(root, arguments.episodes, arguments.steps, arguments.seed)
        os._exit(0)
    assert os.wait()[1] == 0
    encoding = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    runs = [train(root, f"run{i}", arguments.updates, arguments.batch_size) for i in range(2)]
    write_json(
        arguments.output,
        {
            "what": "lerobot-train on two cameras of 640 x 480 at 30 Hz; the first run decodes their frames",
            "units": "seconds of wall time on a machine shared with other work; bytes",
            "command": f"python tests/measuring/two_cameras.py {' '.join(sys.argv[1:])}",
            "settings": {k: v for k, v in vars(arguments).items() if k != "output"},
            "runs": runs,
            "peak_memory_bytes": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024,
            "peak_memory_bytes_of_encoding": encoding * 1024,
            "cache_bytes": sum(size for _, size in stored_files()),
            "video_bytes": sum(path.stat().st_size for path in root.rglob("*.mp4")),
            "machine": {**describe_machine(), "load": os.getloadavg()[0]},
            "versions": versions(),
        },
    )


if __name__ == "__main__":
    main()
