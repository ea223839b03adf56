"""Arguments that several commands share, each with its help; parsing of their values, and checks of output folders."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Protocol, TypeVar

import tyro

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import refuse_overlap

if TYPE_CHECKING:
    from coliags_plugin.core.settings import Settings

S = TypeVar("S", bound="Settings")
R = TypeVar("R")

#: Of options whose help says what is done without them, or which are flags.
_NO_DEFAULT = ""

OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint=_NO_DEFAULT)]
OptionalText = Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint=_NO_DEFAULT)]
OptionalInt = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint=_NO_DEFAULT)]
OptionalFloat = Annotated[float | None, tyro.conf.arg(metavar="MM", help_behavior_hint=_NO_DEFAULT)]
#: What is done by default: ``--no-NAME``, which its help describes, leaves it out.
DoneByDefault = Annotated[bool, tyro.conf.arg(help_behavior_hint=_NO_DEFAULT)]

#: ``--output`` or ``-o``: the one spelling of where a command writes.
Output = Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="PATH")]
OptionalOutput = Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="PATH", help_behavior_hint=_NO_DEFAULT)]
#: ``--set key=value``, repeatable.
Assignments = Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE"), tyro.conf.UseAppendAction]

RunFolder = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(help="Run folder.")]
SceneFolder = Annotated[Path, tyro.conf.arg(help="The scene's folder.")]
#: Name of a data manager; None: recognised from the files.
DataFormat = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="NAME",
        help="Dataset format (`coliags list datamanagers`); default: recognised from the files.",
        help_behavior_hint=_NO_DEFAULT,
    ),
]
MovedData = Annotated[
    Path | None,
    tyro.conf.arg(
        metavar="PATH", help="The scene's folder, where it has moved since training.", help_behavior_hint=_NO_DEFAULT
    ),
]
Device = Annotated[
    str, tyro.conf.arg(metavar="auto|cpu|cuda|cuda:N", help="Device to compute on; cuda is the first CUDA device.")
]
Overwrite = Annotated[bool, tyro.conf.arg(help="Replace the output where it exists.")]
AsJson = Annotated[bool, tyro.conf.arg(help="Print the summary as JSON.")]


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


def call(function: Callable[..., R], command: object, **others: object) -> R:
    """Call a function with the options of a command that have the names of its arguments, and with others."""
    names = [name for name in signature(function).parameters if name not in others and hasattr(command, name)]
    return function(**{name: getattr(command, name) for name in names}, **others)


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
    if not overwrite and output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(f"{output} already exists", "a new or empty folder", "Choose another, or pass --overwrite")


#: Bytes of a unit.
_UNITS = {"": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9}


def bytes_of(text: str, option: str) -> int:
    """A size such as ``20MB`` in bytes; units are powers of 1000."""
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kMG]?B?)\s*", text, re.IGNORECASE)
    unit = found and found[2].lower()
    if found is None or unit not in _UNITS:
        raise InputError(f"{option} {text}", "a size in bytes, kB, MB or GB, for instance 20MB")
    return int(float(found[1]) * _UNITS[unit])
