"""Options and output folders of commands that write a scene, and the commands to run on it next."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from coliags_plugin.config.assignments import settings_of
from coliags_plugin.core.errors import InputError

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


def refuse_output(out: Path, source: Path, overwrite: bool) -> None:
    """Check an output folder before the work starts.

    Raises:
        InputError: It is, contains or is inside the input, or is not empty and ``overwrite`` is off.
    """
    made, read = out.resolve(), source.resolve()
    if made == read or made in read.parents or read in made.parents:
        raise InputError(f"--out {out}, and the input is {source}", "a folder apart from the input", "Choose another")
    if not overwrite and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} already exists", "a new or empty folder", "Choose another, or pass --overwrite")


def train_command(out: Path, method: str = "coliags", assignments: Sequence[str] = ()) -> str:
    """Shell command that trains on a scene.

    Args:
        out: The scene.
        method: Name of a method.
        assignments: Options of training.
    """
    return shlex.join(["coliags", "train", method, "--data", str(out), *_set(assignments)])


def next_commands(out: Path, assignments: Sequence[str] = ()) -> str:
    """Shell commands that estimate the depth of a scene with poses and points, and train on it; two lines.

    Args:
        out: The scene.
        assignments: Options of its data manager, ``datamanager.KEY=VALUE``.
    """
    with_depth = out.with_name(f"{out.name}-depth")
    options = _set([assignment.removeprefix("datamanager.") for assignment in assignments])
    estimate = ["coliags", "depth", "estimate", str(out), "--out", str(with_depth), *options]
    return f"{shlex.join(estimate)}\n{train_command(with_depth, 'coliags-estimated-depth', assignments)}"


def _set(assignments: Sequence[str]) -> list[str]:
    return [word for assignment in assignments for word in ("--set", assignment)]
