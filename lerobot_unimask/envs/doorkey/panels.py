"""The questions of the paper's two gridworld figures, put to one policy trained on DoorKey (sections 5.1 and 5.2).

Everything here returns data that goes into a JSON; `plots` draws it.

Legend of shapes: N trajectories, K = 10 steps of the window, which is a whole episode.
"""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from lerobot_unimask.asking.answers import Answer
from lerobot_unimask.asking.given import Given
from lerobot_unimask.asking.sampling import RejectionError
from lerobot_unimask.data.factors import RETURN_SO_FAR, STATE
from lerobot_unimask.envs.doorkey.environment import DoorKeyEnv
from lerobot_unimask.envs.doorkey.episodes import Episodes
from lerobot_unimask.envs.doorkey.rules import DOOR, GOAL, HORIZON, DynamicsCheck, cell_at
from lerobot_unimask.language.masks import parse_token
from lerobot_unimask.modeling_unimask import UniMASKPolicy


def state_at(agent: tuple[int, int], key: tuple[int, int]) -> list[int]:
    """A state as the dataset stores it, [agent cell, key cell], from two (x, y)."""
    return [int(cell_at(*agent)), int(cell_at(*key))]


# The start of the four rollouts: the key lies beside the agent, one step to the right.
START = state_at((1, 2), (2, 2))

# Name of the panel -> (question, what it is given). Only who goes down first, away from the key, meets the waypoint.
ROLLOUTS: dict[str, tuple[str, dict[str, list[int] | float]]] = {
    "Imitation": ("a[t] | s[:t+1], a[:t]", {}),
    "Another goal": ("a[t] | s[:t+1], a[:t], s[-1]", {"s[-1]": state_at((1, 4), (1, 4))}),
    "A wanted return": ("a[t] | s[:t+1], a[:t], rtg[0]", {"rtg[0]": 2.0}),
    "A waypoint": ("a[t] | s[:t+1], a[:t], s[3]", {"s[3]": state_at((2, 4), (2, 2))}),
}

BACKWARDS = "Backwards"

BACKWARDS_QUESTION = "s[:-1], a[:-1] | s[-1]"

BACKWARDS_GIVEN = {"s[-1]": [GOAL, GOAL]}

DRAWN = 100  # rollouts with drawn actions

TRIES = 30  # to draw a token, and to start a history; a model that has learnt something needs one or two

# The paper's figure of predicted states: from the bottom of the left room, over the key, into the door.
SHOWN_STATES: dict[int, list[int]] = {
    0: state_at((2, 4), (1, 2)),
    3: state_at((1, 2), (1, 2)),
    6: [DOOR, DOOR],
}


@dataclass(frozen=True)
class Panel:
    """One question and the N trajectories that answer it, as plain lists.

    Attributes:
        name: what the question is about, for people.
        question: text in the mask language.
        given: values of single tokens, {"s[-1]": [agent cell, key cell], "rtg[0]": 4.0}.
        states: (N, K, 2) agent and key cells, s[0] to s[K-1].
        actions: (N, K) of a rollout, which also has the action after the last state; (N, K - 1) of samples.
        achieved: what came of it. Of rollouts, a list with one entry for each: `return`, `success`, and for each given
            state whether they were in it at its step, as in `s[-1] reached`. Of samples: how many `possible histories`
            were found, and of these how many `tokens drawn`, those included that were `rejected` as impossible.
        share: part of `DRAWN` rollouts from the same start, with drawn actions, that did what was asked: reached
            the given state, were paid the given return, or, where nothing is given, reached the goal. A given one would
            always be met if the policy were exact. None of samples.
    """

    name: str
    question: str
    given: dict[str, list[int] | float]
    states: list[list[list[int]]]
    actions: list[list[int]]
    achieved: Mapping[str, Any]
    share: float | None = None


