"""The pages' tables are those of their records, and the records hold what the pages' prose says of them."""

import json
import statistics
from pathlib import Path

import pytest

from lerobot_unimask import TASKS
from lerobot_unimask.paper.claims import maze2d_claims
from lerobot_unimask.paper.study_tables import paper_losses
from lerobot_unimask.paper.tables import KINDS, pages, rewrite

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
PAGES = {path.name: path.read_text() for path in pages(ROOT)}


def record(name: str) -> dict:
    return json.loads((RESULTS / name).read_text())


@pytest.mark.parametrize("page", PAGES)
def test_the_tables_are_those_of_their_records(page):
    """After `unimask paper tables` nothing has changed."""
    written, _ = rewrite(PAGES[page], ROOT)
    assert written == PAGES[page]


def test_a_table_of_no_known_kind_is_left_as_it_is_and_named(tmp_path):
    (tmp_path / "found.json").write_text("{}")
    page = "<!-- from: found.json -->\n| a | b |\n| --- | --- |\n| 1 | 2 |\n"
    assert rewrite(page, tmp_path) == (page, ["| a | b |"])


def test_a_table_is_written_from_its_records_in_their_order(tmp_path, monkeypatch):
    monkeypatch.setitem(KINDS, "made up", lambda *records: " ".join(record["value"] for record in records))
    for name in ("one", "two"):
        (tmp_path / f"{name}.json").write_text(json.dumps({"value": name}))
    markers = "<!-- from: two.json -->\n<!-- from: one.json -->\n"
    assert rewrite(f"before\n{markers}| made up |\n| old |\n\nafter\n", tmp_path) == (
        f"before\n{markers}two one\n\nafter\n",
        [],
    )


def test_a_claim_holds_of_numbers_that_do_what_it_says():
    """Fine-tuned random masks act better than single-task training with K = 5; nothing else was run."""
    cells = {row: {"k5_bc": {"mean": mean}} for row, mean in (("random_mask_finetune", 2.0), ("single_task", 1.5))}
    lines = maze2d_claims({"returns": {f"unimask_{row}": cell for row, cell in cells.items()}}).splitlines()
    (claim,) = (line for line in lines if "H1: fine-tuned random masks" in line)
    assert claim.endswith("| 4 of 4, +0.09 | 1 of 1, +0.50 | **yes** |")
    assert sum(line.endswith("| not run | not run |") for line in lines) == len(lines) - 3


def test_500_episodes_are_no_more_than_2_percent_above_the_papers_random_mask_row():
    losses = record("doorkey_500.json")
    assert {run["training"]["seed"] for run in losses["runs"]} == {0, 1}
    assert losses["validation_data"]["seed"] not in {run["training"]["data"]["seed"] for run in losses["runs"]}
    for task, published in paper_losses(500)["random_mask"].items():
        assert losses["mean"][task] <= 1.02 * published, task


@pytest.mark.parametrize("row", [*TASKS, "random_mask", "finetune"])
def test_the_heatmaps_diagonal_and_its_general_models_are_as_good_as_the_papers(row):
    ours, published = record("heatmap.json")["losses"]["500"][row], paper_losses(500)[row]
    for task in TASKS if row in ("random_mask", "finetune") else (row,):
        assert ours[task]["seeds"] >= 2
        assert ours[task]["mean"] <= 1.05 * published[task], task


@pytest.mark.parametrize(("rule", "success", "mean_return"), [("most_likely", 80, 6.5), ("sampled", 0, 0)])
def test_20000_episodes_act_as_the_readme_says(rule, success, mean_return):
    overall = record(f"doorkey_20000_{rule}.json")["overall"]
    assert overall["n_episodes"] == 1000
    assert overall["pc_success"] >= success
    assert overall["avg_sum_reward"] >= mean_return


def test_forward_dynamics_put_their_probability_on_the_true_next_state():
    (run,) = record("doorkey_20000.json")["runs"]
    truth = run["forward_dynamics_probability_of_truth"]
    assert truth > 0.98
    assert f"puts {truth:.3f} of its probability on the true next state" in PAGES["results.md"]


def returns_of(name: str) -> list[float]:
    return [value for task in record(name)["per_task"] for value in task["metrics"]["sum_rewards"]]


