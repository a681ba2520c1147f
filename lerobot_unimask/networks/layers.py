"""What the networks are made of: embeddings of a factor's tokens, attention, and the heads that predict tokens.

Legend of shapes: B windows, K steps, N tokens, D the numbers of a factor, W width, H heads.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import functional

from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.factors import Factor, Output
from lerobot_unimask.language.masks import ASKABLE, Mask

Predictions = dict[str, list[Tensor]]  # factor -> one (B, K, size) for each of its outputs


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

    frequencies: Tensor
    scales: Tensor

    def __init__(self, size: int, *, fine: bool):
        super().__init__()
        self.fine = fine
        # Wavelengths of 4, 2, 1 and 1/2 standard deviations
        self.register_buffer("frequencies", torch.pi / 2 * 2.0 ** torch.arange(4), persistent=False)
        self.register_buffer("scales", 4.0 ** torch.arange(4), persistent=False)
        self.size = size * (1 + 2 * 4 + 4) + 1 if fine else size

    def forward(self, value: Tensor, shown: Tensor) -> Tensor:
        """(B, K, d), 0 where hidden, and (B, K) -> (B, K, size)"""
        if not self.fine:
            return value
        previous = _previous_shown(shown)
        both = (shown & (previous >= 0)).unsqueeze(-1)
        gap = torch.arange(value.shape[1], device=value.device) - previous
        displacement = torch.where(both, (value - _at(value, previous)) / gap.unsqueeze(-1), 0.0)
        scaled = torch.tanh(displacement.unsqueeze(-1) * self.scales).flatten(2)
        angles = (value.unsqueeze(-1) * self.frequencies).flatten(2)
        return torch.cat([value, angles.sin(), angles.cos(), scaled, both.to(value.dtype)], dim=-1)


def course(value: Tensor, shown: Tensor, causal: Tensor | bool) -> Tensor:
    """Where values would be on the straight course through those shown nearest: between one before and one after, on
    from the last two before, or back from the first two after; 0 where nothing is shown.

    Predicted as departures from it, states some steps ahead are exact from the start to within what bends the course,
    which in a squared error over whole windows would weigh too little to be learnt.

    Args:
        value: (B, K, d), 0 where hidden.
        shown: (B, K)
        causal: whether only what is before counts, for all windows or for each, (B,).

    Returns:
        (B, K, d)
    """
    steps = torch.arange(value.shape[1], device=value.device)
    before = _previous_shown(shown)
    onwards = _extrapolate(value, before)
    if causal is True:
        return onwards
    after = value.shape[1] - 1 - _previous_shown(shown.flip(1)).flip(1)  # K: nothing after
    backwards = _extrapolate(value.flip(1), _previous_shown(shown.flip(1))).flip(1)
    share = ((steps - before) / (after - before)).unsqueeze(-1)
    between = torch.lerp(_at(value, before), _at(value, after), share)
    any_before, any_after = (before >= 0).unsqueeze(-1), (after < len(steps)).unsqueeze(-1)
    both_ways = torch.where(any_before & any_after, between, torch.where(any_before, onwards, backwards))
    return both_ways if causal is False else torch.where(causal[:, None, None], onwards, both_ways)


def _previous_shown(shown: Tensor) -> Tensor:
    """(B, K) -> (B, K): the last shown step before each, -1 where there is none."""
    steps = torch.arange(shown.shape[1], device=shown.device)
    return functional.pad(torch.where(shown, steps, -1).cummax(1).values, (1, -1), value=-1)


def _at(value: Tensor, step: Tensor) -> Tensor:
    """Values (B, K, d) at the steps (B, K); any where there is no such step."""
    return value.gather(1, step.clamp(0, value.shape[1] - 1).unsqueeze(-1).expand_as(value))


def _extrapolate(value: Tensor, last: Tensor) -> Tensor:
    """On from the last shown step before each, (B, K), with the slope since the one before that, if there is one."""
    steps = torch.arange(value.shape[1], device=value.device)
    before_last = torch.where(last >= 0, last.gather(1, last.clamp_min(0)), -1)
    start, earlier = _at(value, last), _at(value, before_last)
    slope = (start - earlier) / (last - before_last).clamp_min(1).unsqueeze(-1)
    slope = torch.where((before_last >= 0).unsqueeze(-1), slope, 0.0)
    return torch.where((last >= 0).unsqueeze(-1), start + slope * (steps - last).unsqueeze(-1), 0.0)


class FactorEmbedding(nn.Module):
    """One factor's tokens. Hidden is learned, not zero: zero is a legal action and a legal position."""

    def __init__(self, factor: Factor, width: int, *, fine: bool):
        super().__init__()
        self.discrete = {c.dims.start: c.categories for c in factor.components if c.categories is not None}
        self.continuous = [c.dims for c in factor.components if not c.discrete]
        self.categories = nn.ModuleList(nn.Embedding(count, width) for count in self.discrete.values())
        if self.continuous:
            self.encoding = NumberEncoding(sum(d.stop - d.start for d in self.continuous), fine=fine)
            self.numbers = nn.Linear(self.encoding.size, width)
        # Small, or in a stacked token what is hidden would drown what is shown, and learning takes twice as long.
        self.hidden = nn.Parameter(0.02 * torch.randn(width))

    def forward(self, value: Tensor, shown: Tensor) -> Tensor:
        """(B, K, D) and (B, K) -> (B, K, W)"""
        here = shown.unsqueeze(-1)
        # Replaced before it is embedded, so that not even a NaN in a hidden place can reach the network.
        value = torch.where(here, value, 0.0)
        parts = [table(value[..., i].long()) for i, table in zip(self.discrete, self.categories, strict=True)]
        if self.continuous:
            numbers = torch.cat([value[..., dims] for dims in self.continuous], dim=-1)
            parts.append(self.numbers(self.encoding(numbers, shown)))
        return torch.where(here, torch.stack(parts).sum(0), self.hidden)


