"""Texts of commands: options in messages as flags, sizes, summaries, and commands to type next."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_type_hints

import tyro

from coliags_plugin.core.errors import InputError

#: An option or setting in a message: `name`, `name=value` or `key.path=value`, in backticks.
_QUOTED = re.compile(r'`([a-z]\w*(?:\.(?:\w+|"[^"`]*"))*)(?:=([^`]*))?`')
#: Flags of the running command by names of its options.
_running: dict[str, str] = {}


def translate_for(command: object) -> None:
    """Let :func:`in_flags` name the flags of a command; positional arguments have none."""
    _running.clear()
    hints = get_type_hints(type(getattr(command, "subcommand", command)), include_extras=True)
    for name, kind in hints.items():
        metadata = getattr(kind, "__metadata__", ())
        if tyro.conf.Positional not in metadata:
            names = [each.name for each in metadata if getattr(each, "name", None)]
            _running[name] = f"--{names[0] if names else name.replace('_', '-')}"


def in_flags(text: str) -> str:
    """A message with the options that it quotes as flags of the running command, and other settings as ``--set``."""

    def flag(quoted: re.Match[str]) -> str:
        name, value = quoted.groups()
        if name not in _running:
            return quoted[0] if value is None else f"--set {shlex.quote(quoted[0].strip('`'))}"
        option = _running[name]
        return option if value in (None, "True") else f"{option} {value}"

    return _QUOTED.sub(flag, text)


def parse_size(text: str) -> tuple[int, int]:
    """``WxH`` -> (width, height), pixels."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError(f"--size {text}", "WIDTHxHEIGHT in pixels, for instance 338x270")
    return int(width), int(height)


def print_summary(
    text: str = "",
    facts: Mapping[str, Any] | None = None,
    *,
    written: Sequence[Path] = (),
    then: Sequence[str] = (),
    as_json: bool = False,
) -> None:
    """Print a summary for a person or, with ``--json``, one JSON object for a script: facts, ``written`` and ``next``.

    ``facts`` say the same as ``text`` in JSON values; ``then`` are commands to type next.
    """
    if as_json:
        values = ({"summary": in_flags(text)} if text else {}) if facts is None else facts
        summary = {**values, "written": [str(path) for path in written], "next": list(then)}
        print(json.dumps(summary, indent=2, allow_nan=False, default=str))
        return
    lines = [in_flags(text)] if text else []
    lines += [f"written: {path}" for path in written]
    lines += [f"next:    {command}" for command in then]
    if lines:
        print("\n".join(lines))


def coliags(*words: object) -> str:
    """A command to type, quoted for the shell."""
    return shlex.join(["coliags", *map(str, words)])


def view_command(run: Path, data: Path | None = None) -> str:
    """The command that shows a run, whose scene may have moved to ``data``."""
    return coliags("view", run, *(() if data is None else ("--data", data)))


def train_command(scene: Path, assignments: Sequence[str] = ()) -> str:
    """The command that trains on a scene with options ``KEY=VALUE``."""
    changes = [word for assignment in assignments for word in ("--set", assignment)]
    return coliags("train", "coliags-plus", "--data", scene, *changes)


def depth_commands(scene: Path, reading: Sequence[str] = (), training: Sequence[str] = ()) -> list[str]:
    """The commands of ``TO_GET_DEPTH``: estimate the depth of a scene with poses, and train on it.

    ``reading`` are flags with which the scene is read, ``training`` options ``KEY=VALUE`` of training.
    """
    with_depth = scene.with_name(f"{scene.name}-depth")
    return [coliags("depth", scene, "--output", with_depth, *reading), train_command(with_depth, training)]
