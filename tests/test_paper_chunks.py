"""The records of acting in Maze2D: rollouts on a clock, goals some steps ahead, several tasks, and what they count."""

from itertools import pairwise

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


@pytest.mark.parametrize("shown", ["goal", "straight", "walk"])
def test_a_goal_is_shown_no_farther_than_it_is_said(tiny_policy, monkeypatch, shown):
    """Towards the goal or the next cell on the walk; itself at any distance."""
    hidden = {**FEATURES, "observation.state": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}}
    state = {key: values[:2] for key, values in STATS["observation.state"].items()}
    policy = tiny_policy(
        "gaussian", features=hidden, stats=STATS | {"observation.state": state}, context_length=10, chunk_size=4
    )
    asked = []
    select = policy.select_action
    policy.select_action = lambda batch, **how: asked.append((batch, how)) or select(batch, **how)
    monkeypatch.setattr(chunks, "HORIZON", 5)
    found = chunks.act_towards_goals(policy, 3, shown, 0.3, seed=0)
    assert 0 <= found["success"] <= 1
    starts = [Maze2DEnv(hide_goal=True) for _ in range(3)]
    goals = [env.reset(seed=i) and env.goal for i, env in enumerate(starts)]
    assert len(asked) == 5
    for batch, how in asked:
        told = how["given"]["s[-1]"]
        if shown == "goal":
            assert told.tolist() == [list(goal) for goal in goals]
            continue
        aims = goals if shown == "straight" else [chunks._next_on_walk(env) for env in starts]
        way, here = told - batch["observation.state"], torch.tensor(aims) - batch["observation.state"]
        torch.testing.assert_close(way.norm(dim=1), here.norm(dim=1).clamp(max=0.3), rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(
            torch.nn.functional.cosine_similarity(way, here), torch.ones(3), rtol=1e-4, atol=1e-4
        )


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
