"""Decision-GPT, the paper's causal baseline (paper, appendix "Our Decision-GPT model").

Legend of shapes: B windows, K steps.
"""

from torch import Tensor

from lerobot_unimask.data.factors import Factor
from lerobot_unimask.data.window import Window
from lerobot_unimask.networks.layers import Cache, Predictions
from lerobot_unimask.networks.transformer import Transformer


class DecisionGPT(Transformer):
    """(window, shown) -> predictions: the transformer with causal attention alone, one token per factor and step.

    The return token, with its timestep, comes first; positions count within the window; a window carries all t of a
    question at once, so every step's action is supervised, each from its state's token.

    Note: The paper says "a standard GPT architecture" with the return and position design of its own model. Here that
        is this package's transformer block (GELU, layer norms in front, learned positions), so that the two differ in
        the attention, which is what the comparison is about, and, as the paper's do, in stacking. For behaviour cloning
        the return token stays, hidden.
    """

    def __init__(self, factors: dict[str, Factor], **settings):
        super().__init__(factors, stacked=False, **settings)

    def forward(
        self, window: Window, shown: dict[str, Tensor], causal: Tensor | bool = True, cache: Cache | None = None
    ) -> Predictions:
        """As `Transformer.forward`, causally whatever `causal` says."""
        return super().forward(window, shown, True, cache)
