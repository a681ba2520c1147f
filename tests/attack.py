"""Everything that may go wrong, tried many times: what was refused, what held, and what was lost.

    OMP_NUM_THREADS=1 uv run python tests/attack.py --output=docs/results/reliability.json

An attempt is lost if it ends in another error than one clear sentence, takes longer than `SECONDS`, changes an answer
that it must not change, or leaves something half-made. `test_attack.py` makes a few attempts of each kind.
"""

import argparse
import atexit
import json
import logging
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from hub_server import Hub

HUB = Hub({"token": "me"}).__enter__()
HOME = Path(tempfile.mkdtemp(prefix="attack_"))
OWNER = os.getpid()
atexit.register(lambda: os.getpid() == OWNER and shutil.rmtree(HOME, ignore_errors=True))
os.environ.update(HF_ENDPOINT=HUB.endpoint, HF_HOME=str(HOME), HF_TOKEN="token", HF_HUB_DISABLE_XET="1")
os.environ.update(HF_HUB_OFFLINE="0", HF_HUB_DISABLE_PROGRESS_BARS="1", HF_HUB_DOWNLOAD_TIMEOUT="2")

import torch  # noqa: E402
from huggingface_hub.utils import _http  # noqa: E402
from safetensors.torch import load_file, save_file  # noqa: E402

import lerobot_policy_unimask  # noqa: E402, F401
from dataset_builders.doorkey import build_doorkey  # noqa: E402
from lerobot_unimask import UniMASKConfig, UniMASKPolicy  # noqa: E402
from lerobot_unimask.data.checkpoints import last_checkpoint  # noqa: E402
from lerobot_unimask.data.episodes import check_folder, first_windows, open_dataset, read_info  # noqa: E402
from lerobot_unimask.language.masks import TASKS, parse, tabulate  # noqa: E402
from lerobot_unimask.language.training_masks import TrainingMasks  # noqa: E402
from lerobot_unimask.records import markdown_table, versions, write_json  # noqa: E402
from lerobot_unimask.sharing import cards, hub  # noqa: E402

logging.getLogger("lerobot").setLevel(logging.ERROR)

SECONDS = 5.0  # of processor time, for one attempt
EXPECTED = (ValueError, OSError)  # what the commands print as one sentence; MaskError and HubError are among them
Outcome = str | None  # what was lost, or nothing


def attempt(call: Callable[[], Any], check: Callable[[Any], Outcome] = lambda _: None) -> tuple[str, Outcome]:
    """ "refused" or "held", and what was lost by it."""
    began = time.process_time()
    kind, lost = "held", None
    try:
        lost = check(call())
    except EXPECTED as error:
        kind = "refused"
        if len(str(error)) > 5000 or not str(error):
            lost = f"an error of {len(str(error))} characters"
    except Exception as error:
        lost = f"{type(error).__name__}: {error}"
    if time.process_time() - began > SECONDS:
        lost = f"{time.process_time() - began:.1f} s"
    return kind, lost


# --- Texts, values, files --------------------------------------------------------------------------------------------

PIECES = ["s", "a", "rtg", "task", "t", "s[", "a[", "]", "[", ":", "::", ",", "|", "@", "-", "+", "0", "9", "-1", "t+1"]
PIECES += [*TASKS, "t-1", "1024", "99999999999", "é", "\0", "\n", "(", ")", " ", "__import__('os')"]


def mask_texts(count: int, _: Path) -> Iterator[tuple[str, Outcome]]:
    draw = random.Random(0)
    for _ in range(count):
        if draw.random() < 0.5:
            text = "".join(draw.choices(PIECES, k=draw.randrange(1, 14)))
        else:  # one of the tasks with some characters changed
            text = list(draw.choice(list(TASKS.values())))
            for _ in range(draw.randrange(1, 4)):
                text[draw.randrange(len(text))] = draw.choice(PIECES)
            text = "".join(text)
        yield attempt(lambda text=text: tabulate(text, ("s", "a", "rtg"), 10) if parse(text) else None)


