"""The published files of LPIPS weights, and their installation; only ``coliags weights`` downloads."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from coliags_plugin.core import __version__
from coliags_plugin.core.errors import InputError, UnavailableError
from coliags_plugin.core.files import atomic_path, file_sha256
from coliags_plugin.metrics.lpips import (
    BACKBONE_FILES,
    default_folder,
    find_weights,
    load_network,
    search,
    weights_in,
)

_log = logging.getLogger(__name__)

#: Without any byte for so long, a connection counts as lost, seconds.
_TIMEOUT = 30.0


@dataclass(frozen=True)
class Published:
    """One published file, and the SHA-256 of it and of other files with the same values."""

    url: str
    known: Mapping[str, str]  # checksum, or the first digits of it, to path in the folder of weights; the URL's first

    @property
    def path(self) -> str:
        """Path of what the URL gives, in the folder of weights."""
        return next(iter(self.known.values()))

    def path_of(self, sha256: str) -> str | None:
        """Path in the folder of weights of a file with this checksum; None where it is not known."""
        return next((path for digits, path in self.known.items() if sha256.startswith(digits)), None)

    def check(self, file: Path, source: object, do: str) -> str:
        """Path in the folder of weights of a file; InputError where its checksum is not known."""
        digest = file_sha256(file)
        path = self.path_of(digest)
        if path is None:
            known = (f"{digits}{'...' if len(digits) < len(digest) else ''}" for digits in self.known)
            raise InputError(f"{source} has the SHA-256 {digest}", " or ".join(known), do)
        return path


def _backbone(net: str, **copies: str) -> Published:
    """Torchvision's backbone. The digits in its name begin its checksum; torch checks no more than these either."""
    names = BACKBONE_FILES[net]
    known = {name.removesuffix(".pth").rpartition("-")[2]: name for name in names}
    return Published(f"https://download.pytorch.org/models/{names[0]}", known | {copies[name]: name for name in copies})


def _heads(net: str, sha256: str) -> Published:
    """Linear heads from the repository of LPIPS's authors; the checksum is that of the file at commit 082bb24."""
    url = f"https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/{net}.pth"
    return Published(url, {sha256: f"v0.1/{net}.pth"})


# project/image_likeness/models/squeeze.backbone.pth of delldu/LPIPS at commit 77473a1: torchvision's features without
# the classifier, so never to be stored under torchvision's name.
_SQUEEZE_FEATURES = {"squeeze.backbone.pth": "435cedb387e95bc8291893f61a3a64f0345b8c23a05139aceef43947efb3d52d"}

#: Net -> backbone and linear heads.
SOURCES: dict[str, tuple[Published, Published]] = {
    "vgg": (_backbone("vgg"), _heads("vgg", "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868")),
    "alex": (_backbone("alex"), _heads("alex", "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0")),
    "squeeze": (
        _backbone("squeeze", **_SQUEEZE_FEATURES),
        _heads("squeeze", "4a5350f23600cb79923ce65bb07cbf57dca461329894153e05a1346bd531cf76"),
    ),
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
        files = search(net) if folder is None else weights_in(net, [folder])
        for index, file in enumerate(files):
            if file is None:
                missing.append((net, index))
            elif SOURCES[net][index].path_of(digest := file_sha256(file)) is None:
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
        urls = ", ".join(left.url for left in files[number:])
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
    copies = [
        (file, target / published.check(file, file, f"Download {published.url} again"))
        for published, file in files
        if file is not None
    ]
    for file, place in copies:
        with atomic_path(place) as path:
            shutil.copyfile(file, path)
    return [place for _, place in copies]
