"""LPIPS, a learned perceptual distance between two images: the metric, its networks and their weights.

Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", in plain torch. The
backbones carry torchvision's layer numbering (``vgg16``, ``alexnet`` and ``squeezenet1_1``, their ``.features``), so
weights published for those load as they are. Only :func:`install`, of ``coliags weights``, downloads.
"""

from __future__ import annotations

import logging
import os
import pickle
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d

from coliags_plugin.contracts import Comparison, Metric
from coliags_plugin.core import __version__
from coliags_plugin.core.errors import InputError, UnavailableError
from coliags_plugin.core.files import atomic_path, file_sha256, user_path
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.tensors import zero_outside
from coliags_plugin.core.text_files import unreadable
from coliags_plugin.metrics.pixels import require_image

_log = logging.getLogger(__name__)

WEIGHTS_VARIABLE = "COLIAGS_LPIPS_WEIGHTS"

#: The nets of the protocols' metrics.
DEFAULT_NETS = ("vgg", "squeeze")

#: File names of torchvision's weights in torch's download folder.
BACKBONE_FILES = {
    "vgg": "vgg16-397923af.pth",
    "alex": "alexnet-owt-7be5be79.pth",
    "squeeze": "squeezenet1_1-b8a52dc0.pth",
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
    # range of the network's input; it was trained on minus-one-one, but the splatting papers, this one included, feed
    # [0, 1] unmapped
    input_range: Literal["zero-one", "minus-one-one"] = "zero-one"


class LPIPS(Metric[LPIPSSettings]):
    """LPIPS v0.1 (Zhang et al. 2018; docs/methods.md 2.4) without torchvision.

    Ignored pixels are black in both images, as outside an endoscope's aperture, and the distance is averaged over the
    valid ones, so the content of an ignored pixel has no influence.
    """

    higher_is_better: ClassVar[bool] = False
    unit: ClassVar[str] = ""

    def __call__(self, comparison: Comparison) -> float:
        """LPIPS of one frame, 0 for equal images; unavailable without weights, and for small or unusable images."""
        require_image(comparison)
        height, width = comparison.valid.shape
        if min(height, width) < _SMALLEST:
            raise UnavailableError(f"LPIPS needs at least {_SMALLEST} pixels a side, the image is {width}x{height}")
        network = _network(self.settings.net, *find_weights(self.settings.net), comparison.rgb.device)
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


def find_weights(net: str, folder: Path | None = None) -> tuple[Path, Path]:
    """Paths of the backbone and linear head weights.

    Searched in :func:`searched_folders`. Where one is missing, UnavailableError names it and the command that installs
    it.
    """
    backbone, heads = weights_in(net, searched_folders(folder))
    if backbone is None or heads is None:
        names = {f"backbone ({BACKBONE_FILES[net]})": backbone, f"linear heads (v0.1/{net}.pth)": heads}
        missing = [name for name, file in names.items() if file is None]
        command = "coliags weights" + ("" if net in DEFAULT_NETS else f" --net {net}")
        # Recorded with results, which are to be the same on every machine: no folders here.
        raise UnavailableError(
            f"LPIPS {net} weights not found: {' and '.join(missing)}. To download them, run `{command}`"
        )
    return backbone, heads


def searched_folders(folder: Path | None = None) -> list[Path]:
    """Folders in which weights are searched for: this one, that of ``COLIAGS_LPIPS_WEIGHTS``, and torch's downloads."""
    named = [user_path(path) for path in (folder, os.environ.get(WEIGHTS_VARIABLE)) if path]
    return [*named, default_folder()]


def weights_in(net: str, folders: Sequence[Path]) -> tuple[Path | None, Path | None]:
    """Backbone and linear heads in the first of some folders that has them; None for what is missing.

    A backbone is a file under torchvision's name, or any ``.pth`` with the net's name and "backbone" in its own; heads
    are ``{net}.pth``, directly or in ``v0.1/``.
    """
    backbones = (
        file
        for folder in folders
        for file in (folder / BACKBONE_FILES[net], *sorted(folder.glob(f"*{net}*backbone*.pth")))
    )
    heads = (folder / name for folder in folders for name in (f"{net}.pth", f"v0.1/{net}.pth"))
    return next(filter(Path.is_file, backbones), None), next(filter(Path.is_file, heads), None)


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


def _read(file: Path) -> dict[str, Tensor]:
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError, ValueError, LookupError, pickle.UnpicklingError) as error:
        raise UnavailableError(unreadable(file, f"{file} cannot be read as torch weights", "").seen) from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise UnavailableError(f"{file} does not hold a table of tensors")
    return state


# --- installation of weights ----------------------------------------------------------------------------------------

#: Without any byte for so long, a connection counts as lost, seconds.
_TIMEOUT = 30.0


