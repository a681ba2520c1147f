"""Attacks by what hinders a process: kills, full disks, homes that cannot be written, another locale."""

import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import commands
import numpy as np
from attack_ground import CONFIG, HOME, HUB, Outcome, attempt, complete, duration, forked, push_policy, small_policy
from lerobot.common.train_utils import update_last_checkpoint
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts import lerobot_train
from policies import TRAIN_FLAGS

from dataset_builders.doorkey import build_doorkey
from dataset_builders.prepare import make_plan, prepare
from lerobot_unimask import UniMASKPolicy
from lerobot_unimask.data import frames
from lerobot_unimask.data.checkpoints import last_checkpoint
from lerobot_unimask.data.episodes import check_folder, first_windows, open_dataset, read_info
from lerobot_unimask.paper.study import run_study
from lerobot_unimask.records import write_json


def killed_builds(count: int, _: Path) -> Iterator[tuple[str, Outcome]]:
    """A build killed at any time leaves no dataset or a whole one; the next build succeeds."""
    draw = random.Random(0)
    whole = duration(lambda: build_doorkey(HOME / "warm", episodes=40, progress=False))
    for i in range(count):
        place = HOME / "builds" / str(i)
        forked(lambda p=place: build_doorkey(p, episodes=40, progress=False), kill_after=draw.uniform(0, 1.2 * whole))
        kind, lost = "refused", None
        if place.exists():
            kind, lost = attempt(lambda p=place: (check_folder(p), first_windows(open_dataset(CONFIG(), p))))
            lost = lost or (None if kind == "held" else "half a dataset")
        else:
            again, lost = attempt(lambda p=place: build_doorkey(p, episodes=40, progress=False))
            lost = lost or (None if again == "held" else "not to be built afterwards")
        shutil.rmtree(place, ignore_errors=True)
        yield kind, lost


