"""Stages of a reconstruction, run one after the other; a record in the folder says which are done."""

from __future__ import annotations

import json
import logging
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter

from coliags_plugin.core import __version__
from coliags_plugin.core.errors import InputError, NotFiniteError, NothingDrawnError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.jobs import locked
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.settings import invalid_reported
from coliags_plugin.core.text_files import without_places
from coliags_plugin.reporting.numbers import duration

log = logging.getLogger(__name__)

#: Name of the file, and version of the schema of what a reconstruction records.
RECORD_FILE, FORMAT = "reconstruction.json", 2
MADE = "what `coliags reconstruct` wrote"
#: Page that leads to everything a reconstruction has made.
PAGE_FILE = "index.html"
#: Lock that a process holds while it works in the folder.
LOCK_FILE = ".lock"
#: Longest wait for a worker that was asked to end, seconds.
LOCK_SECONDS = 120.0
#: Files and folders that each stage writes, in the folder of its segment or sub-map.
OUTPUTS: dict[str, tuple[str, ...]] = {
    "survey": ("survey.npz",),
    "frames": ("frames",),
    "poses": ("poses",),
    "check": ("check.html", "check.json"),
    "depth": ("depth", ".depth.work"),
    "train": ("run",),
    "evaluate": ("run/eval",),
    "mesh": ("run/mesh",),
    "coverage": ("run/coverage",),
    "scene": ("run/scene.html", "run/pictures"),
    "report": ("report.html",),
}
#: Stages that are of no sub-map.
SHARED = ("survey", "frames", "poses", "joins")


def submap_name(segment: str, number: int) -> str:
    """Name of a sub-map on pages: ``sub-map 1``, or of a long video ``segment-003/1``."""
    return f"{segment}/{number}" if segment else f"sub-map {number}"


@dataclass(frozen=True)
class StageRecord:
    """Result of a stage, and its state."""

    summary: str = ""  # what came out, or why it failed, in one line
    files: Mapping[str, str] = field(default_factory=dict)  # what it made, relative to its folder, and what each is
    warnings: Sequence[str] = ()  # what limits the result, and what to do
    figures: Mapping[str, Any] = field(default_factory=dict)  # numbers of the summary, by name
    state: Literal["begun", "failed", "done"] = "done"  # failed: for its input
    options: Mapping[str, Any] = field(default_factory=dict)  # what it depends on, as JSON
    seconds: float = 0.0  # of the attempt that ended, wall-clock


@dataclass(frozen=True)
class Stage:
    """A step of a reconstruction. It reads what earlier stages wrote, and can be repeated after a kill.

    ``work`` replaces what an attempt that was killed has left, or goes on with that.
    """

    name: str  # as the record and messages call it: behind the way to the folder of its sub-map
    work: Callable[[], StageRecord]
    options: Mapping[str, Any] = field(default_factory=dict)  # all that it depends on apart from the stages before it


#: Name of a stage: of a long video behind the folder of the segment, of other sub-maps than the largest behind theirs.
_StageName = Annotated[str, Field(pattern=r"^(segment-[0-9]{1,6}/)?(submap-[0-9]{1,6}/)?[a-z]+$")]
_RECORDED = TypeAdapter(dict[_StageName, StageRecord])


class Record:
    """The record in a folder, written after every change: its stages by their names.

    Several processes, each of which works on other stages, change one file: what others have written is read before.
    """

    def __init__(self, folder: Path, stages: Mapping[str, StageRecord] | None = None) -> None:
        self.folder, self.stages = folder, dict(stages or {})
        self.places: Sequence[Path] = (folder,)  # files and folders whose places are kept out of what stages say
        self._file, self._read = folder / RECORD_FILE, (0, 0)

    @classmethod
    def of(cls, folder: Path, places: Sequence[Path] = ()) -> Record:
        """The record of a folder; empty for one that is new or empty, and refused for one of something else."""
        record = cls(folder)
        record.places = (folder, *places)
        if not record.refresh() and folder.exists():
            # Before the record, there is a lock, or what a kill has left of writing the record.
            others = (path.name for path in folder.glob("*") if not path.name.startswith(f".{RECORD_FILE}."))
            if not folder.is_dir() or any(name != LOCK_FILE for name in others):
                raise InputError(
                    f"{folder} already exists and is no reconstruction",
                    "a new or empty folder, or one that `coliags reconstruct` made",
                    "Choose another `output`",
                )
        return record

    def refresh(self) -> bool:
        """Read what others have written; returns whether there is a file.

        Raises:
            InputError: It is damaged, or of another version of the package.
        """
        if not self._file.is_file():
            return False
        if (status := self._status()) != self._read:
            self.stages, self._read = _read(self._file), status
        return True

    def _status(self) -> tuple[int, int]:
        """Inode and time of the file, which differ after every writing."""
        status = self._file.stat()
        return status.st_ino, status.st_mtime_ns

    def within(self, segment: str) -> dict[str, StageRecord]:
        """The stages of a segment by their names in its folder; of the only one, '', all."""
        prefix = f"{segment}/" if segment else ""
        return {name.removeprefix(prefix): stage for name, stage in self.stages.items() if name.startswith(prefix)}

    def of_submaps(self, prefix: str) -> list[str]:
        """Names of the stages of sub-maps of the segment that a prefix is of."""
        return [name for name in self.stages if name.startswith(prefix) and name.rpartition("/")[2] not in SHARED]

    def is_done(self, name: str) -> bool:
        """True if a stage is done."""
        return name in self.stages and self.stages[name].state == "done"

    def put(self, name: str, stage: StageRecord) -> None:
        """Set a stage, in the place it has."""
        summary, *warnings = (without_places(text, self.places) for text in (stage.summary, *stage.warnings))
        self.write({name: replace(stage, summary=summary, warnings=tuple(warnings))})

    def forget(self, names: Sequence[str]) -> None:
        """Forget stages, and remove what they made, with folders that are empty then."""
        self.write(without=names)
        for name in names:
            parent, _, step = name.rpartition("/")
            for path in (self.folder / parent / output for output in OUTPUTS.get(step, ())):
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)
                for folder in path.relative_to(self.folder).parents:
                    place = self.folder / folder
                    if place != self.folder and place.is_dir() and not any(place.iterdir()):
                        place.rmdir()

    def write(self, stages: Mapping[str, StageRecord] | None = None, without: Sequence[str] = ()) -> None:
        """Write the file atomically, with these stages and without some, in the order of segments and sub-maps."""
        with locked(self.folder / f".{RECORD_FILE}.lock", self._file, LOCK_SECONDS):
            self.refresh()
            changed = {name: stage for name, stage in self.stages.items() if name not in without} | dict(stages or {})
            self.stages = dict(sorted(changed.items(), key=lambda item: list(map(int, re.findall(r"\d+", item[0])))))
            plain = {name: asdict(stage) for name, stage in self.stages.items()}
            write_json(self._file, {"format": FORMAT, "version": __version__, "stages": plain})
            self._read = self._status()


