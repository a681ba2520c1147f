"""A multi-layer perceptron over the whole window (paper, appendix "Detailed heatmaps": "Multi-layer Perceptron").

Legend of shapes: B windows, K steps, N tokens, W width, H inner width.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn

from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.factors import Factor
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import ASKABLE
from lerobot_unimask.networks.layers import Cache, Dropout, Heads, Predictions, make_embeddings


class FeedForward(nn.Module):
    """(window, shown) -> predictions: every token embedded, hidden ones too, all of them end to end, then an MLP.

    Note: The paper gives the sizes (embeddings of 32, three hidden layers of 128) and the masks, "the same maskings as
        our transformer", and no more. Here a hidden token is a learned embedding, as in the transformer, which tells
        the network the mask; the activation is GELU; a property is one token and not one for each step, because only
        its first is ever shown; every token has weights of its own, so there are no position embeddings.

    Args:
        factors: parts of a step. Every factor is read.
    """

    def __init__(self, config: UniMASKConfig, factors: dict[str, Factor]):
        super().__init__()
        K, inner = config.context_length, config.feedforward_width
        self.embeddings = make_embeddings(config, factors)
        tokens = sum(K if name in ASKABLE else 1 for name in factors)
        layers = [
            nn.Sequential(nn.Linear(before, after), nn.GELU(), Dropout(config.dropout))
            for before, after in pairwise([tokens * config.width] + config.depth * [inner])
        ]
        self.hidden = nn.Sequential(*layers)
        self.heads = Heads(factors, config.predicted(factors), inner, steps=K)

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
