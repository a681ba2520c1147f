"""The exact optimum of DoorKey: what any model could answer at best, by dynamic programming over the true states.

DoorKey and its expert are known and small: 77 reachable states (agent cell, key cell, door open or not) and four
actions. So the posterior of every token given the shown ones is computed, for any mask, by the forward-backward
algorithm (Rabiner, 1989) over a chain of which states are seen without the door, actions seen or not, and the return
and properties of the episode known or not. `Optimum` takes the place of a policy's `predict`, so that losses, answers
and pictures read it as they read a trained model; its loss is the lowest that a model can reach.

A reward is by how much the distance to the goal shrank, so a window's return-to-go is the distance at its first step
minus the distance after the episode's last action: given the return, the chain is solved once for each distance that
the first state can have, and the last state's distance follows. A property says whether some step of the episode did
something; a state then holds, too, whether one has.

Legend of shapes: B windows, K steps, S states, A actions, C distances of the first state, R returns.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lerobot_unimask.asking.answers import Answer, Model
from lerobot_unimask.asking.answers import answer as answer_question
from lerobot_unimask.data.factors import ACTION, LOG_SCALE, RETURN_TO_GO, STATE, Factor, Feature, make_factors
from lerobot_unimask.data.window import Statistics, Window
from lerobot_unimask.envs.doorkey.expert import Expert, expert_probabilities
from lerobot_unimask.envs.doorkey.rules import ACTIONS, CELLS, GOAL, HORIZON, START_PAIRS, distance_to_goal, step
from lerobot_unimask.language.masks import ASKABLE, RANDOM_MASK, Mask
from lerobot_unimask.language.training_masks import VALIDATION_STEP, TrainingMasks
from lerobot_unimask.networks.layers import Cache, Predictions, by_component

FEATURES = {
    "s": [Feature(STATE, 2, [len(CELLS), len(CELLS)], ["agent_cell", "key_cell"])],
    "a": [Feature(ACTION, 1, [len(ACTIONS)], ["direction"])],
    "rtg": [Feature(RETURN_TO_GO, 1, None, ["return_to_go"])],
}

# What a property calls a step from one agent's cell to the next, if an episode is to have it. The state after the last
# action is seen by the success alone: `unimask prepare --visits` labels the states that are stored.
PROPERTIES: dict[str, Callable[[int, int], bool]] = {
    "success": lambda agent, following: following == GOAL,
    "visits_corner": lambda agent, following: agent == 0,
}

RETURNS = torch.arange(-HORIZON, HORIZON + 1)  # (R,)

SHARES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # edges of the bins of how much a random mask hides

# A return is one of few numbers: a mixture of as many Gaussians, as narrow as an answer can have them.
FACTORS = make_factors(FEATURES, joint=True, gaussians=len(RETURNS))

_CHUNK = 2048  # windows at a time: half a gigabyte, and as much again for each property

_LOG_ZERO = -1000.0  # instead of minus infinity, which times zero is NaN; its exponential is exactly zero


class Optimum:
    """The exact posterior of every token given the shown ones, as `asking.answers.Model`.

    Args:
        expert: name of whose data it is, see `envs.doorkey.expert_progress`.
        beta: the expert's rationality.
        first_step: the episode's step at which the windows start. Known to the optimum, also where no return shows it.
        properties: names of those in `PROPERTIES` that the windows have.

    Raises:
        ValueError: an unknown expert or property, or a step that no episode has.
    """

    def __init__(
        self, expert: Expert = "paper", *, beta: float = 1.0, first_step: int = 0, properties: Sequence[str] = ()
    ):
        if not 0 <= first_step < HORIZON:
            raise ValueError(f"first_step is {first_step}; an episode's steps are 0 to {HORIZON - 1}.")
        if not set(properties) <= PROPERTIES.keys():
            raise ValueError(f"The optimum knows of the properties {', '.join(PROPERTIES)}, not {list(properties)}.")
        states, following = _reachable_states(properties)  # (S, 3 + properties), (S, A)
        agent, key, door_open = states.T[:3]
        features = FEATURES | {name: [Feature(f"observation.{name}", 1, [2])] for name in properties}
        self.factors: Mapping[str, Factor] = FACTORS | make_factors({name: features[name] for name in properties})
        self.statistics = Statistics(features, self.factors, HORIZON)  # not filled, so that nothing is scaled
        self.first_step = first_step
        self.has = {name: torch.from_numpy(states[:, 3 + i]) for i, name in enumerate(properties)}  # (S,) 0 or 1
        self.following = torch.from_numpy(following)
        self.policy = torch.from_numpy(
            expert_probabilities(agent, key, door_open.astype(bool), expert=expert, beta=beta)
        )  # (S, A)
        self.seen = torch.from_numpy(states[:, :2])  # (S, 2): agent and key cell, of which the window tells
        self.distance = torch.from_numpy(distance_to_goal(agent))  # (S,)
        self.start = torch.zeros(len(states), dtype=torch.float64)  # (S,): of the window's first state
        self.start[: len(START_PAIRS)] = 1 / len(START_PAIRS)
        for _ in range(first_step):
            self.start = self._advance(self.start[:, None] * self.policy)

    def predict(self, window: Window, mask: Mask, cache: Cache | None = None) -> Predictions:
        """For every step logarithms of probabilities, float64, of the state, the agent's and the key's cell together,
        and of the action; and where they are asked, at step 0, of properties, and of the return Gaussians.

        Args:
            window: in the dataset's units, where a policy's `predict` takes normalised values.
            mask: what is shown; each window is one question.
            cache: not used: nothing need be remembered between questions.

        Raises:
            ValueError: what a window shows cannot occur together, or it shows or asks for what the optimum does not
                know.
        """
        B, K = window.valid.shape
        device = window.valid.device
        values = {name: value.cpu() for name, value in window.values.items()}
        shown = {name: tokens.cpu() for name, tokens in mask.shown.items()}
        asked = [name for name, tokens in mask.asked.items() if tokens.any()]
        unknown = {*asked, *(name for name, tokens in shown.items() if tokens.any())} - self.factors.keys()
        if unknown:
            raise ValueError(f"DoorKey's optimum knows nothing of {', '.join(sorted(unknown))}.")
        parts: list[dict[str, Tensor]] = []
        for first in range(0, B, _CHUNK):
            chunk = slice(first, first + _CHUNK)
            these, seen = ({name: tensor[chunk] for name, tensor in part.items()} for part in (values, shown))
            parts.append(self._marginals(these, seen, K, first, split="rtg" in asked))
        predictions: Predictions = {}
        for name in (*ASKABLE, *(name for name in asked if name not in ASKABLE)):
            logs = torch.cat([part[name] for part in parts]).log().clamp_min(_LOG_ZERO)
            if name == "rtg":  # (B, R) -> (B, K, size)
                means = RETURNS.double().expand_as(logs).unsqueeze(-1)
                logs = FACTORS[name].outputs[0].pack(logs, means, torch.full_like(means, LOG_SCALE[0]))
            if name not in ASKABLE:
                logs = functional.pad(logs.unsqueeze(1), (0, 0, 0, K - 1))
            predictions[name] = [logs.to(device)]
        return predictions

    def _marginals(
        self, values: dict[str, Tensor], shown: dict[str, Tensor], K: int, first_window: int, *, split: bool
    ) -> dict[str, Tensor]:
        """Probabilities of the agent's and the key's cell together, (B, K, 256), of the action, (B, K, 4), of each
        property, (B, 2), and with `split` of the return, (B, R)."""
        steps = HORIZON - self.first_step  # to the end of the episode; what follows the window is not seen
        seen_state, seen_action = self._evidence(values, shown, K, steps)  # (B, T, S), (B, T, A)
        distances = self.distance[self.start > 0].unique()  # (C,)
        first, last = self._return_evidence(values, shown, distances, split)  # (1, C, S), (B, C, S)
        for name, has in self.has.items():
            agrees = (values[name][:, :1] == has) | ~shown[name][:, :1, None]  # (B, 1, S)
            last = last * agrees
        B = len(last)

        # Backward: ahead[k], (B, C, S), the probability of all that is seen from step k on, given the state there.
        ahead = [last]
        for k in reversed(range(steps)):
            ahead.append(self._choices(ahead[-1], seen_action[:, k]).sum(-1) * seen_state[:, k, None])
        ahead.reverse()

        # Forward: past (B, C, S), the probability of all that is seen up to this step's state, and of the state.
        cells = FACTORS["s"].outputs[0]
        state = torch.full((B, K, cells.size), 1 / cells.size, dtype=torch.float64)
        action = torch.full((B, K, len(ACTIONS)), 1 / len(ACTIONS), dtype=torch.float64)  # past the episode's end
        past = self.start * first * seen_state[:, 0, None]
        for k in range(steps if split or self.has else min(K, steps)):
            joint = (past.unsqueeze(-1) * self._choices(ahead[k + 1], seen_action[:, k])).sum(1)  # (B, S, A)
            total = joint.sum((1, 2))  # the probability of everything that is seen: the same at every step
            if (total <= 0).any():
                window = first_window + int((total <= 0).int().argmax())
                raise ValueError(
                    f"What window {window} shows cannot occur together in DoorKey, in an episode of this expert from "
                    f"step {self.first_step} on: its probability is zero."
                )
            joint = joint / total[:, None, None]
            if k < K:
                state[:, k] = torch.zeros_like(state[:, k]).index_add_(1, cells.combination(self.seen), joint.sum(-1))
                action[:, k] = joint.sum(1)
            past = self._advance(past.unsqueeze(-1) * self.policy * seen_action[:, k, None, None])
            past = past * (seen_state[:, k + 1, None] if k + 1 < steps else last)
        # Where the loop went to the episode's end, `past` is what is left of its last state.
        found = {"s": state, "a": action}
        past = past / past.sum((1, 2), keepdim=True)
        for name, has in self.has.items():
            found[name] = torch.zeros(B, 2, dtype=torch.float64).index_add_(1, has, past.sum(1))
        if split:
            paid = (distances[:, None] - self.distance - RETURNS[0]).flatten()  # (C S,), the return's number
            found["rtg"] = torch.zeros(B, len(RETURNS), dtype=torch.float64).index_add_(1, paid, past.flatten(1))
        return found

    def _evidence(
        self, values: dict[str, Tensor], shown: dict[str, Tensor], K: int, steps: int
    ) -> tuple[Tensor, Tensor]:
        """Which states, (B, T, S), and actions, (B, T, A), agree with what is shown at each step of the episode."""
        B = len(shown["s"])
        state = torch.ones(B, steps, len(self.seen), dtype=torch.float64)
        action = torch.ones(B, steps, len(ACTIONS), dtype=torch.float64)
        within = min(K, steps)
        agrees = (values["s"][:, :within, None] == self.seen).all(-1)  # (B, T, S)
        state[:, :within] = (agrees | ~shown["s"][:, :within, None]).double()
        agrees = values["a"][:, :within] == torch.arange(len(ACTIONS))  # (B, T, A)
        action[:, :within] = (agrees | ~shown["a"][:, :within, None]).double()
        return state, action

    def _return_evidence(
        self, values: dict[str, Tensor], shown: dict[str, Tensor], distances: Tensor, split: bool
    ) -> tuple[Tensor, Tensor]:
        """Which first states (1, C, S) have each of the distances (C,), and which last states (B, C, S) give the shown
        return; one case of all first states where no return is shown, unless `split`."""
        B, S = len(shown["s"]), len(self.seen)
        conditioned = shown["rtg"][:, 0] if "rtg" in shown else torch.zeros(B, dtype=torch.bool)
        if not conditioned.any() and not split:
            return torch.ones(1, 1, S, dtype=torch.float64), torch.ones(B, 1, S, dtype=torch.float64)
        returns, timestep = torch.where(conditioned[:, None], values["rtg"][:, 0], 0.0).unbind(-1)  # (B,)
        if ((timestep * HORIZON - self.first_step).abs()[conditioned] > 1e-3).any():
            raise ValueError(f"A shown return is not one at step {self.first_step}, where these windows start.")
        first = self.distance == distances[:, None]  # (C, S)
        apart = distances[:, None] - self.distance - returns[:, None, None]
        gives = apart.abs() < 0.01  # (B, C, S); a drawn return is a whole number but for its Gaussian's scale
        return first[None].double(), (gives | ~conditioned[:, None, None]).double()

    def _choices(self, ahead: Tensor, seen_action: Tensor) -> Tensor:
        """(B, C, S) of the next step and (B, A) -> (B, C, S, A), action by action what comes of it."""
        return self.policy * seen_action[:, None, None] * ahead[..., self.following]

    def _advance(self, moves: Tensor) -> Tensor:
        """Move the mass of each state and action, (..., S, A), to the states that follow, (..., S)."""
        after = moves.new_zeros(moves.shape[:-1])
        return after.index_add_(-1, self.following.flatten(), moves.flatten(-2))


def known_properties(features: Mapping[str, Sequence[Feature]]) -> list[str]:
    """The properties of a model that the optimum can stand beside.

    Raises:
        ValueError: the model's features are others than the optimum's.
    """
    found = [name for name in features if name not in FEATURES]
    known = FEATURES | {name: [Feature(f"observation.{name}", 1, [2])] for name in PROPERTIES}
    if any(columns != known.get(name) for name, columns in features.items()):
        raise ValueError(
            f"Only DoorKey's states, actions, return and {', '.join(PROPERTIES)} have an exact optimum; this model's "
            f"features are {', '.join(f.key for columns in features.values() for f in columns)}."
        )
    return found


def exact_answer(window: Window, mask: Mask, *, expert: Expert = "paper", first_step: int = 0) -> Answer:
    """What the optimum answers to one mask, in place of what a policy's `infer` does.

    Args:
        window: values in the dataset's units; the return token is (return-to-go, timestep / 10).
        mask: question about the same windows.
        expert, first_step: see `Optimum`.

    Raises:
        ValueError: what a window shows cannot occur together.
    """
    properties = [name for name in window.values if name in PROPERTIES]
    return answer_question(Optimum(expert, first_step=first_step, properties=properties), window, mask)


def divergences(exact: Predictions, predictions: Predictions) -> dict[str, list[Tensor]]:
    """Kullback-Leibler divergence from the exact marginal to the model's, for each component at every step.

    Args:
        exact, predictions: marginals, see `by_component`: factor -> logits, one (B, K, categories) for each component.
            States and actions count, as the paper has it.

    Returns:
        factor -> one (B, K) float64 for each component, in nats; 0 where the two agree.
    """
    return {
        name: [_cross_entropy(p, q) - _cross_entropy(p, p) for p, q in zip(parts, predictions[name], strict=True)]
        for name, parts in exact.items()
        if name in ASKABLE
    }


def entropies(exact: Predictions) -> dict[str, list[Tensor]]:
    """The loss that no model can beat in expectation, by marginals, for each component at every step: (B, K) float64,
    in nats."""
    return {name: [_cross_entropy(p, p) for p in parts] for name, parts in exact.items() if name in ASKABLE}


def mean_over_asked(costs: dict[str, list[Tensor]], asked: dict[str, Tensor]) -> float:
    """Each component's mean over the asked-for tokens, added up: how `masked_losses` adds up its own costs."""
    return sum(cost[asked[name]].mean().item() for name, parts in costs.items() for cost in parts if asked[name].any())


