"""Pictures that are observed, recorded or given -> the tokens that the network makes of them, each looked at once.

Legend of shapes: B windows or environments, K steps, C channels, H and W pixels, D width of a token.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lerobot_unimask.asking.answers import LearntModel
from lerobot_unimask.asking.given import check_picture
from lerobot_unimask.data.window import Window, as_tensor
from lerobot_unimask.language.masks import Mask, Token


def look(model: LearntModel, name: str, pictures: Tensor) -> Tensor:
    """(B, C, H, W) of one camera -> (B, D)."""
    encoder = model.network.get_submodule(f"cameras.{name}.encoder")
    return encoder(pictures.to(model.device).unsqueeze(1), pictures.new_ones(len(pictures), 1).bool().to(model.device))[
        :, 0
    ]


def look_at_window(model: LearntModel, window: Window, shown: Mapping[str, Tensor]) -> Window:
    """The window with tokens, (B, K, D), in place of pictures: of those shown; NaN where a shown picture is, which is
    how one that is not there is marked."""
    values = dict(window.values)
    for name in model.cameras:
        pictures = values[name]
        if pictures.ndim == 5:
            there = shown[name] & ~pictures[..., 0, 0, 0].isnan()
            tokens = model.network.get_submodule(f"cameras.{name}.encoder")(pictures, there)
            values[name] = torch.where((shown[name] & ~there).unsqueeze(-1), torch.nan, tokens)
    return Window(values, window.valid)


def look_at_given(model: LearntModel, tokens: Mapping[Token, Tensor]) -> dict[Token, Tensor]:
    """What is given, (B, D) or (1, D) in place of each camera's pictures."""
    return {
        token: look(model, token.factor, value) if token.factor in model.cameras else value
        for token, value in tokens.items()
    }


def observed_pictures(model: LearntModel, batch: Mapping[str, Any], batch_size: int) -> dict[str, Tensor]:
    """Camera -> (B, D): the tokens of the pictures that the environments show at this step.

    Raises:
        ValueError: a camera is missing, or its pictures are none.
    """
    tokens = {}
    for name, camera in model.cameras.items():
        value = batch.get(camera.key)
        pictures = None if value is None else as_tensor(repr(camera.key), value)
        if pictures is None or pictures.ndim != 4 or pictures.shape[:2] != (batch_size, camera.shape[0]):
            found = "nothing" if pictures is None else f"shape {tuple(pictures.shape)}"
            raise ValueError(
                f"This policy looks at camera {camera.key!r}, ({batch_size}, {camera.shape[0]}, height, width); the "
                f"environment gives {found} under that name. It gives {', '.join(sorted(map(str, batch)))}."
            )
        check_picture(f"The picture of {camera.key!r}", pictures)
        tokens[name] = look(model, name, pictures)
    return tokens


def shown_pictures(
    model: LearntModel, window: Window | None, mask: Mask, given: Mapping[Token, Tensor]
) -> dict[str, Tensor]:
    """Token -> (H, W, C), from 0 to 1: the pictures of the first window that a question shows, in the order of time."""
    found = {}
    for step in range(next(iter(mask.shown.values())).shape[1]):
        for name in model.cameras:
            if mask.shown[name][0, step]:
                token = Token(name, step)
                recorded = None if window is None else window.values[name][:, step]
                picture = given.get(token, recorded)
                if picture is not None:
                    scale = 255 if picture.dtype == torch.uint8 else 1
                    found[str(token)] = (picture[0].float() / scale).permute(1, 2, 0).clamp(0, 1).cpu()
    return found
