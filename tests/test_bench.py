"""The benchmark in its quick form, and what it makes of its numbers."""

import copy
import json
import multiprocessing
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from lerobot_unimask.bench import clock, measuring
from lerobot_unimask.bench.measuring import CONFIGS, QUICK, Stopwatch, alone, spread
from lerobot_unimask.bench.tables import markdown, targets
from lerobot_unimask.cli import main
from lerobot_unimask.plots.growth import cost_of_growth

ROOT = Path(__file__).parents[1]
RECORD = ROOT / "docs" / "results" / "bench.json"
PIECES = ["data", "masks", "forward", "backward", "optimiser", "rest"]


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """What `unimask bench --quick` writes."""
    output = tmp_path_factory.mktemp("bench") / "bench.json"
    with pytest.MonkeyPatch.context() as monkeypatch:
        # A server of forks would import LeRobot first; this process has done so.
        fork = multiprocessing.get_context("fork")
        monkeypatch.setattr(clock, "multiprocessing", SimpleNamespace(get_context=lambda method: fork))
        # The network of LeRobot's diffusion takes longer to make than all the rest to measure.
        monkeypatch.setattr(measuring, "POLICIES", ("unimask", "act"))
        main(["bench", "--quick", f"--configs={ROOT / 'configs'}", f"--output={output}"])
    assert output.with_suffix(".png").stat().st_size > 10_000
    return json.loads(output.read_text())


def leaves(value, path=()):
    if isinstance(value, dict):
        for name, part in value.items():
            yield from leaves(part, (*path, name))
    elif isinstance(value, list):
        for part in value:
            yield from leaves(part, path)
    else:
        yield path, value


def test_the_quick_form_measures_everything(record):
    assert record["command"].startswith("unimask bench --quick")
    assert record["machine"]["cores"] >= 1
    assert set(record["reading"]) == {"lerobot", "unimask"}
    assert set(record["building"]) == {"stepping", "building"}
    assert set(CONFIGS) <= set(record["training"])
    assert {"unimask", "act"} <= set(record["acting"])
    for runs in record["acting"].values():
        assert [int(count) for count in runs] == list(QUICK.environments)
    assert {what: tuple(point[what] for point in points) for what, points in record["growth"].items()} == QUICK.growth


def test_a_steps_shares_are_all_of_it(record):
    for run in record["training"].values():
        assert list(run["share"]) == PIECES
        assert sum(run["share"].values()) == pytest.approx(1)
        assert all(share >= 0 for share in run["share"].values())


def test_a_rollouts_parts_are_all_of_it(record):
    total, *parts = record["evaluating"]["ms_per_rollout"].values()
    assert sum(parts) == pytest.approx(total)
    assert all(part > 0 for part in parts)


def test_times_are_positive_and_memory_is_more_than_that_of_the_imports(record):
    times = ("step_ms", "latency_ms", "windows_per_second", "ms_per_episode")
    assert all(value > 0 for path, value in leaves(record) if any(name in path for name in times))
    peaks = [value for path, value in leaves(record) if path[-1] == "peak_memory_mib"]
    assert min(peaks) == record["imports"]["peak_memory_mib"] > 100


def test_batched_reads_are_those_of_lerobot_without_the_plugin(record):
    read = {who: run["windows_per_second"]["median"] for who, run in record["reading"].items()}
    assert read["unimask"] > 10 * read["lerobot"]
    share = {name: record["training"][name]["share"]["data"] for name in ("doorkey", "doorkey, LeRobot's reads")}
    assert share["doorkey, LeRobot's reads"] > share["doorkey"]


def test_targets_are_met_and_missed_at_their_bounds(record):
    def verdicts(waiting, latency, evaluation):
        changed = copy.deepcopy(record)
        changed["training"]["doorkey"]["share"] |= {"data": waiting - 0.01, "masks": 0.01}
        changed["acting"]["unimask"]["1"]["latency_ms"]["median"] = latency
        changed["building"]["stepping"]["ms_per_episode"]["median"] = 3.0
        changed["evaluating"]["ms_per_rollout"] |= {"total": evaluation, "forward": 7.0}
        return [met for *_, met in targets(changed)]

    assert verdicts(0.049, 2.9, 20.0) == [True, True, True]
    assert verdicts(0.051, 3.1, 20.1) == [False, False, False]


def test_the_tables_hold_every_run(record):
    text = markdown(record)
    for name in [*record["training"], *record["acting"]]:
        assert f"\n| {name} " in text
    assert text.count(" met |") + text.count(" missed |") == len(targets(record))
    rows = [line for line in text.splitlines() if line.startswith("|")]
    widths = {line.count("|") for line in rows if line.startswith("| doorkey")}
    assert widths == {len(PIECES) + 4}


def test_the_readmes_tables_are_those_of_the_record():
    found = json.loads(RECORD.read_text())
    assert not found["quick"]
    assert markdown(found) in (ROOT / "docs" / "speed.md").read_text()


def test_a_stopwatch_counts_every_call_and_leaves_what_it_returns(monkeypatch):
    class Worker:
        def double(self, number):
            return 2 * number

    watch, worker = Stopwatch(), Worker()
    watch.wrap(Worker, "double", "work")
    assert [worker.double(i) for i in range(3)] == [0, 2, 4]
    assert len(watch.seconds["work"]) == len(watch.began["work"]) == 3
    assert watch.began["work"] == sorted(watch.began["work"])
    assert spread([4.0, 1.0, 2.0, 3.0, 5.0]) == {"median": 3.0, "quartiles": [2.0, 4.0], "repeats": 5}


def allocate(mebibytes):
    return {"sum": torch.ones(mebibytes, 2**18).sum().item()}


@pytest.mark.slow  # the server of forks imports LeRobot
def test_a_measurements_memory_is_its_own():
    large, small = (alone("memory", allocate, mebibytes)["peak_memory_mib"] for mebibytes in (301, 1))
    assert large - small == pytest.approx(300, abs=20)


def test_a_folder_without_configs_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["bench", f"--configs={tmp_path}", f"--output={tmp_path / 'bench.json'}"])
    assert "holds no doorkey.yaml and no maze2d_k10.yaml" in capsys.readouterr().err


def test_the_figure_draws_every_point(record):
    figure = cost_of_growth(record)
    assert len(figure.axes) == 2 * len(record["growth"])
    for column, (what, points) in enumerate(record["growth"].items()):
        time, memory = (figure.axes[row * len(record["growth"]) + column] for row in (0, 1))
        assert list(time.lines[0].get_ydata()) == [point["step_ms"]["median"] for point in points]
        assert list(memory.lines[0].get_xdata()) == [point[what] for point in points]