def killed_pushes(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """A push killed at any time leaves all of it or nothing, and the next one finishes it."""
    folder, draw = HOME / "killed", random.Random(0)
    small_policy(root).save_pretrained(folder)
    seconds = duration(lambda: push_policy(folder, "me/unkilled"))
    for i in range(count):
        name = f"me/killed_{i}"
        forked(lambda n=name: push_policy(folder, n), kill_after=draw.uniform(0, 1.2 * seconds))
        there = HUB.repositories.get(("model", name))
        whole = there is not None and complete(there, "model")
        lost = "part of it is there" if there and len(there.files) > 1 and not whole else None
        again, wrong = attempt(lambda n=name: push_policy(folder, n))
        yield "held" if whole else "refused", lost or wrong or (None if again == "held" else "unfinished")


def full_disks(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """No file may grow beyond some bytes: a build, a record and a policy are there in full, or not at all."""
    draw, policy = random.Random(0), small_policy(root)
    record = HOME / "record.json"
    for i in range(count):
        most = int(10 ** draw.uniform(1, 5.5))
        if i % 2:
            place = HOME / "full" / str(i)
            status = forked(lambda p=place: build_doorkey(p, episodes=40, progress=False), most_bytes=most)
            whole = place.exists() and attempt(lambda p=place: open_dataset(policy.config, p))[0] == "held"
            lost = None if whole or not place.exists() else "half a dataset"
        else:
            write_json(record, {"before": 1}, say=False)
            status = forked(lambda: write_json(record, {"after": list(range(2000))}, say=False), most_bytes=most)
            lost = None if set(json.loads(record.read_text())) <= {"before", "after"} else "half a record"
        yield "held" if status == 0 else "refused", lost


def killed_saves(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """A run killed while it saves its checkpoints, one after another: its last whole one is taken."""
    draw, policy = random.Random(0), small_policy(root)
    seconds = duration(lambda: policy.save_pretrained(HOME / "saves" / "one"))
    for i in range(count):
        run = HOME / "saves" / str(i)

        def save(run=run):
            for step in range(1, 1000):
                folder = run / "checkpoints" / f"{step:06d}"
                policy.updates.fill_(step)
                policy.save_pretrained(folder / "pretrained_model")
                if step % 2:  # every other time, as if the link had not been set yet
                    update_last_checkpoint(folder)

        forked(save, kill_after=draw.uniform(0, 5 * seconds))
        begun = list(run.glob("checkpoints/*/pretrained_model/model.safetensors"))
        kind, lost = attempt(lambda run=run: UniMASKPolicy.from_pretrained(last_checkpoint(run)))
        yield kind, lost or (None if kind == "held" or len(begun) <= 1 else "no whole checkpoint")
        shutil.rmtree(run, ignore_errors=True)


def killed_prepares(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """`unimask prepare` killed at any time, into a new folder or in place: the old dataset or the new one is there,
    whole, and the next time succeeds."""

    def renamed(source: Path, output: Path | None) -> None:
        prepare(source, make_plan(source, rename={"observation.return_to_go": "observation.left"}), output=output)

    draw = random.Random(0)
    seconds = duration(lambda: renamed(root, HOME / "prepared"))
    for i in range(count):
        source = Path(shutil.copytree(root, HOME / "prepares" / str(i)))
        output = source.with_name(f"{i}_new") if i % 2 else None
        place = output or source
        begun = place.with_name(f".{place.name}.partial")
        forked(lambda s=source, o=output: renamed(s, o), kill_after=draw.uniform(0, seconds), kill_from=begun)
        kind, lost = "refused", None
        if place.exists():
            read, lost = attempt(lambda p=place: first_windows(open_dataset(CONFIG(), p)))
            kind = "held" if "observation.left" in read_info(place)["features"] else "refused"
            lost = lost or (None if read == "held" else "half a dataset")
        elif output is None:
            lost = "no dataset"
        if kind == "refused":
            again, wrong = attempt(lambda s=source, o=output: renamed(s, o))
            lost = lost or wrong or (None if again == "held" else "not to be prepared afterwards")
        shutil.rmtree(source.parent, ignore_errors=True)
        yield kind, lost


def killed_studies(count: int, _: Path) -> Iterator[tuple[str, Outcome]]:
    """A study of six runs killed at any time: the same call finishes it, each run with one record."""
    draw, runs = random.Random(0), [{"row": "row", "seed": seed} for seed in range(6)]

    def study(place: Path) -> None:
        run_study("attacked", runs, lambda run: {"loss": float(run["seed"])}, output=place, heartbeat=1)

    seconds = duration(lambda: study(HOME / "study"))
    for i in range(count):
        place = HOME / "studies" / str(i)
        forked(lambda p=place: study(p), kill_after=draw.uniform(0, 1.2 * seconds))
        done = len(list(place.glob("runs/*.json")))
        status = forked(lambda p=place: study(p))
        records = {path.stem: json.loads(path.read_text())["loss"] for path in place.glob("runs/*.json")}
        whole = status == 0 and records == {f"row-{seed}": float(seed) for seed in range(6)}
        yield "held" if done == len(runs) else "refused", None if whole else f"status {status}, {len(records)} records"
        shutil.rmtree(place, ignore_errors=True)


UPDATES = 5  # of a training here, each with its checkpoint
TRAIN = [*TRAIN_FLAGS, "--num_workers=0", "--batch_size=4", f"--steps={UPDATES}", "--save_freq=1"]
TRAIN += ["--env_eval_freq=0", "--dataset.repo_id=local/doorkey"]


def train(*flags: str) -> None:
    sys.argv = ["lerobot-train", *flags]
    commands.fresh(lerobot_train.main)()


def last_loads(run: Path) -> tuple[str, Outcome]:
    """ "held" where a run's last checkpoint loads, "refused" where it has none."""
    kind, lost = attempt(lambda: UniMASKPolicy.from_pretrained(last_checkpoint(run)))
    linked = (run / "checkpoints" / "last").exists()
    return kind, lost or ("no whole checkpoint" if kind == "refused" and linked else None)


def killed_trainings(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """lerobot-train killed while it saves a checkpoint or soon after; the last one loads, and resuming ends the run."""
    draw, flags = random.Random(0), [*TRAIN, f"--dataset.root={root}"]
    for i in range(count):
        run = HOME / "trainings" / str(i)
        begun = run / "checkpoints" / f"{1 + i % UPDATES:06d}" / "pretrained_model"
        forked(lambda r=run: train(*flags, f"--output_dir={r}"), kill_after=draw.uniform(0, 0.3), kill_from=begun)
        kind, lost = last_loads(run)
        config = run / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
        if config.exists() and (run / "checkpoints" / "last").resolve().name != f"{UPDATES:06d}":
            status = forked(lambda c=config: train(f"--config_path={c}", "--resume=true"))
            lost = lost or (None if status == 0 else f"not to be resumed, status {status}")
        yield kind, lost
        shutil.rmtree(run, ignore_errors=True)


def full_trainings(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """lerobot-train where no file may grow beyond some bytes: the last checkpoint that the run points to is whole."""
    draw, flags = random.Random(0), [*TRAIN, f"--dataset.root={root}"]
    for i in range(count):
        run = HOME / "full_trainings" / str(i)
        most = int(10 ** draw.uniform(3, 5.5))
        status = forked(lambda r=run: train(*flags, f"--output_dir={r}"), most_bytes=most)
        kind, lost = last_loads(run)
        yield (
            "held" if status == 0 else "refused",
            lost or ("none was saved" if kind != "held" and not status else None),
        )
        shutil.rmtree(run, ignore_errors=True)


def full_caches(count: int, _: Path) -> Iterator[tuple[str, Outcome]]:
    """Frames cached where no file may grow beyond some bytes: nothing half-made loads, and one sentence ends it."""
    draw, key = random.Random(0), "observation.images.top"
    picture = {"dtype": "image", "shape": (32, 32, 3), "names": ["height", "width", "channels"]}
    numbers = {"dtype": "float32", "shape": (1,), "names": None}
    written = LeRobotDataset.create(
        "local/seen", 10, {key: picture, "action": numbers}, HOME / "seen", use_videos=False
    )
    drawn = np.random.default_rng(0)
    for _ in range(2):
        for _ in range(10):
            frame = {key: drawn.integers(256, size=picture["shape"], dtype=np.uint8), "action": np.zeros(1, np.float32)}
            written.add_frame({**frame, "task": "look"})
        written.save_episode()
    written.finalize()
    dataset = LeRobotDataset("local/seen", root=HOME / "seen")
    expected = frames.cached_frames(dataset, key, (32, 32), HOME / "cache")
    for i in range(count):
        folder = HOME / "caches" / str(i)
        cache = lambda f=folder: frames.cached_frames(dataset, key, (32, 32), f)  # noqa: E731
        status = forked(cache, most_bytes=int(10 ** draw.uniform(0, 5.2)))
        made = list(folder.glob("*.frames"))
        lost = f"status {status}" if status not in (0, 2) else "half a cache" if status and made else None
        again, wrong = attempt(cache, lambda got: None if np.array_equal(got, expected) else "other pictures")
        yield "held" if status == 0 else "refused", lost or wrong or (None if again == "held" else "not afterwards")
        shutil.rmtree(folder, ignore_errors=True)


SESSION = """
import sys
from lerobot.scripts import lerobot_train
from lerobot_unimask import cli
import lerobot_policy_unimask
words, commands = [], sys.argv[1:]
for word in [*commands, ";"]:
    if word != ";":
        words.append(word)
    elif words[0] == "lerobot-train":
        sys.argv, words = words, []
        lerobot_train.main()
    else:
        status = cli.main(words)
        assert not status, status
        words = []
"""


def homes(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """Training, asking and preparing in a process of its own, whose home is absent, a file or read-only, or whose
    locale is C, in a folder with a name that is not ASCII: all of it works, or one sentence names the home."""
    readable = HOME / "read_only"
    readable.mkdir()
    readable.chmod(0o555)
    (HOME / "a_file").write_text("not a folder")
    places = {"absent": HOME / "nowhere" / "at_all", "read-only": Path("/proc/self"), "read-only folder": readable}
    kinds = [*places, "a file", "locale C"]
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("HF_", "XDG_"))}
    for i, kind in enumerate((kinds * count)[:count]):
        work = HOME / "homes" / f"Übung {i}"
        work.mkdir(parents=True)
        data = Path(shutil.copytree(root, work / "données"))
        home = HOME / "a_file" if kind == "a file" else places.get(kind, HOME)
        environment = {**plain, "HOME": str(home), "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
        if kind == "locale C":
            environment |= {"LC_ALL": "C", "LANG": "C"}
        flags = [*TRAIN, f"--dataset.root={data}", f"--output_dir={work / 'run'}", "--save_freq=5"]
        asked = [
            "query",
            f"--policy.path={work / 'run'}",
            "--mask=past",
            "--t=3",
            "--episode=0",
            f"--dataset.root={data}",
        ]
        made = ["prepare", f"--dataset.root={data}", "--drop=next.done", f"--output={work / 'préparé'}"]
        command = [sys.executable, "-c", SESSION, "lerobot-train", *flags, ";", *asked, ";", *made]
        done = subprocess.run(command, cwd=work, env=environment, capture_output=True, text=True, errors="replace")
        said = [line for line in done.stderr.splitlines() if line.strip()] or [""]
        clear = said[-1].startswith(("OSError", "ValueError")) and str(home) in said[-1]
        lost = None if not done.returncode or (clear and kind != "absent") else f"{kind}: {said[-1]}"
        yield "refused" if done.returncode else "held", lost
