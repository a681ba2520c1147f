"""The records in docs/results hold what README.md and docs/results.md say of them."""

import csv
import json
import re
import statistics
from pathlib import Path

import pytest

from lerobot_unimask import TASKS
from lerobot_unimask.paper import ablation, heatmap, table

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
PAGES = "".join(path.read_text() for path in (ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))))


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
        assert row in PAGES


def test_the_heatmaps_diagonal_and_its_general_models_are_as_good_as_the_papers():
    grid = record("heatmap.json")
    assert grid["config"]["seeds"] == [0, 1]
    rows = grid["losses"]["500"]
    for row in (*TASKS, "random_mask", "finetune"):
        published = paper(row)
        for task in TASKS if row in ("random_mask", "finetune") else (row,):
            assert rows[row][task]["seeds"] == 2
            assert rows[row][task]["mean"] <= 1.05 * published[task], (row, task)
    for line in heatmap.markdown(grid).splitlines():
        assert not re.match(r"\| `.*\(", line) or line in PAGES


def test_reading_half_of_the_windows_causally_acts_better_at_equal_updates():
    short = record("maze_table.json")
    rows = short["returns"]
    for column, cell in rows["acts_and_asks"].items():
        random = rows["unimask_random_mask"][column]
        assert cell["mean"] - random["mean"] > 2 * (cell["standard_error"] + random["standard_error"])
    for line in table.markdown(short).splitlines():
        assert not line.startswith("| `") or line in PAGES


@pytest.mark.parametrize(("rule", "success", "mean_return"), [("most_likely", 80, 6.5), ("sampled", 0, 0)])
def test_20000_episodes_act_as_the_readme_says(rule, success, mean_return):
    overall = record(f"doorkey_20000_{rule}.json")["overall"]
    assert overall["n_episodes"] == 1000
    assert overall["pc_success"] >= success
    assert overall["avg_sum_reward"] >= mean_return
    name = rule.replace("_", " ")
    assert re.search(rf"\| {name} \| {overall['pc_success']:.1f} % \| {overall['avg_sum_reward']:.2f} ±", PAGES)


def test_forward_dynamics_put_their_probability_on_the_true_next_state():
    (run,) = record("doorkey_20000.json")["runs"]
    truth = run["forward_dynamics_probability_of_truth"]
    assert truth > 0.98
    assert f"puts {truth:.3f} of its probability on the true next state" in PAGES


def returns_of(name: str) -> list[float]:
    return [value for task in record(name)["per_task"] for value in task["metrics"]["sum_rewards"]]


@pytest.mark.parametrize(("model", "row"), [("k5", "5"), ("k10", "10"), ("k10_s1", "10, second seed"), ("k20", "20")])
def test_one_maze2d_model_acts_as_the_readme_says(model, row):
    cells = []
    for question in ("imitation", "return"):
        returns = returns_of(f"maze2d_{model}_{question}.json")
        assert len(returns) == 1000
        assert statistics.mean(returns) >= 2.7
        cells.append(f"{statistics.mean(returns):.2f} ± {statistics.stdev(returns) / len(returns) ** 0.5:.2f}")
    assert f"| {row} | {cells[0]} | {cells[1]} |" in PAGES


@pytest.mark.parametrize("question", ["imitation", "return"])
def test_twice_the_context_returns_no_less_by_more_than_a_standard_error(question):
    longer, shorter = (returns_of(f"maze2d_k{K}_{question}.json") for K in (20, 10))
    error = statistics.stdev(shorter) / len(shorter) ** 0.5
    assert statistics.mean(longer) >= statistics.mean(shorter) - error


def test_every_one_question_model_returns_at_least_2():
    runs = record("maze2d_one_question.json")["runs"]
    assert [run["run"] for run in runs] == ["maze2d_bc_k5", "maze2d_rc_k5", "maze2d_bc_k10", "maze2d_rc_k10"]
    for run in runs:
        last = run["checkpoints"][-1]
        assert last["updates"] == 16000
        assert last["episodes"] == 1000
        assert last["mean_return"] >= 2.0
        assert f"| `{run['run']}` | {last['mean_return']:.2f} ± {last['standard_error']:.2f} |" in PAGES


def test_the_model_that_acts_sees_five_steps_ahead_as_well_as_random_masks_alone():
    acts, random = (record(f"maze2d_{name}_measures.json") for name in ("k10", "random_k10"))
    assert acts["policy"]["updates"] == 2 * random["policy"]["updates"]  # as many windows in both directions
    assert acts["ahead"]["model"] <= 1.05 * random["ahead"]["model"]
    assert random["ahead"]["model"] < random["ahead"]["last_displacement_repeated"]
    for found in (acts, random):
        assert f"| {found['ahead']['model']:.4f} |" in PAGES
    apart = acts["disagreement_nats"]
    assert f"agree on actions to within {max(apart.values()):.2f} nats" in PAGES


