"""The random search: what is drawn, what is trained with it, and which settings are found to be the best."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import optuna
import pytest

from lerobot_unimask import cli
from lerobot_unimask.paper.search import SearchConfig, best, draw, markdown, nested, search
from lerobot_unimask.paper.study import read_config

CONFIGS = Path(__file__).parents[1] / "configs"
PAPER = read_config(SearchConfig, CONFIGS / "search.yaml").space
SMALL = {"device": "cpu", "attention": "bidirectional", "token_layout": "stacked", "depth": 1, "heads": 2}


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("search")
    return SearchConfig(
        variants={"past": {"training_masks": "past"}, "future": {"training_masks": "future"}},
        space={
            "batch_size": [4, 8],
            "width": [8, 16],
            "loss_weights.s": [0.1, 0.5],
            "optimizer_lr": {"low": 1e-5, "high": 1e-2, "log": True},
        },
        draws=2,
        steps=4,
        evaluate_every=2,
        episodes=20,
        validation_episodes=10,
        policy={**SMALL, "feedforward_width": 16},
        data=str(folder / "data"),
        output=str(folder / "output"),
    )


@pytest.fixture(scope="module")
def record(config):
    return search(config)


def test_draws_are_the_same_every_time_and_more_of_them_keep_the_first():
    assert draw(PAPER, 5) == draw(PAPER, 20)[:5]
    assert len({json.dumps(drawn) for drawn in draw(PAPER, 20)}) == 20


def test_draws_are_spread_over_the_papers_ranges():
    """All choices are about equally frequent; the learning rate's logarithm is uniform."""
    drawn = draw(PAPER, 600)
    for name, choices in PAPER.items():
        if name != "optimizer_lr":
            counts = [sum(settings[name] == choice for settings in drawn) for choice in choices]
            assert sum(counts) == 600
            assert min(counts) > 0.8 * 600 / len(choices)
    decades = [math.log10(settings["optimizer_lr"]) for settings in drawn]
    assert -5 <= min(decades) < -4.95
    assert -3.05 < max(decades) <= -3
    assert sum(decades) / 600 == pytest.approx(-4, abs=4 * (2 / 12**0.5) / 600**0.5)  # four standard errors


def test_each_run_is_trained_with_what_was_drawn(config, record):
    drawn = draw(config.space, 2)
    assert [(run["row"], run["draw"]) for run in record["runs"]] == [
        ("past", 0), ("future", 0), ("past", 1), ("future", 1),
    ]  # fmt: skip
    for run in record["runs"]:
        assert run["drawn"] == drawn[run["draw"]]
        assert run["batch_size"] == run["drawn"]["batch_size"]
        assert run["settings"]["training_masks"] == run["row"]
        assert run["settings"]["width"] == run["drawn"]["width"]
        assert run["settings"]["loss_weights"] == {"s": run["drawn"]["loss_weights.s"]}
        assert run["loss"] == min(run["curve"].values()) == run["curve"][str(run["updates"])]
    parameters = {run["drawn"]["width"]: run["parameters"] for run in record["runs"]}
    assert len(parameters) == len({settings["width"] for settings in drawn})


def test_the_study_knows_what_was_drawn(config, record):
    """Optuna's own tools, such as its dashboard, read parameters off the trials."""
    study = optuna.load_study(study_name="search", storage=f"sqlite:///{config.output}/study.db")
    assert [trial.params for trial in study.trials] == [run["drawn"] for run in record["runs"]]
    assert [trial.value for trial in study.trials] == [run["loss"] for run in record["runs"]]


def test_more_draws_go_on_and_repeat_nothing(config, record, tmp_path, capsys):
    output = shutil.copytree(config.output, tmp_path / "output")
    more = search(replace(config, draws=3, output=str(output)))
    assert more["runs"][: len(record["runs"])] == record["runs"]
    assert [run["draw"] for run in more["runs"][len(record["runs"]) :]] == [2, 2]
    assert capsys.readouterr().out.count("runs done") == 2
    with pytest.raises(ValueError, match=r"steps=4.* 5"):
        search(replace(config, steps=5, output=str(output)))


def test_the_best_draw_has_the_lowest_mean_loss_over_seeds():
    losses = {0: (3.0, 1.0), 1: (1.8, 1.8), 2: (math.nan, 0.1)}
    records = [
        {"row": "past", "draw": number, "seed": seed, "drawn": {"width": 8 + number}, "loss": loss, "updates": 5}
        for number, of_seeds in losses.items()
        for seed, loss in enumerate(of_seeds)
    ]
    found = best(records)["past"]
    assert found == {"draw": 1, "loss": 1.8, "median_loss": 2.0, "updates": [5, 5], "drawn": {"width": 9}}


def test_the_table_names_the_best_settings(config, record):
    text = markdown(record)
    assert "| model | loss | median | `batch_size` | `width` | `loss_weights.s` | `optimizer_lr` |" in text
    chosen = record["best"]["past"]
    row = f"| `past` | {chosen['loss']:.4f} | {chosen['median_loss']:.4f} | {chosen['drawn']['batch_size']} |"
    assert row in text
    output = Path(config.output)
    assert (output / "search.md").read_text() == text
    assert json.loads((output / "search.json").read_text())["best"] == record["best"]


def test_dotted_names_lead_into_mappings():
    assert nested({"width": 8, "loss_weights.s": 0.5}) == {"width": 8, "loss_weights": {"s": 0.5}}


@pytest.mark.slow
def test_the_quick_form(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cli.main(["paper", "search", f"--config_path={CONFIGS / 'search_quick.yaml'}"])
    record = json.loads(Path("outputs/search_quick/search_quick.json").read_text())
    assert record["best"].keys() == record["config"]["variants"].keys()