@dataclass(frozen=True)
class Published:
    """One published file: its address, its path in the folder of weights, and its SHA-256 or the first digits of it."""

    url: str
    path: str
    sha256: str

    def check(self, file: Path, source: object, do: str) -> None:
        """Refuse a file with another checksum (InputError)."""
        digest = file_sha256(file)
        if not digest.startswith(self.sha256):
            raise InputError(f"{source} has the SHA-256 {digest}", f"{self.sha256}, of {self.url}", do)


def _published(net: str, heads_sha256: str) -> tuple[Published, Published]:
    """Torchvision's backbone, and linear heads from the repository of LPIPS's authors, at commit 082bb24.

    The digits in a backbone's name begin its checksum; torch checks no more than these either.
    """
    name = BACKBONE_FILES[net]
    digits = name.removesuffix(".pth").rpartition("-")[2]
    repository = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights"
    path = f"v0.1/{net}.pth"
    heads = Published(f"{repository}/{path}", path, heads_sha256)
    return Published(f"https://download.pytorch.org/models/{name}", name, digits), heads


#: Net -> backbone and linear heads.
SOURCES: dict[str, tuple[Published, Published]] = {
    "vgg": _published("vgg", "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868"),
    "alex": _published("alex", "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"),
    "squeeze": _published("squeeze", "4a5350f23600cb79923ce65bb07cbf57dca461329894153e05a1346bd531cf76"),
}


def install(nets: Sequence[str], folder: Path | None, origin: Path | None) -> list[Path]:
    """Install the weights of some nets where they are missing, see that their networks load, and name the new files.

    Without a folder to look in and install to, they are looked for wherever LPIPS does, and installed where
    ``torch.hub`` keeps downloads. Without an ``origin`` to copy from they are downloaded; nothing is copied unless all
    that are missing are in it.
    """
    if origin is not None and not origin.is_dir():
        raise InputError(f"`from_folder={origin}` is not a folder", "a folder with LPIPS weights")
    missing = _missing(nets, folder)
    target = folder or default_folder()
    written = _download(missing, target) if origin is None else _copy(missing, origin, target)
    for net in nets:
        try:
            load_network(net, *find_weights(net, folder))
        except UnavailableError as error:
            raise InputError(
                str(error), "the published weights", "Remove that file and run the command again"
            ) from error
    return written


def _missing(nets: Sequence[str], folder: Path | None) -> list[tuple[str, int]]:
    """Net and index in its pair of every file that is not there, linear heads first; warns of unknown ones there."""
    missing = []
    for net in nets:
        files = weights_in(net, searched_folders() if folder is None else [folder])
        for index, file in enumerate(files):
            if file is None:
                missing.append((net, index))
            elif not (digest := file_sha256(file)).startswith(SOURCES[net][index].sha256):
                _log.warning("%s is not the published file: its SHA-256 is %s", file, digest)
    return sorted(missing, key=lambda item: -item[1])


def _download(missing: Sequence[tuple[str, int]], target: Path) -> list[Path]:
    """Fetch files by HTTP, through the proxy of ``HTTPS_PROXY`` where that is set."""
    import pooch
    import requests

    files = [SOURCES[net][index] for net, index in missing]
    # Some content networks refuse a library's own name.
    fetch = pooch.HTTPDownloader(timeout=_TIMEOUT, headers={"User-Agent": f"coliags_plugin/{__version__}"})
    for number, file in enumerate(files):
        urls = ", ".join(later.url for later in files[number:])
        otherwise = f"On a machine with a connection download {urls}, and pass `from_folder=FOLDER` with them here"
        _log.info("download %s", file.url)
        with atomic_path(target / file.path) as path:
            try:
                fetch(file.url, path, None)
            except requests.RequestException as error:
                raise InputError(f"cannot download {file.url}: {error}", "", otherwise) from error
            file.check(path, file.url, f"Perhaps a proxy answered in the server's place. {otherwise}")
    return [target / file.path for file in files]


def _copy(missing: Sequence[tuple[str, int]], origin: Path, target: Path) -> list[Path]:
    files = [(SOURCES[net][index], weights_in(net, [origin])[index]) for net, index in missing]
    lacking = [published for published, file in files if file is None]
    if lacking:
        raise InputError(
            f"{origin} has no {', '.join(published.path for published in lacking)}",
            "",
            f"Download {', '.join(published.url for published in lacking)} into it, or choose another `net`",
        )
    copies = [(file, published) for published, file in files if file is not None]
    for file, published in copies:
        published.check(file, file, f"Download {published.url} again")
    for file, published in copies:
        with atomic_path(target / published.path) as path:
            shutil.copyfile(file, path)
    return [target / published.path for _, published in copies]
