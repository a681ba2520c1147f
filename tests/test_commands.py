"""A forked command is the command: it ends as a process of its own does, prints the same and leaves the same behind."""

import contextlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import commands
import psutil
import pytest
from policies import TRAIN_FLAGS
from safetensors.torch import load_file

TRAIN = [*TRAIN_FLAGS, "--steps=4", "--batch_size=8", "--log_freq=1", "--num_workers=0"]


def as_a_process(script: str, *arguments: str, cwd: Path) -> commands.Result:
    done = subprocess.run(
        [Path(sys.executable).with_name(script), *arguments],
        cwd=cwd,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    return commands.Result(done.returncode, done.stdout, done.stderr)


def replace_main(monkeypatch: pytest.MonkeyPatch, main) -> None:
    monkeypatch.setattr(commands, "_main", lambda script: main)


@pytest.mark.parametrize(
    ("code", "status", "printed"), [(None, 0, ""), (0, 0, ""), (3, 3, ""), (True, 1, ""), ("why", 1, "why\n")]
)
def test_the_exit_status_is_that_of_a_console_script(code, status, printed, tmp_path, monkeypatch):
    replace_main(monkeypatch, lambda: sys.exit(code))
    assert commands.run("any", cwd=tmp_path) == commands.Result(status, "", printed)


def test_an_error_is_a_traceback_and_status_one(tmp_path, monkeypatch):
    replace_main(monkeypatch, lambda: 1 / 0)
    result = commands.run("any", cwd=tmp_path)
    assert (result.status, result.stdout) == (1, "")
    assert result.stderr.endswith("ZeroDivisionError: division by zero\n")


def test_a_command_has_its_own_arguments_folder_and_environment(tmp_path, monkeypatch):
    replace_main(monkeypatch, lambda: print(sys.argv, Path.cwd(), os.environ["WHERE"], sys.stdin.read()))
    before = sys.argv, Path.cwd(), dict(os.environ)
    printed = commands.check("any", "--flag=1", cwd=tmp_path, env={"WHERE": "here"})
    assert printed == f"['any', '--flag=1'] {tmp_path} here \n"
    assert (sys.argv, Path.cwd(), dict(os.environ)) == before


def test_what_takes_too_long_is_ended_with_all_that_it_started(tmp_path, monkeypatch):
    def start_and_wait() -> None:
        started = subprocess.Popen(["sleep", "60"])
        Path("started").write_text(str(started.pid))
        time.sleep(60)

    monkeypatch.setattr(commands, "SECONDS", 2)
    replace_main(monkeypatch, start_and_wait)
    with pytest.raises(TimeoutError, match="any --flag takes longer"):
        commands.run("any", "--flag", cwd=tmp_path)
    with contextlib.suppress(psutil.NoSuchProcess):  # unless the system's first process has buried it already
        started = psutil.Process(int((tmp_path / "started").read_text()))
        assert started.status() == psutil.STATUS_ZOMBIE


@pytest.mark.slow
def test_a_forked_training_and_its_answer_are_those_of_real_processes(doorkey_root, tmp_path):
    dataset = ["--dataset.repo_id=local/doorkey", f"--dataset.root={doorkey_root}"]
    query = ["query", "--policy.path=run", *dataset, "--episode=0", "--mask=past", "--t=3", "--json"]
    weights, answers = [], []
    for name, start in (("forked", commands.run), ("process", as_a_process)):
        cwd = tmp_path / name
        cwd.mkdir()
        trained = start("lerobot-train", *TRAIN, *dataset, "--output_dir=run", cwd=cwd)
        assert trained.status == 0, f"{name}: {trained.stderr[-3000:]}"
        weights.append(load_file(cwd / "run/checkpoints/last/pretrained_model/model.safetensors"))
        asked = start("unimask", *query, cwd=cwd)
        assert asked.status == 0, f"{name}: {asked.stderr[-3000:]}"
        answers.append(json.loads(asked.stdout)["answers"])
    assert answers[0] == answers[1] != []
    assert weights[0].keys() == weights[1].keys()
    assert [key for key in weights[0] if not weights[0][key].equal(weights[1][key])] == []
