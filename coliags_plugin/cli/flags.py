"""Flags of commands: hints at misspelt ones, and the options that messages of libraries quote, as flags."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from typing import Any, get_args, get_type_hints

import tyro

from coliags_plugin.core.errors import did_you_mean

#: An option or setting in a message: `name`, `name=value` or `key.path=value`, in backticks.
_QUOTED = re.compile(r'`([a-z]\w*(?:\.(?:\w+|"[^"`]*"))*)(?:=([^`]*))?`')
#: Flags of the running command by names of its options.
_running: dict[str, str] = {}


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


def hint(argv: Sequence[str], commands: Any) -> str:
    """The command that an unknown one resembles most, or else the option of its command; empty without one.

    ``commands`` is the union of the commands.
    """
    if not argv:
        return ""
    kinds = {name.name: kind for kind, name in map(get_args, get_args(commands))}
    if argv[0] not in kinds:
        return did_you_mean(argv[0], kinds)
    kind = kinds[argv[0]]
    if (inner := get_type_hints(kind, include_extras=True).get("subcommand")) is not None:
        return hint(argv[1:], get_args(inner)[0])
    known = {spelling for flag in flags_of(kind).values() for spelling in _spellings(flag)}
    unknown = (word.partition("=")[0] for word in argv if word.startswith("--"))
    return next((did_you_mean(word, known) for word in unknown if word not in known), "")


def _spellings(flag: str) -> Iterator[str]:
    yield from (flag, flag.replace("--", "--no-", 1))
