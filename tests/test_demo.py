"""The demo: the whole of it as a user runs it (slow), and a small one with LeRobot's loops in this process."""

import contextlib
import io
import json
import re
import subprocess
import sys
import time
from pathlib import Path

import commands
import psutil
import pytest
from policies import few_draws

from lerobot_unimask import UniMASKPolicy, demo
from lerobot_unimask.language.masks import TASKS

PICTURES = {"five_panels.png", "trained_five_panels.png", "trained_state_distributions.png"}
QUESTIONS = {"imitation", "imitation, sampled actions"}
SECONDS = 4 * 60
BYTES = 4 * 10**9


def check_files(output: Path) -> dict:
    """What every demo leaves behind; returns its record."""
    assert {path.name for path in output.iterdir()} >= {"demo.json", *PICTURES}
    for picture in PICTURES:
        assert (output / picture).stat().st_size > 10_000
    assert UniMASKPolicy.from_pretrained(output / "train/checkpoints/last/pretrained_model")
    assert list((output / "eval").rglob("*.mp4"))
    record = json.loads((output / "demo.json").read_text())
    assert record["rollouts"].keys() == QUESTIONS
    assert record["loss_on_unseen_episodes"].keys() == TASKS.keys()
    names = ["Imitation", "Another goal", "A wanted return", "A waypoint", "Backwards"]
    for panels in ("shipped_panels", "panels"):
        assert [panel["name"] for panel in record[panels]] == names
    assert record["state_distributions"]["shown"] == [0, 3, 6]
    return record


def numbers_in(text: str) -> list[str]:
    return re.findall(r"-?\d+(?:\.\d+)?", text)


def recorded(value: object) -> set[float]:
    """Every number in a JSON value, those in its texts included, and how many entries each list has."""
    if isinstance(value, dict):
        return set().union(*map(recorded, [*value, *value.values()]))
    if isinstance(value, list):
        return set().union({float(len(value))}, *map(recorded, value))
    if isinstance(value, str):
        return set(map(float, numbers_in(value)))
    return set() if value is None else {float(value)}


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A demo of four updates and a few episodes: its folder, its record and what it printed itself."""
    output = tmp_path_factory.mktemp("demo") / "unimask-demo"
    printed = io.StringIO()
    with few_draws(), pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        for name, value in {"EPISODES": 40, "UNSEEN_EPISODES": 20, "ROLLOUTS": 3}.items():
            patch.setattr(demo, name, value)
        patch.setattr(demo, "COMMANDS", {script: commands.fresh(main) for script, main in demo.COMMANDS.items()})
        record = demo.run_demo(output, steps=4)
    return output, record, printed.getvalue()


def test_a_small_demo_leaves_everything(small):
    output, record, printed = small
    assert check_files(output) == json.loads(json.dumps(record))
    assert record["updates"] == 4
    assert re.findall(r"^\[(\d)/5\] \w+", printed, re.MULTILINE) == list("12345")
    assert f"everything is in {output}" in printed


def test_every_number_that_is_printed_is_recorded(small):
    output, record, printed = small
    printed = printed.partition("What to try next:")[0]
    results = [line.replace(str(output), "") for line in printed.splitlines() if re.match(r" {2,}\S", line)]
    asked = [*record["shipped_panels"], *record["panels"]]
    known = recorded(record) | {100 * panel["share"] for panel in asked if panel["share"] is not None}
    for line in results:
        for number in numbers_in(line):
            decimals = len(number.partition(".")[2])
            assert any(abs(float(number) - value) <= 0.51 * 10**-decimals for value in known), line
    assert len(results) > len(QUESTIONS) + len(TASKS) + 2 * len(record["panels"])


def test_the_commands_to_try_next_name_what_is_there(small):
    output, _, printed = small
    _, _, advice = printed.partition("What to try next:")
    assert [word for word in ("lerobot-eval", "lerobot-train", "unimask validate") if word not in advice] == []
    paths = re.findall(rf"{re.escape(str(output))}[\w/.-]*", advice)
    assert len(paths) == 5
    assert [path for path in paths if not Path(path).exists()] == []


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_a_place_that_is_taken_is_refused_and_left_as_it_was(tmp_path, kind, capsys):
    taken = tmp_path / "thesis.txt"
    taken.write_text("three years of work")
    with pytest.raises(FileExistsError, match="--output=DIR"):
        demo.run_demo(tmp_path if kind == "folder" else taken)
    assert list(tmp_path.iterdir()) == [taken]
    assert taken.read_text() == "three years of work"
    assert capsys.readouterr().out == ""


def test_a_command_that_fails_ends_the_demo_and_its_log_says_why(tmp_path):
    log = tmp_path / "eval.log"
    with pytest.raises(ChildProcessError, match=rf"lerobot-eval.*{log}"):
        demo._run(log, "lerobot-eval", "--policy.path=nowhere", "--env.type=doorkey")
    assert "nowhere" in log.read_text()


def most_memory(process: subprocess.Popen) -> int:
    """Bytes that a process and all below it held at once, at the most; waits until it ends.

    Pages that several of them share count several times, so the true number is no higher.
    """
    most = 0
    root = psutil.Process(process.pid)
    while process.poll() is None:
        held = 0
        with contextlib.suppress(psutil.NoSuchProcess):
            for one in [root, *root.children(recursive=True)]:
                with contextlib.suppress(psutil.NoSuchProcess):
                    held += one.memory_info().rss
        most = max(most, held)
        time.sleep(0.2)
    return most


@pytest.mark.slow
def test_the_full_demo_is_quick_and_small_and_answers_well(tmp_path):
    script = Path(sys.executable).with_name("unimask")
    began = time.monotonic()
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen([script, "demo"], cwd=tmp_path, stdout=log, stderr=subprocess.STDOUT)
        most = most_memory(process)
    seconds = time.monotonic() - began
    assert process.returncode == 0, (tmp_path / "log").read_text()[-3000:]
    print(f"the demo took {seconds:.0f} s and {most / 1e9:.2f} GB")
    record = check_files(tmp_path / "unimask-demo")
    assert seconds < SECONDS
    assert most < BYTES
    assert record["seconds"] <= seconds
    assert record["rollouts"]["imitation"]["success_percent"] > 60  # at most 84; the expert itself succeeds in 7
    shipped = {panel["name"]: panel for panel in record["shipped_panels"]}
    assert shipped["Imitation"]["achieved"]["success"] == [True]
    assert shipped["A waypoint"]["achieved"]["s[3] reached"] == [True]
    assert shipped["A wanted return"]["share"] > 0.9
    assert shipped["Another goal"]["share"] > 0.4  # its most likely actions miss
