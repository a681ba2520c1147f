"""The paper's network: a bidirectional transformer encoder over the steps of a window (paper, section 2.2, appendix D).

Legend of shapes: B windows, K steps, F factors, N tokens, D the dimensions of a factor, W width, H heads.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from lerobot_unimask.masks import ASKABLE
from lerobot_unimask.window import Factor, Window

Predictions = dict[str, list[Tensor]]  # factor -> one (B, K, size) for each of its components


class NumberEncoding(nn.Module):
    """Continuous values, normalised, as inputs that a network can resolve.

    A point mass moves by a fiftieth of its positions' standard deviation in a step, and its velocity is there only as
    that difference. So each number comes with its displacement per step since the previous shown step, at several
    scales because no dataset's statistics tell its size, and with sines and cosines. A displacement exists only where
    both ends are shown, and looks only backwards in time.

    Args:
        size: numbers of one token.
        fine: False leaves the numbers alone, as the paper has them.
    """

    def __init__(self, size: int, *, fine: bool):
        super().__init__()
        self.fine = fine
        # Wavelengths of 4, 2, 1 and 1/2 standard deviations
        self.register_buffer("frequencies", torch.pi / 2 * 2.0 ** torch.arange(4), persistent=False)
        self.register_buffer("scales", 4.0 ** torch.arange(4), persistent=False)
        self.size = size * (1 + 2 * 4 + 4) + 1 if fine else size

    def forward(self, value: Tensor, visible: Tensor) -> Tensor:
        """(B, K, d), 0 where hidden, and (B, K) -> (B, K, size)"""
        if not self.fine:
            return value
        K = value.shape[1]
        steps = torch.arange(K, device=value.device)
        latest = torch.where(visible, steps, -1).cummax(1).values  # (B, K) the last shown step up to here
        previous = functional.pad(latest, (1, -1), value=-1)  # ... before here
        both = (visible & (previous >= 0)).unsqueeze(-1)
        start = value.gather(1, previous.clamp_min(0).unsqueeze(-1).expand_as(value))
        displacement = torch.where(both, (value - start) / (steps - previous).unsqueeze(-1), 0.0)
        scaled = torch.tanh(displacement.unsqueeze(-1) * self.scales).flatten(2)
        angles = (value.unsqueeze(-1) * self.frequencies).flatten(2)
        return torch.cat([value, angles.sin(), angles.cos(), scaled, both.to(value.dtype)], dim=-1)


class FactorEmbedding(nn.Module):
    """One factor's tokens. Hidden is learned, not zero: zero is a legal action and a legal position."""

    def __init__(self, factor: Factor, width: int, *, fine_inputs: bool):
        super().__init__()
        self.discrete = {c.dims.start: c.categories for c in factor.components if c.discrete}
        continuous = [i for c in factor.components if not c.discrete for i in range(c.dims.start, c.dims.stop)]
        self.continuous = continuous
        self.categories = nn.ModuleList(nn.Embedding(count, width) for count in self.discrete.values())
        if continuous:
            self.encoding = NumberEncoding(len(continuous), fine=fine_inputs)
            self.numbers = nn.Linear(self.encoding.size, width)
        # Small, or in a stacked token what is hidden would drown what is shown, and learning takes twice as long.
        self.hidden = nn.Parameter(0.02 * torch.randn(width))

    def forward(self, value: Tensor, visible: Tensor) -> Tensor:
        """(B, K, D) and (B, K) -> (B, K, W)"""
        shown = visible.unsqueeze(-1)
        # Replaced before it is embedded, so that not even a NaN in a hidden place can reach the network.
        value = torch.where(shown, value, 0.0)
        parts = [table(value[..., i].long()) for i, table in zip(self.discrete, self.categories, strict=True)]
        if self.continuous:
            parts.append(self.numbers(self.encoding(value[..., self.continuous], visible)))
        return torch.where(shown, torch.stack(parts).sum(0), self.hidden)


