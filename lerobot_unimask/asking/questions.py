"""A question about recorded or given values: its window and its mask, with nothing shown that is not known.

Legend of shapes: B windows, K steps.
"""

import operator
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lerobot_unimask.asking.answers import LearntModel
from lerobot_unimask.asking.given import (
    Given,
    check_known,
    check_shown,
    check_values,
    give,
    in_window,
    read_given,
    text_of,
)
from lerobot_unimask.asking.looking import look_at_given, look_at_window
from lerobot_unimask.asking.memory import RolloutMemory
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import Mask, tabulate


def pose_question(
    model: LearntModel,
    window: Window | Mapping[str, Tensor] | None,
    mask: Mask | str,
    t: int | None,
    given: Given | None,
) -> tuple[Window, Mask]:
    """The window and mask of a question, on the model's device; see `UniMASKPolicy.infer` for arguments and errors."""
    K = model.config.context_length
    recorded = window is not None
    cameras = model.cameras
    if window is None:
        tokens = read_given({} if given is None else given, model.factors, K, cameras=cameras)
        width = dict.fromkeys(cameras, model.config.width)
        empty = RolloutMemory(model.factors, K, max(map(len, tokens.values()), default=1), model.device, cameras=width)
        window = empty.window(model.statistics.horizon)
        empty.carry_return(window)
    elif not isinstance(window, Window):
        window = model.make_window(window, partial=True)
    if window.valid.shape[1] != K:
        raise ValueError(f"The window has {window.valid.shape[1]} steps; this model's have {K}.")
    window = window.to(model.device)
    batch_size = len(window.valid)
    if isinstance(mask, Mask):
        if mask.causal is not False:
            raise ValueError("A question's direction follows from what it asks: leave out the Mask's `causal`.")
        text = mask.draw()
        hidden = {name: torch.zeros_like(window.valid) for name in (*model.factors, *cameras)}
        mask = Mask(hidden | mask.shown, hidden | mask.asked)
    else:
        table = tabulate(mask, tuple(model.factors), K, tuple(cameras))
        text, mask = table.question.text, table.at(None if t is None else step_number(t), batch_size)
    mask = mask.to(model.device).within(window.valid)
    tokens = read_given({} if given is None else given, model.factors, K, batch_size, cameras)
    for token in tokens:
        if token.of_episode:
            raise ValueError(f"{token} is a moment of an episode, for rollouts; here name one of the window, s[3].")
    window = look_at_window(model, window, mask.shown)
    known = {}
    for name, value in window.values.items():
        lacking = mask.shown[name] & value.isnan().any(-1)  # as in a sample, or a column that is not there
        known[name] = torch.full((K,), recorded) & ~lacking.any(0).cpu()
    for token in tokens:  # here the user changes a recorded window on purpose
        known[token.factor][token.step] = False
    window, known = give(window, in_window(look_at_given(model, tokens), 0, K), known)
    check_shown(tokens, mask.shown, text)
    check_known(mask, known, text)
    for name, factor in model.factors.items():
        check_values(f"A shown token of {name}", window.values[name][mask.shown[name]], factor)
    return window, mask


def step_number(t: Any) -> int:
    """
    Raises:
        ValueError: it is not a whole number.
    """
    try:
        return operator.index(t)
    except TypeError as error:
        raise ValueError(f"t is {text_of(t)}; give the number of a step, as in t=3.") from error
