"""Arguments of commands: their flags in messages and hints, their values, and checks of output folders."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar, get_args, get_type_hints

import tyro

from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.core.files import refuse_existing, refuse_overlap

if TYPE_CHECKING:
    from coliags_plugin.core.settings import Settings

S = TypeVar("S", bound="Settings")

#: An option or setting in a message: `name`, `name=value` or `key.path=value`, in backticks.
_QUOTED = re.compile(r'`([a-z]\w*(?:\.(?:\w+|"[^"`]*"))*)(?:=([^`]*))?`')
#: Flags of the running command by names of its options.
_running: dict[str, str] = {}


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


def translate_for(command: object) -> None:
    """Let :func:`in_flags` name the flags of a command."""
    _running.clear()
    _running.update(flags_of(type(getattr(command, "subcommand", command))))


def in_flags(text: str) -> str:
    """A message with the options that it quotes as flags of the running command, and other settings as ``--set``."""

    def flag(quoted: re.Match[str]) -> str:
        name, value = quoted.groups()
        if name not in _running:
            return quoted[0] if value is None else f"--set {shlex.quote(quoted[0].strip('`'))}"
        option = _running[name]
        return option if value in (None, "True") else f"{option} {value}"

    return _QUOTED.sub(flag, text)


def flags_of(command: type) -> dict[str, str]:
    """The flag of each option of a command by the option's name; positional arguments have none."""
    flags = {}
    for name, kind in get_type_hints(command, include_extras=True).items():
        metadata = getattr(kind, "__metadata__", ())
        if tyro.conf.Positional not in metadata:
            names = [each.name for each in metadata if getattr(each, "name", None)]
            flags[name] = f"--{names[0] if names else name.replace('_', '-')}"
    return flags


def subcommands(command: type) -> dict[str, type[Runnable]]:
    """The subcommands of a command by their names; none of one that has none."""
    union = get_args(get_type_hints(command, include_extras=True).get("subcommand"))[:1]
    return {name.name: kind for kind, name in map(get_args, get_args(*union))} if union else {}


def hint(argv: Sequence[str], commands: Mapping[str, type[Runnable]]) -> str:
    """The command that an unknown one resembles most, or else the option of its command; empty without one."""
    if not argv:
        return ""
    if argv[0] not in commands:
        return did_you_mean(argv[0], commands)
    kind = commands[argv[0]]
    if inner := subcommands(kind):
        return hint(argv[1:], inner)
    spellings = {spelling for flag in flags_of(kind).values() for spelling in _spellings(flag)}
    unknown = (word.partition("=")[0] for word in argv if word.startswith("--"))
    return next((did_you_mean(word, spellings) for word in unknown if word not in spellings), "")


def _spellings(flag: str) -> Iterator[str]:
    yield from (flag, flag.replace("--", "--no-", 1))


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

    chosen = [assignment.removeprefix(prefix) for assignment in assignments if assignment.startswith(prefix)]
    return settings_of(kind, chosen, prefix), [item for item in assignments if not item.startswith(prefix)]


def refuse_output(output: Path, source: Path, overwrite: bool) -> None:
    """Refuse, before work starts, an output that is, contains or is in the input, or is there without ``overwrite``."""
    refuse_overlap(output, source)
    refuse_existing(output, overwrite)
