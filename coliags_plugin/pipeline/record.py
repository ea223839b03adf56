"""Record of a reconstruction: which stages are done, with which options, and what they made."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from coliags_plugin._version import __version__
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.json_files import json_text, parse_json

#: Name of the file, and version of its schema.
RECORD_FILE, _FORMAT = "reconstruction.json", 1
#: Lock that a process holds while it works in the folder.
LOCK_FILE = ".lock"


@dataclass(frozen=True)
class StageRecord:
    """A stage that was begun.

    Attributes:
        options: What it depends on, as JSON.
        state: ``begun``, ``failed`` for its input, or ``done``.
        summary: What came out, in one line.
        seconds: Of the attempt that ended, wall-clock.
        files: What it made, relative to the folder, and what each is.
    """

    options: Mapping[str, Any]
    state: Literal["begun", "failed", "done"] = "begun"
    summary: str = ""
    seconds: float = 0.0
    files: Mapping[str, str] = field(default_factory=dict)


class Record:
    """The record in a folder, written after every change.

    Args:
        folder: The reconstruction.
        stages: By their names.
    """

    def __init__(self, folder: Path, stages: Mapping[str, StageRecord] | None = None) -> None:
        self.folder, self.stages = folder, dict(stages or {})

    @classmethod
    def of(cls, folder: Path) -> Record:
        """The record of a folder; empty for one that is new or empty.

        Raises:
            InputError: The folder holds something else, or the record is damaged.
        """
        file = folder / RECORD_FILE
        if file.is_file():
            try:
                found = parse_json(json_text(file))
                return cls(folder, {name: StageRecord(**stage) for name, stage in found["stages"].items()})
            except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
                raise InputError(
                    f"cannot read {file}: {error}", "what `coliags reconstruct` wrote", "Choose another --out"
                ) from error
        if folder.exists() and (not folder.is_dir() or any(not _is_ours(path) for path in folder.iterdir())):
            raise InputError(
                f"{folder} already exists and is no reconstruction",
                "a new or empty folder, or one that `coliags reconstruct` made",
                "Choose another --out",
            )
        return cls(folder)

    def put(self, name: str, stage: StageRecord) -> None:
        """Set a stage, in the place it has."""
        self.stages[name] = stage
        self.write()

    def forget(self, names: Sequence[str], outputs: Sequence[str]) -> None:
        """Forget stages and remove what they made.

        Args:
            names: Of the stages.
            outputs: Files and folders of theirs, relative to the folder.
        """
        self.stages = {name: stage for name, stage in self.stages.items() if name not in names}
        self.write()
        for output in outputs:
            path = self.folder / output
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)

    def write(self) -> None:
        """Write the file atomically.

        Raises:
            InputError: The folder cannot be written.
        """
        stages = {name: asdict(stage) for name, stage in self.stages.items()}
        write_json(self.folder / RECORD_FILE, {"format": _FORMAT, "version": __version__, "stages": stages})


def _is_ours(path: Path) -> bool:
    """Whether a file is there before the record is: the lock, or what a kill has left of writing the record."""
    return path.name == LOCK_FILE or path.name.startswith(f".{RECORD_FILE}.")
