"""Everything that may go wrong, tried many times: what was refused, what held, and what was lost.

    OMP_NUM_THREADS=1 uv run python tests/measuring/attack.py --output=docs/results/reliability.json

An attempt is lost if it ends in another error than one clear sentence, takes longer than `SECONDS`, changes an answer
that it must not change, or leaves something half-made. An attack that the record has already is not made again: who is
interrupted gives the same command. `test_attack.py` makes a few attempts of each kind.
"""

import argparse
import json
import random
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attack_ground  # noqa: F401 (first: it sets up what others read as they are imported)
import attack_hindrances as hindrances
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from attack_ground import (
    CONFIG,
    HOME,
    HUB,
    Attack,
    Outcome,
    attempt,
    complete,
    push_dataset,
    push_policy,
    small_policy,
)
from huggingface_hub.utils import _http
from lerobot.policies.factory import make_policy
from safetensors.torch import load_file, save_file

from dataset_builders.doorkey import build_doorkey
from dataset_builders.prepare import make_plan, prepare
from lerobot_unimask import UniMASKPolicy
from lerobot_unimask.data.episodes import first_windows, open_dataset, read_info
from lerobot_unimask.language.masks import TASKS, parse, tabulate
from lerobot_unimask.language.training_masks import TrainingMasks
from lerobot_unimask.records import commit, markdown_table, versions, write_json
from lerobot_unimask.sharing import cards

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


