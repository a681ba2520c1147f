"""`unimask bench --device`: its short form on a processor, and what it says of a record."""

import json
import multiprocessing
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from lerobot_unimask.bench import clock
from lerobot_unimask.bench.device import QUICK, markdown
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
    assert {"doorkey, eager, float32", "maze2d, captured, float32", "act"} <= set(record["updates"])
    assert all(run["windows_per_second"] > 0 for runs in record["updates"].values() for run in runs.values())
    assert set(record["acting"]["unimask"]) == {str(count) for count in QUICK.environments}
    assert all(run["latency_ms"]["median"] > 0 for runs in record["acting"].values() for run in runs.values())


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_the_pages_tables_are_those_of_the_record(path):
    assert markdown(json.loads(path.read_text())) in (ROOT / "docs" / "speed.md").read_text()


def test_a_device_that_is_not_there_is_refused(capsys, tmp_path):
    with pytest.raises(SystemExit):
        main(["bench", "--device=nonsense", f"--configs={ROOT / 'configs'}", f"--output={tmp_path / 'x.json'}"])
    assert "no device 'nonsense'" in capsys.readouterr().err
