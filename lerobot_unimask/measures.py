"""What a policy's answers say: how near they come to recorded actions, how far ahead they see, whether both directions
agree, how long they take.

Legend of shapes: B windows, K steps, D the dimensions of a state.
"""

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from lerobot_unimask.asking.answers import ContinuousDistribution
from lerobot_unimask.asking.answers import answer as answer_question
from lerobot_unimask.data.checkpoints import episodes_trained_on
from lerobot_unimask.data.episodes import bounds_of, read_windows
from lerobot_unimask.data.factors import RETURN_SO_FAR, TASK, Output
from lerobot_unimask.language.masks import Mask, tabulate
from lerobot_unimask.modeling_unimask import UniMASKPolicy

logger = logging.getLogger(__name__)

DRAWS = 200  # that a divergence of mixtures is taken over

EVERY = 7  # steps between the windows that are read


def unseen_windows(dataset: LeRobotDataset, context_length: int, episodes: Sequence[int]) -> dict[str, Tensor]:
    """Full windows of some episodes, one every few steps, as one LeRobot batch.

    Raises:
        ValueError: no episode is as long as a window.
    """
    K = context_length
    bounds = bounds_of(dataset)
    starts = [start for e in episodes for start in range(bounds[e][0], bounds[e][1] - K + 1, EVERY)]
    if not starts:
        raise ValueError(f"None of these episodes of {dataset.root} has the {K} steps of a window.")
    return read_windows(dataset, starts)


def error_ahead(policy: UniMASKPolicy, batch: dict[str, Tensor], ahead: int) -> dict[str, float]:
    """How far the predicted state is from the true one `ahead` steps on, given all states and actions up to now; beside
    it, how far one gets by repeating the last displacement as often.

    Returns:
        Mean Euclidean distances in the dataset's units, and the number of windows; but for an L2 head also the mean
        logarithm of the true state's density, in nats.

    Raises:
        ValueError: states that are not continuous, or a window that is too short.
    """
    if not policy.factors["s"].continuous:
        raise ValueError("The distance to the true state is measured where states are continuous.")
    now = policy.config.context_length - 1 - ahead
    if now < 1:
        raise ValueError(f"{ahead} steps ahead needs a context_length of at least {ahead + 2}.")
    answer = policy.infer(batch, f"s[{now + ahead}] | s[:{now + 1}], a[:{now}]")
    states = policy.make_window(batch).values["s"]  # (B, K, D)
    truth = states[:, now + ahead]
    repeated = states[:, now] + ahead * (states[:, now] - states[:, now - 1])
    found = {
        "steps": ahead,
        "model": (answer.most_likely("s")[:, now + ahead] - truth).norm(dim=-1).mean().item(),
        "last_displacement_repeated": (repeated - truth).norm(dim=-1).mean().item(),
        "windows": len(truth),
    }
    if policy.config.continuous_head != "l2":
        parts = (part for part in answer.distributions["s"] if isinstance(part, ContinuousDistribution))
        found["log_density"] = sum(part.log_density(states)[:, now + ahead].mean().item() for part in parts)
    return found


@torch.no_grad()
def action_error(policy: UniMASKPolicy, batch: dict[str, Tensor], question: str) -> float:
    """The mean squared error of the action that acting would carry out, in standard deviations of the data, over all
    windows, steps t and dimensions: what a rollout's returns follow, and far less noisy than they are."""
    policy.eval()
    recorded = policy.make_window(batch)
    actions = recorded.values["a"]  # (B, K, D)
    table = tabulate(question, tuple(policy.factors), policy.config.context_length, tuple(policy.cameras))
    errors = []
    for t in table.t.tolist():
        mask = table.at(t, len(actions)).to(policy.device).within(recorded.valid)
        answer = answer_question(policy, recorded, mask)
        error = (answer.carried_out("a")[:, t] - actions[:, t]) / policy.statistics.get_buffer("a_std")
        errors.append(error[mask.asked["a"][:, t]].square().flatten())
    return torch.cat(errors).mean().item()


@torch.no_grad()
def disagreement(policy: UniMASKPolicy, batch: dict[str, Tensor], question: str) -> float:
    """The mean Kullback-Leibler divergence, in nats, from the causal answer about an action to that in both directions,
    over all windows and steps t, outputs added up. An L2 head counts as a Gaussian of the data's scale."""
    policy.eval()
    window = policy.statistics.normalise(policy.make_window(batch))
    table = tabulate(question, tuple(policy.factors), policy.config.context_length, tuple(policy.cameras))
    found = []
    for t in table.t.tolist():
        mask: Mask = table.at(t, len(window.valid)).to(policy.device).within(window.valid)
        causal, both = (policy.network(window, mask.shown, direction)["a"] for direction in (True, False))
        outputs = policy.factors["a"].outputs
        parts = [_divergence(p[:, t], q[:, t], output) for p, q, output in zip(causal, both, outputs, strict=True)]
        found.append(torch.stack(parts).sum(0)[mask.asked["a"][:, t]])
    return torch.cat(found).mean().item()


