"""Studies: every run is done once, whoever is killed; records are those of the runs; interrupted ones go on."""

import json
import multiprocessing
import os
import random
import time
import uuid
from collections.abc import Callable
from functools import partial
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState

from lerobot_unimask.paper import study as module
from lerobot_unimask.paper.study import key, run_study

RUNS = [{"row": "row", "episodes": episodes, "seed": seed} for episodes in (50, 500) for seed in range(6)]


def sleep(seconds: float, run: dict) -> dict:
    """A run that is recognised afterwards."""
    time.sleep(seconds)
    return {"loss": float(run["seed"]), "token": uuid.uuid4().hex}


def tokens(output: Path) -> dict[str, str]:
    return {path.stem: json.loads(path.read_text())["token"] for path in (output / "runs").glob("*.json")}


def states_of(output: Path) -> dict[str, list[TrialState]]:
    study = module._open("test", f"sqlite:///{(output / 'study.db').resolve()}", 1)
    found: dict[str, list[TrialState]] = {}
    for trial in study.get_trials():
        found.setdefault(module.key_of(trial), []).append(trial.state)
    return found


def test_each_run_is_done_once_and_never_again(tmp_path, capsys):
    records = run_study("test", RUNS[:3], partial(sleep, 0), output=tmp_path)
    assert [{name: record[name] for name in run} for record, run in zip(records, RUNS[:3], strict=True)] == RUNS[:3]
    assert records[2]["loss"] == 2
    assert records[0].keys() >= {"token", "wall_seconds", "processor_seconds", "commit", "machine", "versions"}
    assert "3 of 3 runs done: row-50-2, loss 2.0000" in capsys.readouterr().out
    more = run_study("test", RUNS[:5], partial(sleep, 0), output=tmp_path)  # the grid has grown
    assert more[:3] == records
    assert tokens(tmp_path) == {key(record): record["token"] for record in more}
    assert set(states_of(tmp_path)) == {key(run) for run in RUNS[:5]}


def test_without_workers_nothing_is_run_and_what_is_done_is_returned(tmp_path):
    done = run_study("test", RUNS[1:3], partial(sleep, 0), output=tmp_path)
    assert run_study("test", RUNS[:4], partial(sleep, 0), output=tmp_path, workers=0) == done
    assert len(states_of(tmp_path)) == 2


def test_runs_of_other_settings_are_not_mixed_with_those_that_are_done(tmp_path):
    do = partial(run_study, "test", execute=partial(sleep, 0), output=tmp_path)
    done = do(runs=RUNS[:1], settings={"steps": 10, "variants.a": {"width": 16}})
    with pytest.raises(ValueError, match=r"steps=10.* 20.*name.*output"):
        do(runs=RUNS[:1], settings={"steps": 20})
    assert do(runs=RUNS[:2], settings={"steps": 10, "variants.b": {}})[0] == done[0]  # the grid has grown
    with pytest.raises(ValueError, match=r"variants.a"):
        do(runs=RUNS[:1], settings={"steps": 10, "variants.a": {"width": 32}})


def test_a_run_that_fails_ends_the_study_and_is_tried_again_by_the_next(tmp_path):
    def fail(run: dict) -> dict:
        if run["seed"] == 1:
            raise ZeroDivisionError("a bug")
        return {"loss": 0.0}

    with pytest.raises(ZeroDivisionError, match="a bug"):
        run_study("test", RUNS[:3], fail, output=tmp_path)
    assert len(run_study("test", RUNS[:3], partial(sleep, 0), output=tmp_path)) == 3
    assert states_of(tmp_path)["row-50-1"] == [TrialState.FAIL, TrialState.COMPLETE]


def test_a_record_whose_worker_died_before_it_could_say_so_counts(tmp_path):
    (tmp_path / "runs").mkdir()
    kept = {**RUNS[0], "loss": 7.0, "token": "kept", "wall_seconds": 1.0}
    (tmp_path / "runs" / f"{key(RUNS[0])}.json").write_text(json.dumps(kept))
    assert run_study("test", RUNS[:1], partial(sleep, 0), output=tmp_path) == [kept]


def test_a_record_that_a_worker_on_another_machine_stored_before_it_died_counts(tmp_path):
    """The trial that takes up a dead worker's has its attributes; its files are elsewhere."""
    kept = {**RUNS[0], "loss": 7.0, "token": "kept", "wall_seconds": 1.0}
    study = module._open("test", f"sqlite:///{(tmp_path / 'study.db').resolve()}", 1)
    study.add_trial(optuna.create_trial(state=TrialState.WAITING, user_attrs={"run": RUNS[0], "record": kept}))
    assert run_study("test", RUNS[:1], partial(sleep, 0), output=tmp_path) == [kept]
    assert tokens(tmp_path) == {key(RUNS[0]): "kept"}


def test_what_two_machines_enqueue_at_once_is_done_once(tmp_path):
    output = tmp_path
    (output / "runs").mkdir()
    study = module._open("test", f"sqlite:///{(output / 'study.db').resolve()}", 1)
    for _ in range(2):
        module.enqueue(study, RUNS[0])
    run_study("test", RUNS[:1], partial(sleep, 0), output=output, heartbeat=1)
    assert sorted(states_of(output)["row-50-0"]) == sorted([TrialState.COMPLETE, TrialState.PRUNED])


