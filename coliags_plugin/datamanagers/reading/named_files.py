"""Files that other files of a scene name."""

from __future__ import annotations

import errno
import posixpath
from pathlib import Path

from coliags_plugin.core.errors import InputError


def named_file(folder: Path, name: str, said: str, outside: bool) -> Path:
    """The path of a file that another one names; it need not exist.

    Args:
        folder: What names are relative to.
        name: As it stands.
        said: Where, for the message.
        outside: Whether it may lie outside of the folder. Links within the folder may always lead anywhere.

    Raises:
        InputError: It lies outside, and must not; or no file can have this name.
    """
    path = folder / name
    within = Path(posixpath.normpath(folder.absolute()))
    if not outside and not Path(posixpath.normpath(path.absolute())).is_relative_to(within):
        raise InputError(
            f"{said} names {name[:200]}, which is outside of {folder}",
            "files in the scene's own folder",
            "If you trust it, set datamanager.outside_files=true (in other commands --set outside_files=true)",
        )
    try:
        path.lstat()
    except ValueError as error:  # it has a zero
        raise InputError(f"{said} names {name[:200]!r}", "the name of a file") from error
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise InputError(f"{said} names {name[:200]}..., {len(name):,} letters", "the name of a file") from error
    return path
