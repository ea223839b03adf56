"""Work files of an estimation, which an interrupted one is resumed from."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coliags_plugin.core.arrays import read_arrays
from coliags_plugin.core.files import atomic_write, make_folder, write_arrays, write_json
from coliags_plugin.core.jobs import locked

log = logging.getLogger(__name__)

Arrays = Mapping[str, np.ndarray]
#: What describes the estimation, in the folder of its work files.
_REQUEST = "request.json"


@dataclass(frozen=True)
class WorkFolder:
    """The folder of an estimation's work files: one folder for each pass, one file in it for each frame."""

    path: Path

    def has(self, stage: str, index: int) -> bool:
        """True if a frame of a pass is there."""
        return self._file(stage, index).is_file()

    def save(self, stage: str, index: int, arrays: Arrays) -> None:
        """Keep the results of a frame of a pass; atomic."""
        write_arrays(self._file(stage, index), arrays)

    def load(self, stage: str, index: int) -> dict[str, np.ndarray]:
        """The results of a frame of a pass."""
        return read_arrays(self._file(stage, index), "a work file of this estimation", optional=None)

    def is_done(self, stage: str) -> bool:
        """True if all frames of a pass have been kept."""
        return (self.path / f"{stage}.done").is_file()

    def finish(self, stage: str, before: str | None) -> None:
        """Mark a pass as done, and remove the files of the one before it, which it was made from."""
        atomic_write(self.path / f"{stage}.done", "")
        if before is not None:
            shutil.rmtree(self.path / before, ignore_errors=True)

    def value(self, name: str, make: Callable[[], Any]) -> Any:
        """A JSON value: the kept one, or else a new one, which is kept."""
        file = self.path / f"{name}.json"
        if not file.is_file():
            write_json(file, make())
        return json.loads(file.read_text())

    def _file(self, stage: str, index: int) -> Path:
        return self.path / stage / f"{index:06d}.npz"


@contextmanager
def work_folder(out: Path, request: Mapping[str, Any]) -> Iterator[WorkFolder]:
    """The work files for an output folder, beside it; removed when the block ends without an error.

    ``request`` is everything that determines the results, as JSON values; work files of another one are removed first.
    """
    path = out.parent / f".{out.name}.work"
    make_folder(path)
    with locked(path / "lock", out):
        file, described = path / _REQUEST, json.loads(json.dumps(dict(request)))
        stored = json.loads(file.read_text()) if file.is_file() else None
        if stored is not None and stored != described:
            log.warning("%s: work files of other data or options are removed", path)
        if stored != described:
            for old in path.iterdir():
                if old.is_dir():
                    shutil.rmtree(old)
                elif old.name != "lock":
                    old.unlink()
            write_json(file, described)
        else:
            log.info("resuming from the work files in %s", path)
        yield WorkFolder(path)
    shutil.rmtree(path, ignore_errors=True)