def sleep_and_say_so(folder: Path, run: dict) -> dict:
    """While it lasts, a file is named after the process."""
    (folder / str(os.getpid())).touch()
    record = sleep(0.4, run)
    (folder / str(os.getpid())).unlink()
    return record


def test_killing_workers_loses_no_finished_run_and_repeats_none(tmp_path):
    """Workers are killed, six in all: in turns in the middle of a run and at any moment. Records that were there at a
    kill are the same at the end."""
    rng = random.Random(0)
    runs = [{"row": "row", "episodes": 50, "seed": seed} for seed in range(24)]
    output, at_work = tmp_path / "output", tmp_path / "at_work"
    at_work.mkdir()
    (output / "runs").mkdir(parents=True)
    storage = f"sqlite:///{(output / 'study.db').resolve()}"
    study = module._open("test", storage, 1)
    for run in runs:
        module.enqueue(study, run)
    context = multiprocessing.get_context("fork")  # spawned workers would each import LeRobot first
    execute = partial(sleep_and_say_so, at_work)

    def start():
        process = context.Process(target=module.work, args=("test", storage, execute, output, 1))
        process.start()
        return process

    def wait(condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def one_more_is_done() -> bool:
        return len(tokens(output)) > len(kept)

    workers = [start(), start()]
    kept: dict[str, str] = {}
    for kill in range(6):
        wait(one_more_is_done)
        killed = workers.pop(rng.randrange(2))
        if kill % 2:
            wait((at_work / str(killed.pid)).exists)
        else:
            time.sleep(rng.uniform(0, 0.6))
        killed.kill()
        killed.join()
        found = tokens(output)
        assert kept.items() <= found.items()
        kept = found
        workers.append(start())
    records = run_study("test", runs, execute, output=output, heartbeat=1)
    for worker in workers:
        worker.join()
    final = tokens(output)
    assert len(kept) < len(runs)  # there was something left to do
    assert kept.items() <= final.items()
    assert final == {key(record): record["token"] for record in records}
    states = states_of(output)
    assert all(of_one.count(TrialState.COMPLETE) == 1 for name, of_one in states.items() if name)
    assert sum(of_one.count(TrialState.FAIL) for of_one in states.values()) >= 3  # those killed in the middle


@pytest.mark.slow  # each worker imports LeRobot
def test_spawned_workers_share_a_study(tmp_path):
    records = run_study("test", RUNS[:4], partial(sleep, 0.1), output=tmp_path, workers=2, heartbeat=1)
    assert [record["seed"] for record in records] == [0, 1, 2, 3]
    assert all(states == [TrialState.COMPLETE] for name, states in states_of(tmp_path).items() if name)


def test_the_storage_may_be_another_database(tmp_path):
    """Any URL that Optuna takes; here a second SQLite file stands for it."""
    storage = f"sqlite:///{tmp_path / 'elsewhere.db'}"
    run_study("test", RUNS[:1], partial(sleep, 0), output=tmp_path / "out", storage=storage)
    assert len(optuna.load_study(study_name="test", storage=storage).trials) == 1
    assert not (tmp_path / "out" / "study.db").exists()


@pytest.mark.parametrize(
    ("storage", "error", "message"),
    [
        ("postgresql+psycopg://me:secret@localhost/x", ValueError, "needs a driver that is not installed"),
        ("a file", ValueError, "no database's URL"),
        ("sqlite:////no/such/folder/study.db", OSError, "sqlite:... does not answer"),
    ],
)
def test_a_storage_that_cannot_be_opened_is_named_without_its_password(tmp_path, storage, error, message):
    with pytest.raises(error, match=message) as raised:
        run_study("test", RUNS[:1], partial(sleep, 0), output=tmp_path, storage=storage)
    assert "secret" not in str(raised.value)


@pytest.mark.parametrize(
    ("part", "text", "message"),
    [
        ("heatmap", "rows: [mlp]", "has no row 'mlp'"),
        ("heatmap", "rows: [finetune]", "goes on from random_mask"),
        ("heatmap", "seedz: [0]", "seedz"),
        ("heatmap", "steps: many", "steps"),
        ("table", "rows: [dt]", "has no row 'dt'"),
        ("table", "rows: [unimask_multi_task_finetune]", "goes on from unimask_multi_task"),
        ("search", "draws: 2", "space is empty"),
        ("search", "space: {widht: [8]}", "no setting 'widht'"),
        ("search", "space: {width: 8}", "space.width is 8: give a list of choices or"),
        ("search", "space: {optimizer_lr: {low: 1, hihg: 2}}", "space.optimizer_lr is"),
        ("search", "space: {width: [8]}\nenvironment: ant", "choose one of doorkey, maze2d"),
        ("search", "space: {width: [8]}\ndraws: 0", "draws is 0; it must be at least 1"),
        ("search", "space: {width: [8]}\nvariants: {}", "variants is empty"),
        ("search", "space: {width: [8]}\nseeds: []", "seeds is empty"),
        ("ablation", "seeds: []", "seeds is empty"),
        ("ablation", "variants: {a/b: {}}", "leave '/' out"),
        ("ablation", "steps: 0", "at least 1"),
        ("ablation", "zero_hidden: zeros", "the variants are default"),
        ("ablation", "rolouts: 3", "rolouts"),
    ],
)
def test_a_wrong_setting_is_named(part, text, message, tmp_path, refused):
    (tmp_path / "wrong.yaml").write_text(text)
    assert message in refused("paper", part, f"--config_path={tmp_path / 'wrong.yaml'}")
