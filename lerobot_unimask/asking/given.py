"""Values that a user gives for single tokens of a window, `{"s[-1]": [15, 15], "rtg[0]": 5, "top[-1]": "goal.png"}`,
read and checked.

Legend of shapes: B windows or environments, K steps, D the numbers of a factor; C channels, H and W pixels.
"""

import reprlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from lerobot_unimask.data.factors import Camera, Factor, category_numbers
from lerobot_unimask.data.window import Window, as_tensor
from lerobot_unimask.language.masks import Mask, Token, parse_token

SHORT = reprlib.Repr(maxlist=12, maxdict=6, maxstring=60, maxother=200)
Given = Mapping[str, Any]  # token text -> its value, shared (D,) or one per environment (B, D); a number where D = 1


def read_given(
    given: Given,
    factors: Mapping[str, Factor],
    context_length: int,
    batch_size: int | None = None,
    cameras: Mapping[str, Camera] | None = None,
) -> dict[Token, Tensor]:
    """Check what a user gives: token -> (B, D) or (1, D), D as the user counts it, without computed parts; for a camera
    (B, C, H, W) or (1, C, H, W).

    Args:
        batch_size: B; None where it is not known yet, and any number of rows will do.

    Raises:
        MaskError: a key that is not a token.
        ValueError: a value of the wrong size, not finite, or not one of the categories; no picture.
    """
    cameras = cameras or {}
    if not isinstance(given, Mapping):
        raise ValueError(f'given is {text_of(given)}; give values by token, as in {{"s[-1]": [15, 15], "rtg[0]": 5}}.')
    tokens: dict[Token, Tensor] = {}
    for text, value in given.items():
        if not isinstance(text, str):
            raise ValueError(f"given names {text_of(text)}; name a token by its text, as in 's[-1]'.")
        token = parse_token(text, tuple(factors), context_length, tuple(cameras))
        if token in tokens:
            raise ValueError(f"{token} is given twice, the second time as {text}.")
        if token.factor in cameras:
            tokens[token] = _picture(text, value, cameras[token.factor], batch_size)
        else:
            tokens[token] = _token(text, value, factors[token.factor], batch_size)
    return tokens


def in_window(
    tokens: Mapping[Token, Tensor], first_step: int, context_length: int, horizon: int | None = None
) -> dict[tuple[str, int], Tensor]:
    """(factor, position) -> value, of the tokens that lie in a window that begins at an episode's step `first_step`.

    Args:
        horizon: steps of the longest episode.

    Raises:
        ValueError: a step that no episode has.
    """
    here = {}
    for token, value in tokens.items():
        if token.of_episode and horizon is not None and token.step >= horizon:
            raise ValueError(f"{token} is given, but the longest episode has {horizon} steps, 0 to {horizon - 1}.")
        position = token.step - first_step if token.of_episode else token.step
        if 0 <= position < context_length:
            here[token.factor, position] = value
    return here


def give(
    window: Window, tokens: Mapping[tuple[str, int], Tensor], known: Mapping[str, Tensor]
) -> tuple[Window, dict[str, Tensor]]:
    """The window with the given tokens where nothing has been observed, and which tokens are known then.

    Args:
        tokens: (factor, position) -> value, as `in_window` returns them.
        known: factor -> (K,) bool, True where the window holds an observed value, which wins over a given one.
    """
    values, known = dict(window.values), dict(known)
    for (name, step), value in tokens.items():
        if not known[name][step]:
            values[name], known[name] = values[name].clone(), known[name].clone()
            values[name][:, step, : value.shape[-1]] = value.to(window.valid.device)
            known[name][step] = True
    return Window(values, window.valid), known


def _token(text: str, value: Any, factor: Factor, B: int | None) -> Tensor:
    """(B, given_size) or (1, given_size), checked."""
    size = factor.given_size
    numbers = f"{size} number{'s' * (size > 1)}"
    texts = [value] if isinstance(value, str) else value
    if factor.components[0].labels and isinstance(texts, list | tuple) and any(isinstance(one, str) for one in texts):
        value = category_numbers(texts, factor)
    try:
        token = as_tensor(text, value).float()
    except ValueError as error:
        raise ValueError(f"{text} is given {text_of(value)}; give {numbers}.") from error
    if token.ndim == 0 or (token.ndim == 1 and size == 1 and token.shape[0] in (B or token.shape[0], 1)):
        token = token.reshape(-1, 1)
    elif token.ndim == 1:
        token = token.unsqueeze(0)
    if token.ndim != 2 or token.shape[1] != size or token.shape[0] not in (1, B or token.shape[0]):
        each = "each window or environment" if B is None else f"each of the {B} windows or environments"
        raise ValueError(f"{text} is given {text_of(value)}; give {numbers}, or one such row for {each}.")
    check_values(f"{text} is given {text_of(value)}, which", token, factor)
    return token


