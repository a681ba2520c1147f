"""The heatmap: runs, records, tables and the figure from a small grid; what its losses are."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from policies import SMALL

from lerobot_unimask import TASKS, UniMASKPolicy, cli
from lerobot_unimask.data.episodes import first_windows, open_dataset
from lerobot_unimask.paper import early_stopping
from lerobot_unimask.paper.early_stopping import train_to_lowest
from lerobot_unimask.paper.heatmap import FINETUNE, HeatmapConfig, figures, heatmap, markdown, optimum_losses
from lerobot_unimask.paper.study_tables import paper_losses
from lerobot_unimask.validation import task_losses

CONFIGS = Path(__file__).parents[1] / "configs"
STACKED = {"device": "cpu", "context_length": 10, "attention": "bidirectional", "token_layout": "stacked"}
ANSWERED = {"random_mask": set(TASKS), "decision_transformer_reward_conditioned": {"reward_conditioned"}}


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("heatmap")
    return HeatmapConfig(
        rows=[*ANSWERED, FINETUNE],
        episodes=[20],
        seeds=[0, 1],
        steps=6,
        finetune_steps=4,
        evaluate_every=2,
        batch_size=8,
        validation_episodes=30,
        policy=SMALL | STACKED,
        finetune_policy={"optimizer_lr": 0.01},
        data=str(folder / "data"),
        output=str(folder / "output"),
    )


@pytest.fixture(scope="module")
def record(config):
    return heatmap(config)


def test_every_row_has_the_tasks_that_it_answers(config, record):
    rows = record["losses"]["20"]
    assert {row: set(tasks) for row, tasks in rows.items()} == ANSWERED | {FINETUNE: set(TASKS)}
    assert all(cell["seeds"] == 2 and cell["spread"] > 0 for tasks in rows.values() for cell in tasks.values())
    assert len(record["runs"]) == 2 * (2 + len(TASKS))
    for run in record["runs"]:
        assert run["loss"] == min(run["curve"].values())
        assert run["steps"] == (4 if run["row"] == FINETUNE else 6)
        assert run["versions"].keys() == {"python", "torch", "lerobot", "lerobot_policy_unimask", "optuna"}
    json.dumps(record, allow_nan=False)
    output = Path(config.output)
    assert json.loads((output / "heatmap.json").read_text())["losses"] == record["losses"]
    for name in ("heatmap_20.png", "heatmap_20_raw.png"):
        assert (output / name).stat().st_size > 10_000


def test_a_cell_is_what_validate_finds_of_the_kept_weights(config, record):
    """The random-mask model of seed 1, loaded from its checkpoint."""
    policy = UniMASKPolicy.from_pretrained(Path(config.output) / "checkpoints" / "random_mask-20-1")
    batch = first_windows(open_dataset(policy.config, Path(config.data) / "released_validation_30"))
    (run,) = (run for run in record["runs"] if run["row"] == "random_mask" and run["seed"] == 1)
    assert run["losses"] == pytest.approx(task_losses(policy, batch, TASKS))
    assert int(policy.updates) == run["updates"]


def test_the_second_time_nothing_is_run(config, record, capsys):
    assert heatmap(config) == record
    assert "runs done" not in capsys.readouterr().out


def test_the_optimum_is_below_every_model(config, record):
    assert record["optimum"] == optimum_losses(config)
    assert record["optimum"]["forward_dynamics"] == pytest.approx(0, abs=1e-9)
    for tasks in record["losses"]["20"].values():
        assert all(cell["mean"] > record["optimum"][task] for task, cell in tasks.items())


@pytest.mark.parametrize(("patience", "ends", "best"), [(1, 2, 1), (2, 5, 3), (3, 6, 3), (4, 7, 7), (None, 7, 7)])
def test_training_ends_when_patience_does_and_keeps_the_best_weights(monkeypatch, patience, ends, best):
    """A policy whose one weight counts updates, validated after each."""
    losses = iter([3.0, 4.0, 2.0, 2.5, 2.5, 2.5, 1.0])
    weight = torch.zeros(1)
    policy = SimpleNamespace(
        training_masks=SimpleNamespace(weights={"task": 1.0}),
        state_dict=lambda: {"weight": weight},
        load_state_dict=lambda state: weight.copy_(state["weight"]),
    )

    class Trainer:
        steps = 7

        def __init__(self) -> None:
            self.policy = policy

        def __iter__(self):
            for _ in range(self.steps):
                weight.add_(1)
                yield 0.0

    monkeypatch.setattr(early_stopping, "task_losses", lambda *_: {"task": next(losses)})
    found = train_to_lowest(Trainer(), {}, every=1, patience=patience)
    assert max(found["curve"]) == ends
    assert weight.item() == found["updates"] == best


def made_up(episodes: int) -> dict:
    """A record of two rows, of which one has no number for the past."""
    seed = {"standard_error": 0.0, "spread": 0.0, "seeds": 1}
    cell = {task: {"mean": 1.5, **seed} for task in TASKS}
    other = {task: {"mean": 3.0, **seed} for task in TASKS if task != "past"}
    config = {
        "rows": ["random_mask", "other", "third"], "expert": "released", "validation_episodes": 1, "seeds": [0],
        "steps": 1, "batch_size": 1,
        "evaluate_every": 1, "finetune_steps": 1,
    }  # fmt: skip
    losses = {str(episodes): {"random_mask": cell, "other": other}}
    return {"config": config, "losses": losses, "optimum": dict.fromkeys(TASKS, 1)}


def test_tables_show_the_papers_numbers_in_brackets():
    text = markdown(made_up(500))
    assert paper_losses(500)["random_mask"]["past"] == 4.95
    assert paper_losses(7) is None
    assert "| `random_mask` | 1.500 (1.19) | 1.500 (1.14) |" in text
    assert "| `other` | 3.000 | 3.000 | 3.000 | 3.000 |  | 3.000 |" in text
    assert "| `third` |  |  |  |  |  |  |  |  | not run |" in text
    assert "| `random_mask` | 1.00 (1.06) |" in text
    assert "| `other` | 2.00 | 2.00 | 2.00 | 2.00 |  | 2.00 |" in text
    assert "| `optimum` | 0.67 | 0.67 |" in text


def test_figures_show_what_the_tables_do():
    """Cells in the order of rows; the paper's random-mask model is the only one of its rows that is drawn here."""

    def cells(figure) -> list[list[str]]:
        return [[text.get_text() for text in axes.texts] for axes in figure.axes]

    drawn = figures(made_up(500), 500)
    assert cells(drawn["heatmap_500"]) == [8 * ["1.00"] + 7 * ["2.00"] + 8 * ["0.667"], 8 * ["1.00"]]
    nats, difference = cells(drawn["heatmap_500_raw"])
    assert nats == 8 * ["1.50"] + 7 * ["3.00"] + 8 * ["1.00"]
    assert difference == [f"{1.5 - loss:+.2f}" for loss in paper_losses(500)["random_mask"].values()]
    assert [len(figure.axes) for figure in figures(made_up(7), 7).values()] == [1, 1]  # nothing to compare with


@pytest.mark.slow
def test_the_two_minute_form(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cli.main(["paper", "heatmap", f"--config_path={CONFIGS / 'heatmap_quick.yaml'}", "--workers=2"])
    assert Path("outputs/heatmap_quick/heatmap_50.png").exists()
