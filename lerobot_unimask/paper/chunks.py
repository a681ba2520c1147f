"""Acting in Maze2D: what chunks and real-time chunking return and cost, and how far actions jump between chunks; what
comes of goals that last, and of tasks that are asked for or hidden.

Legend of shapes: B environments, T steps, H actions of a chunk, D the numbers of an action.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset
import torch
from torch import Tensor

from lerobot_unimask.asking.acting import new_memory, plan
from lerobot_unimask.envs.maze2d.environment import Maze2DEnv
from lerobot_unimask.envs.maze2d.maze import HORIZON, SUCCESS_DISTANCE, task_of
from lerobot_unimask.evaluating import rollout
from lerobot_unimask.modeling_unimask import UniMASKPolicy
from lerobot_unimask.paper.study_tables import SHOWN, acting_table, real_time_table
from lerobot_unimask.records import versions

AGAIN = 4  # steps from one request for a chunk to the next, or the delay if it is longer


def measure_chunks(
    checkpoint: Path,
    data: Path,
    *,
    episodes: int,
    rtc_episodes: int,
    batch_size: int,
    chunk_size: int,
    carried_out: Sequence[int],
    delays: Sequence[int],
    seed: int,
) -> dict[str, Any]:
    """A JSON record: returns of acting without and with chunks, and of real-time chunking.

    Args:
        data: folder of a dataset, whose own steps from action to action stand beside those of the policy.
        episodes: rollouts of lerobot-eval for each way of acting.
        rtc_episodes: rollouts for each delay, with the mask of the actions on their way and without it.
        chunk_size: H of acting with chunks; real-time chunking has chunks of twice the longest delay.
        carried_out: numbers of actions that are carried out before acting asks again.
        delays: steps that pass until a chunk is there.
    """
    rows = []
    for size, steps in [(1, 1), *((chunk_size, steps) for steps in carried_out)]:
        with _watched() as watch:
            result = rollout(
                checkpoint, "maze2d", episodes, batch_size=batch_size, seed=seed, chunk_size=size, n_action_steps=steps
            )
        calls = watch["calls"]
        costs = {"ms": 1000 * watch["seconds"] / calls, "passes": watch["passes"] / calls}
        rows.append({"chunk_size": size, "n_action_steps": steps, **result, **costs})
        print(f"H = {size}, {steps} carried out: {result['mean_return']:.3f}", flush=True)
    policy = UniMASKPolicy.from_pretrained(checkpoint)
    policy.config.chunk_size = 2 * max(*delays, AGAIN)
    scale = policy.statistics.a_std
    chunking = []
    for delay in delays:
        for prefix in (True, False):
            returns, steps, seams = act_in_real_time(policy, rtc_episodes, delay, prefix=prefix, seed=seed)
            jumps = (steps / scale).abs().mean(-1)  # (T - 1, B)
            chunking.append({"delay": delay, "mask": prefix, **_spread(returns), **_jumps(jumps, seams)})
            print(f"delay {delay}, {'with' if prefix else 'without'} the mask: {chunking[-1]}", flush=True)
    table = pyarrow.dataset.dataset(data / "data", format="parquet").to_table(["action", "frame_index"])
    actions = torch.from_numpy(np.stack(table["action"].to_numpy()))
    own = (actions.diff(dim=0) / scale).abs().mean(-1)[torch.from_numpy(table["frame_index"].to_numpy())[1:] > 0]
    return {
        "acting": rows,
        "data_mean": own.mean().item(),
        "data_99": float(np.quantile(own.numpy(), 0.99)),
        "real_time": {"chunk_size": policy.config.chunk_size, "rollouts": rtc_episodes, "rows": chunking},
        "batch_size": batch_size,
        "seed": seed,
        "policy": policy.describe_origin(),
        "versions": versions(),
    }


def act_in_real_time(
    policy: UniMASKPolicy, episodes: int, delay: int, *, prefix: bool, seed: int
) -> tuple[Tensor, Tensor, list[int]]:
    """Rollouts on a clock: a chunk that is asked for at step k is there at step k + delay, and nothing waits but the
    first action.

    Args:
        prefix: whether the policy is told which actions are on their way meanwhile.

    Returns:
        (B,) returns, (T - 1, B, D) differences of each action from the one before, and the steps (counted in these)
        at which a new chunk begins.
    """
    environments = [Maze2DEnv(render_mode=None) for _ in range(episodes)]
    states = np.stack([env.reset(seed=seed + i)[0]["agent_pos"] for i, env in enumerate(environments)])
    returns, actions, seams = np.zeros(episodes), [], []
    planned = _ask(policy, states, 0, None)
    asked, asked_at = None, 0  # the first chunk is waited for
    for step in range(HORIZON):
        if asked is not None and step - asked_at == delay:
            planned, asked = asked[:, delay:], None
            seams.append(step - 1)
        if step - asked_at >= max(AGAIN, delay):
            asked, asked_at = _ask(policy, states, delay, planned if prefix else None), step
            if delay == 0:
                planned, asked = asked, None
                seams.append(step - 1)
        action, planned = planned[:, 0], planned[:, 1:]
        actions.append(action)
        results = [env.step(one) for env, one in zip(environments, action.numpy(), strict=True)]
        states = np.stack([result[0]["agent_pos"] for result in results])
        returns += [result[1] for result in results]
    taken = torch.stack(actions).clamp(-1, 1)
    return torch.from_numpy(returns), taken.diff(dim=0), seams


@torch.no_grad()
def _ask(policy: UniMASKPolicy, states: np.ndarray, delay: int, left: Tensor | None) -> Tensor:
    """(B, H, D), as `predict_action_chunk` answers, whose left-over is one robot's: here each mass has its own."""
    memory = new_memory(policy, len(states))
    memory.observe(torch.from_numpy(states), None)
    return plan(policy, memory, policy.config.chunk_size, prefix=None if left is None else left[:, :delay])


