"""How well one DoorKey policy does what it is asked: goals, returns and a property in rollouts, samples, and marginals.

Rollouts sample their actions, the imitation that they stand beside as well, and play the rules' tables. What the expert
does from a start is exact, by dynamic programming over the same tables.

Legend of shapes: P starts, N rollouts, K = 10 steps, S = 512 states (agent cell, key cell, door open or not).
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_unimask.asking.given import Given
from lerobot_unimask.asking.sampling import Check, Samples
from lerobot_unimask.data.factors import RETURN_SO_FAR, STATE
from lerobot_unimask.envs.doorkey.expert import Expert, expert_probabilities
from lerobot_unimask.envs.doorkey.panels import BACKWARDS_QUESTION, START
from lerobot_unimask.envs.doorkey.rules import ACTIONS, CELLS, HORIZON, START_PAIRS, DynamicsCheck, reward, step
from lerobot_unimask.language.masks import RANDOM_MASK, TASKS, Mask
from lerobot_unimask.language.training_masks import TrainingMasks
from lerobot_unimask.modeling_unimask import UniMASKPolicy
from lerobot_unimask.records import versions

IMITATION, GOAL, RETURN = (TASKS[name] for name in ("behavior_cloning", "goal_conditioned", "reward_conditioned"))

PROPERTY = "visits_corner"

PROPERTY_QUESTION = f"a[t] | s[:t+1], a[:t], {PROPERTY}[0]"

CORNER = 0  # the cell (1, 1)

RARE, COMMON = 0.01, 0.10  # probabilities of the final states that are asked for

RETURNS = range(7)

# Drawn in every order. An action is one number; a state's two are drawn together where they are predicted so.
ACTIONS_QUESTION, HISTORY_QUESTION = "a[:] | s[0]", "s[1:], a[:] | s[0]"


@dataclass(frozen=True)
class Outcomes:
    """What the expert does from each start, exactly.

    final: (P, 16, 16), the probability of s[K-1], by agent and key cell.
    returns: (P, 21), of the episode's return, -10 to 10.
    visits: (P,), of ever being in the corner in s[0] to s[K-1].
    """

    final: np.ndarray
    returns: np.ndarray
    visits: np.ndarray


def possible_steps(states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Whether each state follows from the one before by the action between them.

    An open door needs no key, but it takes the key to open it, and a key once taken is carried on: the two cells of a
    state decide every step.

    Args:
        states: (N, T, 2) agent and key cells.
        actions: (N, T - 1).

    Returns:
        (N, T - 1) bool.
    """
    agent, key = states[..., 0], states[..., 1]
    next_agent, next_key, _ = step(agent[:, :-1], key[:, :-1], np.array(False), actions)
    return (next_agent == agent[:, 1:]) & (next_key == key[:, 1:])


def expert_outcomes(starts: np.ndarray = START_PAIRS, expert: Expert = "paper") -> Outcomes:
    """Roll the expert's distribution over states forward from starts (P, 2)."""
    C, P = len(CELLS), len(starts)
    agent, key, door = (array.ravel() for array in np.indices((C, C, 2)))  # (S,)
    door = door.astype(bool)
    chosen = expert_probabilities(agent, key, door, expert=expert)  # (S, 4)
    next_agent, next_key, next_door = step(agent[:, None], key[:, None], door[:, None], np.arange(len(ACTIONS)))
    following = (next_agent * C + next_key) * 2 + next_door  # (S, 4)
    rewards = reward(agent[:, None], next_agent)  # (S, 4)
    first = np.zeros((len(agent), P))
    first[(starts[:, 0] * C + starts[:, 1]) * 2, np.arange(P)] = 1.0

    def advance(states: np.ndarray, paid: bool = False) -> np.ndarray:
        """(S, P, ...) after one step; with `paid`, its last axis is shifted by the reward."""
        after = np.zeros_like(states)
        for a in range(len(ACTIONS)):
            moved = states * chosen[:, a].reshape(-1, *[1] * (states.ndim - 1))
            for r in (-1, 0, 1) if paid else (0,):
                here = rewards[:, a] == r if paid else np.ones(len(agent), dtype=bool)
                np.add.at(after, following[here, a], np.roll(moved[here], r, axis=-1) if paid else moved[here])
        return after

    final, away = first, first * (agent != CORNER)[:, None]
    for _ in range(HORIZON - 1):
        final, away = advance(final), advance(away) * (agent != CORNER)[:, None]
    returns = np.zeros((len(agent), P, 2 * HORIZON + 1))
    returns[..., HORIZON] = first
    for _ in range(HORIZON):
        returns = advance(returns, paid=True)
    return Outcomes(final.T.reshape(P, C, C, 2).sum(-1), returns.sum(0), 1 - away.sum(0))


