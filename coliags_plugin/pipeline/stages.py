"""Stages of a reconstruction, run one after the other; a record in the folder says which are done."""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, TypeAdapter

from coliags_plugin._version import __version__
from coliags_plugin.core.errors import (
    InputError,
    NotFiniteError,
    NothingDrawnError,
    NotWritableError,
    ReportedError,
)
from coliags_plugin.core.files import write_json
from coliags_plugin.core.json_files import json_text, parse_json
from coliags_plugin.core.locks import locked
from coliags_plugin.core.settings import invalid_reported
from coliags_plugin.core.text_files import without_places
from coliags_plugin.reporting.numbers import duration

log = logging.getLogger(__name__)

T = TypeVar("T")

#: Name of the file, and version of the schema of what a reconstruction records.
RECORD_FILE, FORMAT = "reconstruction.json", 1
#: Page that leads to everything a reconstruction has made.
PAGE_FILE = "index.html"
#: Lock that a process holds while it works in the folder.
LOCK_FILE = ".lock"
#: For a worker that was asked to end, seconds.
LOCK_SECONDS = 120.0
#: How the names of records by workers begin.
_WORKER_FILES = ".reconstruction-"
#: A part of the stages that one process works on: those that all others need (None), or those of one sub-map.
Part = int | None


def part_name(part: Part) -> str:
    """For keys and files: the number of a sub-map, or ``plan`` of the stages that all need."""
    return "plan" if part is None else str(part)


@dataclass(frozen=True)
class StageRecord:
    """A stage that was begun."""

    options: Mapping[str, Any]  # what it depends on, as JSON
    state: Literal["begun", "failed", "done"] = "begun"  # failed: for its input
    summary: str = ""  # what came out, or why it failed, in one line
    seconds: float = 0.0  # of the attempt that ended, wall-clock
    files: Mapping[str, str] = field(default_factory=dict)  # what it made, relative to the folder, and what each is
    warnings: Sequence[str] = ()  # what limits the result, and what to do
    figures: Mapping[str, Any] = field(default_factory=dict)  # numbers of the summary, by name


_StageName = Annotated[str, Field(pattern=r"^(submap-[0-9]{1,6}/)?[a-z]+$")]
_RECORDED = TypeAdapter(dict[_StageName, StageRecord])


class Record:
    """The record in a folder, written after every change: its stages by their names.

    That of a worker, which works on one part beside others, has a file of its own for the stages that it puts.
    """

    def __init__(
        self, folder: Path, stages: Mapping[str, StageRecord] | None = None, worker: str | None = None
    ) -> None:
        self.folder, self.stages = folder, dict(stages or {})
        self.places: Sequence[Path] = (folder,)  # files and folders whose places are kept out of what stages say
        self._is_worker, self._own = worker is not None, set[str]()
        self._file = folder / (RECORD_FILE if worker is None else _worker_file(worker))

    @classmethod
    def of(cls, folder: Path, worker: str | None = None) -> Record:
        """The record of a folder; empty for one that is new or empty, and refused for one of something else."""
        if (folder / RECORD_FILE).is_file():
            record = cls(folder, worker=worker)
            for file in (folder / RECORD_FILE, *sorted(folder.glob(_worker_file("*")))):
                stages = _read(file)
                record.stages |= stages
                if file == record._file:
                    record._own |= set(stages)
            return record
        if folder.exists() and (not folder.is_dir() or any(not _is_ours(path) for path in folder.iterdir())):
            raise InputError(
                f"{folder} already exists and is no reconstruction",
                "a new or empty folder, or one that `coliags reconstruct` made",
                "Choose another --output",
            )
        return cls(folder, worker=worker)

    def is_done(self, name: str) -> bool:
        """Whether a stage is."""
        return name in self.stages and self.stages[name].state == "done"

    def take_over_all(self) -> None:
        """Take what the workers of an earlier call have written; one that has not ended is waited for.

        Raises:
            LockedError: It does not end.
        """
        for file in sorted(self.folder.glob(_worker_file("*"))):
            worker = file.stem.removeprefix(_WORKER_FILES)
            with locked(self.folder / f"{LOCK_FILE}-{worker}", self.folder, LOCK_SECONDS):
                self.take_over(worker)

    def take_over(self, worker: str) -> None:
        """Take what a worker that has ended has written."""
        file = self.folder / _worker_file(worker)
        if file.is_file():
            self.stages |= _read(file)
            self.write()
            file.unlink()

    def put(self, name: str, stage: StageRecord) -> None:
        """Set a stage, in the place it has."""
        summary, *warnings = (without_places(text, self.places) for text in (stage.summary, *stage.warnings))
        self.stages[name] = replace(stage, summary=summary, warnings=tuple(warnings))
        self._own.add(name)
        self.write()

    def forget(self, names: Sequence[str], outputs: Sequence[str]) -> None:
        """Forget stages and remove what they made, files and folders relative to the folder."""
        self.stages = {name: stage for name, stage in self.stages.items() if name not in names}
        self.write()
        for output in outputs:
            path = self.folder / output
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
            if path.parent != self.folder and path.parent.is_dir() and not any(path.parent.iterdir()):
                path.parent.rmdir()

    def write(self) -> None:
        """Write the file atomically."""
        stages = {n: asdict(stage) for n, stage in self.stages.items() if not self._is_worker or n in self._own}
        write_json(self._file, {"format": FORMAT, "version": __version__, "stages": stages})