def random_mask_divergence(
    optimum: Optimum, model: Model, window: Window, normalised: Window, index: Tensor, *, draws: int = 10
) -> dict[str, dict[str, float]]:
    """How far a model is from the optimum over many random masks: the mean divergence of the asked-for tokens, in nats.

    Args:
        window, normalised: the same windows in the dataset's units, for the optimum, and as the network reads them.
        index: (B,) the windows' first frames, which decide the masks.
        draws: masks of each window.

    Returns:
        Component (agent_cell, key_cell, direction) -> the share of states and actions that the mask hides, as
        "0.2-0.4", or "all" -> mean over all asked-for tokens of such masks.
    """
    draw = TrainingMasks(RANDOM_MASK, tuple(window.values), window.valid.shape[1]).to(window.valid.device)
    kinds = [(name, i, c.name) for name in ("s", "a") for i, c in enumerate(FACTORS[name].components)]
    found: dict[str, list[Tensor]] = {label: [] for _, _, label in kinds}
    shares: dict[str, list[Tensor]] = {label: [] for _, _, label in kinds}
    for number in range(draws):
        mask = draw(window.valid, index, seed=0, step=VALIDATION_STEP - number)
        exact = by_component(optimum.predict(window, mask), FACTORS)
        apart = divergences(exact, by_component(model.predict(normalised, mask), model.factors))
        hidden = torch.cat([mask.asked["s"], mask.asked["a"]], dim=1).double().mean(1)  # (B,)
        for name, i, label in kinds:
            found[label].append(apart[name][i][mask.asked[name]])
            shares[label].append(hidden[:, None].expand_as(mask.asked[name])[mask.asked[name]])
    return {label: _by_share(torch.cat(found[label]), torch.cat(shares[label])) for label in found}


