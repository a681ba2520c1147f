"""The networks: (window, shown) -> predictions, one file each, chosen by `--policy.network=...`."""

from torch import nn

from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.factors import Factor
from lerobot_unimask.networks.decision_transformer import DecisionTransformer
from lerobot_unimask.networks.feedforward import FeedForward
from lerobot_unimask.networks.transformer import Transformer


def make_network(config: UniMASKConfig, factors: dict[str, Factor], *, load_backbone: bool = True) -> nn.Module:
    """The network that the config names, for these factors and the config's cameras.

    Raises:
        ValueError: the network needs a factor that is not there.
    """
    match config.network:
        case "feedforward":
            return FeedForward(config, factors)
        case "decision_transformer":
            return DecisionTransformer(config, factors)
    return Transformer(config, factors, load_backbone=load_backbone)
