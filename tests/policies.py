"""What the tests of policies share: kinds of policies, recorded episodes, and how answers are compared."""

from contextlib import contextmanager

import pytest
import torch

from lerobot_unimask.language.training_masks import TrainingMasks

CONTINUOUS_FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": ["x", "y", "goal"]},
    "action": {"dtype": "float32", "shape": (2,), "names": None},
    "observation.return_to_go": {"dtype": "float32", "shape": (1,), "names": None},
}
# Offsets and scales far from 0 and 1, so that a wrong unit shows.
CONTINUOUS_STATS = {
    "observation.state": {"mean": [100.0, -5.0, 0.5], "std": [10.0, 0.1, 0.0]},
    "action": {"mean": [0.25, -2.0], "std": [0.5, 4.0]},
    "observation.return_to_go": {"mean": [30.0], "std": [7.0]},
    "frame_index": {"max": [49.0]},
    "timestamp": {"max": [4.9]},
}

SMALL = {"context_length": 10, "width": 16, "depth": 1, "heads": 2, "feedforward_width": 16}
SMALL_FLAGS = [f"--policy.{name}={value}" for name, value in SMALL.items()]
TRAIN_FLAGS = ["--policy.type=unimask", "--policy.push_to_hub=false", "--policy.device=cpu", *SMALL_FLAGS]

MAZE = {
    "observation.state": {"dtype": "float32", "shape": (4,), "names": ["x", "y", "goal_x", "goal_y"]},
    "action": {"dtype": "float32", "shape": (2,), "names": None},
}
MAZE_STATS = {
    "observation.state": {"mean": [3.0] * 4, "std": [1.0] * 4},
    "action": {"mean": [0.0] * 2, "std": [1.0] * 2},
}
CORNER = {"dtype": "int64", "shape": (1,), "names": None, "categories": [2]}  # a property of DoorKey's episodes
PARTS = ("probabilities", "mean", "scale")
KINDS = ("doorkey", "continuous", "gaussian")

LAYOUTS = {
    "stacked": {"token_layout": "stacked", "attention": "bidirectional"},
    "separate": {"attention": "bidirectional"},
    "both": {"attention": "both"},
}


def assert_unchanged(batch, before):
    assert batch.keys() == before.keys()
    for key, value in before.items():
        assert torch.equal(batch[key], value) if isinstance(value, torch.Tensor) else batch[key] == value, key


def numbers(answer):
    """Everything an answer says, one tensor for each component, NaN replaced so that it can be compared."""
    parts = [getattr(d, part, None) for name in ("s", "a") for d in answer[name] for part in PARTS]
    return [part.nan_to_num(-99.0) for part in parts if part is not None]


def assert_same_answers(one, other, exactly=True):
    for a, b in zip(numbers(one), numbers(other), strict=True):
        torch.testing.assert_close(a, b, **({"rtol": 0, "atol": 0} if exactly else {"rtol": 1e-4, "atol": 1e-5}))


def doorkey_policy(features=None, **settings):
    """An untrained DoorKey policy that scales nothing, as the exact optimum reads its windows."""
    from dataset_builders.doorkey import FEATURES
    from lerobot_unimask import UniMASKConfig, UniMASKPolicy

    torch.manual_seed(0)
    config = UniMASKConfig(device="cpu", **(SMALL | settings))
    config.set_dataset_feature_metadata(features or FEATURES)
    return UniMASKPolicy(config)


@contextmanager
def few_draws():
    """The panels' questions with few draws: a model that has learnt nothing takes all that it may."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"TRIES": 1, "DRAWN": 4}.items():
            patch.setattr(f"lerobot_unimask.envs.doorkey.panels.{name}", value)
        yield


def without_return(doorkey):
    return {key: entry for key, entry in doorkey.meta.features.items() if key != "observation.return_to_go"}


def random_question(policy, batch, seed):
    """(window, mask): random masking over a batch's windows."""
    window = policy.make_window(batch)
    drawer = TrainingMasks("random_mask", tuple(policy.factors), policy.config.context_length)
    return window, drawer(window.valid, torch.arange(len(window.valid)), seed=0, step=seed)


class Episode:
    """Observations of B environments over T steps, the return received so far, and what was done at each step."""

    def __init__(self, kind, B, T):
        generator = torch.Generator().manual_seed(3)
        if kind == "doorkey":
            self.states = torch.randint(0, 16, (T, B, 2), generator=generator).float()
        else:
            mean, std = (torch.tensor(CONTINUOUS_STATS["observation.state"][key]) for key in ("mean", "std"))
            self.states = mean + std * torch.randn(T, B, 3, generator=generator)
        self.received = torch.randn(T, B, 1, generator=generator).cumsum(0)
        self.received[0] = 0
        self.action_size = 1 if kind == "doorkey" else 2
        self.actions = []

    def observation(self, step):
        return {"observation.state": self.states[step], "observation.return_so_far": self.received[step]}

    def window(self, step, K, fps):
        """(batch, first step, position of the present): what a dataset would have recorded of the window in which
        `step` is the present, under LeRobot's keys, NaN for all that has not happened."""
        first = max(0, step - K + 1)
        B, D = self.states.shape[1:]
        state = torch.full((B, K, D), torch.nan)
        action = torch.full((B, K, self.action_size), torch.nan)
        for k in range(step - first + 1):
            state[:, k] = self.states[first + k]
            if first + k < step:
                action[:, k] = self.actions[first + k].float()
        batch = {
            "observation.state": state,
            "action": action,
            "observation.return_to_go": torch.full((B, K), torch.nan),
        }
        batch["timestamp"] = torch.full((B,), first / fps)
        return batch, first, step - first


def roll(policy, states, **how):
    policy.reset()
    nothing = torch.zeros(states.shape[1], 1)  # received so far
    observations = ({"observation.state": state, "observation.return_so_far": nothing} for state in states)
    return torch.stack([policy.select_action(observation, **how) for observation in observations])