def _worker_file(name: str) -> str:
    return f"{_WORKER_FILES}{name}.json"


def _read(file: Path) -> dict[str, StageRecord]:
    return read_record(file, lambda _, content: _RECORDED.validate_python(content["stages"]), "Choose another --output")


def read_record(file: Path, validate: Callable[[str, Any], T], do: str = "") -> T:
    """Read a record by its text and JSON value; refused are damaged ones, and those of other versions of the package.

    ``do`` is what to do about a damaged one.
    """
    try:
        text = json_text(file)
        content = parse_json(text)
        if isinstance(content, dict) and content.get("format") != FORMAT:
            raise InputError(
                f"{file} is of version {content.get('version', 'unknown')} of coliags_plugin",
                f"format {FORMAT}, of version {__version__}",
                "Choose another --output, or go on with that version",
            )
        with invalid_reported(f"cannot read {file}: ", "what `coliags reconstruct` wrote", do):
            return validate(text, content)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"cannot read {file}: {error}", "what `coliags reconstruct` wrote", do) from error


def _is_ours(path: Path) -> bool:
    """Whether a file is there before the record is: the lock, or what a kill has left of writing the record."""
    return path.name == LOCK_FILE or path.name.startswith(f".{RECORD_FILE}.")


@dataclass(frozen=True)
class StageOutcome:
    """What a stage has made."""

    summary: str
    files: Mapping[str, str] = field(default_factory=dict)  # paths relative to the folder, and what each is
    warnings: Sequence[str] = ()  # logged, and kept
    figures: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Stage:
    """A step of a reconstruction. It reads what earlier stages wrote, and can be repeated after a kill.

    ``run`` replaces what an attempt that was killed has left, or goes on with that.
    """

    name: str  # as the record and messages call it
    options: Mapping[str, Any]  # all that it depends on apart from the stages before it, as JSON
    run: Callable[[], StageOutcome]
    outputs: Sequence[str] = ()  # files and folders that it writes, relative to the reconstruction's folder
    part: Part = None  # which of several parts, independent of each other, it is of; None: all need it
    is_plan: bool = False  # whether the stages after it are known only once it is done


