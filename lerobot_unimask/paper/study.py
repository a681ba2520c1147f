"""A grid of runs as an Optuna study: any number of workers, on any number of machines, share what is left to do.

Each run is a trial that is enqueued with its specification; a worker takes the next one, runs it, and stores its
record, JSON, with the trial and as a file. Nothing is run twice: not by a second worker, not after an interruption. A
worker that dies stops its heartbeat, and another takes up what it was doing (Optuna's retry callback). The
storage is an SQLite file, for one machine, or any database that Optuna supports.
"""

import fcntl
import json
import logging
import math
import multiprocessing
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import draccus
import optuna
import sqlalchemy
import torch
import yaml
from optuna.distributions import BaseDistribution
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.trial import FrozenTrial, TrialState

from lerobot_unimask.machine import describe_machine
from lerobot_unimask.records import commit, versions, write_json

Run = dict[str, Any]  # what makes a run: JSON values

Execute = Callable[[Run], dict[str, Any]]  # does one; returns its record, JSON values, with a "loss"

HEARTBEAT = 15  # seconds; a worker counts as dead after four

_OPEN = (TrialState.WAITING, TrialState.RUNNING)

logger = logging.getLogger(__name__)


@dataclass
class StudyConfig:
    """What every study's YAML file says; each kind of study adds its own. Lists are the grid, which may grow.

    Raises:
        ValueError: a list that is empty, or a count below 1.
    """

    name: str = "study"
    # Runs of the same name in the same storage are shared.
    seeds: list[int] = field(default_factory=lambda: [0, 1])
    steps: int = 4000
    # Updates of a run.
    batch_size: int = 100
    policy: dict[str, Any] = field(default_factory=dict)
    # Settings of every run's policy.
    data: str = "data/study"
    # Folder of the dataset or datasets, which are built where they are missing.
    output: str = "outputs/study"
    # Folder of the records, checkpoints, tables and figures, and of the study's file.

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value == []:
                raise ValueError(f"{name} is empty; it needs at least one entry.")
            if isinstance(value, int) and value < 1:
                raise ValueError(f"{name} is {value}; it must be at least 1.")

    def settings(self) -> dict[str, Any]:
        """All that a run's record depends on besides the run itself."""
        settings = {name: value for name, value in asdict(self).items() if not isinstance(value, list)}
        return {name: value for name, value in settings.items() if name not in ("name", "output")}


@dataclass
class VariantsConfig(StudyConfig):
    """A study of several settings of the policy.

    Raises:
        ValueError: no variant, or one that cannot name files.
    """

    variants: dict[str, dict[str, Any]] = field(default_factory=lambda: {"default": {}})
    # Name -> settings of the policy, over those of `policy`.

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.variants:
            raise ValueError("variants is empty; it needs at least one entry.")
        if any("/" in name for name in self.variants):
            raise ValueError("A variant gives its files their names: leave '/' out of it.")

    def settings(self) -> dict[str, Any]:
        settings = super().settings()
        return settings | {f"variants.{name}": value for name, value in settings.pop("variants").items()}


def check_rows(rows: Sequence[str], known: Collection[str], finetuned: Mapping[str, str]) -> None:
    """
    Args:
        finetuned: row -> the one whose weights it goes on from.

    Raises:
        ValueError: a row that there is not, or a fine-tuned one without the one before it.
    """
    names = [*known, *finetuned]
    for row in rows:
        if row not in names:
            raise ValueError(f"The study has no row {row!r}; its rows are {', '.join(names)}.")
        if row in finetuned and finetuned[row] not in rows:
            raise ValueError(f"The row {row} goes on from {finetuned[row]}: add that row too.")


class _Storage(RDBStorage):
    """Optuna's storage, with two gaps closed that killed workers fall into.

    SQLite has no row locks, and two processes could take the same trial: a lock beside the file keeps them apart. And a
    worker killed after taking a trial, before its first heartbeat, would never count as dead: here the heartbeat comes
    first.
    """

    def __init__(self, url: str, heartbeat: int):
        self.lock = url.removeprefix("sqlite:///") + ".lock" if url.startswith("sqlite:///") else None
        super().__init__(
            url,
            engine_kwargs={"connect_args": {"timeout": 60}} if self.lock else None,
            heartbeat_interval=heartbeat,
            grace_period=4 * heartbeat,
            heartbeat_stale_trial_callback=RetryHeartbeatStaleTrialCallback(),
        )

    def set_trial_state_values(self, trial_id: int, state: TrialState, values: Sequence[float] | None = None) -> bool:
        with open(self.lock, "a") if self.lock else nullcontext() as file:
            if file:
                fcntl.flock(file, fcntl.LOCK_EX)
            if state == TrialState.RUNNING:
                self.record_heartbeat(trial_id)
            return super().set_trial_state_values(trial_id, state, values)


