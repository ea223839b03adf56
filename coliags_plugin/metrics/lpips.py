"""LPIPS, a learned perceptual distance between two images."""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Comparison, Metric
from coliags_plugin.core.errors import InputError, UnavailableError
from coliags_plugin.core.files import user_path
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.tensors import zero_outside
from coliags_plugin.metrics.image import require_image
from coliags_plugin.metrics.lpips_network import LPIPSNetwork
from coliags_plugin.metrics.lpips_weights import find_weights, load_network

_log = logging.getLogger(__name__)

# AlexNet's last tap has one cell from 31 pixels on; smaller images give no meaningful value with any of the three.
_SMALLEST = 32


class LPIPSSettings(Settings):
    """Backbone and input range of LPIPS; values of different variants are not comparable."""

    net: Literal["vgg", "alex", "squeeze"] = Field(default="vgg", description="The backbone.")
    input_range: Literal["zero-one", "minus-one-one"] = Field(
        default="zero-one",
        description="Range of the network's input. LPIPS was trained on minus-one-one; the splatting papers, this one "
        "included, feed [0, 1] unmapped.",
    )
    weights: str | None = Field(default=None, description="A folder searched for weights before the default ones.")


class LPIPS(Metric[LPIPSSettings]):
    """LPIPS v0.1 (Zhang et al. 2018; docs/methods.md 2.4) without torchvision.

    Ignored pixels are black in both images, as outside an endoscope's aperture, and the distance is averaged over the
    valid ones, so the content of an ignored pixel has no influence.
    """

    Settings: ClassVar[type[Settings]] = LPIPSSettings
    higher_is_better: ClassVar[bool] = False
    unit: ClassVar[str] = ""

    def __init__(self, settings: LPIPSSettings) -> None:
        super().__init__(settings)
        if settings.weights is not None and not user_path(settings.weights).is_dir():
            raise InputError(f"lpips: weights = '{settings.weights}' is not a folder", "a folder with LPIPS weights")

    def __call__(self, comparison: Comparison) -> float:
        """LPIPS of one frame, 0 for equal images; unavailable without weights, and for small or unusable images."""
        require_image(comparison)
        height, width = comparison.valid.shape
        if min(height, width) < _SMALLEST:
            raise UnavailableError(f"LPIPS needs at least {_SMALLEST} pixels a side, the image is {width}x{height}")
        network = _network(
            self.settings.net, *find_weights(self.settings.net, self.settings.weights), comparison.rgb.device
        )
        with torch.no_grad():
            first, second = self._input(comparison.rgb, comparison), self._input(comparison.true_rgb, comparison)
            return float(network(first, second, comparison.valid))

    def _input(self, rgb: Float[Tensor, "H W 3"], comparison: Comparison) -> Float[Tensor, "1 3 H W"]:
        image = zero_outside(rgb.float(), comparison.valid).permute(2, 0, 1)[None]
        return image if self.settings.input_range == "zero-one" else 2.0 * image - 1.0


@lru_cache(maxsize=4)
def _network(net: str, backbone: Path, heads: Path, device: torch.device) -> LPIPSNetwork:
    _log.info("LPIPS %s: backbone %s, linear heads %s", net, backbone, heads)
    # Kept between calls, so its tensors must stay usable outside inference mode.
    with torch.inference_mode(False):
        return load_network(net, backbone, heads).to(device)
