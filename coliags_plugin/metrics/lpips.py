"""LPIPS, a learned perceptual distance between two images: the metric, its networks and the search for their weights.

Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", in plain torch. The
backbones carry torchvision's layer numbering (``vgg16``, ``alexnet`` and ``squeezenet1_1``, their ``.features``), so
weights published for those load as they are. Only ``coliags weights lpips`` downloads them (``lpips_install.py``).
"""

from __future__ import annotations

import logging
import os
import pickle
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d

from coliags_plugin.contracts import Comparison, Metric
from coliags_plugin.core.errors import InputError, UnavailableError
from coliags_plugin.core.files import user_path
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.tensors import zero_outside
from coliags_plugin.core.text_files import unreadable
from coliags_plugin.metrics.pixels import require_image

_log = logging.getLogger(__name__)

WEIGHTS_VARIABLE = "COLIAGS_LPIPS_WEIGHTS"

#: The nets of the protocols' metrics.
DEFAULT_NETS = ("vgg", "squeeze")

#: File names of torchvision's weights in torch's download folder; the second names are older copies of the same.
BACKBONE_FILES: dict[str, tuple[str, ...]] = {
    "vgg": ("vgg16-397923af.pth",),
    "alex": ("alexnet-owt-7be5be79.pth", "alexnet-owt-4df8aa71.pth"),
    "squeeze": ("squeezenet1_1-b8a52dc0.pth", "squeezenet1_1-f364aa15.pth"),
}

#: The layers after which features are compared (each the ReLU of a block), and how many channels they have there.
TAPS: dict[str, dict[int, int]] = {
    "vgg": {3: 64, 8: 128, 15: 256, 22: 512, 29: 512},
    "alex": {1: 64, 4: 192, 7: 384, 9: 256, 11: 256},
    "squeeze": {1: 64, 4: 128, 7: 256, 9: 384, 10: 384, 11: 512, 12: 512},
}

# LPIPS's own input normalisation, for images in [-1, 1].
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)

# AlexNet's last tap has one cell from 31 pixels on; smaller images give no meaningful value with any of the three.
_SMALLEST = 32


class LPIPSSettings(Settings):
    """Backbone and input range of LPIPS; values of different variants are not comparable."""

    net: Literal["vgg", "alex", "squeeze"] = "vgg"  # the backbone
    # of the network, which was trained on minus-one-one; the splatting papers, this one included, feed [0, 1] unmapped
    input_range: Literal["zero-one", "minus-one-one"] = "zero-one"
    weights: str | None = None  # a folder searched for weights before the default ones


class LPIPS(Metric[LPIPSSettings]):
    """LPIPS v0.1 (Zhang et al. 2018; docs/methods.md 2.4) without torchvision.

    Ignored pixels are black in both images, as outside an endoscope's aperture, and the distance is averaged over the
    valid ones, so the content of an ignored pixel has no influence.
    """

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


# --- networks -------------------------------------------------------------------------------------------------------


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
        """Concatenated expansions, the 1x1 one first."""
        squeezed = self.squeeze(x).relu_()
        return torch.cat([self.expand1x1(squeezed), self.expand3x3(squeezed)], dim=1).relu_()


# --- weights --------------------------------------------------------------------------------------------------------


def find_weights(net: str, folder: str | Path | None = None) -> tuple[Path, Path]:
    """Paths of the backbone and linear head weights.

    Searched in ``folder``, then in the folder that ``COLIAGS_LPIPS_WEIGHTS`` names, then where ``torch.hub`` keeps
    downloads, and the heads also in an installed ``lpips`` package. A backbone is a file under torchvision's name, or
    any ``.pth`` with the net's name and "backbone" in its own; heads are ``{net}.pth`` or ``lpips_{net}.pth``, directly
    or in ``v0.1/``. Where one is missing, UnavailableError names it and the command that installs it.
    """
    backbone, heads = search(net, folder)
    if backbone is None or heads is None:
        names = {f"backbone ({BACKBONE_FILES[net][0]})": backbone, f"linear heads (v0.1/{net}.pth)": heads}
        missing = [name for name, file in names.items() if file is None]
        command = "coliags weights lpips" + ("" if net in DEFAULT_NETS else f" --net {net}")
        # Recorded with results, which are to be the same on every machine: no folders here.
        raise UnavailableError(
            f"LPIPS {net} weights not found: {' and '.join(missing)}. To download them, run `{command}`"
        )
    return backbone, heads


def search(net: str, folder: str | Path | None = None) -> tuple[Path | None, Path | None]:
    """Backbone and linear heads where :func:`find_weights` looks; None for what is missing."""
    backbone, heads = weights_in(net, searched_folders(folder))
    return backbone, heads or weights_in(net, _package_folders())[1]


def weights_in(net: str, folders: Iterable[Path]) -> tuple[Path | None, Path | None]:
    """Backbone and linear heads in the first of some folders that has them; None for what is missing."""
    folders = list(folders)
    backbone = next((file for folder in folders for file in _backbones(net, folder)), None)
    return backbone, next((file for folder in folders for file in _heads(net, folder)), None)


def default_folder() -> Path:
    """Folder in which ``torch.hub`` keeps downloads."""
    return Path(torch.hub.get_dir()) / "checkpoints"


def load_network(net: str, backbone: Path, heads: Path) -> LPIPSNetwork:
    """Load the network with these weights; UnavailableError where a file cannot be read or holds something else."""
    state = _read(backbone)
    prefix = "features."
    if any(key.startswith(prefix) for key in state):
        state = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
    linear = _read(heads)
    try:
        weights = [linear[f"lin{index}.model.1.weight"] for index in range(len(TAPS[net]))]
    except KeyError as error:
        raise UnavailableError(f"{heads} has no {error}: it does not hold the linear heads of LPIPS {net}") from error
    for weight, channels in zip(weights, TAPS[net].values(), strict=True):
        if weight.shape != (1, channels, 1, 1) or bool((weight < 0).any()):
            raise UnavailableError(f"{heads} does not hold the linear heads of LPIPS {net}")
    try:
        return LPIPSNetwork(net, state, weights)
    except RuntimeError as error:
        raise UnavailableError(f"{backbone} does not hold the backbone of LPIPS {net}") from error


def searched_folders(folder: str | Path | None = None) -> Iterator[Path]:
    """Folders in which weights are searched for, in order; heads also in an installed ``lpips`` package."""
    for named in (folder, os.environ.get(WEIGHTS_VARIABLE)):
        if named:
            yield user_path(named)
    yield default_folder()


def _package_folders() -> Iterator[Path]:
    spec = find_spec("lpips")
    for location in (spec.submodule_search_locations or ()) if spec else ():
        yield Path(location) / "weights"


def _backbones(net: str, folder: Path) -> Iterator[Path]:
    exact = (folder / name for name in BACKBONE_FILES[net])
    alike = (file for file in sorted(folder.glob("*backbone*.pth")) if net in file.name)
    yield from (file for file in (*exact, *alike) if file.is_file())


def _heads(net: str, folder: Path) -> Iterator[Path]:
    names = (f"{net}.pth", f"v0.1/{net}.pth", f"lpips_{net}.pth", f"v0.1/lpips_{net}.pth")
    yield from (file for file in (folder / name for name in names) if file.is_file())


def _read(file: Path) -> dict[str, Tensor]:
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError, ValueError, LookupError, pickle.UnpicklingError) as error:
        raise UnavailableError(unreadable(file, f"{file} cannot be read as torch weights", "").seen) from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise UnavailableError(f"{file} does not hold a table of tensors")
    return state
