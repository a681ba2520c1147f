"""What training says of episodes that it holds out: how far acting is from repeating the last action.

Legend of shapes: B windows, K steps, D the numbers of an action.
"""

import contextlib

import torch
from torch import Tensor

from lerobot_unimask.asking.answers import LearntModel, answer
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.training_masks import validation_masks


class HeldOutActions:
    """Sums over the batches of one evaluation: of windows, each asked one step's action as acting asks it."""

    def __init__(self) -> None:
        self.steps = 0
        self.missed = torch.zeros(2, dtype=torch.float64)  # by the policy, and by the last action repeated

    @torch.no_grad()
    def add(self, model: LearntModel, window: Window, index: Tensor) -> None:
        """Ask for an action of each window that has one before it.

        Args:
            window: recorded values, in the dataset's units.
            index: (B,) the windows' first frames, which decide the steps that are asked.
        """
        text, factors = model.config.inference_mask, tuple(model.factors)
        mask = validation_masks(text, factors, window.valid, index, tuple(model.cameras))
        asked = mask.asked["a"][:, 1:]
        with contextlib.suppress(MaskError):  # the model has not learnt to answer what acting asks
            guessed = answer(model, window, mask).carried_out("a")[:, 1:][asked]  # (n, D)
            recorded, last = window.values["a"][:, 1:][asked], window.values["a"][:, :-1][asked]
            self.missed += torch.stack([_missed(model, guess, recorded) for guess in (guessed, last)]).cpu()
            self.steps += len(recorded)

    def line(self, model: LearntModel) -> str | None:
        """The comparison in words; None where nothing was asked."""
        if not self.steps:
            return None
        mine, repeated = (self.missed / self.steps).tolist()
        where = f"On {self.steps} held-out steps"
        if model.factors["a"].discrete:
            return (
                f"{where} acting chooses another action than the recorded one in {mine:.1%}, repeating the last action "
                f"in {repeated:.1%}."
            )
        return (
            f"{where} acting misses the recorded action by {mine**0.5:.3f} standard deviations, repeating the last "
            f"action by {repeated**0.5:.3f} (root mean squares)."
        )


def _missed(model: LearntModel, guessed: Tensor, recorded: Tensor) -> Tensor:
    """The number of (n, D) actions that are not the recorded ones, or the sum of their mean squared distances."""
    if model.factors["a"].discrete:
        return (guessed != recorded).any(-1).double().sum()
    return ((guessed - recorded) / model.statistics.get_buffer("a_std")).double().square().mean(-1).sum()
