"""The Maze2D table from a small grid, and its text."""

import json
from pathlib import Path

import pytest

from lerobot_unimask import cli
from lerobot_unimask.paper.study import read_config
from lerobot_unimask.paper.study_tables import paper_returns
from lerobot_unimask.paper.table import TableConfig, markdown, summary

CONFIGS = Path(__file__).parents[1] / "configs"


def run(row: str, seed: int, returns: dict[str, float]) -> dict:
    results = {question: {"mean_return": value, "standard_error": 0.5} for question, value in returns.items()}
    return {"row": row, "context_length": 5, "seed": seed, "returns": results}


def test_the_table_has_means_and_standard_errors_beside_the_papers():
    records = [run("decision_gpt", seed, {"behavior_cloning": 1.0 + seed}) for seed in (0, 1)]
    records.append(run("acts_and_asks", 0, {"behavior_cloning": 2.0, "reward_conditioned": 3.0}))
    found = summary(records)
    assert found["decision_gpt"]["k5_bc"] == {"mean": 1.5, "standard_error": pytest.approx(0.5), "seeds": 2}
    assert paper_returns()["decision_gpt"]["k5_bc"] == 2.66
    config = {"seeds": [0, 1], "rollouts": 1, "steps": 1, "finetune_steps": 1, "context_lengths": [5]}
    text = markdown({"config": config, "returns": found, "expert": 2.81, "bound": 3.3})
    assert "| `decision_gpt` | 1.50 ± 0.50 (2.66) | not run (2.32) |" in text
    assert "| `acts_and_asks` | 2.00 ± 0.50 | 3.00 ± 0.50 |" in text


@pytest.mark.slow
def test_the_two_minute_form(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cli.main(["paper", "table", f"--config_path={CONFIGS / 'maze_table_quick.yaml'}", "--workers=2"])
    record = json.loads(Path("outputs/maze_table_quick/table.json").read_text())
    assert set(record["returns"]["unimask_random_mask"]) == {"k5_bc", "k5_rc"}
    assert record["returns"].keys() == set(read_config(TableConfig, CONFIGS / "maze_table_quick.yaml").rows)
