"""Windows with a camera read per second, batched from cached frames and item by item by LeRobot, in one run.

    python tests/measuring/frames.py --output=docs/results/frames.json

One camera of 96 x 96, K = 10, 20 episodes of 150 steps of video, made by LeRobot's own writer from noise and ramps.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data import default_collate

from lerobot_unimask.data import frames, reads
from lerobot_unimask.machine import describe_machine
from lerobot_unimask.records import versions, write_json

KEY, SIDE, K, EPISODES, STEPS, BATCH, SEED = "observation.images.top", 96, 10, 20, 150, 64, 0


def record(root: Path) -> None:
    rng = np.random.default_rng(SEED)
    features = {
        KEY: {"dtype": "video", "shape": (SIDE, SIDE, 3), "names": ["height", "width", "channels"]},
        "action": {"dtype": "float32", "shape": (2,), "names": None},
    }
    dataset = LeRobotDataset.create("local/ramps", 10, features, root=root, use_videos=True)
    ramp = np.add.outer(np.arange(SIDE), np.arange(SIDE))[..., None]
    for _ in range(EPISODES):
        for step in range(STEPS):
            picture = (ramp + 3 * step + rng.integers(8, size=(SIDE, SIDE, 3))) % 256
            frame = {KEY: picture.astype(np.uint8), "action": np.zeros(2, np.float32), "task": "look"}
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()


def main(output: Path, folder: Path) -> None:
    record(folder / "dataset")
    steps = [step / 10 for step in range(K)]
    dataset = LeRobotDataset("local/ramps", root=folder / "dataset", delta_timestamps={KEY: steps, "action": steps})
    rng = np.random.default_rng(SEED)
    frames.frames_folder = lambda: folder / "cache"
    began = time.perf_counter()
    reads.serve_frames(dataset, [KEY], (SIDE, SIDE))
    first_pass = time.perf_counter() - began
    read = reads.batched_read(dataset)
    largest = 0.0
    rates: dict[str, list[float]] = {"lerobot": [], "cached": []}
    for _ in range(3):  # the two in turn
        chosen = rng.integers(len(dataset), size=BATCH).tolist()
        began = time.perf_counter()
        single = default_collate([dataset[i] for i in chosen])
        rates["lerobot"].append(BATCH / (time.perf_counter() - began))
        many = [rng.integers(len(dataset), size=BATCH).tolist() for _ in range(50)]
        began = time.perf_counter()
        for indices in many:
            default_collate(read(indices))
        rates["cached"].append(50 * BATCH / (time.perf_counter() - began))
        largest = max(largest, float((read(chosen).batch[KEY] - single[KEY] * 255).abs().max()))
    medians = {name: float(np.median(values)) for name, values in rates.items()}
    result = {
        "config": {"side": SIDE, "K": K, "episodes": EPISODES, "steps": STEPS, "batch": BATCH, "seed": SEED},
        "windows_per_second": medians,
        "windows_per_second_each": rates,
        "times_as_many": medians["cached"] / medians["lerobot"],
        "largest_difference_in_grey_levels": largest,
        "first_pass_seconds": first_pass,
        "cache_bytes": sum(size for _, size in frames.stored_files(folder / "cache")),
        "video_bytes": sum(path.stat().st_size for path in (folder / "dataset").rglob("*.mp4")),
        "backend": dataset._video_backend,
        "versions": versions("torchcodec", "av"),
        "machine": describe_machine(),
    }
    write_json(output, result)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        main(Path(sys.argv[1].removeprefix("--output=")), Path(temporary))