def _by_share(values: Tensor, share: Tensor) -> dict[str, float]:
    """The means of values whose share lies in each of the bins of `SHARES`, and of all."""
    bins = torch.bucketize(share, torch.tensor(SHARES[1:-1], dtype=share.dtype, device=share.device))
    labels = [f"{low:g}-{high:g}" for low, high in itertools.pairwise(SHARES)]
    means = {label: values[bins == i].mean().item() for i, label in enumerate(labels) if (bins == i).any()}
    return {**means, "all": values.mean().item()}


def _cross_entropy(target: Tensor, prediction: Tensor) -> Tensor:
    """(..., categories) logits of both -> (...), in nats, float64."""
    return -(target.double().softmax(-1) * prediction.double().log_softmax(-1)).sum(-1)


def _reachable_states(properties: Sequence[str] = ()) -> tuple[np.ndarray, np.ndarray]:
    """All states, (S, 3 + properties) int64 (agent, key, door open, whether the episode has each property by now), the
    starts first, and where each action leads, (S, A)."""
    states = [(int(agent), int(key), 0, *[0] * len(properties)) for agent, key in START_PAIRS]
    number = {state: i for i, state in enumerate(states)}
    following = []
    for agent, key, door_open, *has in states:  # grows while it is read
        reached = zip(*step(agent, key, np.array(bool(door_open)), np.arange(len(ACTIONS))), strict=True)
        for a, k, d in reached:
            by_now = (int(h or PROPERTIES[name](agent, int(a))) for h, name in zip(has, properties, strict=True))
            state = (int(a), int(k), int(d), *by_now)
            if state not in number:
                number[state] = len(states)
                states.append(state)
            following.append(number[state])
    return np.array(states), np.array(following).reshape(len(states), len(ACTIONS))