def make_embeddings(config: UniMASKConfig, factors: Mapping[str, Factor]) -> nn.ModuleDict:
    """An embedding of each factor."""
    fine = config.fine_inputs is not False
    return nn.ModuleDict({name: FactorEmbedding(factor, config.width, fine=fine) for name, factor in factors.items()})


class Dropout(nn.Dropout):
    """PyTorch's, and faster on a processor: there each number of `bernoulli_` takes 15 ns, and here one draw of 64 bits
    serves four. The share is met to within 2**-17."""

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or self.p == 0 or x.device.type != "cpu" or torch.compiler.is_compiling():
            return super().forward(x)
        bits = torch.empty(-(-x.numel() // 4), dtype=torch.int64).random_(-(2**63), None).view(torch.int16)
        left_out = round(self.p * 2**16)
        keep = bits[: x.numel()].view(x.shape) >= left_out - 2**15
        return x * keep.to(x.dtype).mul_(2**16 / (2**16 - left_out))


class Heads(nn.ModuleDict):
    """A linear layer for each predicted factor. Answers are in full precision also under mixed precision.

    Args:
        predicted: names of the factors that are predicted.
        width: size of what they read.
        steps: number of steps that are predicted from one input; of a property one.
    """

    def __init__(self, factors: dict[str, Factor], predicted: Sequence[str], width: int, *, steps: int = 1):
        sizes = {name: [output.size for output in factors[name].outputs] for name in predicted}
        steps_of = {name: steps if name in ASKABLE else 1 for name in predicted}
        super().__init__({name: nn.Linear(width, steps_of[name] * sum(parts)) for name, parts in sizes.items()})
        self._sizes, self._steps = sizes, steps_of  # underscored: a property may have any name

    def forward(self, x: dict[str, Tensor], asked: dict[str, Tensor] | None = None) -> Predictions:
        """
        Args:
            x: factor -> (B, K / steps, W), of a property (B, 1, W), of those that are to be predicted; with `asked`,
                (M, W) of its M asked tokens.
            asked: factor -> (B, K) bool, True = asked; what is predicted of the others is 0.

        Returns:
            (B, K, size) of each output; of a property's steps all but the first are 0.
        """
        with torch.autocast(x["s"].device.type, enabled=False):
            outputs = {name: self[name](tokens.float()) for name, tokens in x.items()}
        K = self._steps["s"] * outputs["s"].shape[1] if asked is None else asked["s"].shape[1]
        for name, output in outputs.items():
            if asked is None:
                output = output.unflatten(-1, (self._steps[name], -1)).flatten(1, 2)
                outputs[name] = functional.pad(output, (0, 0, 0, K - output.shape[1]))
            else:
                everywhere = output.new_zeros(*asked[name].shape, output.shape[-1])
                outputs[name] = everywhere.masked_scatter(asked[name].unsqueeze(-1), output)
        return {name: list(output.split(self._sizes[name], dim=-1)) for name, output in outputs.items()}


def by_component(predictions: Predictions, factors: Mapping[str, Factor]) -> Predictions:
    """The marginals of predictions: factor -> one (B, K, size) for each of its components."""
    apart: Predictions = {}
    for name, wholes in predictions.items():
        parts = {
            component.dims.start: part
            for whole, output in zip(wholes, factors[name].outputs, strict=True)
            for part, component in zip(marginals(whole, output), output.components, strict=True)
        }
        apart[name] = [parts[c.dims.start] for c in factors[name].components if not c.computed]
    return apart


def marginals(prediction: Tensor, output: Output) -> list[Tensor]:
    """A prediction, (..., size), of each of its components without the others."""
    if len(output.components) == 1:
        return [prediction]
    if not output.discrete:
        logits, means, scales = output.unpack(prediction)
        sizes = [len(part.numbers) for part in output.apart]
        pairs = zip(output.apart, means.split(sizes, dim=-1), scales.split(sizes, dim=-1), strict=True)
        return [part.pack(logits, *of_numbers) for part, *of_numbers in pairs]
    table = output.table(prediction).unflatten(-1, output.categories)
    axes = range(-len(output.categories), 0)
    return [table.logsumexp([other for other in axes if other != axis]) for axis in axes]


@dataclass
class Cache:
    """What a rollout has computed of its window: each factor's values, (B, K, D), shown, (B, K), and tokens, (B, K, W);
    and of causal attention, for the first n tokens, their inputs, (B, n, W), and each block's keys and values, (B, H,
    n, W/H)."""

    question: Mask | None = None  # the last one that was answered causally
    slides: bool = False  # whether each step begins anew
    grows: bool = False  # whether more than one token is asked at a step
    embedded: dict[str, tuple[Tensor, Tensor, Tensor]] = field(default_factory=dict)
    inputs: Tensor | None = None
    keys: list[Tensor] = field(default_factory=list)
    values: list[Tensor] = field(default_factory=list)

    def slide(self) -> None:
        """Forget what depends on where in the window a token stands: all that comes after its embedding."""
        self.slides = True
        self.inputs, self.keys, self.values = None, [], []

    def embed(self, name: str, embedding: nn.Module, value: Tensor, shown: Tensor) -> Tensor:
        """A factor's tokens, (B, K, W). Once the window stands a step later than before, three of them are new: the
        first, whose displacement is lost, and the last two. The others depend on themselves and the step before. A few
        windows are embedded sooner than compared."""
        if not self.slides or len(value) < 8:
            return embedding(value, shown)
        tokens = self._kept(name, value, shown)
        if tokens is None:
            tokens = embedding(value, shown)
        else:
            new = embedding(*(torch.cat([x[:, :1], x[:, -3:]], dim=1) for x in (value, shown)))
            tokens = torch.cat([new[:, :1], tokens, new[:, 2:]], dim=1)
        self.embedded[name] = value, shown, tokens
        return tokens

    def _kept(self, name: str, value: Tensor, shown: Tensor) -> Tensor | None:
        """Tokens 1 to K - 3, if the window shows there what it showed a step earlier."""
        if name not in self.embedded or shown.shape[1] < 5:
            return None
        before, shown_before, tokens = self.embedded[name]
        everything_shown = shown[:, :-2].all() and shown_before[:, 1:-1].all()
        return tokens[:, 2:-1] if everything_shown and torch.equal(value[:, :-2], before[:, 1:-1]) else None

    def matches(self, x: Tensor) -> bool:
        """Whether (B, N, W) begins with the tokens that are kept; nothing else could be answered from them."""
        return self.inputs is not None and torch.equal(x[:, : self.inputs.shape[1]], self.inputs)


class Block(nn.Module):
    """Self-attention, then a feed-forward network, each behind a layer norm."""

    def __init__(self, config: UniMASKConfig):
        super().__init__()
        width, inner = config.width, config.feedforward_width
        self.heads = config.heads
        self.dropout = Dropout(config.dropout)
        self.norm_attention = nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.project = nn.Linear(width, width)
        self.norm_feedforward = nn.LayerNorm(width)
        self.feedforward = nn.Sequential(
            nn.Linear(width, inner), nn.GELU(), nn.Linear(inner, width), Dropout(config.dropout)
        )

    def forward(
        self,
        x: Tensor,
        attend: Tensor | None,
        past: tuple[Tensor, Tensor] | None,
        *,
        read: Tensor | None = None,
        last: bool = False,
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """
        Args:
            x: (B, n, W), the last n of N tokens.
            attend: which of the N tokens each of the n sees, True = seen; None: all.
            past: keys and values of the tokens before them, (B, H, N - n, W/H).
            read: (M,) numbers among the B n tokens of those whose outputs somebody reads; the others' are not computed.
                None: all.
            last: whether only the last token's output is computed; it sees all.

        Returns:
            (B, n, W), (M, W) or (B, 1, W), and the keys and values of all N tokens.
        """
        B, n, W = x.shape
        qkv = self.query_key_value(self.norm_attention(x)).view(B, n, 3, self.heads, W // self.heads)
        if x.device.type == "cpu":
            qkv = qkv.float()  # mixed precision: here the backward pass in bfloat16 takes ten times as long
        query, key, value = qkv.permute(2, 0, 3, 1, 4)  # each (B, H, n, W/H)
        if past is not None:
            key, value = torch.cat([past[0], key], dim=2), torch.cat([past[1], value], dim=2)
        if last:
            x, query, attend = x[:, -1:], query[:, :, -1:], None
        with torch.autocast("cpu", enabled=False):
            attended = self._attend(query, key, value, attend).transpose(1, 2).flatten(2)
        if read is not None:
            x, attended = x.flatten(0, 1)[read], attended.flatten(0, 1)[read]
        x = x + self.dropout(self.project(attended))
        return x + self.feedforward(self.norm_feedforward(x)), (key, value)

    def last(self, x: Tensor) -> Tensor:
        """The output of the last of (B, n, W) tokens, which sees all: (B, 1, W), as `forward` computes it, without keys
        and values of the others: its query goes back through the keys' weights, and what it reads through the values'.
        """
        if type(self.query_key_value) is not nn.Linear:  # an adapter, whose weights are not all
            return self(x, None, None, last=True)[0]
        H = self.heads
        with torch.autocast(x.device.type, enabled=False):
            seen = self.norm_attention(x.float())  # (B, n, W)
            query, key, value = self.query_key_value.weight.chunk(3)  # each (W, W); a key's bias moves all scores alike
            bias = self.query_key_value.bias
            asked = functional.linear(seen[:, -1], query, bias[: len(query)]).unflatten(1, (H, -1)).transpose(0, 1)
            toward = (asked / math.sqrt(asked.shape[-1])) @ key.unflatten(0, (H, -1))  # (H, B, W)
            weights = (toward.transpose(0, 1) @ seen.transpose(1, 2)).softmax(-1)  # (B, H, n)
            read = (weights @ seen).transpose(0, 1) @ value.unflatten(0, (H, -1)).transpose(1, 2)  # (H, B, W/H)
            attended = read.transpose(0, 1).flatten(1) + bias[-len(value) :]
        x = x[:, -1:] + self.project(attended).unsqueeze(1)
        return x + self.feedforward(self.norm_feedforward(x))

    def _attend(self, query: Tensor, key: Tensor, value: Tensor, attend: Tensor | None) -> Tensor:
        """(B, H, n, W/H). On a processor PyTorch's own is not fused once it has a dropout, which it draws slowly, and a
        softmax over a short last dimension takes three times as long as over the one before it."""
        dropout = self.dropout.p if self.training else 0.0
        B, _, n, size = query.shape
        short = n <= 64 and B * n >= 256  # not worth more operations, or the memory
        if query.device.type != "cpu" or torch.compiler.is_compiling() or (dropout == 0 and not short):
            return functional.scaled_dot_product_attention(query, key, value, attn_mask=attend, dropout_p=dropout)
        scores = key @ (query / math.sqrt(size)).transpose(2, 3)  # (B, H, N, n)
        if attend is not None:
            scores += torch.where(attend.transpose(-2, -1), 0.0, -math.inf)
        return self.dropout(scores.softmax(-2)).transpose(2, 3) @ value


def _before_or_here(tokens: int, device: torch.device) -> Tensor:
    """(N, N) bool: row i sees column j, j <= i."""
    return torch.ones(tokens, tokens, dtype=torch.bool, device=device).tril()