@dataclass(frozen=True)
class Rollouts:
    """N episodes: the states (N, K, 2) in the window, and the returns (N,) of all its actions."""

    states: np.ndarray
    returns: np.ndarray


def rollout(policy: UniMASKPolicy, starts: np.ndarray, question: str, given: Given, *, seed: int) -> Rollouts:
    """Whole episodes from starts (N, 2), all at once, with sampled actions, by the rules' tables."""
    generator = torch.Generator(policy.device).manual_seed(seed)
    agent, key = starts.T
    door, total = np.zeros(len(starts), dtype=bool), np.zeros(len(starts))
    states = []
    policy.reset()
    for _ in range(HORIZON):
        states.append(np.stack([agent, key], axis=-1))
        observation = {STATE: torch.from_numpy(states[-1]), RETURN_SO_FAR: torch.from_numpy(total[:, None]).float()}
        action = policy.select_action(observation, mask=question, given=given, sample=True, generator=generator)
        before = agent
        agent, key, door = step(agent, key, door, action[:, 0].cpu().numpy())
        total = total + reward(before, agent)
    policy.reset()
    return Rollouts(np.stack(states, axis=1), total)


def goals(policy: UniMASKPolicy, outcomes: Outcomes, imitation: Rollouts, *, each: int, seed: int) -> dict[str, Any]:
    """Final states that the expert reaches seldom, asked for from the start from which it does.

    Args:
        imitation: the same number of episodes from each start, one start after another.
        each: rollouts for each start and final state.
    """
    start, agent, key = np.nonzero((outcomes.final >= RARE) & (outcomes.final <= COMMON))
    wanted = np.stack([agent, key], axis=-1).repeat(each, axis=0)
    rolled = rollout(
        policy, START_PAIRS[start].repeat(each, axis=0), GOAL, {"s[-1]": torch.from_numpy(wanted)}, seed=seed
    )
    reached = (rolled.states[:, -1] == wanted).all(axis=-1)
    final = imitation.states[:, -1].reshape(len(START_PAIRS), -1, 2)  # (P, episodes, 2)
    by_chance = (final[start] == np.stack([agent, key], axis=-1)[:, None]).all(axis=-1).mean(axis=1)
    return {
        "question": GOAL,
        "starts_and_goals": len(start),
        "rollouts": len(wanted),
        "reached": reached.mean(),
        "reached_by_imitation": by_chance.mean(),
        "reached_by_the_expert": outcomes.final[start, agent, key].mean(),
        "times_imitation": reached.mean() / max(by_chance.mean(), 1e-9),
    }


def returns(policy: UniMASKPolicy, outcomes: Outcomes, *, each: int, seed: int) -> dict[str, Any]:
    """Each return that the expert attains from a start with 1 % or more, asked for from there: what is returned."""
    rows = []
    for number, asked in enumerate(RETURNS):
        starts = START_PAIRS[outcomes.returns[:, HORIZON + asked] >= RARE].repeat(each, axis=0)
        rolled = rollout(policy, starts, RETURN, {"rtg[0]": float(asked)}, seed=seed + number)
        mean = rolled.returns.mean()
        rows.append(
            {
                "asked": asked,
                "starts": len(starts) // each,
                "rollouts": len(starts),
                "mean_return": mean,
                "deviation": abs(mean - asked),
                "standard_error": rolled.returns.std() / np.sqrt(len(starts)),
                "exactly": (rolled.returns == asked).mean(),
            }
        )
    return {"question": RETURN, "returns": rows, "largest_deviation": max(row["deviation"] for row in rows)}


def visits(policy: UniMASKPolicy, outcomes: Outcomes, imitation: Rollouts, *, each: int, seed: int) -> dict[str, Any]:
    """The corner, asked to visit it and not to, over starts with neither agent nor key in it: shares that did."""
    chosen = (START_PAIRS != CORNER).all(axis=1)  # (P,)
    starts = START_PAIRS[chosen].repeat(each, axis=0)
    result = {"question": PROPERTY_QUESTION, "starts": int(chosen.sum()), "rollouts": len(starts)}
    for number, (name, value) in enumerate({"asked_to": 1, "asked_not_to": 0}.items()):
        rolled = rollout(policy, starts, PROPERTY_QUESTION, {f"{PROPERTY}[0]": value}, seed=seed + number)
        result[name] = (rolled.states[..., 0] == CORNER).any(axis=1).mean()
    cells = imitation.states[..., 0].reshape(len(START_PAIRS), -1, HORIZON)[chosen]
    result["imitation"] = (cells == CORNER).any(axis=-1).mean()
    result["expert"] = outcomes.visits[chosen].mean()
    return result


