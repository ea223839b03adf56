"""What pictures that lie anywhere are called."""

from __future__ import annotations

import os
import posixpath
from collections.abc import Sequence
from pathlib import PurePosixPath

from coliags_plugin.errors import InputError


def short_names(paths: Sequence[str]) -> list[str]:
    """Unique names, fit for files, of pictures given by their relative paths.

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
    raise InputError(f"two pictures would be called '{double}'", "names that differ in more than / and -", "Rename one")


def first_few(names: Sequence[str]) -> str:
    """The first three of some names, for messages."""
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
