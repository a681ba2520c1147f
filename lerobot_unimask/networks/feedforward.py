"""A multi-layer perceptron over the whole window (paper, appendix "Detailed heatmaps": "Multi-layer Perceptron").

Legend of shapes: B windows, K steps, N tokens, W width, H inner width.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from lerobot_unimask.data.factors import Factor
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import ASKABLE
from lerobot_unimask.networks.layers import Cache, Dropout, FactorEmbedding, Heads, Predictions


class FeedForward(nn.Module):
    """(window, shown) -> predictions: every token embedded, hidden ones too, all of them end to end, then an MLP.

    Note: The paper gives the sizes (embeddings of 32, three hidden layers of 128) and the masks, "the same maskings as
        our transformer", and no more. Here a hidden token is a learned embedding, as in the transformer, which tells
        the network the mask; the activation is GELU; a property is one token and not one for each step, because only
        its first is ever shown; every token has weights of its own, so there are no position embeddings.

    Args:
        factors: parts of a step. Every factor is read.
        predicted: names of those that are predicted.
        fine_inputs: whether `NumberEncoding` encodes continuous values.
        width: size of each token's embedding.
        depth: number of hidden layers.
        feedforward_width: size of each hidden layer.
    """

    def __init__(
        self,
        factors: dict[str, Factor],
        *,
        predicted: Sequence[str] = ASKABLE,
        context_length: int,
        fine_inputs: bool,
        width: int,
        depth: int,
        feedforward_width: int,
        dropout: float,
    ):
        super().__init__()
        self.embeddings = nn.ModuleDict(
            {name: FactorEmbedding(factor, width, fine_inputs=fine_inputs) for name, factor in factors.items()}
        )
        tokens = sum(context_length if name in ASKABLE else 1 for name in factors)
        widths = [tokens * width] + depth * [feedforward_width]
        self.hidden = nn.Sequential(
            *(
                nn.Sequential(nn.Linear(before, after), nn.GELU(), Dropout(dropout))
                for before, after in pairwise(widths)
            )
        )
        self.heads = Heads(factors, predicted, feedforward_width, steps=context_length)

    def forward(
        self,
        window: Window,
        shown: dict[str, Tensor],
        causal: Tensor | bool = False,
        cache: Cache | None = None,
        asked: dict[str, Tensor] | None = None,
    ) -> Predictions:
        """As `Transformer.forward`; it sees the whole window whatever `causal` says, and keeps nothing in a cache."""
        tokens = {name: embed(window.values[name], shown[name]) for name, embed in self.embeddings.items()}
        x = torch.cat(
            [token.flatten(1) if name in ASKABLE else token[:, 0] for name, token in tokens.items()], dim=1
        )  # (B, N W)
        x = self.hidden(x).unsqueeze(1)  # (B, 1, H)
        return self.heads(dict.fromkeys(self.heads, x))
