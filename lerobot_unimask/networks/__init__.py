"""The networks: (window, shown) -> predictions, one file each, chosen by `--policy.network=...`."""

from typing import Any

from torch import nn

from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.factors import Factor
from lerobot_unimask.networks.decision_transformer import DecisionTransformer
from lerobot_unimask.networks.feedforward import FeedForward
from lerobot_unimask.networks.transformer import Transformer


def make_network(config: UniMASKConfig, factors: dict[str, Factor], *, load_backbone: bool = True) -> nn.Module:
    """The network that the config names, for these factors and the config's cameras.

    Args:
        load_backbone: whether pretrained weights of what looks at pictures are fetched; a checkpoint brings its own.

    Raises:
        ValueError: the network needs a factor that is not there.
    """
    shared: dict[str, Any] = {
        "context_length": config.context_length,
        "fine_inputs": config.fine_inputs is not False,
        "width": config.width,
        "depth": config.depth,
        "feedforward_width": config.feedforward_width,
        "dropout": config.dropout,
    }
    match config.network:
        case "transformer":
            return Transformer(
                factors,
                predicted=config.predicted(factors),
                stacked=config.token_layout == "stacked",
                residuals=config.state_residuals,
                heads=config.heads,
                cameras=config.pictures,
                backbone={
                    "backbone": config.vision_backbone,
                    "weights": config.pretrained_backbone_weights,
                    "load": load_backbone,
                },
                **shared,
            )
        case "feedforward":
            return FeedForward(factors, predicted=config.predicted(factors), **shared)
        case "decision_transformer":
            return DecisionTransformer(factors, heads=config.heads, **shared)
        case other:
            raise ValueError(f"There is no network {other!r}.")
