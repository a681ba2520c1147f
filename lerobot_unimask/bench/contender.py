"""One model of a comparison of processor time, in a process of its own: `python contender.py NAME`.

It reads what to do from its input, a line each (`random`, `imitation` or a number of environments), does it once, and
answers with the seconds of processor time that it took. Of this package it uses what its older versions have too, for
`beside.py` runs it with one of those as well.

Legend of shapes: B windows, K steps, N tokens, W width, H heads.
"""

import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

STATE, ACTIONS, CONTEXT, BATCH = 39, 4, 10, 64  # numbers of a state and an action, steps and windows
WIDTH, HEADS, INNER = 128, 8, 512  # of every model
Work = Callable[[str], None]


def unimask() -> Work:
    """This package's policy with its defaults, but for the window's length."""
    from lerobot_unimask import UniMASKConfig, UniMASKPolicy

    def make(masks: str) -> UniMASKPolicy:
        sizes: dict[str, Any] = {"context_length": CONTEXT, "width": WIDTH, "heads": HEADS, "feedforward_width": INNER}
        config = UniMASKConfig(device="cpu", training_masks=masks, **sizes)
        config.set_dataset_feature_metadata(
            {
                "observation.state": {"dtype": "float32", "shape": (STATE,), "names": None},
                "action": {"dtype": "float32", "shape": (ACTIONS,), "names": None},
            }
        )
        return UniMASKPolicy(config)

    policies = {"random": make("random_mask"), "imitation": make("behavior_cloning")}
    optimisers = {
        name: policy.config.get_optimizer_preset().build(policy.get_optim_params()) for name, policy in policies.items()
    }
    windows = {
        "observation.state": torch.randn(BATCH, CONTEXT, STATE),
        "action": torch.randn(BATCH, CONTEXT, ACTIONS),
        "observation.state_is_pad": torch.zeros(BATCH, CONTEXT, dtype=torch.bool),
        "action_is_pad": torch.zeros(BATCH, CONTEXT, dtype=torch.bool),
        "index": torch.arange(BATCH),
    }
    acting = {}  # by number of environments, each in an episode of its own

    def work(what: str) -> None:
        if what in policies:
            policy = policies[what].train()
            _update(policy, optimisers[what], policy(windows)[0])
            policy.update()
            return
        if what not in acting:  # a history that is full
            acting[what] = make("random_mask").eval()
            for _ in range(CONTEXT + 2):
                _act(acting[what], int(what))
        _act(acting[what], int(what))

    return work


@torch.inference_mode()
def _act(policy: Any, environments: int) -> None:
    policy.select_action({"observation.state": torch.randn(environments, STATE)})


class MaskedAutoencoder(nn.Module):
    """A masked model in the manner of Masked Trajectory Models (Wu et al., 2023): two layers encode what is shown and
    nothing else, one decodes all tokens. No dropout; what is hidden is the same in all windows of a batch."""

    def __init__(self) -> None:
        super().__init__()
        self.embeddings = nn.ModuleList(nn.Linear(size, WIDTH) for size in (STATE, ACTIONS))
        self.positions = nn.Parameter(torch.zeros(2 * CONTEXT, WIDTH))
        self.encoder = nn.Sequential(*(_Layer() for _ in range(2)), nn.LayerNorm(WIDTH))
        self.hidden = nn.Parameter(torch.zeros(WIDTH))
        self.decoder = nn.Sequential(_Layer(), nn.LayerNorm(WIDTH))
        self.heads = nn.ModuleList(nn.Linear(WIDTH, size) for size in (STATE, ACTIONS))

    def forward(self, state: Tensor, action: Tensor, shown: Tensor) -> list[Tensor]:
        """(B, K, d) of each, (N,) bool -> predictions of the same shapes."""
        tokens = [embed(value) for embed, value in zip(self.embeddings, (state, action), strict=True)]
        x = (torch.stack(tokens, dim=2).flatten(1, 2) + self.positions)[:, shown]
        everywhere = self.hidden.expand(len(x), 2 * CONTEXT, -1).clone()
        everywhere[:, shown] = self.encoder(x)
        x = self.decoder(everywhere + self.positions).unflatten(1, (CONTEXT, 2))
        return [head(x[:, :, i]) for i, head in enumerate(self.heads)]


