"""The records of acting in Maze2D: rollouts on a clock, goals that last, several tasks, and what they count."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from test_deployment import FEATURES, STATS

from lerobot_unimask.envs.maze2d.environment import Maze2DEnv
from lerobot_unimask.paper import chunks


@pytest.fixture
def policy(tiny_policy):
    return tiny_policy("gaussian", features=FEATURES, stats=STATS, chunk_size=8)


@pytest.mark.parametrize("delay", [0, 2, 4])
def test_a_new_chunk_begins_every_four_steps(policy, delay):
    """It is asked for every four steps, and there as soon as the delay has passed."""
    returns, steps, seams = chunks.act_in_real_time(policy, 2, delay, prefix=True, seed=0)
    assert returns.shape == (2,)
    assert steps.shape == (199, 2, 2)
    assert seams[0] == max(4, delay) + delay - 1
    assert set(torch.tensor(seams).diff().tolist()) == {4}


def test_without_a_delay_nothing_is_on_its_way(policy):
    with_mask, without = (chunks.act_in_real_time(policy, 2, 0, prefix=prefix, seed=0) for prefix in (True, False))
    assert torch.equal(with_mask[1], without[1])
    assert torch.equal(with_mask[0], without[0])


def test_with_the_mask_a_chunk_goes_on_from_the_one_before(policy, monkeypatch):
    """Its first actions are those that were carried out while it was worked out."""
    asked = []
    ask = chunks._ask
    monkeypatch.setattr(chunks, "_ask", lambda *arguments: asked.append(ask(*arguments)) or asked[-1])
    chunks.act_in_real_time(policy, 2, 4, prefix=True, seed=0)
    for before, after in pairwise(asked):
        assert torch.equal(after[:, :4], before[:, 4:8])


@pytest.fixture
def blind(tiny_policy):
    """A policy whose state is the position, without the goal."""
    hidden = {**FEATURES, "observation.state": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}}
    state = {key: values[:2] for key, values in STATS["observation.state"].items()}
    settings = {"context_length": 10, "chunk_size": 4, "n_action_steps": 2}
    return tiny_policy("gaussian", features=hidden, stats=STATS | {"observation.state": state}, **settings)


@pytest.mark.parametrize("shown", list(chunks.SHOWN))
def test_a_goal_is_told_at_every_step_and_counted_where_it_is(blind, monkeypatch, shown):
    """A policy that stands still succeeds where it stands on the goal at the start, and comes to what it is told."""
    asked = []
    select = blind.select_action
    blind.select_action = lambda batch, **how: 0 * (asked.append((batch, how)) or select(batch, **how))
    monkeypatch.setattr(chunks, "HORIZON", 5)
    found = chunks.act_towards_goals(blind, 8, "umaze", shown, "goal_conditioned", seed=0)
    environments = [Maze2DEnv("umaze", hide_goal=True) for _ in range(8)]
    starts = np.stack([env.reset(seed=i)[0]["agent_pos"] for i, env in enumerate(environments)])
    goals = np.array([env.goal for env in environments])
    there = np.roll(goals, 1, axis=0) if shown == "other" else goals
    assert len(asked) == 5
    for batch, how in asked:
        assert np.abs(batch["observation.state"].numpy() - starts).max() < 0.05
        told = {} if shown == "nothing" else {"s[-1]": there.tolist()}
        assert {token: value.tolist() for token, value in how["given"].items()} == told
    near = np.linalg.norm(starts - there, axis=1) < 0.5
    assert found.get("there", near.mean()) == near.mean()
    assert found["success"] == (np.linalg.norm(starts - goals, axis=1) < 0.5).mean()
    assert 0 < near.mean() < 1 or shown != "other"


def test_each_maze_is_asked_for_its_task_for_each_other_and_for_none(tiny_policy, monkeypatch, tmp_path):
    tiny_policy("gaussian", features=FEATURES, stats=STATS).save_pretrained(tmp_path)
    asked = []

    def rollout(*arguments, environment, batch_size, seed, **question):
        asked.append((environment["maze"], question))
        return {"mean_return": 1.0, "standard_error": 0.1, "success": 0.5}

    monkeypatch.setattr(chunks, "rollout", rollout)
    record = chunks.measure_tasks(tmp_path, ["umaze", "medium"], episodes=1, batch_size=1, seed=0)
    hidden = {"inference_mask": "a[t] | s[:t+1], a[:t]"}
    told = {maze: {"given": {"task[0]": Maze2DEnv(maze).task_description}} for maze in ("umaze", "medium")}
    assert asked == [
        *(("umaze", question) for question in ({}, told["medium"], hidden)),
        *(("medium", question) for question in (told["umaze"], {}, hidden)),
    ]
    assert [row["asked"] for row in record["tasks"]] == ["umaze", "medium", None] * 2
