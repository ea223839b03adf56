"""Hints for mistyped command-line arguments."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, get_args, get_type_hints

import tyro

from coliags_plugin.core.errors import did_you_mean


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
    fields = get_type_hints(kind, include_extras=True)
    if (inner := fields.get("subcommand")) is not None:
        return hint(argv[1:], get_args(inner)[0])
    known = {option for field in fields.items() for option in _options(*field)}
    unknown = (word.partition("=")[0] for word in argv if word.startswith("--"))
    return next((did_you_mean(word, known) for word in unknown if word not in known), "")


def _options(field: str, kind: Any) -> Iterator[str]:
    """The spellings of a field of a command as an option; none of a positional argument."""
    metadata = getattr(kind, "__metadata__", ())
    if tyro.conf.Positional not in metadata:
        names = [name for each in metadata if (name := getattr(each, "name", None))] or [field.replace("_", "-")]
        yield from (f"--{prefix}{name}" for name in names for prefix in ("", "no-"))
