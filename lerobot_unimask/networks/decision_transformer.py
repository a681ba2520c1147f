"""Decision Transformer (Chen et al., NeurIPS 2021), a baseline of the paper.

Legend of shapes: B windows, K steps, W width.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.factors import Factor
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import ASKABLE
from lerobot_unimask.networks.layers import Block, Cache, Dropout, Heads, Predictions, make_embeddings

# Rows of the timestep embedding, as in the original: an episode's steps, or thousandths of a longer one
TIMESTEPS = 1000


class DecisionTransformer(nn.Module):
    """(window, shown) -> predictions: a causal transformer over return-to-go, state and action of every step.

    A mask shows the return at a window's first step or not at all. Where it does, this network alone reads the later
    steps' too: recorded ones in training, in a rollout the first lowered by the rewards received since. At step t it
    reads those up to t, which follow from the first return and what has happened. For behaviour cloning no return is
    shown.

    Note: Departures from the original. The embedding of the timestep is of its share of the horizon, in thousandths,
        because a window does not know the horizon: one row for each step of an episode of up to 1,000. Hidden returns
        (behaviour cloning) are a learned embedding, where the original has no such tokens. Returns are normalised by
        the dataset's statistics instead of divided by a constant. The blocks, the optimiser and the action's head are
        this package's (layer norms in front, GELU, AdamW, no tanh). Where a state is asked for, which the original
        never does, it is predicted from the action before it.

    Args:
        factors: what a step consists of; other properties than the return are not read.

    Raises:
        ValueError: there is no return factor.
    """

    def __init__(self, config: UniMASKConfig, factors: dict[str, Factor]):
        super().__init__()
        width, tokens = config.width, 3 * config.context_length
        if "rtg" not in factors:
            raise ValueError(
                "network=decision_transformer reads a return at every step, and this dataset has no "
                "'observation.return_to_go'; network=transformer with attention=causal needs none."
            )
        self.embeddings = make_embeddings(config, {name: factors[name] for name in ASKABLE})
        self.returns = nn.Linear(1, width)
        self.hidden_return = nn.Parameter(0.02 * torch.randn(width))
        self.timesteps = nn.Embedding(TIMESTEPS + 1, width)
        nn.init.normal_(self.timesteps.weight, std=0.02)
        self.norm_inputs = nn.LayerNorm(width)
        self.dropout = Dropout(config.dropout)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.depth))
        self.norm = nn.LayerNorm(width)
        self.heads = Heads(factors, ASKABLE, width)
        before = torch.ones(tokens, tokens, dtype=torch.bool).tril()
        self.register_buffer("before", before, persistent=False)

    def forward(
        self,
        window: Window,
        shown: dict[str, Tensor],
        causal: Tensor | bool = True,
        cache: Cache | None = None,
        asked: dict[str, Tensor] | None = None,
    ) -> Predictions:
        """As `Transformer.forward`, causally whatever `causal` says; it keeps nothing in a cache.

        Raises:
            ValueError: the first return is shown and a later one, at a step whose state is shown, is not known.
        """
        tokens = [self._embed_returns(window, shown)]
        tokens += [embed(window.values[name], shown[name]) for name, embed in self.embeddings.items()]
        timestep = (window.values["rtg"][..., -1] * TIMESTEPS).round().long().clamp(0, TIMESTEPS)  # (B, K)
        x = torch.stack(tokens, dim=2) + self.timesteps(timestep).unsqueeze(2)  # (B, K, 3, W)
        x = self.dropout(self.norm_inputs(x.flatten(1, 2)))  # (B, 3 K, W): R0 s0 a0 R1 s1 a1 ...
        for block in self.blocks:
            x, _ = block(x, self.before, None)
        _, at_state, at_action = self.norm(x).unflatten(1, (-1, 3)).unbind(2)  # each (B, K, W)
        # Each is predicted from the token before it; before s0 there is none.
        return self.heads({"s": functional.pad(at_action, (0, 0, 1, -1)), "a": at_state})

    def _embed_returns(self, window: Window, shown: dict[str, Tensor]) -> Tensor:
        """(B, K, W)"""
        returns = window.values["rtg"][..., :1]  # (B, K, 1)
        conditioned = shown["rtg"][:, :1]  # (B, 1): of all steps, or none
        known = returns[..., 0].isfinite()
        # A captured update cannot look into its tensors; and recorded windows have their returns.
        if not torch.compiler.is_compiling() and (conditioned & shown["s"] & ~known).any():
            raise ValueError(
                "A Decision Transformer reads the return-to-go of every step, and this window has that of its first "
                "alone. Ask about a recorded window, or in a rollout whose environment reports "
                "'observation.return_so_far' (an array 'return_so_far' of shape (1,) in its observations)."
            )
        read = (conditioned & known).unsqueeze(-1)
        return torch.where(read, self.returns(torch.where(read, returns, 0.0)), self.hidden_return)