def backward(policy: UniMASKPolicy, final: Tensor, *, seed: int) -> dict[str, Any]:
    """Histories of recorded final states, (N, 2), drawn backwards: impossible steps, and what the checks cost."""
    result = {"question": BACKWARDS_QUESTION, "samples": len(final)}
    checks = {"unchecked": None, "dynamics": DynamicsCheck(), "agreement": DynamicsCheck(agree=True)}
    for name, check in checks.items():
        drawn = policy.sample(
            None, BACKWARDS_QUESTION, given={"s[-1]": final}, order="backward", seed=seed, check=check
        )
        states = drawn.values["s"].long().cpu().numpy()
        possible = possible_steps(states, drawn.values["a"][:, :-1, 0].long().cpu().numpy())
        result[name] = {
            "impossible_steps": int((~possible).sum()),
            "possible_samples": possible.all(axis=1).mean(),
            "acceptance": drawn.acceptance,
            "drawn": drawn.drawn,
            "rejected": drawn.rejected,
            "restarted": drawn.restarted,
        }
    return result


def orders(policy: UniMASKPolicy, *, samples: int, seed: int) -> dict[str, Any]:
    """The same questions drawn in each order, from one start: how far their marginals are apart."""
    result: dict[str, Any] = {"given": {"s[0]": list(START)}, "samples": samples}
    for name, question, check in (
        ("actions", ACTIONS_QUESTION, None),
        ("histories", HISTORY_QUESTION, None),
        ("histories, checked", HISTORY_QUESTION, DynamicsCheck(agree=True)),
    ):
        differences = differences_of_orders(policy, question, check, samples=samples, seed=seed)
        result[name] = {"question": question, "largest_difference_from_forward": differences}
    return result


def differences_of_orders(
    policy: UniMASKPolicy, question: str, check: Check | None, *, samples: int, seed: int
) -> dict[str, float]:
    """The largest difference of any marginal from that of samples drawn forward; that of another draw in the same
    order, `forward again`, is chance."""
    shares = []
    for number, order in enumerate(("forward", "backward", "random", "forward")):
        drawn = policy.sample(
            None,
            question,
            given={"s[0]": list(START)},
            samples=samples,
            order=order,
            seed=seed + number,
            check=check,
        )
        shares.append(_shares(policy, drawn))
    pairs = zip(("backward", "random", "forward again"), shares[1:], strict=True)
    return {pair: (other - shares[0]).abs().max().item() for pair, other in pairs}


def _shares(policy: UniMASKPolicy, drawn: Samples) -> Tensor:
    """How often each category of each component occurs at each step that has one, all in one row."""
    parts = []
    for name in ("s", "a"):
        for component in policy.factors[name].components:
            values = drawn.values[name][..., component.dims].squeeze(-1)  # (N, K)
            values = values[:, ~values.isnan().any(0)].long()
            parts.append(torch.nn.functional.one_hot(values, component.categories).double().mean(0).flatten())
    return torch.cat(parts)


def consistency(policy: UniMASKPolicy, batch: dict[str, Tensor], *, seed: int) -> dict[str, Any]:
    """Random masks over recorded windows: sums of probabilities, shown values, and one asked token alone."""
    window = policy.make_window(batch, partial=True)
    draw = TrainingMasks(RANDOM_MASK, tuple(policy.factors), policy.config.context_length).to(policy.device)
    mask = draw(window.valid, batch["index"].to(policy.device), seed=seed, step=0)
    for name, tokens in mask.shown.items():
        mask.shown[name] = tokens & ~window.values[name].isnan().any(-1)  # the data may lack a property
    asked = torch.stack([mask.asked[name] for name in ("s", "a")], dim=-1).flatten(1)  # (N, 2 K)
    some = asked.any(1)
    generator = torch.Generator(asked.device).manual_seed(seed)
    one = torch.multinomial(asked.float() + ~some[:, None], 1, generator=generator)
    alone = torch.zeros_like(asked).scatter(1, one, True) & asked
    states, actions = alone.unflatten(1, (-1, 2)).unbind(-1)
    alone = Mask(mask.shown, mask.asked | {"s": states, "a": actions})
    answers = policy.infer(window, mask), policy.infer(window, alone)
    sums, differences, changed = [], [], 0
    for name in ("s", "a"):
        for among, single in zip(answers[0][name], answers[1][name], strict=True):
            sums.append((among.probabilities[mask.asked[name]].sum(-1) - 1).abs().max())
            here = alone.asked[name]
            differences.append((among.probabilities[here] - single.probabilities[here]).abs().max())
        shown = mask.shown[name]
        changed += int((answers[0].most_likely(name)[shown] != window.values[name][shown]).sum())
    return {
        "masks": len(asked),
        "largest_deviation_of_a_sum_from_1": torch.stack(sums).max().item(),
        "shown_values_changed": changed,
        "largest_difference_of_a_token_alone_and_among_others": torch.stack(differences).max().item(),
    }


