"""The records in docs/results hold what the README says of them."""

import csv
import json
import re
from pathlib import Path

import pytest

from lerobot_unimask import TASKS

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
README = (ROOT / "README.md").read_text()


def record(name: str) -> dict:
    return json.loads((RESULTS / name).read_text())


def paper(regime: str) -> dict[str, float]:
    with (RESULTS / "paper_doorkey_heatmap_500.csv").open() as file:
        (row,) = (row for row in csv.DictReader(file) if row["training"] == regime)
    return {task: float(row[task]) for task in TASKS}


def test_500_episodes_are_no_more_than_2_percent_above_the_papers_random_mask_row():
    losses = record("doorkey_500.json")
    assert len(losses["runs"]) == 2
    assert {run["training"]["seed"] for run in losses["runs"]} == {0, 1}
    assert losses["validation_episodes"] == 1000
    assert losses["validation_data"]["seed"] not in {run["training"]["data"]["seed"] for run in losses["runs"]}
    for task, published in paper("random_mask").items():
        assert losses["mean"][task] <= 1.02 * published, task
        best = losses["optimum"]["expected_losses"][task]
        row = f"| `{task}` | {losses['mean'][task]:.3f} | {losses['spread'][task]:.3f} | {published:g} | {best:.3f} |"
        assert row in README


@pytest.mark.parametrize(("rule", "success", "mean_return"), [("most_likely", 80, 6.5), ("sampled", 0, 0)])
def test_20000_episodes_act_as_the_readme_says(rule, success, mean_return):
    overall = record(f"doorkey_20000_{rule}.json")["overall"]
    assert overall["n_episodes"] == 1000
    assert overall["pc_success"] >= success
    assert overall["avg_sum_reward"] >= mean_return
    name = rule.replace("_", " ")
    assert re.search(rf"\| {name} \| {overall['pc_success']:.1f} % \| {overall['avg_sum_reward']:.2f} ±", README)


def test_forward_dynamics_put_their_probability_on_the_true_next_state():
    (run,) = record("doorkey_20000.json")["runs"]
    truth = run["forward_dynamics_probability_of_truth"]
    assert truth > 0.98
    assert f"puts {truth:.3f} of its probability on the true next state" in README


def test_maze2d_imitation_returns_what_the_readme_says():
    (run,) = record("maze2d_bc_k5.json")["runs"]
    last = run["checkpoints"][-1]
    assert last["episodes"] == 1000
    assert last["updates"] == run["training"]["steps"]
    assert f"| most likely | {last['mean_return']:.2f} ± {last['standard_error']:.2f} | 2.81 | 3.30 |" in README