def run_study(
    name: str,
    runs: Sequence[Run],
    execute: Execute,
    *,
    output: Path,
    settings: Mapping[str, Any] | None = None,
    space: Mapping[str, BaseDistribution] | None = None,
    storage: str | None = None,
    workers: int = 1,
    heartbeat: int = HEARTBEAT,
) -> list[dict[str, Any]]:
    """Do all runs that no one has done yet, and wait for those that others are doing.

    Args:
        name: the study's; runs of the same study are shared.
        execute: does one run. With several workers it must be picklable.
        output: folder; each record goes to `output/runs/KEY.json`.
        settings: all else that the records depend on, JSON values; kept in `output/settings.json`.
        space: what each run's `drawn` values were drawn from, which Optuna's own tools then know.
        storage: a database's URL; None: `sqlite:///OUTPUT/study.db`.
        workers: processes to start here; with 1 this process works itself, with 0 nothing is run.
        heartbeat: seconds.

    Returns:
        The records, in the order of `runs`; with 0 workers, of those that are done.

    Raises:
        ValueError: the folder holds runs of other settings.
        ChildProcessError: some runs were not finished; the same call goes on with them.
    """
    (output / "runs").mkdir(parents=True, exist_ok=True)
    _keep_settings(output, settings or {})
    storage = storage or f"sqlite:///{(output / 'study.db').resolve()}"
    study = _open(name, storage, heartbeat)
    known = {
        key_of(trial) for trial in study.get_trials(deepcopy=False) if trial.state in (*_OPEN, TrialState.COMPLETE)
    }
    for run in runs if workers else ():
        if key(run) not in known:
            enqueue(study, run, space)
    arguments = (name, storage, execute, output, heartbeat)
    if workers == 1:
        work(*arguments)
    elif workers:
        context = multiprocessing.get_context("spawn")
        processes = [context.Process(target=_worker, args=arguments) for _ in range(workers)]
        for process in processes:
            process.start()
        for process in processes:
            process.join()
    done = {key_of(trial): trial for trial in study.get_trials(deepcopy=False) if trial.state == TrialState.COMPLETE}
    missing = [key(run) for run in runs if key(run) not in done]
    if missing and workers:
        raise ChildProcessError(
            f"{len(missing)} of {len(runs)} runs were not finished: {', '.join(missing[:5])}. "
            "The same command goes on with them."
        )
    return [done[key(run)].user_attrs["record"] for run in runs if key(run) in done]


def enqueue(study: optuna.Study, run: Run, space: Mapping[str, BaseDistribution] | None = None) -> None:
    drawn = {"params": run["drawn"], "distributions": dict(space)} if space else {}
    study.add_trial(optuna.create_trial(state=TrialState.WAITING, user_attrs={"run": run}, **drawn))


def _keep_settings(output: Path, settings: Mapping[str, Any]) -> None:
    """Runs are known by their names alone, so what is done once must not be mixed with what other settings give."""
    path = output / "settings.json"
    kept = json.loads(path.read_text()) if path.exists() else {}
    settings = json.loads(json.dumps(settings))  # as they will be read
    for name, value in settings.items():
        if kept.get(name, value) != value:
            raise ValueError(
                f"{output} holds runs with {name}={json.dumps(kept[name])}, and now it is {json.dumps(value)}: choose "
                "another name and output."
            )
    write_json(path, {**kept, **settings}, say=False)


def work(name: str, storage: str, execute: Execute, output: Path, heartbeat: int) -> None:
    """Take runs until none is waiting and none is being done."""
    study = _open(name, storage, heartbeat)
    while True:
        with _without_warnings():
            optuna.storages.fail_stale_trials(study)  # gives back what dead workers were doing
        states = {trial.state for trial in study.get_trials(deepcopy=False)}
        if TrialState.WAITING in states:
            study.optimize(lambda trial: _objective(trial, study, execute, output), n_trials=1)
        elif TrialState.RUNNING in states:
            time.sleep(min(heartbeat, 5))
        else:
            return


def _worker(*arguments: Any) -> None:
    torch.set_num_threads(1)  # two threads beside another busy process are many times slower than one
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    work(*arguments)