def run_stages(
    stages: Sequence[Stage],
    record: Record,
    overwrite: bool = False,
    plan: Callable[[], Sequence[Stage]] | None = None,
    parts: Container[Part] | None = None,
) -> ReportedError | None:
    """Run the stages that are not done, all or those of some parts; ``plan`` gives them anew after one that decides.

    A stage that was begun with other options is an error, or with ``overwrite`` removed and repeated, along with those
    that need it. The options of one that failed may change. A stage of a part that fails ends that part alone: the
    error of part 0 is returned, those of others are in the record.
    """
    number, failed = 0, dict[int, ReportedError]()
    check_options(stages, record, overwrite)
    while number < len(stages):
        stage = stages[number]
        number += 1
        if stage.part in failed or (parts is not None and stage.part not in parts):
            continue
        before = [other.name for other in stages[: number - 1] if other.part in (None, stage.part)]
        try:
            _run_stage(stage, f"[{number}/{len(stages)}] {stage.name}", record)
        except NotWritableError as error:
            raise _failed(error, stage, before) from error
        except (InputError, NotFiniteError, NothingDrawnError) as error:
            told = _failed(error, stage, before) if isinstance(error, InputError) else error
            if stage.part is None:
                raise told from error
            failed[stage.part] = told
            if any(other.part not in (None, stage.part) for other in stages):
                log.warning("%s; the others go on", str(told).rstrip("."))
        if stage.is_plan and plan is not None:
            stages = plan()
            check_options(stages, record, overwrite)
    return failed.get(0)


def _run_stage(stage: Stage, title: str, record: Record) -> None:
    """Run a stage that is not done."""
    known = record.stages.get(stage.name)
    if known is not None and known.state == "done":
        log.info("%s: done before: %s", title, known.summary)
        return
    log.info("%s%s", title, "" if known is None else ": begun before")
    begun = StageRecord(_plain(stage.options))
    record.put(stage.name, begun)
    began = time.monotonic()
    try:
        made = stage.run()
    except (InputError, NotFiniteError, NothingDrawnError) as error:
        record.put(stage.name, replace(begun, state="failed", summary=str(error)))
        raise
    except KeyboardInterrupt:
        log.info("%s: interrupted; the same command goes on from here", title)
        raise
    seconds = time.monotonic() - began
    for warning in made.warnings:
        log.warning("%s: %s", stage.name, warning)
    record.put(stage.name, replace(begun, state="done", seconds=round(seconds, 1), **vars(made)))
    log.info("%s: %s; took %s", title, made.summary, duration(seconds))


def check_options(stages: Sequence[Stage], record: Record, overwrite: bool) -> None:
    """Refuse, or remove, what was made with other options."""
    for number, stage in enumerate(stages):
        known = record.stages.get(stage.name)
        if known is None or known.options == _plain(stage.options):
            continue
        if not overwrite and known.state != "failed":
            raise InputError(
                f"{record.folder}: stage {stage.name} was made with {_differences(known.options, stage.options)}",
                "the options that it was begun with",
                f"Choose another --output, or pass --overwrite to repeat {stage.name} and what follows it",
            )
        later = [other for other in stages[number:] if stage.part in (None, other.part)]
        record.forget([other.name for other in later], [output for other in later for output in other.outputs])


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """The first differing option, with both values."""
    old, new = dict(_leaves(before)), dict(_leaves(_plain(now)))
    name = next(key for key in [*old, *new] if old.get(key) != new.get(key))
    return f"{name} {old.get(name)}, not {new.get(name)}"


def _leaves(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    leaves: list[tuple[str, Any]] = []
    for key, value in values.items():
        leaves += _leaves(value, f"{prefix}{key}.") if isinstance(value, Mapping) else [(f"{prefix}{key}", value)]
    return leaves


def _plain(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options as they are read back from JSON."""
    values: dict[str, Any] = json.loads(json.dumps(options, default=str))
    return values


def _failed(error: InputError, stage: Stage, before: Sequence[str]) -> InputError:
    """The error of a stage, with those before it that stand."""
    stands = f"{', '.join(before)} {'stand' if len(before) > 1 else 'stands'}: the same command goes on from there"
    advice = ". ".join(part.rstrip(".") for part in (error.do, stands if before else "") if part)
    return type(error)(f"stage {stage.name}: {error.seen}", error.expected, advice)
