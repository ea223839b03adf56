"""What images that lie anywhere are called."""

from __future__ import annotations

import logging
import os
import posixpath
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from coliags_plugin.core.errors import InputError

log = logging.getLogger(__name__)


def short_names(paths: Sequence[str]) -> list[str]:
    """Unique names, fit for files, of images given by their relative paths.

    Folders common to all are left out and further ones joined by a dash; suffixes go where names stay unique.

    Raises:
        InputError: Two cannot be told apart.
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


def others_beside(used: Sequence[Path], but: Iterable[Path | None] = ()) -> list[Path]:
    """Images in the folders of the used ones that are not used: those that nobody gave a pose.

    Args:
        used: Images with a pose.
        but: Files that are something else: depth, masks.
    """
    known = {*used, *but}
    suffixes = {path.suffix.lower() for path in used}
    return [
        path
        for folder in dict.fromkeys(path.parent for path in used)
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in suffixes and path not in known and path.is_file()
    ]


def warn_of_others(file: Path, others: Sequence[Path]) -> None:
    """Say which images are left out because ``file`` has no pose for them; nothing where there are none."""
    if others:
        named = first_few([path.name for path in others])
        log.warning("%s: %d images have no pose and are left out: %s", file, len(others), named)


def first_few(names: Sequence[str]) -> str:
    """The first three of some names, for messages."""
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
