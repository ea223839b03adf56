"""The networks of LPIPS v0.1 in plain torch.

Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric". The backbones carry
torchvision's layer numbering (``vgg16``, ``alexnet`` and ``squeezenet1_1``, their ``.features``), so weights published
for those load as they are.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d

#: The layers after which features are compared (each the ReLU of a block), and how many channels they have there.
TAPS: dict[str, dict[int, int]] = {
    "vgg": {3: 64, 8: 128, 15: 256, 22: 512, 29: 512},
    "alex": {1: 64, 4: 192, 7: 384, 9: 256, 11: 256},
    "squeeze": {1: 64, 4: 128, 7: 256, 9: 384, 10: 384, 11: 512, 12: 512},
}

# LPIPS's own input normalisation, for images in [-1, 1].
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


class LPIPSNetwork(nn.Module):
    """Frozen backbone and linear heads of one LPIPS variant.

    The backbone has torchvision's ``features`` weights, keys like ``"0.weight"``; where these do not fit, torch's
    RuntimeError names them. Heads have one non-negative weight per channel of each tap, in order, each [1, C, 1, 1].
    """

    def __init__(self, net: str, backbone: Mapping[str, Tensor], heads: list[Tensor]) -> None:
        super().__init__()
        # Without storage, so that nothing is initialised at random (which would move torch's global generator).
        with torch.device("meta"):
            self.features = features(net)
        self.features.load_state_dict(backbone, assign=True)
        self.taps = tuple(TAPS[net])
        for index, head in enumerate(heads):
            self.register_buffer(f"head{index}", head)
        self.register_buffer("shift", torch.tensor(_SHIFT).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor(_SCALE).view(1, 3, 1, 1))
        self.requires_grad_(False).float()

    def forward(
        self, first: Float[Tensor, "1 3 H W"], second: Float[Tensor, "1 3 H W"], mask: Bool[Tensor, "H W"]
    ) -> Float[Tensor, ""]:
        """Distance between two images in the input range of the variant, 0 for equal ones.

        It is averaged over the mask: at each tap, a cell counts by the share of it that is True.
        """
        shares = mask.to(first.dtype)[None, None]
        x, y = self._standardised(first), self._standardised(second)
        total = first.new_zeros(())
        heads = (self.get_buffer(f"head{index}") for index in range(len(self.taps)))
        for index, layer in enumerate(self.features):
            x, y = layer(x), layer(y)
            if index in self.taps:
                distances = (next(heads) * (_unit(x) - _unit(y)).square()).sum(dim=1)
                counts = adaptive_avg_pool2d(shares, (distances.shape[-2], distances.shape[-1]))[:, 0]
                total = total + (distances * counts).sum() / counts.sum()
        return total

    def _standardised(self, images: Tensor) -> Tensor:
        return (images - self.get_buffer("shift")) / self.get_buffer("scale")


def _unit(x: Float[Tensor, "1 C h w"]) -> Float[Tensor, "1 C h w"]:
    """Channels normalised to unit length at every pixel."""
    return x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)


def features(net: str) -> nn.Sequential:
    """The backbone up to its last tap, in torchvision's numbering."""
    return {"vgg": _vgg16, "alex": _alexnet, "squeeze": _squeezenet}[net]()


def _vgg16() -> nn.Sequential:
    layers: list[nn.Module] = []
    channels = 3
    for block in ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512)):
        if layers:
            layers.append(nn.MaxPool2d(2))
        for width in block:
            layers += _convolution(channels, width, 3, padding=1)
            channels = width
    return nn.Sequential(*layers)


def _convolution(inputs: int, outputs: int, size: int, stride: int = 1, padding: int = 0) -> list[nn.Module]:
    return [nn.Conv2d(inputs, outputs, size, stride, padding), nn.ReLU(inplace=True)]


def _alexnet() -> nn.Sequential:
    return nn.Sequential(
        *_convolution(3, 64, 11, stride=4, padding=2),
        nn.MaxPool2d(3, stride=2),
        *_convolution(64, 192, 5, padding=2),
        nn.MaxPool2d(3, stride=2),
        *_convolution(192, 384, 3, padding=1),
        *_convolution(384, 256, 3, padding=1),
        *_convolution(256, 256, 3, padding=1),
    )


def _squeezenet() -> nn.Sequential:
    layers = _convolution(3, 64, 3, stride=2)
    inputs = 64
    for block in (((16, 64), (16, 64)), ((32, 128), (32, 128)), ((48, 192), (48, 192), (64, 256), (64, 256))):
        layers.append(nn.MaxPool2d(3, stride=2, ceil_mode=True))
        for squeezed, expanded in block:
            layers.append(Fire(inputs, squeezed, expanded))
            inputs = 2 * expanded
    return nn.Sequential(*layers)


class Fire(nn.Module):
    """SqueezeNet's fire module: a 1x1 squeeze, then 1x1 and 3x3 expansions in parallel, each ``expanded`` wide."""

    def __init__(self, inputs: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Float[Tensor, "1 C h w"]) -> Float[Tensor, "1 D h w"]:
        """Both expansions, the 1x1 one first."""
        squeezed = self.squeeze(x).relu_()
        return torch.cat([self.expand1x1(squeezed), self.expand3x3(squeezed)], dim=1).relu_()