def measure_goals(
    checkpoint: Path, maze: str, *, episodes: int, chunk_sizes: Sequence[int], mask: str, n_action_steps: int, seed: int
) -> dict[str, Any]:
    """A JSON record: rollouts of a policy whose state is the position without the goal, which is told of the goal by
    s[-1] alone, H - 1 steps from now at every step, beside imitation, which is told nothing.

    Args:
        maze: that of its episodes, a name or a text.
        episodes: rollouts of each way, all from the same starts.
        chunk_sizes: H; with the first one nothing and another rollout's goal are shown too.
        mask: the question that shows s[-1].
        n_action_steps: actions of a chunk that are carried out.
    """
    policy, rows = UniMASKPolicy.from_pretrained(checkpoint), []
    policy.config.n_action_steps = n_action_steps
    for size in chunk_sizes:
        policy.config.chunk_size = size
        for shown in SHOWN if size == chunk_sizes[0] else ("goal",):
            found = act_towards_goals(policy, episodes, maze, shown, mask, seed=seed)
            rows.append({"chunk_size": size, "shown": shown, **found})
            print(f"H = {size}, shown {shown}: {found}", flush=True)
    return {
        "goals": rows,
        "maze": maze,
        "mask": mask,
        "n_action_steps": n_action_steps,
        "episodes": episodes,
        "seed": seed,
        "policy": policy.describe_origin(),
        "versions": versions(),
    }


@torch.no_grad()
def act_towards_goals(
    policy: UniMASKPolicy, episodes: int, maze: str, shown: str, mask: str, *, seed: int
) -> dict[str, float]:
    """Rollouts, one beside another.

    Args:
        shown: a key of `SHOWN`.

    Returns:
        mean return, its standard error, the share of successes, and the share that comes as near to what is shown.
    """
    environments = [Maze2DEnv(maze, render_mode=None, hide_goal=True) for _ in range(episodes)]
    positions = np.stack([env.reset(seed=seed + i)[0]["agent_pos"] for i, env in enumerate(environments)])
    goals, returns = np.array([env.goal for env in environments], np.float32), np.zeros(episodes)
    there = np.roll(goals, 1, axis=0) if shown == "other" else goals
    nearest = np.full(episodes, np.inf)
    question: dict[str, Any] = {"mask": "behavior_cloning", "given": {}}
    if shown != "nothing":
        question = {"mask": mask, "given": {"s[-1]": torch.from_numpy(there)}}
    policy.reset()
    for _ in range(HORIZON):
        actions = policy.select_action({"observation.state": torch.from_numpy(positions)}, **question)
        results = [env.step(one) for env, one in zip(environments, actions.numpy(), strict=True)]
        positions = np.stack([result[0]["agent_pos"] for result in results])
        returns += [result[1] for result in results]
        nearest = np.minimum(nearest, np.linalg.norm(positions - there, axis=1))
    success = np.mean([result[4]["is_success"] for result in results]).item()
    reached = {} if shown == "nothing" else {"there": float((nearest <= SUCCESS_DISTANCE).mean())}
    return {**_spread(torch.from_numpy(returns)), "success": success, **reached}