@pytest.mark.parametrize("question", ["imitation", "return"])
@pytest.mark.parametrize("model", ["k5", "k10", "k10_s1", "k20"])
def test_one_maze2d_model_acts_and_asks(model, question):
    returns = returns_of(f"maze2d_{model}_{question}.json")
    assert len(returns) == 1000
    assert statistics.mean(returns) >= 2.7


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


def test_the_model_that_acts_sees_five_steps_ahead_as_well_as_random_masks_alone():
    acts, random = (record(f"maze2d_{name}_measures.json") for name in ("k10", "random_k10"))
    assert acts["policy"]["updates"] == 2 * random["policy"]["updates"]  # as many windows in both directions
    assert acts["ahead"]["model"] <= 1.05 * random["ahead"]["model"]
    assert random["ahead"]["model"] < random["ahead"]["last_displacement_repeated"]
    apart = acts["disagreement_nats"]
    assert f"agree on actions to within {max(apart.values()):.2f} nats" in PAGES["results.md"]


def test_doorkeys_model_that_acts_beside_random_masks_alone():
    acts, random = ([record(f"doorkey_20000_{name}{seed}.json") for seed in ("", "_s1")] for name in ("both", "random"))
    for of_seeds in (acts, random):
        assert [run["training"]["seed"] for found in of_seeds for run in found["runs"]] == [0, 1]
    for task in TASKS:
        ours, theirs = ([found["mean"][task] for found in of_seeds] for of_seeds in (acts, random))
        difference = sum(ours) / sum(theirs) - 1
        assert difference <= (0 if task in ("behavior_cloning", "reward_conditioned") else 0.008)


def test_a_longer_context_costs_no_return():
    found = record("context.json")
    for question in ("behavior_cloning", "reward_conditioned"):
        means = [found["summary"][f"both, K = {K}"][question]["mean"] for K in (5, 10, 20, 40)]
        assert means[3] > means[2] > max(means[:2])


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


def test_ten_million_frames_cost_what_the_readme_says():
    found = record("scale.json")
    assert found["large"]["megabytes_beyond_imports"] < 2000
    assert found["large"]["seconds"]["first_batch"] < 10
    assert found["large_over_small"]["windows_read_per_second"] > 0.8
    own = found["large"]["megabytes"]["opened"]["now"] - found["large"]["megabytes"]["imports"]["now"]
    assert f"takes {own} MB" in PAGES["scale.md"]


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
    assert asked["visits"]["asked_to"] >= 0.8
    assert asked["visits"]["asked_not_to"] <= 0.1
    assert asked["backward"]["dynamics"]["impossible_steps"] == 0
    assert asked["backward"]["samples"] == 1000
    assert asked["consistency"]["masks"] == 1000
    assert asked["consistency"]["shown_values_changed"] == 0


def mean_success(runs):
    return statistics.mean(run["success"] for run in runs)


def arm_runs(name, **wanted):
    return [run for run in record(name)["runs"] if wanted.items() <= run.items()]


ARM = list(dict.fromkeys(run["task"] for run in record("arm_k5.json")["runs"]))


def test_the_default_succeeds_on_the_arm():
    ours = arm_runs("arm_k5.json", model="unimask", episodes=100)
    assert sorted((run["task"], run["seed"]) for run in ours) == sorted((task, seed) for task in ARM for seed in (0, 1))
    assert len(ARM) == 6
    assert mean_success(ours) >= 0.95
    assert all(run["settings"] == {"mask_seed": run["seed"], "context_length": 5} for run in ours)


@pytest.mark.parametrize("task", ARM)
def test_the_default_is_beside_a_perceptron_at_its_best(task):
    ours = arm_runs("arm_k5.json", model="unimask", task=task)
    perceptrons = [arm_runs("arm_k5.json", model="perceptron", task=task, updates=n) for n in (5000, 20000)]
    best = max(perceptrons, key=mean_success)
    assert mean_success(ours) > mean_success(best) - 0.05
    seconds = [statistics.mean(run["train_processor_seconds"] for run in runs) for runs in (ours, best)]
    assert seconds[0] < 10 * seconds[1]


def test_one_model_for_six_tasks_is_beside_one_for_each():
    together = arm_runs("arm_six.json")
    assert {run["task"] for run in together} == set(ARM)
    assert mean_success(together) >= mean_success(arm_runs("arm_k5.json", model="unimask")) - 0.05