class _Layer(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(WIDTH) for _ in range(2))
        self.query_key_value, self.project = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH)
        self.inner = nn.Sequential(nn.Linear(WIDTH, INNER), nn.GELU(), nn.Linear(INNER, WIDTH))

    def forward(self, x: Tensor) -> Tensor:
        parts = self.query_key_value(self.norms[0](x)).unflatten(-1, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        attended = functional.scaled_dot_product_attention(*parts.unbind(0))  # (B, H, N, W/H)
        x = x + self.project(attended.transpose(1, 2).flatten(2))
        return x + self.inner(self.norms[1](x))


def masked_autoencoder() -> Work:
    model = MaskedAutoencoder()
    optimiser = torch.optim.AdamW(model.parameters(), fused=True)
    state, action = torch.randn(BATCH, CONTEXT, STATE), torch.randn(BATCH, CONTEXT, ACTIONS)
    past = torch.arange(2 * CONTEXT) < 2 * CONTEXT - 1  # imitation: the last action follows from all before it

    def work(what: str) -> None:
        if what in ("random", "imitation"):
            shown = torch.rand(2 * CONTEXT) >= torch.rand(()) if what == "random" else past
            said = model.train()(state, action, shown)
            errors = [(one - other).square().mean() for one, other in zip(said, (state, action), strict=True)]
            _update(model, optimiser, errors[0] + errors[1])
            return
        with torch.inference_mode():
            size = int(what)
            model.eval()(torch.randn(size, CONTEXT, STATE), torch.randn(size, CONTEXT, ACTIONS), past)

    return work


def transformers_own(
    state: int, actions: int, layers: int, heads: int, device: str = "cpu"
) -> tuple[nn.Module, Callable[[int], Callable[[], Tensor]]]:
    """transformers' Decision Transformer with its own dropout, and what draws so many windows, once, and then answers
    for them: the error of the actions that it predicts."""
    from transformers import DecisionTransformerConfig, DecisionTransformerModel

    sizes = {"hidden_size": WIDTH, "n_layer": layers, "n_head": heads, "n_inner": INNER, "max_ep_len": 1000}
    model = DecisionTransformerModel(DecisionTransformerConfig(state_dim=state, act_dim=actions, **sizes)).to(device)

    def windows(count: int) -> Callable[[], Tensor]:
        shape = (count, CONTEXT)
        states, taken, returns = (torch.randn(*shape, size, device=device) for size in (state, actions, 1))
        steps = torch.arange(CONTEXT, device=device).expand(shape)
        here = torch.ones(shape, dtype=torch.long, device=device)

        def error() -> Tensor:
            said = model(states, taken, returns, returns, steps, attention_mask=here).action_preds
            return (said - taken).square().mean()

        return error

    return model, windows


def decision_transformer() -> Work:
    """transformers' own, with as many layers; it imitates alone."""
    model, windows = transformers_own(STATE, ACTIONS, layers=3, heads=HEADS)
    optimiser = torch.optim.AdamW(model.parameters(), fused=True)

    def work(what: str) -> None:
        if what == "imitation":
            model.train()
            _update(model, optimiser, windows(BATCH)())
        else:
            with torch.inference_mode():
                model.eval()
                windows(int(what))()

    return work


def _update(model: nn.Module, optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
    loss.backward()
    nn.utils.clip_grad_norm_(model.parameters(), 1.0)
    optimiser.step()
    optimiser.zero_grad()


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    makers = {made.__name__: made for made in (unimask, masked_autoencoder, decision_transformer)}
    work = makers[sys.argv[1]]()
    print("ready", flush=True)
    for line in sys.stdin:
        began = time.process_time()
        work(line.strip())
        print(time.process_time() - began, flush=True)


if __name__ == "__main__":
    main()