def _objective(trial: optuna.Trial, study: optuna.Study, execute: Execute, output: Path) -> float:
    run = trial.user_attrs.get("run")
    if run is None:  # another worker was quicker, and the queue was empty
        raise optuna.TrialPruned
    others = [other for other in study.get_trials(deepcopy=False) if key_of(other) == key(run)]
    if any(o.number < trial.number and o.state in (*_OPEN, TrialState.COMPLETE) for o in others):
        raise optuna.TrialPruned  # enqueued twice, by two machines at once
    path = output / "runs" / f"{key(run)}.json"
    if "record" in trial.user_attrs:  # done by a worker that died before it could say so
        record = trial.user_attrs["record"]
    elif path.exists():  # by one that died even before it could store it
        record = json.loads(path.read_text())
    else:
        began, processor = time.monotonic(), time.process_time()
        record = {
            **run,
            **execute(run),
            "wall_seconds": round(time.monotonic() - began, 1),
            "processor_seconds": round(time.process_time() - processor, 1),
            "commit": commit(),
            "machine": describe_machine(),
            "versions": versions("optuna"),
        }
    if not path.exists():
        write_json(path, record, say=False)
    trial.set_user_attr("record", record)
    print(_progress(study, trial, record), flush=True)
    return math.inf if math.isnan(record["loss"]) else record["loss"]  # Optuna would count it as a failure


def _progress(study: optuna.Study, trial: optuna.Trial, record: dict[str, Any]) -> str:
    trials = study.get_trials(deepcopy=False)
    states = [other.state for other in trials]
    done = states.count(TrialState.COMPLETE) + 1  # this one is about to be
    left = sum(other.state in _OPEN for other in trials) - 1
    times = [other.user_attrs["record"]["wall_seconds"] for other in trials if "record" in other.user_attrs]
    minutes = left * sum(times) / len(times) / max(states.count(TrialState.RUNNING), 1) / 60
    return (
        f"{done} of {done + left} runs done: {key(record)}, loss {record['loss']:.4f}, {record['wall_seconds']:.0f} s; "
        f"about {minutes:.0f} minutes left"
    )


def read_config[Config](kind: type[Config], path: Path) -> Config:
    """A YAML file as a dataclass.

    Raises:
        ValueError: a setting that does not exist, or a value of the wrong type.
    """
    try:
        return draccus.decode(kind, yaml.safe_load(path.read_text()) or {})
    except (draccus.utils.DecodingError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: {error}") from error
    except draccus.utils.ParsingError as error:  # a value that the dataclass itself refuses
        raise ValueError(f"{path}: {error.__cause__ or error}") from error


def key(run: Run) -> str:
    """A run's name: row, episodes, context length or draw, and seed."""
    names = ("row", "task", "episodes", "context_length", "draw", "seed")
    return "-".join(str(run[name]) for name in names if name in run)


def key_of(trial: FrozenTrial) -> str | None:
    run = trial.user_attrs.get("run")
    return key(run) if run else None


def write_results(output: Path, name: str, record: Mapping[str, Any], text: str) -> None:
    """A study's record as NAME.json, its table as NAME.md."""
    write_json(output / f"{name}.json", record, say=False)
    (output / f"{name}.md").write_text(text)


def mean_over_seeds(values: Sequence[float], alone: float = 0.0) -> dict[str, float]:
    """
    Args:
        alone: the standard error of one value.

    Returns:
        mean, standard_error, seeds.
    """
    numbers = torch.tensor(values, dtype=torch.float64)
    n = len(numbers)
    error = numbers.std().item() / math.sqrt(n) if n > 1 else alone
    return {"mean": numbers.mean().item(), "standard_error": error, "seeds": n}


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Optuna has called heartbeats and retries experimental since 2021."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        yield


def _open(name: str, storage: str, heartbeat: int) -> optuna.Study:
    """
    Raises:
        ValueError: no database's URL, or one whose driver is not installed.
        ConnectionError: the database does not answer.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    kind = storage.partition(":")[0]  # what comes after it may hold a password
    try:
        with _without_warnings():
            return optuna.create_study(storage=_Storage(storage, heartbeat), study_name=name, load_if_exists=True)
    except ImportError as error:
        raise ValueError(
            f"--storage={kind}:... needs a driver that is not installed ({error.__cause__ or error}). "
            "For postgresql://: uv run --with 'psycopg[binary]' unimask ...; for mysql+pymysql://: --with pymysql."
        ) from error
    except sqlalchemy.exc.ArgumentError as error:
        raise ValueError(f"--storage={kind} is no database's URL, such as postgresql://ME@HOST/NAME.") from error
    except sqlalchemy.exc.OperationalError as error:
        raise ConnectionError(f"--storage={kind}:... does not answer: {str(error.orig).splitlines()[0]}") from error