def worker_lock(folder: Path, worker: str) -> Path:
    """Lock that a worker holds."""
    return folder / f"{LOCK_FILE}-{worker}"


def wait_for_workers(folder: Path) -> None:
    """Wait for the workers of an earlier call, which end with it.

    Raises:
        LockedError: One does not end.
    """
    for lock in sorted(folder.glob(worker_lock(folder, "*").name)):
        with locked(lock, folder, LOCK_SECONDS):
            pass


def _read(file: Path) -> dict[str, StageRecord]:
    """The stages in a record; refused are damaged ones, and those of other versions of the package."""
    other = "Choose another `output`"
    content = read_json(file, MADE, other)
    if isinstance(content, dict) and content.get("format") != FORMAT:
        raise InputError(
            f"{file} is of version {content.get('version', 'unknown')} of coliags_plugin",
            f"format {FORMAT}, of version {__version__}",
            f"{other}, or go on with that version",
        )
    with invalid_reported(f"cannot read {file}: ", MADE, other):
        return _RECORDED.validate_python(content.get("stages") if isinstance(content, dict) else content)


def run_stages(stages: Sequence[Stage], record: Record) -> None:
    """Run the stages that are not done, in order.

    Raises:
        InputError: One cannot be done; the message names it, and those before it that stand.
    """
    for number, stage in enumerate(stages):
        try:
            _run_stage(stage, f"[{number + 1}/{len(stages)}] {stage.name}", record)
        except InputError as error:
            before = ", ".join(earlier.name for earlier in stages[:number])
            stands = f"{before} {'stand' if number > 1 else 'stands'}: the same command goes on from there"
            advice = ". ".join(part.rstrip(".") for part in (error.do, stands if before else "") if part)
            raise type(error)(f"stage {stage.name}: {error.seen}", error.expected, advice) from error


def _run_stage(stage: Stage, title: str, record: Record) -> None:
    """Run a stage that is not done."""
    recorded = record.stages.get(stage.name)
    if recorded is not None and recorded.state == "done":
        log.info("%s: done before: %s", title, recorded.summary)
        return
    log.info("%s%s", title, "" if recorded is None else ": begun before")
    begun = StageRecord(state="begun", options=_plain(stage.options))
    record.put(stage.name, begun)
    start = time.monotonic()
    try:
        result = stage.work()
    except (InputError, NotFiniteError, NothingDrawnError) as error:
        record.put(stage.name, replace(begun, state="failed", summary=str(error)))
        raise
    except KeyboardInterrupt:
        log.info("%s: interrupted; the same command goes on from here", title)
        raise
    seconds = time.monotonic() - start
    for warning in result.warnings:
        log.warning("%s: %s", stage.name, warning)
    prefix = stage.name[: stage.name.rfind("/") + 1]
    files = {prefix + path: what for path, what in result.files.items()}
    record.put(stage.name, replace(result, files=files, options=begun.options, seconds=round(seconds, 1)))
    log.info("%s: %s; took %s", title, result.summary, duration(seconds))


def check_options(stages: Sequence[Stage], record: Record, overwrite: bool, after: Sequence[str] = ()) -> None:
    """Refuse what was made with other options, or with ``overwrite`` forget it along with what needs it.

    That are the stages behind it, and those whose names are in ``after``. The options of a stage that failed may
    change.
    """
    for number, stage in enumerate(stages):
        recorded = record.stages.get(stage.name)
        if recorded is None or not (differences := _differences(recorded.options, stage.options)):
            continue
        if not overwrite and recorded.state != "failed":
            raise InputError(
                f"{record.folder}: stage {stage.name} was made with {differences}",
                "the options that it was begun with",
                f"Choose another `output`, or pass `overwrite=True` to repeat {stage.name} and what follows it",
            )
        record.forget([*(later.name for later in stages[number:]), *after])
        return


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """The first differing option, with both values; empty if there is none. An option that is not there is None."""
    old, new = dict(_leaves(before)), dict(_leaves(_plain(now)))
    differing = (key for key in [*old, *new] if old.get(key) != new.get(key))
    return next((f"{name} {old.get(name)}, not {new.get(name)}" for name in differing), "")


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        yield from _leaves(value, f"{prefix}{key}.") if isinstance(value, Mapping) else [(f"{prefix}{key}", value)]


def _plain(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options as they are read back from JSON."""
    values: dict[str, Any] = json.loads(json.dumps(options, default=str))
    return values