class Block(nn.Module):
    """Self-attention in both directions, then a feed-forward network, each behind a layer norm."""

    def __init__(self, width: int, heads: int, feedforward_width: int, dropout: float):
        super().__init__()
        self.heads = heads
        self.dropout = dropout
        self.norm_attention = nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.project = nn.Linear(width, width)
        self.norm_feedforward = nn.LayerNorm(width)
        self.feedforward = nn.Sequential(
            nn.Linear(width, feedforward_width), nn.GELU(), nn.Linear(feedforward_width, width), nn.Dropout(dropout)
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, W) -> (B, N, W)"""
        B, N, W = x.shape
        qkv = self.query_key_value(self.norm_attention(x)).view(B, N, 3, self.heads, W // self.heads)
        query, key, value = qkv.permute(2, 0, 3, 1, 4)  # each (B, H, N, W/H)
        dropout = self.dropout if self.training else 0.0
        attended = functional.scaled_dot_product_attention(query, key, value, dropout_p=dropout)
        attended = self.project(attended.transpose(1, 2).reshape(B, N, W))
        x = x + functional.dropout(attended, self.dropout, self.training)
        return x + self.feedforward(self.norm_feedforward(x))


class Transformer(nn.Module):
    """(window, visible) -> predictions.

    Args:
        factors: what a step consists of. Every factor is read; `s` and `a` are predicted.
        stacked: one token per step, made of all its factors (paper, appendix "Input stacking"); otherwise one token
            for each property, at the front, and one for each state and action, in the order of time.
        fine_inputs: encode continuous values as `NumberEncoding` does.
    """

    def __init__(
        self,
        factors: dict[str, Factor],
        *,
        context_length: int,
        stacked: bool,
        fine_inputs: bool,
        width: int,
        depth: int,
        heads: int,
        feedforward_width: int,
        dropout: float,
    ):
        super().__init__()
        self.stacked = stacked
        self.properties = [name for name in factors if name not in ASKABLE]
        self.embeddings = nn.ModuleDict(
            {name: FactorEmbedding(factor, width, fine_inputs=fine_inputs) for name, factor in factors.items()}
        )
        if stacked:
            self.stack = nn.Linear(len(factors) * width, width)
        tokens = context_length if stacked else len(self.properties) + len(ASKABLE) * context_length
        self.positions = nn.Parameter(0.02 * torch.randn(tokens, width))  # within the window, not the episode
        self.dropout = nn.Dropout(dropout)
        self.blocks = nn.Sequential(*(Block(width, heads, feedforward_width, dropout) for _ in range(depth)))
        self.norm = nn.LayerNorm(width)
        self.sizes = {name: [component.size for component in factors[name].components] for name in ASKABLE}
        self.heads = nn.ModuleDict({name: nn.Linear(width, sum(sizes)) for name, sizes in self.sizes.items()})

    def forward(self, window: Window, visible: dict[str, Tensor]) -> Predictions:
        """For every step, logits of discrete components, and of continuous ones normalised means, or means and the
        logarithms of scales.

        Args:
            window: normalised values.
            visible: factor -> (B, K) bool, True = shown.
        """
        tokens = {name: embed(window.values[name], visible[name]) for name, embed in self.embeddings.items()}
        x = self._stack(tokens) if self.stacked else self._lay_out(tokens)  # (B, N, W)
        x = self.norm(self.blocks(self.dropout(x + self.positions)))
        per_factor = dict.fromkeys(ASKABLE, x) if self.stacked else self._split(x)
        return {
            name: list(self.heads[name](per_factor[name]).split(sizes, dim=-1)) for name, sizes in self.sizes.items()
        }

    def _stack(self, tokens: dict[str, Tensor]) -> Tensor:
        return self.stack(torch.cat(list(tokens.values()), dim=-1))  # (B, K, F W) -> (B, K, W)

    def _lay_out(self, tokens: dict[str, Tensor]) -> Tensor:
        """Properties (their first step alone is ever shown), then s0 a0 s1 a1 ...: (B, P + 2 K, W)."""
        steps = torch.stack([tokens[name] for name in ASKABLE], dim=2).flatten(1, 2)  # (B, 2 K, W)
        return torch.cat([*(tokens[name][:, :1] for name in self.properties), steps], dim=1)

    def _split(self, x: Tensor) -> dict[str, Tensor]:
        steps = x[:, len(self.properties) :].unflatten(1, (-1, len(ASKABLE)))  # (B, K, 2, W)
        return {name: steps[:, :, i] for i, name in enumerate(ASKABLE)}
