"""A transformer over the tokens of a window that attends in both directions, as the paper's does (section 2.2, appendix
D), or causally, with the same weights.

In both directions, a hidden token's output predicts that token. Causally, a token's output predicts the next one, given
it and those before it, so that one pass answers for every step of a window.

Legend of shapes: B windows, K steps, F factors, N tokens, D the dimensions of a factor, W width, H heads.
"""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.factors import Factor
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import ASKABLE
from lerobot_unimask.networks.layers import (
    Block,
    Cache,
    Dropout,
    Heads,
    Predictions,
    _before_or_here,
    course,
    make_embeddings,
)
from lerobot_unimask.networks.vision import CameraEmbedding


class Transformer(nn.Module):
    """(window, shown) -> predictions.

    Args:
        config: settings. With token_layout=stacked a step is one token, made of all its factors (paper, appendix "Input
            stacking"), which cannot attend causally; otherwise there is one for each property, at the front, and one
            for each state, picture and action, in the order of time.
        factors: what a step consists of. Every factor is read; properties are predicted in both directions only.
        load_backbone: whether pretrained weights of what looks at pictures are fetched.
    """

    def __init__(self, config: UniMASKConfig, factors: dict[str, Factor], *, load_backbone: bool = True):
        super().__init__()
        width, cameras = config.width, config.pictures
        self.stacked = config.token_layout == "stacked"
        self.order = ("s", *cameras, "a")  # of a step's tokens
        self.properties = [name for name in factors if name not in ASKABLE]
        self.embeddings = make_embeddings(config, factors)
        tokens = len(self.properties) + len(self.order) * config.context_length
        if self.stacked:
            self.stack = nn.Linear((len(factors) + len(cameras)) * width, width)
            tokens = config.context_length
        self.positions = nn.Parameter(0.02 * torch.randn(tokens, width))  # within the window, not the episode
        self.dropout = Dropout(config.dropout)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.depth))
        self.norm = nn.LayerNorm(width)
        outputs = enumerate(factors["s"].outputs) if config.state_residuals else ()
        self.on_course = {i: output for i, output in outputs if not output.discrete}
        self.heads = Heads(factors, config.predicted(factors), width)
        encoder: dict[str, Any] = {
            "backbone": config.vision_backbone,
            "weights": config.pretrained_backbone_weights,
            "load": load_backbone,
            "fine": config.fine_inputs is not False,
        }
        self.cameras = nn.ModuleDict(
            {name: CameraEmbedding(camera.shape, width, **encoder) for name, camera in cameras.items()}
        )

    def forward(
        self,
        window: Window,
        shown: dict[str, Tensor],
        causal: Tensor | bool = False,
        cache: Cache | None = None,
        asked: dict[str, Tensor] | None = None,
    ) -> Predictions:
        """For every step, logits of discrete outputs, and of continuous ones normalised means, or means and the
        logarithms of scales.

        Args:
            window: normalised values.
            shown: factor -> (B, K) bool, True = shown.
            causal: whether tokens see only those before them, for all windows or each, (B,) bool. The prediction for a
                token is then made from the one before it, and does not depend on whether itself is shown.
            cache: of a rollout, with `causal=True` and `asked`: only what it does not hold yet is computed, up to the
                token before the first asked one; only the prediction for that one means something.
            asked: factor -> (B, K) bool, True = asked: what is read of the predictions. On a processor the last block
                and the heads compute nothing else. None: all.
        """
        tokens = {
            name: cache.embed(name, embed, window.values[name], shown[name])
            if cache is not None and name in ASKABLE
            else embed(window.values[name], shown[name])
            for name, embed in (*self.embeddings.items(), *self.cameras.items())
        }
        x = self._stack(tokens) if self.stacked else self._lay_out(tokens)  # (B, N, W)
        x = self.dropout(x + self.positions)
        static = x.device.type != "cpu" or torch.compiler.is_compiling()  # how much is computed never depends on masks
        if cache is not None:
            assert asked is not None
            predictions = self._predict_next(x, asked, cache)
        elif asked is not None and not self.stacked and not static:
            predictions = self._predict_asked(x, causal, asked)
        else:
            x = self.norm(self._attend(x, causal))
            if causal is not False:  # the token before; nothing stands before the first one
                before = functional.pad(x, (0, 0, 1, -1))
                x = before if causal is True else torch.where(causal[:, None, None], before, x)
            predictions = self.heads(self._split(x, ASKABLE if causal is True else self.heads))
        if self.on_course and (asked is None or static or asked["s"].any()):
            states = torch.where(shown["s"].unsqueeze(-1), window.values["s"], 0.0)
            ahead = course(states, shown["s"], causal)
            for i, output in self.on_course.items():
                logits, means, scales = output.unpack(predictions["s"][i])
                means = means + ahead[..., output.dims].unsqueeze(-2)
                predictions["s"][i] = output.pack(logits, means, scales)
        return predictions

    def _predict_asked(self, x: Tensor, causal: Tensor | bool, asked: dict[str, Tensor]) -> Predictions:
        """The asked tokens of (B, N, W); how many there are is known on a processor without waiting for it."""
        B, N, _ = x.shape
        earlier = (
            int(causal) if isinstance(causal, bool) else causal.long()[:, None]
        )  # 1: predicted from the one before
        names = list(ASKABLE if causal is True else self.heads)
        step = len(self.properties) + len(self.order) * torch.arange(asked["s"].shape[1]) - earlier
        position = [(step + self.order.index(name)).expand(B, -1)[asked[name]] for name in ASKABLE]
        window = [asked[name].nonzero()[:, 0] for name in names]
        position += [torch.full_like(w, self.properties.index(n)) for n, w in zip(names[2:], window[2:], strict=True)]
        sizes = [len(rows) for rows in position]
        place = torch.cat(position)  # (M,) of what each asked token is predicted from, in its window; -1: nothing
        x = self.norm(self._attend(x, causal, torch.cat(window) * N + place.clamp_min(0)))
        x = torch.where((place >= 0).unsqueeze(-1), x, 0.0)
        return self.heads(dict(zip(names, x.split(sizes), strict=True)), asked)

    def _attend(self, x: Tensor, causal: Tensor | bool, read: Tensor | None = None) -> Tensor:
        """All tokens, (B, N, W) -> (B, N, W), or those whose numbers among the B N tokens are `read`: (M, W)."""
        attend = None
        if causal is not False:
            attend = _before_or_here(x.shape[1], x.device)  # (N, N)
            if causal is not True:
                attend = attend | ~causal[:, None, None, None]  # (B, 1, N, N)
        for block in self.blocks[:-1]:
            x, _ = block(x, attend, None)
        return self.blocks[-1](x, attend, None, read=read)[0]

    def _predict_next(self, x: Tensor, asked: dict[str, Tensor], cache: Cache) -> Predictions:
        """The first of (B, N, W) tokens that is asked in some window; of others nothing that counts."""
        count = self._before(asked)
        last = self.norm(self._extend(x[:, :count], cache))  # (B, 1, W)
        return self.heads(self._split(functional.pad(last, (0, 0, count, x.shape[1] - count - 1)), ASKABLE))

    def _extend(self, x: Tensor, cache: Cache) -> Tensor:
        """The last of (B, n, W) tokens, (B, 1, W), from those alone that the cache lacks."""
        if cache.slides and not cache.grows:  # nobody will read what could be kept
            attend = _before_or_here(x.shape[1], x.device)
            for block in self.blocks[:-1]:
                x, _ = block(x, attend, None)
            last = self.blocks[-1]
            assert isinstance(last, Block)
            return last.last(x)
        if cache.inputs is None or not cache.matches(x) or cache.inputs.shape[1] == x.shape[1]:
            cache.inputs, cache.keys, cache.values = None, [], []
        start = 0 if cache.inputs is None else cache.inputs.shape[1]
        attend = _before_or_here(x.shape[1], x.device)[start:]
        new = x[:, start:]
        for depth, block in enumerate(self.blocks):
            past = (cache.keys[depth], cache.values[depth]) if start else None
            new, kept = block(new, attend, past, last=depth == len(self.blocks) - 1)
            cache.keys[depth : depth + 1], cache.values[depth : depth + 1] = [kept[0]], [kept[1]]
        cache.inputs = x
        return new

    def _before(self, asked: dict[str, Tensor]) -> int:
        """Tokens before the first state or action that is asked in some window: what is shown, and a picture that is
        not, from whose place an action is predicted."""
        nothing = torch.zeros_like(asked["s"][0])
        steps = torch.stack([asked[name].any(0) if name in ASKABLE else nothing for name in self.order], dim=1)
        return len(self.properties) + int(steps.flatten().nonzero()[0])

    def _stack(self, tokens: dict[str, Tensor]) -> Tensor:
        return self.stack(torch.cat(list(tokens.values()), dim=-1))  # (B, K, (F + cameras) W) -> (B, K, W)

    def _lay_out(self, tokens: dict[str, Tensor]) -> Tensor:
        """Properties (their first step alone is ever shown), then s0 a0 s1 a1 ..., a step's n - 2 pictures between its
        state and its action: (B, P + n K, W)."""
        steps = torch.stack([tokens[name] for name in self.order], dim=2).flatten(1, 2)  # (B, n K, W)
        return torch.cat([*(tokens[name][:, :1] for name in self.properties), steps], dim=1)

    def _split(self, x: Tensor, names: Iterable[str]) -> dict[str, Tensor]:
        """(B, N, W) -> what each factor's tokens are predicted from: (B, K, W), of a property (B, 1, W)."""
        if self.stacked:
            return {name: x if name in ASKABLE else x[:, :1] for name in names}
        steps = x[:, len(self.properties) :].unflatten(1, (-1, len(self.order)))  # (B, K, n, W)
        return {
            name: steps[:, :, self.order.index(name)] if name in ASKABLE else x[:, self.properties.index(name), None]
            for name in names
        }
