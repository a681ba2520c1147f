"""`unimask bench --device` in its short form on a processor, what it says of a record, and `unimask bench --beside`."""

import json
import multiprocessing
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from lerobot_unimask.bench import beside, clock, contender
from lerobot_unimask.bench.device import QUICK
from lerobot_unimask.bench.tables import beside as table
from lerobot_unimask.bench.tables import device as device_tables
from lerobot_unimask.cli import main

ROOT = Path(__file__).parents[1]
RECORDS = sorted((ROOT / "docs" / "results").glob("device_*.json"))


@pytest.mark.slow  # four trainings
def test_the_short_form_measures_everything(tmp_path, monkeypatch):
    fork = multiprocessing.get_context("fork")
    monkeypatch.setattr(clock, "multiprocessing", SimpleNamespace(get_context=lambda method: fork))
    monkeypatch.setattr(torch._dynamo.config, "disable", True)  # compiling has tests of its own
    output = tmp_path / "device.json"
    main(["bench", "--device=cpu", "--quick", f"--configs={ROOT / 'configs'}", f"--output={output}"])
    record = json.loads(output.read_text())
    assert not record["left_out"]
    assert not record["failed"]
    assert {"doorkey, eager, float32", "maze2d, captured, float32", "act"} <= set(record["updates"])
    assert all(run["windows_per_second"] > 0 for runs in record["updates"].values() for run in runs.values())
    assert set(record["acting"]["unimask"]) == {str(count) for count in QUICK.environments}
    assert all(run["latency_ms"]["median"] > 0 for runs in record["acting"].values() for run in runs.values())


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_the_pages_tables_are_those_of_the_record(path):
    assert device_tables(json.loads(path.read_text())) in (ROOT / "docs" / "speed.md").read_text()


def test_a_device_that_is_not_there_is_refused(capsys, tmp_path):
    with pytest.raises(SystemExit):
        main(["bench", "--device=nonsense", f"--configs={ROOT / 'configs'}", f"--output={tmp_path / 'x.json'}"])
    assert "no device 'nonsense'" in capsys.readouterr().err


def test_models_take_turns(monkeypatch):
    turns = []

    def turn(model, work):
        turns.append((work, model.name))
        return {"unimask": 0.002, "before": 0.004, "masked_autoencoder": 0.003}[model.name]

    def start(model, package, environment):
        name = "before" if package == ROOT / "docs" else model
        return nullcontext(SimpleNamespace(name=name, terminate=lambda: None))

    monkeypatch.setattr(beside, "_start", start)
    monkeypatch.setattr(beside, "_turn", turn)
    monkeypatch.setattr(beside, "_await", lambda name, process: None)
    monkeypatch.setattr(beside, "find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match="holds no lerobot_unimask"):
        beside.bench_beside(ROOT / "docs")
    monkeypatch.setattr(Path, "is_dir", lambda path: True)
    record = beside.bench_beside(ROOT / "docs", repeats=2)
    names = ["unimask", "before", "masked_autoencoder"]
    repeats = beside.WARM_UP + 2
    assert turns == [(work, name) for work in beside.WORKS for _ in range(repeats) for name in names]
    assert "| action, 1 environment | 2.0 (2.0), 0.50 | 4.0 (4.0), 1.00 | 3.0 (3.0), 0.75 |" in table(record)


@pytest.mark.parametrize("work", ["random", "imitation", "2"])
def test_each_model_does_each_work(work):
    for make in (contender.unimask, contender.masked_autoencoder):
        make()(work)


def test_what_is_hidden_from_the_masked_autoencoder_changes_nothing():
    model, shown = contender.MaskedAutoencoder(), torch.ones(2 * contender.CONTEXT, dtype=torch.bool)
    shown[6] = False  # the state at step 3
    state, action = torch.randn(2, 10, contender.STATE), torch.randn(2, 10, contender.ACTIONS)
    other = state.clone()
    other[:, 3] += 1
    for one, same in zip(model(state, action, shown), model(other, action, shown), strict=True):
        assert torch.equal(one, same)
    assert not torch.equal(model(state, action, ~shown)[0], model(other, action, ~shown)[0])
