"""What acting remembers of the episodes that run side by side.

Legend of shapes: B environments, K steps, D the numbers of a factor.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from lerobot_unimask.data.factors import Factor
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import ASKABLE, Mask
from lerobot_unimask.networks.layers import Cache


class RolloutMemory:
    """The last states and actions of each environment in a batch, and the return that each had received by then.

    The present stands at position min(step, last_position) of the window. Positions after it are empty; once it stands
    at the last one, the window slides.

    Args:
        context_length: K.
        batch_size: B.
        last_position: position where the present stops, K - 1 or less; None: K - 1.
        cameras: name of each camera -> numbers of the token that stands for its picture.
    """

    @torch.inference_mode(False)
    def __init__(
        self,
        factors: Mapping[str, Factor],
        context_length: int,
        batch_size: int,
        device: torch.device,
        last_position: int | None = None,
        cameras: Mapping[str, int] | None = None,
    ):
        K = context_length
        self.last_position = K - 1 if last_position is None else last_position
        self.step = -1  # of the episode; nothing has been observed yet
        self.acted = True  # the step has ended, so that the next observation begins another
        self.cameras = tuple(cameras or {})
        sizes = {name: factor.size for name, factor in factors.items()} | dict(cameras or {})
        self.values = {name: torch.zeros(batch_size, K, size, device=device) for name, size in sizes.items()}
        self.return_so_far = torch.full((batch_size, K), torch.nan, device=device)
        self.first_state = self.values["s"][:, 0]  # (B, D) of the episode's first step, once that is observed
        self.task: str | Sequence[str] | None = None  # what each environment is to do, as it says at this step
        self.planned: list[Tensor] = []  # actions of a chunk that are still to be carried out, each (B, D)
        self.valid = torch.ones(batch_size, K, dtype=torch.bool, device=device)
        self.cache = Cache()  # of the steps in the window
        self.posed: tuple[Any, ...] | None = None  # what the last question was made of, and
        self.question: Mask | None = None  # the same again while the window slides

    @property
    def position(self) -> int:
        """Where the present stands in the window."""
        return min(self.step, self.last_position)

    @property
    def first_step(self) -> int:
        """The episode's step at position 0."""
        return self.step - self.position

    @torch.inference_mode(False)  # LeRobot acts in inference mode; what is remembered outlives it
    def observe(
        self, state: Tensor, return_so_far: Tensor | None, pictures: Mapping[str, Tensor] | None = None
    ) -> None:
        """Begin a step: (B, D) of `s`, (B,) the rewards received so far, where the environment reports them, and (B,
        width) of each camera, the token of its picture.

        Where the last step found no action, because its question was refused, it begins again.
        """
        if self.acted:
            self.step += 1
            if self.step > self.last_position:
                for name in (*ASKABLE, *self.cameras):
                    self.values[name] = self.values[name].roll(-1, dims=1)
                self.return_so_far = self.return_so_far.roll(-1, dims=1)
                self.cache.slide()
            self.acted = False
        state = state.clone()
        if self.step == 0:
            self.first_state = state
        self.values["s"][:, self.position] = state
        for name, token in (pictures or {}).items():
            self.values[name][:, self.position] = token.clone()
        self.return_so_far[:, self.position] = torch.nan if return_so_far is None else return_so_far

    @torch.inference_mode(False)
    def act(self, action: Tensor) -> None:
        """End the step: (B, D) of `a`."""
        self.values["a"][:, self.position] = action.clone()
        self.acted = True

    def known(self) -> dict[str, Tensor]:
        """factor -> (K,) bool: states and pictures up to the present, actions before it."""
        steps = torch.arange(self.valid.shape[1])
        known = dict.fromkeys(self.values, torch.zeros_like(steps, dtype=torch.bool))
        known |= dict.fromkeys(("s", *self.cameras), steps <= self.position)
        return known | {"a": steps < self.position}

    def window(self, horizon: Tensor) -> Window:
        """The window as it stands; the return token knows its timestep, its return is for `give` to fill in."""
        values = dict(self.values)
        if "rtg" in values:
            values["rtg"] = values["rtg"].clone()
            values["rtg"][..., -1] = (self.first_step + torch.arange(self.valid.shape[1]).to(horizon)) / horizon
        return Window(values, self.valid)

    def carry_return(self, window: Window) -> None:
        """Write into a window what is left of its first step's return at the later steps, NaN where nobody has reported
        the rewards since. No mask shows it; a Decision Transformer reads it."""
        if "rtg" in window.values:
            received = self.return_so_far[:, 1:] - self.return_so_far[:, :1]  # (B, K - 1)
            window.values["rtg"][:, 1:, 0] = window.values["rtg"][:, :1, 0] - received

    def remaining(self, target_return: Tensor) -> Tensor:
        """What is left of the target return, (B, 1) or (1, 1), at the window's first step: (B, 1).

        Raises:
            ValueError: the window has slid and the environment never reported the return so far.
        """
        if self.first_step == 0:
            return target_return.expand(len(self.valid), 1)
        received = self.return_so_far[:, :1]
        if received.isnan().any():
            raise ValueError(NO_RETURN_SO_FAR)
        return target_return - received


NO_RETURN_SO_FAR = (
    "Asking for a return over an episode that is longer than the window needs the environment to report what it has "
    "paid so far, as 'observation.return_so_far' (an array 'return_so_far' of shape (1,) in its observations)."
)