def damaged_files(count: int, root: Path) -> Iterator[tuple[str, Outcome]]:
    """A dataset with a file gone, cut or of other bytes, or a table of other rows or columns: opened, taken over by a
    policy, looked at, and prepared."""
    draw = random.Random(0)
    files = sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.suffix in (".json", ".parquet"))
    tables = [file for file in files if file.endswith(".parquet")]

    def changed_bytes(path: Path) -> None:
        content, place = path.read_bytes(), draw.randrange(path.stat().st_size)
        path.write_bytes(content[:place] + draw.randbytes(8) + content[place + 8 :])

    damages: list[Callable[[Path], Any]] = [
        lambda path: path.unlink(),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[: draw.randrange(path.stat().st_size)]),
        changed_bytes,
        changed_bytes,
        lambda path: path.write_text("<!DOCTYPE html><html><body>Log in</body></html>"),
        lambda path: path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"),
        lambda path: (path.unlink(), path.mkdir()),
        lambda path: (path.unlink(), path.symlink_to("nowhere")),
    ]

    def of(change: Callable[[pa.Table, int], pa.Table]) -> Callable[[Path], Any]:
        def rewrite(path: Path) -> None:
            table = pq.read_table(path).replace_schema_metadata(None)
            pq.write_table(change(table, draw.randrange(table.num_columns)), path)

        return rewrite

    changes = [
        of(lambda table, i: table.remove_column(i)),
        of(lambda table, i: table.set_column(i, table.column_names[i], pa.nulls(len(table), table.column(i).type))),
        of(lambda table, i: table.set_column(i, table.column_names[i], pa.array(["x"] * len(table)))),
        of(lambda table, i: table.set_column(i, table.column_names[i], pa.array([-7] * len(table)))),
        of(lambda table, i: table.set_column(i, table.column_names[i], pa.array([float("nan")] * len(table)))),
        of(lambda table, i: table.set_column(i, table.column_names[i], pa.array([[1.0]] * len(table)))),
        of(lambda table, i: table.slice(0, draw.randrange(len(table)))),
        of(lambda table, i: pa.concat_tables([table, table])),
        of(lambda table, i: table.take(list(reversed(range(len(table)))))),
    ]

    def open_it(folder: Path) -> None:
        dataset = open_dataset(CONFIG(), folder)
        make_policy(CONFIG(), ds_meta=dataset.meta).forward(first_windows(dataset))

    for i in range(count // 2):
        folder = shutil.copytree(root, HOME / "damaged" / str(i))
        file = folder / draw.choice(tables if i % 2 else files)
        draw.choice(changes if i % 2 else damages)(file)
        yield attempt(lambda f=folder: open_it(f))
        yield attempt(lambda f=folder: prepare(f, make_plan(f), output=f.with_name(f"{f.name}_made")))


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


# --- All of it -------------------------------------------------------------------------------------------------------


ATTACKS: dict[str, tuple[Attack, int]] = {
    "mask texts, made of the language's pieces": (mask_texts, 1_000_000),
    "hidden values replaced": (hidden_values, 500),
    "weights: not finite, of other types and shapes, cut, other bytes": (weights, 300),
    "entries of a policy's config.json": (configs, 2_000),
    "entries of a dataset's info.json": (infos, 2_000),
    "files of a dataset: gone, cut, of other bytes, rows and columns": (damaged_files, 400),
    "calls in Python with values of any kind": (calls, 20_000),
    "pulls from a Hub at fault": (pulls, 60),
    "pushes to a Hub at fault": (pushes, 40),
    "kills while building": (hindrances.killed_builds, 100),
    "kills while preparing": (hindrances.killed_prepares, 60),
    "kills while training": (hindrances.killed_trainings, 12),
    "kills while saving checkpoints": (hindrances.killed_saves, 100),
    "kills of studies": (hindrances.killed_studies, 20),
    "kills while pushing": (hindrances.killed_pushes, 30),
    "full disks while building and recording": (hindrances.full_disks, 100),
    "full disks while training": (hindrances.full_trainings, 20),
    "full disks while frames are cached": (hindrances.full_caches, 40),
    "homes that are absent, a file or read-only, and locale C": (hindrances.homes, 5),
}


def attack(
    share: float, write: Callable[[dict[str, Any]], None], before: dict[str, Any], only: str = ""
) -> dict[str, Any]:
    """A record: for each attack how many attempts were made, refused, held and lost, with the first losses. It is
    written after each attack.

    Args:
        before: attacks that a record has already; they are not made again.
        only: text that the names of those to make hold.
    """
    _http.time.sleep = lambda seconds, sleep=time.sleep: sleep(min(seconds, 0.01))  # the client tries again by itself
    root = build_doorkey(HOME / "data", episodes=30, progress=False)
    found: dict[str, Any] = dict(before)
    record: dict[str, Any] = {
        "what": "attempts that ended in one sentence (refused), had no effect (held), or lost something",
        "units": "attempts; seconds: wall time",
        "attacks": found,
        "versions": versions(),
    }
    for name in [name for name in ATTACKS if name not in before and only in name]:
        tries, count = ATTACKS[name]
        began, outcomes, losses = time.time(), {"refused": 0, "held": 0}, []
        for kind, lost in tries(max(2, int(share * count)), root):
            outcomes[kind] += 1
            losses += [lost] if lost else []
        tried = sum(outcomes.values())
        seconds = round(time.time() - began, 1)
        found[name] = {"tried": tried, **outcomes, "lost": len(losses), "seconds": seconds, "commit": commit()}
        if losses:
            found[name]["losses"] = [str(loss)[:300] for loss in sorted(set(losses))[:10]]
        print(json.dumps({name: found[name]}), file=sys.stderr, flush=True)
        record["attacks"] = {name: found[name] for name in ATTACKS if name in found}
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
    parser.add_argument("--only", default="", help="attacks whose name holds this text")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    command = f"python tests/measuring/attack.py --share={arguments.share}"

    def write(record: dict[str, Any]) -> None:
        if arguments.output:
            write_json(arguments.output, {**record, "command": command}, say=False)

    before = json.loads(arguments.output.read_text()) if arguments.output and arguments.output.exists() else {}
    if before.get("command", command) != command:
        parser.error(f"{arguments.output} is of another command, {before['command']}: choose another file.")
    record = attack(arguments.share, write, before.get("attacks", {}), arguments.only)
    print(table(record))
    sys.exit(any(entry["lost"] for entry in record["attacks"].values()))
