"""Groups of commands; parsing of values of arguments, and checks of output folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import refuse_existing, refuse_overlap

if TYPE_CHECKING:
    from coliags_plugin.core.settings import Settings

S = TypeVar("S", bound="Settings")


class Runnable(Protocol):
    """Protocol of a parsed command."""

    def run(self) -> None:
        """Execute the command."""


class CommandGroup:
    """A command of subcommands, one of which is executed."""

    subcommand: Runnable

    def run(self) -> None:
        """Execute the subcommand."""
        self.subcommand.run()


def parse_size(text: str) -> tuple[int, int]:
    """``WxH`` -> (width, height), pixels."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError(f"--size {text}", "WIDTHxHEIGHT in pixels, for instance 338x270")
    return int(width), int(height)


def parse_vector(option: str, text: str) -> tuple[float, float, float]:
    """``X,Y,Z`` -> three numbers."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{option} {text}", "three numbers X,Y,Z") from error
    return x, y, z


def settings_among(kind: type[S], assignments: Sequence[str], prefix: str) -> tuple[S, list[str]]:
    """Settings from the ``--set`` assignments with a key prefix, and the others, which are the data manager's."""
    from coliags_plugin.config.assignments import settings_of

    own = [assignment.removeprefix(prefix) for assignment in assignments if assignment.startswith(prefix)]
    return settings_of(kind, own, prefix), [item for item in assignments if not item.startswith(prefix)]


def refuse_output(output: Path, source: Path, overwrite: bool) -> None:
    """Refuse, before work starts, an output that is, contains or is in the input, or is there without ``overwrite``."""
    refuse_overlap(output, source)
    refuse_existing(output, overwrite)