def _picture(text: str, value: Any, camera: Camera, B: int | None) -> Tensor:
    """A picture's path, or an array or tensor, colours first or last, one or one for each of B: (B or 1, C, H, W)."""
    channels = camera.shape[0]
    if isinstance(value, str | Path):
        try:
            with Image.open(value) as picture:
                value = np.array(picture.convert("L" if channels == 1 else "RGB"))
        except OSError as error:
            raise ValueError(
                f"{text} is given {str(value)!r}, which is no picture that can be read: {error}"
            ) from error
        value = value.reshape(*value.shape[:2], -1)
    pictures = as_tensor(text, value)
    pictures = pictures.unsqueeze(0) if pictures.ndim == 3 else pictures
    if pictures.ndim == 4 and pictures.shape[1] != channels and pictures.shape[-1] == channels:
        pictures = pictures.permute(0, 3, 1, 2)
    if pictures.ndim != 4 or pictures.shape[1] != channels or len(pictures) not in (1, B or len(pictures)):
        raise ValueError(
            f"{text} is given an array of shape {tuple(as_tensor(text, value).shape)}; give a picture's path, or a "
            f"picture ({channels}, height, width), or one for each window or environment."
        )
    check_picture(f"The picture given as {text}", pictures)
    return pictures


def check_picture(what: str, pictures: Tensor) -> None:
    """
    Raises:
        ValueError: they are neither uint8 nor numbers from 0 to 1.
    """
    if pictures.dtype != torch.uint8 and (
        not pictures.is_floating_point() or not ((pictures >= -1e-3) & (pictures <= 1 + 1e-3)).all()
    ):
        raise ValueError(f"{what} is {pictures.dtype} and not uint8, or holds other numbers than those from 0 to 1.")


def text_of(value: Any) -> str:
    """A value of any size in a few words, for an error."""
    if isinstance(value, Tensor) and (value.is_meta or value.layout != torch.strided):
        return f"a tensor of {value.dtype}, {value.layout}, on {value.device}"
    if isinstance(value, int) and abs(value) >= 10**30:
        return f"a whole number of {value.bit_length()} bits"
    return SHORT.repr(value)


def check_values(what: str, values: Tensor, factor: Factor) -> None:
    """Values of a factor, (..., D) or without its computed numbers, must be finite, and categories where discrete.

    Raises:
        ValueError: they are not; names `what` and the first bad value.
    """
    fine = values.isfinite()
    if not fine.all():
        raise ValueError(f"{what} holds {values[~fine][0].item()}; its numbers must be finite.")
    for component in factor.components:
        if component.categories is not None:
            numbers = values[..., component.dims]
            bad = (numbers < 0) | (numbers >= component.categories) | (numbers != numbers.round())
            if bad.any():
                raise ValueError(
                    f"{what} holds {numbers[bad][0].item():g}; {component.name} is a category from 0 to "
                    f"{component.categories - 1}."
                )


def check_shown(tokens: Iterable[Token], shown: Mapping[str, Tensor], text: str) -> None:
    """A given token of the window must be one that the mask shows, (..., K) bool for each factor, or giving it changes
    nothing.

    Raises:
        ValueError: the mask does not show it.
    """
    for token in tokens:
        if not token.of_episode and not shown[token.factor][..., token.step].any():
            raise ValueError(
                f"{token} is given, but the mask does not show it:\n  {text}\n"
                f"Add {token} after the bar, or do not give it."
            )


def check_known(mask: Mask, known: Mapping[str, Tensor], text: str) -> None:
    """Everything that the mask shows must be known.

    Raises:
        ValueError: it shows a token that has been neither observed nor given.
    """
    missing = [
        f"{name}[{step}]"
        for name, shown in mask.shown.items()
        for step in (shown.any(0).cpu() & ~known[name]).nonzero().flatten().tolist()
    ]
    if missing:
        example = missing[0]
        raise ValueError(
            f"The mask shows {', '.join(missing)}, which has been neither observed nor given.\n  {text}\n"
            f'Give its value, as in given={{"{example}": ...}}, or choose a mask that does not show it.'
        )