def test_doorkeys_model_that_acts_beside_random_masks_alone():
    acts, random = ([record(f"doorkey_20000_{name}{seed}.json") for seed in ("", "_s1")] for name in ("both", "random"))
    for of_seeds in (acts, random):
        assert [run["training"]["seed"] for found in of_seeds for run in found["runs"]] == [0, 1]
    stacked, best = record("doorkey_20000.json")["mean"], acts[0]["optimum"]["losses"]
    for task in TASKS:
        ours, theirs = ([found["mean"][task] for found in of_seeds] for of_seeds in (acts, random))
        difference = sum(ours) / sum(theirs) - 1
        assert difference <= (0 if task in ("behavior_cloning", "reward_conditioned") else 0.008)
        seeds = " | ".join(", ".join(f"{loss:.3f}" for loss in losses) for losses in (ours, theirs))
        assert f"| `{task}` | {seeds} | {100 * difference:+.1f} % | {stacked[task]:.3f} | {best[task]:.3f} |" in PAGES


def test_a_longer_context_costs_no_return():
    found = record("context.json")
    for question in ("behavior_cloning", "reward_conditioned"):
        means = [found["summary"][f"both, K = {K}"][question]["mean"] for K in (5, 10, 20, 40)]
        assert means[3] > means[2] > max(means[:2])
    for line in ablation.markdown(found).splitlines():
        assert not line.startswith("| both") or line in PAGES


def test_the_defaults_are_what_won_the_ablation():
    found = record("ablation.json")
    assert found["config"]["seeds"] == [0, 1]
    assert len(found["runs"]) == 2 * len(found["config"]["variants"])
    error, ahead = (
        {row.removesuffix(", K = 5"): cells[name]["mean"] for row, cells in found["summary"].items() if name in cells}
        for name in ("behavior_cloning_error", "error_ahead")
    )
    losers = ("bidirectional", "bidirectional and stacked", "drawn per update", "a quarter causal", "plain numbers")
    for loser in losers:
        assert error["default"] < 0.95 * error[loser]
    for loser in ("three quarters causal", "L2 head", "plain numbers"):
        assert ahead["default"] < 0.9 * ahead[loser]
    assert abs(error["default"] / error["zeros for hidden tokens"] - 1) < 0.01
    for row in ("half as wide", "half as deep"):
        assert 1.02 < error[row] / error["default"] < 1.05
    for line in ablation.markdown(found).splitlines():
        assert "K = 5" not in line or line in PAGES


def test_ten_million_frames_cost_what_the_readme_says():
    found = record("scale.json")
    assert found["large"]["megabytes_beyond_imports"] < 2000
    assert found["large"]["seconds"]["first_batch"] < 10
    assert found["large_over_small"]["windows_read_per_second"] > 0.8
    for size in (found["small"], found["large"]):
        cells = f"{size['seconds']['first_batch']:.2f} s | {size['megabytes_beyond_imports']:,} MB"
        assert f"| {size['frames']:,} | {cells} | {size['windows_read_per_second']:,} |" in PAGES
    own = found["large"]["megabytes"]["opened"]["now"] - found["large"]["megabytes"]["imports"]["now"]
    assert f"takes {own} MB" in PAGES


def test_encoded_inputs_are_worth_it():
    summary = record("encoding.json")["summary"]
    encoded, plain = summary["encoded numbers, K = 5"], summary["plain numbers, K = 5"]
    for question in ("behavior_cloning", "reward_conditioned"):
        assert encoded[question]["mean"] > plain[question]["mean"] + 0.5
    assert encoded["error_ahead"]["mean"] < plain["error_ahead"]["mean"]


def test_doorkey_does_what_it_is_asked():
    asked = record("doorkey_questions.json")
    assert asked["goals"]["times_imitation"] >= 3
    for row in asked["returns"]["returns"]:
        assert abs(row["mean_return"] - row["asked"]) < 0.75
        assert f"| {row['asked']} | {row['mean_return']:.2f} ± {row['standard_error']:.2f} |" in PAGES
    assert asked["visits"]["asked_to"] >= 0.8
    assert asked["visits"]["asked_not_to"] <= 0.1
    assert asked["backward"]["dynamics"]["impossible_steps"] == 0
    assert asked["backward"]["samples"] == 1000
    assert asked["consistency"]["masks"] == 1000
    assert asked["consistency"]["shown_values_changed"] == 0
    for share in ("asked_to", "asked_not_to"):
        assert f"{asked['visits'][share]:.1%}" in PAGES


@pytest.mark.parametrize("task", ["peg", "pick", "door", "drawer"])
def test_the_default_acts_on_the_arm_as_the_page_says(task):
    found, perceptron = record(f"arm_{task}_policy.json"), record(f"arm_{task}_perceptron.json")
    acts, seconds = found["remembers"]["10"]["success"], found["train_processor_seconds"]
    assert found["training"]["settings"] == {"mask_seed": 0}
    assert acts >= 0.95 - 1e-6
    assert acts > max(run["success"] for run in perceptron["updates"].values()) - 0.05
    assert f"{100 * acts:.0f} ({100 * found['remembers']['10']['standard_error']:.0f}), {seconds:.0f} s" in PAGES
