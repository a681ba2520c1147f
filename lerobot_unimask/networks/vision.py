"""Cameras: one token for each picture, from an encoder that all steps share.

Shapes: B windows, K steps, C channels, H and W pixels, D width of a token, N pictures that are shown.
"""

import functools
import logging
from collections.abc import Iterable, Sequence
from typing import Any

import torch
import torchvision
from lerobot.policies.diffusion.modeling_diffusion import SpatialSoftmax
from torch import Tensor, nn

from lerobot_unimask.data.frames import resized

logger = logging.getLogger(__name__)

KEYPOINTS = 32  # as in LeRobot's diffusion policy: 64 numbers for each picture


def _convolutions(channels: int) -> nn.Module:
    """Three layers that two processor cores can train, those of Mnih et al. (2015) with group norms: a picture of 96 x
    96 becomes 64 maps of 12 x 12."""
    layers: list[nn.Module] = []
    for before, after, kernel, stride in ((channels, 32, 8, 4), (32, 64, 4, 2), (64, 64, 3, 1)):
        convolution = nn.Conv2d(before, after, kernel, stride, padding=(kernel - stride + 1) // 2)
        layers += [convolution, nn.GroupNorm(after // 16, after), nn.ReLU()]
    return nn.Sequential(*layers)


def _group_norms(module: nn.Module) -> nn.Module:
    """Batch norms become group norms, in place: a picture's token depends on that picture only."""
    for name, child in module.named_children():
        if isinstance(child, nn.BatchNorm2d):
            setattr(module, name, nn.GroupNorm(child.num_features // 16, child.num_features))
        else:
            _group_norms(child)
    return module


class CameraEncoder(nn.Module):
    """A convolutional network, a spatial softmax (Finn et al., 2016, as LeRobot's diffusion policy has it), a layer.

    The spatial softmax finds points; their places, -1 to 1, are numbers as a state's are, and come with sines and
    cosines where those do (`NumberEncoding`).

    Args:
        shape: channels, height and width of the pictures; others are resized.
        width: size of a token, D.
        backbone: name of a ResNet of torchvision, or None: three convolutions.
        weights: name of that ResNet's weights in torchvision; None: drawn. With weights its batch norms stay, and are
            used as in evaluation, so that no picture depends on others of its batch.
        load: whether these weights are fetched; a checkpoint brings its own.
        fine: whether points come with sines and cosines.

    Raises:
        ValueError: pictures so small that the spatial softmax has one place to look at.
    """

    frequencies: Tensor

    def __init__(
        self,
        shape: Sequence[int],
        width: int,
        backbone: str | None = None,
        weights: str | None = None,
        load: bool = True,
        *,
        fine: bool,
    ):
        super().__init__()
        if backbone is None:
            self.backbone = _convolutions(shape[0])
        else:
            resnet = getattr(torchvision.models, backbone)(weights=weights if load else None)
            self.backbone = nn.Sequential(*list(resnet.children())[:-2])  # without its pooling and its classifier
            if weights is None:
                _group_norms(self.backbone)
        self.frozen_norms = weights is not None
        with torch.no_grad():
            maps = self.backbone.eval()(torch.zeros(1, *shape)).shape[1:]
        if maps[1] * maps[2] == 1:  # then a spatial softmax is the same for all pictures
            raise ValueError(
                f"Pictures of {shape[1]} x {shape[2]} are too small for {backbone or 'these convolutions'}: one place "
                "of each map is left, so that all pictures would look the same; image_size has to be larger"
            )
        self.pool = SpatialSoftmax(maps, num_kp=KEYPOINTS)
        self.fine = fine
        # Wavelengths of a picture's whole side, a half, a quarter and an eighth
        self.register_buffer("frequencies", torch.pi * 2.0 ** torch.arange(4), persistent=False)
        self.out = nn.Linear(2 * KEYPOINTS * (1 + 2 * 4 if fine else 1), width)
        self.width = width
        self.size = (shape[1], shape[2])
        self.train()

    def train(self, mode: bool = True) -> "CameraEncoder":
        super().train(mode)
        if self.frozen_norms:
            for module in self.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eval()
        return self

    def forward(self, pictures: Tensor, shown: Tensor) -> Tensor:
        """
        Args:
            pictures: (B, K, C, H, W), uint8 or numbers from 0 to 1, of any height and width.
            shown: (B, K) booleans; pictures that are not shown are not looked at.

        Returns:
            (B, K, D): a token for each shown picture, 0 elsewhere.
        """
        if torch.compiler.is_compiling():  # how much is computed must not depend on the masks: all pictures are
            seen = torch.where(shown[..., None, None, None], pictures, 0).flatten(0, 1)
            return torch.where(shown[..., None], self._look(seen).unflatten(0, shown.shape), 0.0)
        tokens = self.out.weight.new_zeros(*shown.shape, self.width)
        if not shown.any():
            return tokens
        seen = pictures[shown]  # (N, C, H, W)
        if seen.shape[-2:] != self.size:
            _say_once(tuple(seen.shape[-2:]), self.size)
        return tokens.masked_scatter(shown[..., None], self._look(seen).to(tokens.dtype))

    def _look(self, pictures: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, D)."""
        pictures, dtype = resized(pictures, self.size), self.out.weight.dtype
        pictures = pictures.to(dtype) / 255 if pictures.dtype == torch.uint8 else pictures.to(dtype)
        points = self.pool(self.backbone(2 * pictures - 1)).flatten(1)  # (N, 2 * KEYPOINTS)
        if self.fine:
            angles = (points.unsqueeze(-1) * self.frequencies).flatten(1)
            points = torch.cat([points, angles.sin(), angles.cos()], dim=-1)
        return self.out(points)


class CameraEmbedding(nn.Module):
    """One camera's tokens. Hidden is learned, as in `FactorEmbedding`. For arguments see `CameraEncoder`."""

    def __init__(self, shape: Sequence[int], width: int, **encoder: Any):
        super().__init__()
        self.encoder = CameraEncoder(shape, width, **encoder)
        self.hidden = nn.Parameter(0.02 * torch.randn(width))

    def forward(self, value: Tensor, shown: Tensor) -> Tensor:
        """Pictures (B, K, C, H, W), or what `encoder` has made of them before, (B, K, D), and (B, K) -> (B, K, D)."""
        tokens = value if value.ndim == 3 else self.encoder(value, shown)
        return torch.where(shown.unsqueeze(-1), tokens, self.hidden)


def parameter_groups(model: nn.Module, rate: float | None) -> Iterable[nn.Parameter] | list[dict[str, Any]]:
    """What an optimiser is given: the parameters, those of what looks at pictures apart where they learn at a `rate` of
    their own."""
    backbones = [module.backbone for module in model.modules() if isinstance(module, CameraEncoder)]
    seeing = [parameter for backbone in backbones for parameter in backbone.parameters()]
    if rate is None or not seeing:
        return model.parameters()
    apart = set(map(id, seeing))
    rest: list[nn.Parameter] = [parameter for parameter in model.parameters() if id(parameter) not in apart]
    groups: list[dict[str, Any]] = [{"params": rest}, {"params": seeing, "lr": rate}]
    return groups


@functools.cache
def _say_once(size: tuple[int, ...], wanted: tuple[int, ...]) -> None:
    logger.warning("Pictures of %s x %s are resized to %s x %s, at which this model reads them.", *size, *wanted)
