"""Studies: every run is done once, whoever is killed; records are those of the runs; interrupted ones go on."""

import json
import multiprocessing
import random
import time
import uuid
from functools import partial
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState

from lerobot_unimask.experiments import study as module
from lerobot_unimask.experiments.study import key, run_study

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
    assert records[0].keys() >= {"token", "wall_seconds", "versions"}
    assert "3 of 3 runs done: row-50-2, loss 2.0000" in capsys.readouterr().out
    more = run_study("test", RUNS[:5], partial(sleep, 0), output=tmp_path)  # the grid has grown
    assert more[:3] == records
    assert tokens(tmp_path) == {key(record): record["token"] for record in more}
    assert set(states_of(tmp_path)) == {key(run) for run in RUNS[:5]}


def test_runs_of_other_settings_are_not_mixed_with_those_that_are_done(tmp_path):
    do = partial(run_study, "test", execute=partial(sleep, 0), output=tmp_path)
    done = do(runs=RUNS[:1], settings={"steps": 10, "variants.a": {"width": 16}})
    with pytest.raises(ValueError, match=r"holds runs with steps=10, and now it is 20: choose another name and output"):
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


def test_what_two_machines_enqueue_at_once_is_done_once(tmp_path):
    output = tmp_path
    (output / "runs").mkdir()
    study = module._open("test", f"sqlite:///{(output / 'study.db').resolve()}", 1)
    for _ in range(2):
        study.enqueue_trial({}, user_attrs={"run": RUNS[0]})
    run_study("test", RUNS[:1], partial(sleep, 0), output=output, heartbeat=1)
    assert sorted(states_of(output)["row-50-0"]) == sorted([TrialState.COMPLETE, TrialState.PRUNED])


def test_killing_workers_loses_no_finished_run_and_repeats_none(tmp_path):
    """Workers are killed at random, four in all; records that were there at a kill are the same at the end."""
    rng = random.Random(0)
    output = tmp_path
    storage = f"sqlite:///{(output / 'study.db').resolve()}"
    (output / "runs").mkdir()
    study = module._open("test", storage, 1)
    for run in RUNS:
        study.enqueue_trial({}, user_attrs={"run": run})
    context = multiprocessing.get_context("fork")  # spawned workers would each import LeRobot first
    arguments = ("test", storage, partial(sleep, 0.4), output, 1)

    def start():
        process = context.Process(target=module.work, args=arguments)
        process.start()
        return process

    workers = [start(), start()]
    kept: dict[str, str] = {}
    for _ in range(4):
        time.sleep(rng.uniform(0.3, 1.2))
        killed = workers.pop(rng.randrange(len(workers)))
        killed.kill()
        killed.join()
        found = tokens(output)
        assert kept.items() <= found.items()
        kept = found
        workers.append(start())
    records = run_study("test", RUNS, partial(sleep, 0.4), output=output, heartbeat=1)
    for worker in workers:
        worker.join()
    final = tokens(output)
    assert 0 < len(kept) < len(RUNS)  # killed in the middle
    assert kept.items() <= final.items()
    assert final == {key(record): record["token"] for record in records}
    assert all(states.count(TrialState.COMPLETE) == 1 for name, states in states_of(output).items() if name)
    assert any(TrialState.FAIL in states for states in states_of(output).values())  # somebody was in the middle of one


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
