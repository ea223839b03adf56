"""Search for and loading of LPIPS weights on this machine; only ``coliags weights lpips`` downloads them."""

from __future__ import annotations

import os
import pickle
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor

from coliags_plugin.core.errors import UnavailableError
from coliags_plugin.core.files import user_path
from coliags_plugin.core.text_files import unreadable
from coliags_plugin.metrics.lpips_network import TAPS, LPIPSNetwork

WEIGHTS_VARIABLE = "COLIAGS_LPIPS_WEIGHTS"

#: The nets of the protocols' metrics.
DEFAULT_NETS = ("vgg", "squeeze")

#: File names of torchvision's weights in torch's download folder; the second names are older copies of the same.
BACKBONE_FILES: dict[str, tuple[str, ...]] = {
    "vgg": ("vgg16-397923af.pth",),
    "alex": ("alexnet-owt-7be5be79.pth", "alexnet-owt-4df8aa71.pth"),
    "squeeze": ("squeezenet1_1-b8a52dc0.pth", "squeezenet1_1-f364aa15.pth"),
}


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
