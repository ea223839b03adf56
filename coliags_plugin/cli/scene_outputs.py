"""Options and output folders of commands that write a scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from coliags_plugin.config.assignments import settings_of
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import refuse_overlap

if TYPE_CHECKING:
    from coliags_plugin.core.settings import Settings

S = TypeVar("S", bound="Settings")


def settings_among(kind: type[S], assignments: Sequence[str], prefix: str) -> tuple[S, list[str]]:
    """Settings from the ``--set`` assignments with a key prefix, and the others, which are the data manager's.

    Raises:
        InputError: See :func:`settings_of`.
    """
    own = [assignment.removeprefix(prefix) for assignment in assignments if assignment.startswith(prefix)]
    return settings_of(kind, own, prefix), [item for item in assignments if not item.startswith(prefix)]


def refuse_output(output: Path, source: Path, overwrite: bool) -> None:
    """Check an output folder before the work starts.

    Raises:
        InputError: It is, contains or is inside the input, or is not empty and ``overwrite`` is off.
    """
    refuse_overlap(output, source)
    if not overwrite and output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(f"{output} already exists", "a new or empty folder", "Choose another, or pass --overwrite")