def ask_everything(
    policy: UniMASKPolicy,
    batch: dict[str, Tensor],
    *,
    each: int = 10,
    samples: int = 4000,
    seed: int = 0,
    expert: Expert = "paper",
) -> dict[str, Any]:
    """Every measurement as one JSON record; returns and the property where the model has them.

    Args:
        batch: first windows of unseen episodes.
        each: a tenth of the imitation's and the property's rollouts from each start; all of those for a goal or return.
        samples: in each order.
        expert: whose data it is, to stand beside the policy and to choose the goals and returns.

    Raises:
        ValueError: the policy is not one of whole DoorKey episodes.
    """
    names = [label for feature in policy.config.features["s"] for label in feature.names or []]
    if names != ["agent_cell", "key_cell"] or policy.config.context_length != HORIZON:
        raise ValueError(
            f"These questions are about whole DoorKey episodes of {HORIZON} steps; this policy's states are {names}, "
            f"its context_length is {policy.config.context_length}."
        )
    began = time.monotonic()
    outcomes = expert_outcomes(expert=expert)
    imitation = rollout(policy, START_PAIRS.repeat(10 * each, axis=0), IMITATION, {}, seed=seed)
    record: dict[str, Any] = {
        "what": "sampled rollouts under questions, joint samples and random masks, of one DoorKey policy",
        "updates": int(policy.updates),
        "seed": seed,
        "expert": expert,
        "imitation": {
            "rollouts": len(imitation.returns),
            "mean_return": imitation.returns.mean(),
            "expert_mean_return": (outcomes.returns * np.arange(-HORIZON, HORIZON + 1)).sum(axis=1).mean(),
        },
        "goals": goals(policy, outcomes, imitation, each=each, seed=seed + 100),
        "backward": backward(policy, batch[STATE][:, -1], seed=seed),
        "orders": orders(policy, samples=samples, seed=seed),
        "consistency": consistency(policy, batch, seed=seed),
    }
    if "rtg" in policy.factors:
        record["returns"] = returns(policy, outcomes, each=each, seed=seed + 200)
    if PROPERTY in policy.factors:
        record["visits"] = visits(policy, outcomes, imitation, each=10 * each, seed=seed + 300)
    record["seconds"] = round(time.monotonic() - began, 1)
    record["versions"] = versions()
    return _plain(record)


def _plain(value: Any) -> Any:
    """numpy's numbers as Python's, which JSON takes."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(entry) for entry in value]
    return value.item() if isinstance(value, np.generic) else value


def summary(record: dict[str, Any]) -> str:
    """A record in lines for people."""
    goals, backward, orders = record["goals"], record["backward"], record["orders"]
    lines = [
        f"imitation returns {record['imitation']['mean_return']:.2f} "
        f"(the expert: {record['imitation']['expert_mean_return']:.2f})",
        f"goals: {goals['reached']:.1%} of {goals['rollouts']} rollouts reach theirs, {goals['times_imitation']:.1f} "
        f"times imitation's {goals['reached_by_imitation']:.1%} (the expert: {goals['reached_by_the_expert']:.1%})",
    ]
    for row in record.get("returns", {}).get("returns", []):
        lines.append(
            f"return {row['asked']} asked: {row['mean_return']:.2f} ± {row['standard_error']:.2f} on average, over "
            f"{row['rollouts']} rollouts"
        )
    if "visits" in record:
        lines.append(
            "the corner: {asked_to:.1%} visit it when asked to, {asked_not_to:.1%} when asked not to; imitation "
            "{imitation:.1%}, the expert {expert:.1%}".format(**record["visits"])
        )
    for name in ("unchecked", "dynamics", "agreement"):
        lines.append(
            f"backward samples, {name}: {{impossible_steps}} impossible steps in {backward['samples']} samples, "
            "acceptance {acceptance:.1%}, {restarted} started over".format(**backward[name])
        )
    for name in ("actions", "histories", "histories, checked"):
        parts = ", ".join(f"{p} {value:.3f}" for p, value in orders[name]["largest_difference_from_forward"].items())
        lines.append(f"largest difference in marginals from those drawn forward, {name}: {parts}")
    marginals = record["consistency"]
    lines.append(
        f"{marginals['masks']} random masks: sums off by {marginals['largest_deviation_of_a_sum_from_1']:.1e} at most, "
        f"{marginals['shown_values_changed']} shown values changed, a token alone differs by "
        f"{marginals['largest_difference_of_a_token_alone_and_among_others']:.1e} at most"
    )
    return "\n".join(lines)