def five_panels(policy: UniMASKPolicy, *, seed: int = 0) -> list[Panel]:
    """The paper's gridworld figure: four rollouts of the most likely actions, and possible histories,
    sampled backwards.

    Args:
        policy: one trained on DoorKey, with a window of 10 steps.
        seed: number that samples and drawn actions follow from.

    Raises:
        ValueError: the policy's window is not one episode.
    """
    if policy.config.context_length != HORIZON:
        raise ValueError(
            f"These questions are about whole episodes of {HORIZON} steps; this policy's context_length is "
            f"{policy.config.context_length}."
        )
    panels = [rollout_panel(policy, name, question, given, seed=seed) for name, (question, given) in ROLLOUTS.items()]
    return [*panels, backwards_panel(policy, seed=seed)]


def rollout_panel(
    policy: UniMASKPolicy, name: str, question: str, given: Given, *, start: Sequence[int] = START, seed: int = 0
) -> Panel:
    """Ask `question` at every step of one episode in the real environment, and take the most likely actions; and of
    `DRAWN` more, with drawn actions, for the share that does what is asked."""
    episodes = rollout(policy, [start], question, given)
    drawn = rollout(policy, [start] * DRAWN, question, given, sample=True, seed=seed)
    share = float(did_as_asked(_achieved(drawn, given), given).mean())
    achieved = _achieved(episodes, given)
    return Panel(name, question, dict(given), _window(episodes).tolist(), episodes.action.tolist(), achieved, share)


def did_as_asked(achieved: Mapping[str, Sequence[float]], given: Given) -> np.ndarray:
    """Which rollouts reached every given state and were paid the given return, or, where nothing is given, succeeded.

    Args:
        achieved: what came of N rollouts, see `Panel`.

    Returns:
        (N,) bool.
    """
    reached = [np.asarray(values) for name, values in achieved.items() if name.endswith(" reached")]
    paid = [np.asarray(achieved["return"]) == value for token, value in given.items() if token.startswith("rtg")]
    return np.all(reached + paid if given else [np.asarray(achieved["success"])], axis=0)


def backwards_panel(policy: UniMASKPolicy, *, histories: int = 3, seed: int = 0) -> Panel:
    """Sample possible histories of a final state from the end to the start: a[K-2], s[K-2], a[K-3], ..., s[0].

    Note: No model is exact, so some tokens contradict the environment; as in the paper, they are drawn again. A model
        that has hardly learnt anything seldom draws others: it may have no history.

    Args:
        histories: number of them.
        seed: number that the samples follow from.
    """
    states, actions, achieved = [], [], {"possible histories": 0}
    with contextlib.suppress(RejectionError):
        drawn = policy.sample(
            None,
            BACKWARDS_QUESTION,
            given=BACKWARDS_GIVEN,
            samples=histories,
            order="backward",
            seed=seed,
            check=DynamicsCheck(agree=True),
            tries=TRIES,
        )
        states = drawn.values["s"].long().tolist()  # (histories, K, 2)
        actions = drawn.values["a"][:, :-1, 0].long().tolist()  # (histories, K - 1)
        achieved = {"possible histories": histories, "tokens drawn": drawn.drawn, "rejected": drawn.rejected}
    return Panel(BACKWARDS, BACKWARDS_QUESTION, dict(BACKWARDS_GIVEN), states, actions, achieved)


def predicted_states(policy: UniMASKPolicy, shown: Mapping[int, Sequence[int]] | None = None) -> Answer:
    """Every other state's distribution given the states of a few steps; nothing is said about actions.

    Args:
        shown: step -> [agent cell, key cell]; by default the paper's steps 0, 3 and 6.

    Returns:
        The answer about one window; `answer["s"]` has the agent's distribution, (1, K, 16), and the key's.
    """
    shown = SHOWN_STATES if shown is None else shown
    tokens = [f"s[{at}]" for at in shown]
    given = {token: list(state) for token, state in zip(tokens, shown.values(), strict=True)}
    return policy.infer(None, f"s[:] | {', '.join(tokens)}", given=given)