def hidden_values(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """Other values, NaN and infinity in the places that a question hides."""
    policy = small_policy(root)
    batch = first_windows(open_dataset(policy.config, root))
    window = policy.make_window(batch)
    drawer = TrainingMasks("random_mask", tuple(policy.factors), policy.config.context_length)
    for step in range(count):
        mask = drawer(window.valid, batch["index"], seed=0, step=step)
        value = (float("nan"), float("inf"), -1e30, 7.0)[step % 4]
        changed = policy.make_window(batch)
        for name, tensor in changed.values.items():
            changed.values[name] = torch.where(mask.shown[name].unsqueeze(-1), tensor, value)

        def same(answers):
            pairs = zip(*([d.probabilities for n in ("s", "a") for d in said[n]] for said in answers), strict=True)
            return None if all(torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in pairs) else "another answer"

        yield attempt(lambda m=mask, c=changed: (policy.infer(window, m), policy.infer(c, m)), same)


def weights(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """Each tensor not finite, of another type, of another shape, or gone; files cut, or with another header."""
    folder = HOME / "weights"
    small_policy(root).save_pretrained(folder)
    file, draw = folder / "model.safetensors", random.Random(0)
    whole, tensors = file.read_bytes(), load_file(folder / "model.safetensors")
    faults = {
        "nan": lambda t: torch.full_like(t, torch.nan) if t.is_floating_point() else t.float(),
        "inf": lambda t: torch.full_like(t, torch.inf) if t.is_floating_point() else t.double(),
        "complex": lambda t: t.to(torch.complex64),
        "type": lambda t: t.to(torch.int32) if t.is_floating_point() else t.to(torch.float32),
        "shape": lambda t: torch.cat([t.reshape(-1), t.reshape(-1)[:1]]) if t.numel() else torch.zeros(3),
        "absent": lambda t: None,
    }

    def load_refused(what: str) -> tuple[str, Outcome]:
        kind, lost = attempt(lambda: UniMASKPolicy.from_pretrained(folder))
        return kind, lost or (None if kind == "refused" else f"{what} was loaded")

    plan = [(name, fault) for name in tensors for fault in faults if tensors[name].numel()]
    for name, fault in draw.sample(plan, min(count // 2, len(plan))):
        changed = faults[fault](tensors[name])
        save_file(
            {**tensors, name: changed} if changed is not None else {k: t for k, t in tensors.items() if k != name}, file
        )
        yield load_refused(f"{name}: {fault}")
    header = 8 + int.from_bytes(whole[:8], "little")
    for i in range(count // 2):
        if i % 2:
            file.write_bytes(whole[: draw.randrange(len(whole))])
            yield load_refused("a file cut short")
        else:  # in a header another byte may be another name's of no consequence only if all is as before
            place = draw.randrange(header)
            file.write_bytes(whole[:place] + bytes([draw.randrange(256)]) + whole[place + 1 :])
            same = file.read_bytes() == whole
            kind, lost = attempt(lambda: UniMASKPolicy.from_pretrained(folder))
            metadata = whole[:header].find(b"__metadata__")
            yield (
                kind,
                lost
                or (None if kind == "refused" or same or 0 <= place - metadata < 40 else f"byte {place} of the header"),
            )


ABSURD = [10**9, 2**63, 10**400, -1, 0, -4, 1.5, "x", "", None, True, [], [1], {}, {"a": 1}, [[[]]], "9" * 4000, 1e308]


def configs(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """Each entry of config.json absurd. Some values are legal."""
    folder = HOME / "config"
    small_policy(root).save_pretrained(folder)
    file = folder / "config.json"
    content = json.loads(file.read_text())
    plan = [(name, value) for name in content for value in ABSURD]
    for name, value in random.Random(0).sample(plan, min(count, len(plan))):
        file.write_text(json.dumps({**content, name: value}))
        yield attempt(lambda: UniMASKPolicy.from_pretrained(folder))


def infos(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """Each entry of info.json absurd, top entries and columns'. Some values are legal."""
    folder = HOME / "info"
    (folder / "meta").mkdir(parents=True, exist_ok=True)
    content = read_info(root)
    plan = [((name,), value) for name in content for value in ABSURD]
    plan += [
        (("features", key, entry), value)
        for key in content["features"]
        for entry in ("dtype", "shape")
        for value in ABSURD
    ]
    for path, value in random.Random(0).sample(plan, min(count, len(plan))):
        changed = json.loads(json.dumps(content))
        place = changed
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value
        (folder / "meta" / "info.json").write_text(json.dumps(changed))
        yield attempt(lambda: cards.dataset_card(folder, "me/data"))


def calls(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """Calls of infer, sample, select_action and forward with values of any kind."""
    policy, draw = small_policy(root), random.Random(0)
    batch = first_windows(open_dataset(policy.config, root))
    nested: Any = 0
    for _ in range(10_000):
        nested = [nested]
    values = [*ABSURD, nested, object(), float("nan"), torch.zeros(2), torch.zeros(1, 2), torch.zeros(3, 2).to_sparse()]
    values += [
        torch.zeros(2, device="meta"),
        torch.zeros(2, dtype=torch.complex64),
        [0, 9],
        [16, 0],
        b"x",
        (0, 1),
        {0, 1},
    ]
    counts = [value for value in values if not isinstance(value, int) or value < 10]
    for _ in range(count):
        a, b, c = draw.choices(values, k=3)
        n = draw.choice(counts)
        call = draw.choice(
            [
                lambda a=a: policy.infer(None, "a[0] | s[0]", given={"s[0]": a}),
                lambda a=a: policy.infer(None, "a[0] | s[0]", given=a),
                lambda a=a: policy.infer(batch, "future", t=a),
                lambda b=b, c=c, n=n: policy.sample(batch, "future", t=3, samples=n, seed=b, tries=c),
                lambda a=a, b=b: policy.select_action({"observation.state": a, "observation.return_so_far": b}),
                lambda a=a: policy.select_action({"observation.state": torch.zeros(1, 2)}, given={"s[-1]": a}),
                lambda a=a, b=b: policy.forward({**batch, "action": a, "observation.state_is_pad": b}),
                lambda a=a: policy.forward({**batch, "index": a}),
            ]
        )
        policy.reset()
        yield attempt(call)


# --- The Hub ---------------------------------------------------------------------------------------------------------

FAULTS = [{"status": status} for status in (400, 401, 403, 404, 409, 412, 429, 500, 502, 503, 504)]
FAULTS += [{"cut": True}, {"damage": True}, {"page": True}, {"wait": lambda: time.sleep(0.2)}]
PULLED = ["GET /api/.*/(revision/)?", "GET /api/.*/tree", "(HEAD|GET) /.*/resolve/", "GET /storage/"]
PUSHED = ["/api/repos/create", "GET /api/models", "GET /api/datasets", "/preupload/", "/objects/batch", "PUT /storage/"]
PUSHED += ["/verify/", "/commit/", "/tag/", "/refs"]


def pulls(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """A policy pulled from a Hub at fault; afterwards it is pulled, and is whole."""
    folder = HOME / "pulled"
    small_policy(root).save_pretrained(folder)
    push_policy(folder, "me/pulled")
    plan = [(pattern, fault) for pattern in PULLED for fault in FAULTS]
    for pattern, fault in random.Random(0).choices(plan, k=count):
        shutil.rmtree(HOME / "hub", ignore_errors=True)
        with HUB.fault(pattern, times=random.Random(count).choice([1, 1000]), **fault):
            kind, lost = attempt(lambda: UniMASKPolicy.from_pretrained("me/pulled"))
        again, _ = attempt(lambda: UniMASKPolicy.from_pretrained("me/pulled"))
        yield kind, lost or (None if again == "held" else "not to be pulled afterwards")


def pushes(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """A policy or a dataset pushed to a Hub at fault: there is all of it or nothing, and pushing again finishes it."""
    folder = HOME / "pushed"
    small_policy(root).save_pretrained(folder)
    plan = [(pattern, fault, kind) for pattern in PUSHED for fault in FAULTS for kind in ("model", "dataset")]
    for i, (pattern, fault, what) in enumerate(random.Random(0).choices(plan, k=count)):
        name = f"me/pushed_{i}"
        push = (lambda n=name: push_policy(folder, n)) if what == "model" else (lambda n=name: push_dataset(root, n))
        with HUB.fault(pattern, times=random.Random(i).choice([1, 1000]), **fault):
            kind, lost = attempt(push)
        there = HUB.repositories.get((what, name))
        if there and len(there.files) not in (1, 0) and not complete(there, what):
            lost = lost or "part of it is there"
        again, wrong = attempt(push)
        yield (
            kind,
            lost
            or wrong
            or (None if again == "held" and complete(HUB.repositories[what, name], what) else "unfinished"),
        )


def push_policy(folder: Path, name: str) -> str:
    return hub.push_policy(
        folder, name, cards.policy_card(UniMASKPolicy.from_pretrained(folder).card_facts(folder), name)
    )


def push_dataset(root: Path, name: str) -> str:
    return hub.push_dataset(root, name, cards.dataset_card(root, name))


def complete(repository, what: str) -> bool:
    wanted = {"model.safetensors", "config.json"} if what == "model" else {"meta/info.json", "meta/stats.json"}
    return {*wanted, "README.md"} <= set(repository.files)


# --- Kills and full disks --------------------------------------------------------------------------------------------


def forked(work: Callable[[], Any], *, kill_after: float | None = None, most_bytes: int | None = None) -> int | None:
    """Run in a forked process, that is killed or may write no larger file; its exit status, None if it was killed."""
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        if most_bytes is not None:
            import resource

            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
        try:
            work()
            os._exit(0)
        except EXPECTED:
            os._exit(2)
        except BaseException:
            os._exit(1)
    if kill_after is not None:
        time.sleep(kill_after)
        os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    return None if os.WIFSIGNALED(status) else os.waitstatus_to_exitcode(status)


def duration(work: Callable[[], Any]) -> float:
    """Seconds of the work in a forked process, where it is not killed."""
    began = time.monotonic()
    status = forked(work)
    assert status == 0, f"status {status}"
    return time.monotonic() - began


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
    from lerobot.common.train_utils import update_last_checkpoint

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


# --- All of it -------------------------------------------------------------------------------------------------------


def CONFIG() -> UniMASKConfig:
    return UniMASKConfig(device="cpu", width=16, depth=1, heads=2, feedforward_width=16)


def small_policy(root: Path) -> UniMASKPolicy:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    config, meta = CONFIG(), LeRobotDatasetMetadata("local/dataset", root=root)
    config.set_dataset_feature_metadata(meta.features)
    return UniMASKPolicy(config, dataset_stats=meta.stats).eval()


ATTACKS: dict[str, tuple[Callable[[int, Path], Iterator[tuple[str, Outcome]]], int]] = {
    "mask texts, made of the language's pieces": (mask_texts, 200_000),
    "hidden values replaced": (hidden_values, 500),
    "weights: not finite, of other types and shapes, cut, other bytes": (weights, 300),
    "entries of a policy's config.json": (configs, 2_000),
    "entries of a dataset's info.json": (infos, 2_000),
    "calls in Python with values of any kind": (calls, 20_000),
    "pulls from a Hub at fault": (pulls, 60),
    "pushes to a Hub at fault": (pushes, 40),
    "kills while building": (killed_builds, 100),
    "kills while saving checkpoints": (killed_saves, 100),
    "kills while pushing": (killed_pushes, 30),
    "disks that are full": (full_disks, 100),
}


def attack(share: float, write: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """A record: for each attack how many attempts were made, refused, held and lost, with the first losses. It is
    written after each attack."""
    _http.time.sleep = lambda seconds, sleep=time.sleep: sleep(min(seconds, 0.01))  # the client tries again by itself
    root = build_doorkey(HOME / "data", episodes=30, progress=False)
    found: dict[str, Any] = {}
    record = {
        "what": "attempts that ended in one sentence (refused), had no effect (held), or lost something",
        "units": "attempts; seconds: wall time",
        "attacks": found,
        "versions": versions(),
    }
    for name, (tries, count) in ATTACKS.items():
        began, outcomes, losses = time.time(), {"refused": 0, "held": 0}, []
        for kind, lost in tries(max(2, int(share * count)), root):
            outcomes[kind] += 1
            losses += [lost] if lost else []
        tried = sum(outcomes.values())
        found[name] = {"tried": tried, **outcomes, "lost": len(losses), "seconds": round(time.time() - began, 1)}
        if losses:
            found[name]["losses"] = [str(loss)[:300] for loss in sorted(set(losses))[:10]]
        print(json.dumps({name: found[name]}), file=sys.stderr, flush=True)
        write(record)
    return record


def table(record: dict[str, Any]) -> str:
    rows = [
        [name, *(f"{entry[key]:,}" for key in ("tried", "refused", "held", "lost"))]
        for name, entry in record["attacks"].items()
    ]
    return markdown_table(("attack", "tried", "refused", "held", "lost"), rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--share", type=float, default=1.0, help="of the attempts")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    command = f"python tests/attack.py --share={arguments.share}"

    def write(record: dict[str, Any]) -> None:
        if arguments.output:
            write_json(arguments.output, {**record, "command": command}, say=False)

    record = attack(arguments.share, write)
    print(table(record))
    sys.exit(any(entry["lost"] for entry in record["attacks"].values()))