def _divergence(p: Tensor, q: Tensor, output: Output) -> Tensor:
    """(B, size) of two networks' outputs -> (B,); of mixtures, that of draws, for it has no closed form."""
    if output.discrete:
        p, q = output.table(p).log_softmax(-1), output.table(q).log_softmax(-1)
        return (p.exp() * (p - q)).sum(-1)
    if not output.gaussians:
        return (p - q).square().sum(-1) / 2
    if output.gaussians > 1:
        one, other = _mixture(p, output), _mixture(q, output)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            drawn = one.sample((DRAWS,))
        return (one.log_prob(drawn) - other.log_prob(drawn)).mean(0)
    (mean_p, scale_p), (mean_q, scale_q) = p.chunk(2, dim=-1), q.chunk(2, dim=-1)
    apart = (2 * (scale_p - scale_q)).exp() + ((mean_p - mean_q) * (-scale_q).exp()).square()
    return (scale_q - scale_p + apart / 2 - 0.5).sum(-1)


def _mixture(prediction: Tensor, output: Output) -> MixtureSameFamily:
    logits, means, scales = output.unpack(prediction)
    return MixtureSameFamily(Categorical(logits=logits), Independent(Normal(means, scales.exp()), 1))


def latency(policy: UniMASKPolicy, batch: dict[str, Tensor], calls: int = 100) -> dict[str, float]:
    """Milliseconds of `select_action` once the window slides, with the policy's own inference mask and a step of
    recorded windows as what it observes: median and quartiles over the calls."""
    observed = {name: value[:1, 0] for name, value in policy.make_window(batch).values.items()}
    columns = policy.config.features["s"]
    parts = observed["s"].split([column.size for column in columns], dim=-1)
    observation: dict[str, Any] = {column.key: part for column, part in zip(columns, parts, strict=True)}
    observation |= {camera.key: observed[name] for name, camera in policy.cameras.items()}
    observation |= {RETURN_SO_FAR: torch.zeros(1, 1), TASK: batch[TASK][0] if TASK in batch else None}
    policy.reset()
    times = []
    for call in range(calls + policy.config.context_length):
        began = time.perf_counter()
        policy.select_action(observation)
        if call >= policy.config.context_length:
            times.append(1000 * (time.perf_counter() - began))
    policy.reset()
    low, median, high = torch.tensor(times).quantile(torch.tensor([0.25, 0.5, 0.75])).tolist()
    return {"median_ms": median, "quartiles_ms": [low, high], "environments": 1}


def measure(policy: UniMASKPolicy, dataset: LeRobotDataset, episodes: Sequence[int], *, ahead: int) -> dict[str, Any]:
    """A JSON record of all that applies to this policy, over windows of episodes that it was not trained on."""
    batch = unseen_windows(dataset, policy.config.context_length, episodes)
    known = episodes_trained_on(policy.folder, Path(dataset.root), dataset.repo_id, len(dataset.meta.episodes))
    seen = set(episodes) & set(known)
    record: dict[str, Any] = {
        "what": "a policy's answers about episodes that it was not trained on",
        "units": "action_error: mean squared, in standard deviations of the data; ahead: mean distance, in the "
        "dataset's units; disagreement: nats; latency: milliseconds",
        "windows": len(batch["index"]),
        "episodes": len(episodes),
        "trained_on_episodes": len(seen),
    }
    if seen:
        logger.warning("The policy was trained on %d of these %d episodes.", len(seen), len(episodes))
    questions = ["behavior_cloning"] + ["reward_conditioned"] * ("rtg" in policy.factors)
    if policy.factors["a"].continuous:
        record["action_error"] = {question: action_error(policy, batch, question) for question in questions}
    if (
        policy.factors["s"].continuous
        and policy.config.attention != "causal"
        and policy.config.context_length >= ahead + 2
    ):
        record["ahead"] = error_ahead(policy, batch, ahead)
    if policy.config.attention == "both":
        record["disagreement_nats"] = {question: disagreement(policy, batch, question) for question in questions}
    record["latency"] = latency(policy, batch)
    return record