def measure_tasks(
    checkpoint: Path, mazes: Sequence[str], *, episodes: int, batch_size: int, seed: int
) -> dict[str, Any]:
    """A JSON record: rollouts of lerobot-eval in each maze, of which each is a task of the policy's, asked for the task
    of the maze, which the environment says, for each other, and with the task hidden."""
    rows = []
    for maze in mazes:
        for asked in (*mazes, None):
            question: dict[str, Any] = {}
            if asked is None:
                question["inference_mask"] = "a[t] | s[:t+1], a[:t]"
            elif asked != maze:
                question["given"] = {"task[0]": task_of(asked)}
            result = rollout(
                checkpoint,
                "maze2d",
                episodes,
                batch_size=batch_size,
                seed=seed,
                environment={"maze": maze},
                **question,
            )
            rows.append({"maze": maze, "asked": asked, **result})
            print(f"in {maze}, asked for {asked}: {result['mean_return']:.3f}, {result['success']:.3f}", flush=True)
    policy = UniMASKPolicy.from_pretrained(checkpoint)
    return {
        "tasks": rows,
        "batch_size": batch_size,
        "seed": seed,
        "policy": policy.describe_origin(),
        "versions": versions(),
    }


@contextmanager
def _watched() -> Iterator[dict[str, float]]:
    """Counts the calls of select_action, their seconds and the network's passes."""
    watch = {"calls": 0, "seconds": 0.0, "passes": 0}
    select, make = UniMASKPolicy.select_action, UniMASKPolicy.__init__

    def counted(self: UniMASKPolicy, *arguments: Any, **options: Any) -> None:
        make(self, *arguments, **options)
        self.network.register_forward_hook(lambda *_: watch.update(passes=watch["passes"] + 1))

    def timed(self: UniMASKPolicy, batch: dict[str, Tensor]) -> Tensor:
        began = time.perf_counter()
        action = select(self, batch)
        watch["calls"], watch["seconds"] = watch["calls"] + 1, watch["seconds"] + time.perf_counter() - began
        return action

    UniMASKPolicy.select_action, UniMASKPolicy.__init__ = timed, counted
    try:
        yield watch
    finally:
        UniMASKPolicy.select_action, UniMASKPolicy.__init__ = select, make


def _spread(returns: Tensor) -> dict[str, float]:
    return {"mean_return": returns.mean().item(), "standard_error": (returns.std() / len(returns) ** 0.5).item()}


def _jumps(jumps: Tensor, seams: list[int]) -> dict[str, float]:
    """Mean and 99th percentile, in standard deviations of the data's actions, at the seams and inside the chunks."""
    inside = torch.ones(len(jumps), dtype=torch.bool)
    inside[seams] = False
    here = {"seam": jumps[~inside].flatten(), "inside": jumps[inside].flatten()}
    found = {}
    for name, values in here.items():
        found[f"{name}_mean"], found[f"{name}_99"] = values.mean().item(), values.quantile(0.99).item()
    return found


def markdown(record: dict[str, Any]) -> str:
    """Both tables of a record."""
    own = f"The data's own steps: {record['data_mean']:.3f} on average, 99 % within {record['data_99']:.3f}."
    return f"{acting_table(record)}\n\n{real_time_table(record)}\n\n{own}"
