"""Return against updates: LeRobot's evaluation of each checkpoint, recorded and drawn."""

import math

import pytest

from lerobot_unimask.paper.learning_curve import learning_curve, learning_curves
from lerobot_unimask.processor_unimask import make_unimask_pre_post_processors


@pytest.fixture
def run(tmp_path, tiny_policy):
    """A run of two checkpoints, as lerobot-train lays it out."""
    policy = tiny_policy()
    for updates in (10, 20):
        folder = tmp_path / "run" / "checkpoints" / f"{updates:06d}" / "pretrained_model"
        folder.mkdir(parents=True)
        policy.updates.fill_(updates)
        policy.save_pretrained(folder)
        for processor in make_unimask_pre_post_processors(policy.config):
            processor.save_pretrained(folder)
    return tmp_path / "run"


def test_every_checkpoint_is_rolled_out_and_the_last_one_longest(run):
    record = learning_curve([run], "doorkey", episodes=4, last_episodes=6, batch_size=3, seed=5)
    points = record["runs"][0]["checkpoints"]
    assert [(point["updates"], point["episodes"]) for point in points] == [(10, 4), (20, 6)]
    for point in points:
        assert -10 <= point["mean_return"] <= 10
        assert 0 <= point["standard_error"] <= 20 / math.sqrt(4)
        assert 0 <= point["success"] <= 1
    # The same weights from the same starts: the first rollouts of both are the same.
    again = learning_curve([run], "doorkey", episodes=4, last_episodes=4, batch_size=4, seed=5)
    first, last = again["runs"][0]["checkpoints"]
    assert first["mean_return"] == last["mean_return"] == points[0]["mean_return"]


def test_the_picture_has_a_line_for_each_run():
    points = [{"updates": u, "mean_return": 0.1 * u, "standard_error": 0.2} for u in (1, 2, 3)]
    figure = learning_curves({"runs": [{"run": name, "checkpoints": points} for name in ("k5", "k10")]})
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("updates", "mean return")
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["k5", "k10"]
    assert list(axes.containers[0].lines[0].get_ydata()) == pytest.approx([0.1, 0.2, 0.3])
