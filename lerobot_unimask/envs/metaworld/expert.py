"""MetaWorld's own scripted experts, with noise on their actions.

Legend of shapes: T steps of an episode.
"""

from typing import Any, NamedTuple

import numpy as np

from lerobot_unimask.envs.metaworld.environment import MetaWorldEnv, load_metaworld


class Demonstration(NamedTuple):
    """One episode: what was observed before each action, the action and what it paid; the last action succeeds."""

    hand: np.ndarray  # (T, 4)
    environment: np.ndarray  # (T, numbers)
    action: np.ndarray  # (T, 4)
    reward: np.ndarray  # (T,)


def make_expert(task: str) -> Any:
    """MetaWorld's scripted policy of a task: the full observation -> an action."""
    load_metaworld()
    from metaworld.policies import ENV_POLICY_MAP

    policies: dict[str, Any] = ENV_POLICY_MAP
    return policies[task]()


def demonstrate(env: MetaWorldEnv, expert: Any, noise: float, rng: np.random.Generator) -> Demonstration | None:
    """One episode from a new start, or None where the expert does not succeed.

    Args:
        noise: standard deviation of what is added to the expert's action on half of the steps, drawn at random; the
            action that is recorded is the one that was carried out.
    """
    observation, _ = env.reset(seed=int(rng.integers(2**31)))
    steps = []
    done = False
    while not done:
        action = np.clip(expert.get_action(env.full), -1, 1)
        if rng.random() < 0.5:
            action = np.clip(action + noise * rng.standard_normal(4), -1, 1)
        before = observation
        observation, reward, success, truncated, _ = env.step(action)
        steps.append((before["agent_pos"], before["environment_state"], action, reward))
        done = success or truncated
    if not success:
        return None
    return Demonstration(*(np.array(part, dtype=np.float32) for part in zip(*steps, strict=True)))
