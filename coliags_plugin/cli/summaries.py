"""Summaries that commands print at their end: results, files written, and commands to type next."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coliags_plugin.cli.arguments import in_flags

#: The method for scenes with estimated depth, as `coliags reconstruct` trains it.
ESTIMATED_DEPTH_METHOD = "coliags-in-vivo"


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
        values = ({"summary": text} if text else {}) if facts is None else facts
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


def train_command(scene: Path, method: str = "coliags", assignments: Sequence[str] = ()) -> str:
    """The command that trains a method on a scene with options ``KEY=VALUE``."""
    changes = [word for assignment in assignments for word in ("--set", assignment)]
    return coliags("train", method, "--data", scene, *changes)


def depth_commands(scene: Path) -> list[str]:
    """The commands that estimate the depth of a scene with poses and points, and train on it."""
    with_depth = scene.with_name(f"{scene.name}-depth")
    return [
        coliags("depth", "estimate", scene, "--output", with_depth),
        train_command(with_depth, ESTIMATED_DEPTH_METHOD),
    ]
