"""SHA-256 of files, and lists of them as ``sha256sum`` writes and checks them."""

from __future__ import annotations

import hashlib
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write

#: Name of the list of a folder.
CHECKSUMS = "SHA256SUMS"
_BLOCK = 1 << 20


def file_sha256(file: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    digest = hashlib.sha256()
    try:
        with file.open("rb") as stream:
            while block := stream.read(_BLOCK):
                digest.update(block)
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror or error}", "a readable file") from error
    return digest.hexdigest()


def write_checksums(folder: Path) -> None:
    """List the checksums of all files of a folder in a file of it, :data:`CHECKSUMS`."""
    names = sorted(path.name for path in folder.iterdir() if path.is_file() and path.name != CHECKSUMS)
    atomic_write(folder / CHECKSUMS, "".join(f"{file_sha256(folder / name)}  {name}\n" for name in names))


def differing_files(folder: Path) -> list[str]:
    """Names of files that are missing from a folder or are not those of its list of checksums; without a list, none."""
    try:
        lines = (folder / CHECKSUMS).read_text(encoding="ascii").splitlines()
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError):
        return [CHECKSUMS]
    differing = []
    for line in lines:
        digest, _, name = line.partition("  ")
        if not name or "/" in name:
            return [CHECKSUMS]
        try:
            is_there = (folder / name).is_file()
        except OSError:  # the name is too long
            return [CHECKSUMS]
        if not is_there or file_sha256(folder / name) != digest:
            differing.append(name)
    return differing