def rollout(
    policy: UniMASKPolicy,
    starts: Sequence[Sequence[int]],
    question: str,
    given: Given,
    *,
    sample: bool = False,
    seed: int = 0,
) -> Episodes:
    """Play whole episodes in the real environment, all at once, asking the policy `question` at every step.

    Args:
        starts: N times [agent cell, key cell].
        question: mask that asks for a[t].
        given: values of single tokens, shared or one per episode.
        sample: whether actions are drawn; otherwise the most likely ones are taken.
        seed: number that the draws follow from.

    Returns:
        What the expert's rollouts are made of too; the states include the one after the last action.

    Raises:
        ValueError: a start that the environment does not have; a question that cannot be asked at every step.
    """
    envs = [DoorKeyEnv(render_mode=None) for _ in starts]
    observations = [
        env.reset(options={"agent": agent, "key": key})[0] for env, (agent, key) in zip(envs, starts, strict=True)
    ]
    states, doors, actions, rewards = [_states(observations)], [_doors(envs)], [], []
    generator = torch.Generator(policy.device).manual_seed(seed)
    policy.reset()
    for _ in range(HORIZON):
        chosen = policy.select_action(
            _batch(observations), mask=question, given=given, sample=sample, generator=generator
        )  # (N, 1)
        played = [env.step(action) for env, action in zip(envs, chosen.cpu().numpy(), strict=True)]
        observations = [observation for observation, *_ in played]
        states.append(_states(observations))
        doors.append(_doors(envs))
        actions.append(chosen[:, 0].cpu().numpy())
        rewards.append(np.array([reward for _, reward, *_ in played], dtype=np.int64))
    policy.reset()
    agent, key = np.moveaxis(np.stack(states, axis=1), -1, 0)  # (N, K + 1) each
    return Episodes(agent, key, np.stack(doors, axis=1), np.stack(actions, axis=1), np.stack(rewards, axis=1))


def given_states(given: Given, context_length: int) -> dict[str, tuple[int, Sequence[int]]]:
    """The states among the given values: token -> (step, [agent cell, key cell])."""
    return {
        token: (parse_token(token, ("s",), context_length).step, value)
        for token, value in given.items()
        if token.partition("[")[0].strip() == "s"
    }


def _window(episodes: Episodes) -> np.ndarray:
    """The window's states, (N, K, 2)."""
    return np.stack([episodes.agent, episodes.key], axis=-1)[:, :HORIZON]


def _achieved(episodes: Episodes, given: Given) -> dict[str, list[float] | list[bool]]:
    return {
        "return": episodes.reward.sum(axis=1).astype(float).tolist(),
        "success": (episodes.agent == GOAL).any(axis=1).tolist(),
    } | _reached(_window(episodes), given)


def _reached(states: np.ndarray, given: Given) -> dict[str, list[bool]]:
    """For each given state, whether the trajectories, (N, K, 2), were in it at its step."""
    return {
        f"{token} reached": (states[:, at] == np.asarray(state)).all(axis=-1).tolist()
        for token, (at, state) in given_states(given, states.shape[1]).items()
    }


def _batch(observations: Sequence[Mapping[str, np.ndarray]]) -> dict[str, torch.Tensor]:
    """The environments' observations under LeRobot's names."""
    so_far = np.stack([observation["return_so_far"] for observation in observations])
    return {STATE: torch.from_numpy(_states(observations)), RETURN_SO_FAR: torch.from_numpy(so_far)}


def _states(observations: Sequence[Mapping[str, np.ndarray]]) -> np.ndarray:
    """(N, 2)"""
    return np.stack([observation["agent_pos"] for observation in observations])


def _doors(envs: Sequence[DoorKeyEnv]) -> np.ndarray:
    """(N,) bool"""
    return np.array([env.door_open for env in envs])
