"""Unique frame names from image paths, and images without poses."""

from __future__ import annotations

import logging
import os
import posixpath
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from coliags_plugin.core.errors import InputError

log = logging.getLogger(__name__)


def short_names(paths: Sequence[str]) -> list[str]:
    """Unique names of images given by relative paths, usable as file names.

    Common parent folders are removed and the remaining ones joined by a dash; suffixes are dropped if names stay
    unique.

    Raises:
        InputError: Two names would be equal.
    """
    whole = [PurePosixPath(posixpath.normpath(path)) for path in paths]
    common = len(PurePosixPath(os.path.commonpath([path.parent for path in whole])).parts)
    inner = [PurePosixPath(*path.parts[common:]) for path in whole]
    for short in ([str(path.with_suffix("")) for path in inner], [str(path) for path in inner]):
        names = [name.replace("/", "-") for name in short]
        if len(set(names)) == len(names):
            return names
    double = next(name for index, name in enumerate(names) if name in names[:index])
    raise InputError(f"two images would be called '{double}'", "names that differ in more than / and -", "Rename one")


def unposed_images(used: Sequence[Path], excluded: Iterable[Path | None] = ()) -> list[Path]:
    """Images without a pose in the folders of those with one.

    Args:
        used: Images with a pose.
        excluded: Other files in these folders: depth, masks.
    """
    known = {*used, *excluded}
    suffixes = {path.suffix.lower() for path in used}
    return [
        path
        for folder in dict.fromkeys(path.parent for path in used)
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in suffixes and path not in known and path.is_file()
    ]


def warn_of_unposed(file: Path, others: Sequence[Path]) -> None:
    """Log a warning that names the images without a pose in ``file``, if any."""
    if others:
        named = first_few([path.name for path in others])
        log.warning("%s: %d images have no pose and are left out: %s", file, len(others), named)


def first_few(names: Sequence[str]) -> str:
    """The first three names, for messages."""
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
