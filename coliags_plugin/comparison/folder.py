"""Folder of a comparison: its plan, runs, results, failures and logs."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from coliags_plugin._version import __version__
from coliags_plugin.comparison.cells import Cell
from coliags_plugin.comparison.plan import Request
from coliags_plugin.comparison.scenes import SceneSource
from coliags_plugin.config.assignments import parse_assignments
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import make_folder, write_json
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.locks import LockedError, locked
from coliags_plugin.core.settings import first_error
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.results.reading import NewerResultError, read_result, write_result
from coliags_plugin.results.record import Result

log = logging.getLogger(__name__)

FORMAT: Literal["coliags-comparison"] = "coliags-comparison"
VERSION = 1


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SceneEntry(_Part):
    """A scene of a plan.

    Attributes:
        phantom: Settings it is made with; None for a dataset.
        fingerprint: Of its files.
        package_version: That computed the fingerprint.
    """

    phantom: dict[str, Any] | None
    fingerprint: str
    package_version: str


class CellEntry(_Part):
    """A cell of a plan.

    Attributes:
        scene: Name of the scene; with that of the split where it is not the scene's own.
        method: Name of the method.
        seed: Of the run.
        protocol: Name of the evaluation protocol.
        key: Of the result.
        run: Run folder, relative to the comparison's.
        result: Results file, relative to the comparison's folder; there once the cell is done.
    """

    scene: str
    method: str
    seed: int
    protocol: str
    key: str
    run: str
    result: str

    @property
    def identity(self) -> tuple[str, str, int, str]:
        """As :attr:`Cell.identity`."""
        return self.scene, self.method, self.seed, self.protocol


class PlanRecord(_Part):
    """Content of ``plan.json``: all that was ever asked for in this folder.

    Attributes:
        format: Marks the file.
        version: Of this schema.
        steps: Length of all runs; None: each method's own.
        overrides: Changes of all methods.
        scenes: By name.
        cells: In the order in which they were asked for.
    """

    format: Literal["coliags-comparison"] = FORMAT
    version: int = VERSION
    steps: int | None = None
    overrides: tuple[str, ...] = ()
    scenes: dict[str, SceneEntry] = {}
    cells: tuple[CellEntry, ...] = ()


class Failure(_Part):
    """Why a cell failed.

    Attributes:
        scene: As in the plan.
        method: As in the plan.
        seed: As in the plan.
        protocol: As in the plan.
        key: As in the plan.
        reason: One line.
        attempts: Processes that tried.
        log: Their messages, relative to the comparison's folder.
    """

    scene: str
    method: str
    seed: int
    protocol: str
    key: str
    reason: str
    attempts: int
    log: str


class ComparisonFolder:
    """A folder that comparisons accumulate in.

    ``plan.json``; ``runs/`` with ordinary run folders; ``results/`` with a results file per finished cell, which alone
    make cells count as done; ``failures/``; ``logs/``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()

    @property
    def plan_file(self) -> Path:
        """What was asked for."""
        return self.path / "plan.json"

    @property
    def results(self) -> Path:
        """Results files of finished cells."""
        return self.path / "results"

    def run(self, cell: Cell) -> Path:
        """Run folder of a cell."""
        return self.path / "runs" / cell.run_place

    def lock(self, cell: Cell) -> Path:
        """File whose lock the process has that works on a cell's run."""
        return RunFolder(self.run(cell)).lock_file

    def result(self, cell: Cell) -> Path:
        """Results file of a cell."""
        return self.results / f"{cell.result_place}.json"

    def failure(self, cell: Cell) -> Path:
        """Why a cell failed."""
        return self.path / "failures" / f"{cell.result_place}.json"

    def log(self, cell: Cell) -> Path:
        """Messages of the processes that worked on a cell's run."""
        return self.path / "logs" / f"{cell.run_place}.log"

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep other comparisons out of the folder, which is created where it is missing.

        Raises:
            InputError: Another one is running, or the folder cannot be written or is of something else.
        """
        self.check()
        make_folder(self.path)
        try:
            with locked(self.path / ".lock"):
                yield
        except LockedError as error:
            raise InputError(
                f"another comparison is running in {self.path}: {error}",
                "one at a time",
                "Wait until it has ended, or choose another --output",
            ) from error

    def check(self) -> None:
        """Refuse a folder that holds something else than comparisons.

        Raises:
            InputError: See above.
        """
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"{self.path} is a file", "a folder", "Choose another --output")
        if self.path.is_dir() and not self.plan_file.is_file():
            held = sorted(path.name for path in self.path.iterdir() if not path.name.startswith("."))
            # Results alone may have been brought here from elsewhere.
            if held and held != [self.results.name]:
                raise InputError(
                    f"{self.path} is not the folder of a comparison: it holds {', '.join(held[:4])}",
                    "a new folder, or one with plan.json",
                    "Choose another --output",
                )

    def plan(self) -> PlanRecord:
        """What was asked for so far; empty where nothing was.

        Raises:
            InputError: The file is damaged or from a newer version.
        """
        if not self.plan_file.is_file():
            return PlanRecord()
        try:
            content = read_json(self.plan_file, "what `coliags compare` wrote", finite=True)
            version = content.get("version") if isinstance(content, dict) else None
            if isinstance(version, int) and version > VERSION:
                raise InputError(
                    f"{self.plan_file} is from a newer version of coliags_plugin: version {version}",
                    f"version {VERSION} or older",
                    "Update the package",
                )
            return PlanRecord.model_validate(content)
        except ValidationError as error:
            key, message, _ = first_error(error)
            raise InputError(f"{self.plan_file}: {key}: {message}", "what `coliags compare` wrote") from error

    def check_extends(self, request: Request) -> None:
        """Refuse to mix runs of different length or with different changes.

        Raises:
            InputError: The folder's comparison had another length of runs or other changes.
        """
        if not self.plan_file.is_file():
            return
        before = self.plan()
        if before.steps != request.steps:
            seen = "each method's own steps" if before.steps is None else f"--steps {before.steps}"
            asked = "each method's own" if request.steps is None else request.steps
            raise InputError(f"{self.path} compares runs of {seen}, not {asked}", "the same, or another --output")
        values = [list(parse_assignments(each).items()) for each in (before.overrides, request.overrides)]
        if values[0] != values[1]:  # 1e-3 is 0.001
            seen = " ".join(f"--set {each}" for each in before.overrides) or "no --set"
            asked = " ".join(f"--set {each}" for each in request.overrides) or "no --set"
            raise InputError(f"{self.path} compares runs with {seen}, not {asked}", "the same, or another --output")

    def record(self, request: Request, cells: Sequence[Cell]) -> None:
        """Add to the plan what is asked for now; a cell whose key has changed takes the place of the former one.

        Raises:
            InputError: The folder cannot be written.
        """
        before = self.plan()
        entries = {entry.identity: entry for entry in before.cells}
        changed = [cell for cell in cells if cell.identity in entries and entries[cell.identity].key != _key(cell)]
        if changed:
            log.warning(
                "%d cells are not those of the former plan, as their method, scene or the package has changed: %s",
                len(changed),
                ", ".join(cell.title for cell in changed[:3]) + (", ..." if len(changed) > 3 else ""),
            )
        entries |= {cell.identity: self._entry(cell) for cell in cells}
        scenes = {**before.scenes, **{cell.scene.name: _scene(cell) for cell in cells}}
        plan = PlanRecord(
            steps=request.steps, overrides=tuple(request.overrides), scenes=scenes, cells=tuple(entries.values())
        )
        write_json(self.plan_file, plan.model_dump(mode="json"))

    def recorded_fingerprint(self, scene: SceneSource) -> str | None:
        """Fingerprint of a phantom that is not there, if this version made the same one for this folder before."""
        entry = self.plan().scenes.get(scene.name)
        if entry is None or entry.phantom is None or entry.package_version != __version__:
            return None
        return entry.fingerprint if entry.phantom == scene.phantom_record else None

    def finished(self) -> Finished:
        """The results that are there; files that are half-written or damaged are reported and left as they are.

        Raises:
            NewerResultError: A file is from a newer version.
        """
        found = {}
        for path in sorted(self.results.rglob("*.json")):
            if path.name.startswith("."):
                continue
            try:
                found[path] = read_result(path)
            except NewerResultError:
                raise
            except InputError as error:
                log.warning("not counted as done: %s", error)
        return Finished(self, found)

    def fail(self, cell: Cell, reason: str, attempts: int) -> Failure:
        """Record why a cell failed; a full disk loses the record, not the reason."""
        failure = Failure(
            scene=cell.scene_label,
            method=cell.variant.name,
            seed=cell.seed,
            protocol=cell.protocol,
            key=_key(cell),
            reason=reason,
            attempts=attempts,
            log=str(self.log(cell).relative_to(self.path)),
        )
        try:
            write_json(self.failure(cell), failure.model_dump(mode="json"))
        except InputError as error:
            log.warning("%s", error)
        return failure

    def _entry(self, cell: Cell) -> CellEntry:
        return CellEntry(
            scene=cell.scene_label,
            method=cell.variant.name,
            seed=cell.seed,
            protocol=cell.protocol,
            key=_key(cell),
            run=self.run(cell).relative_to(self.path).as_posix(),
            result=self.result(cell).relative_to(self.path).as_posix(),
        )


class Finished:
    """The results of a folder, for cells to be looked up by their keys.

    Args:
        folder: Whose results.
        results: By path.
    """

    def __init__(self, folder: ComparisonFolder, results: Mapping[Path, Result]) -> None:
        self._folder = folder
        self._by_path = dict(results)
        self._by_key = {result.key: result for result in results.values()}

    @property
    def results(self) -> dict[Path, Result]:
        """All of them, by path."""
        return dict(self._by_path)

    def of(self, cell: Cell) -> Result | None:
        """The result of a cell; under another name where another method is the same; None where it is not done."""
        if cell.keys is None:
            return None
        own = self._by_path.get(self._folder.result(cell))
        if own is not None and own.key == cell.keys.result:
            return own
        return self._by_key.get(cell.keys.result)

    def add(self, cell: Cell, result: Result) -> Result:
        """Count a cell as done, and write its results file where that is not there.

        Args:
            cell: The cell.
            result: Of the cell, or of one whose method is the same under another name.

        Raises:
            InputError: The folder cannot be written.
        """
        path, name = self._folder.result(cell), cell.variant.name
        if result.method != name:
            provenance = {**result.provenance, "same_as": result.method}
            result = result.model_copy(update={"method": name, "provenance": provenance})
        if self._by_path.get(path) != result:
            write_result(path, result)
        self._by_path[path] = self._by_key[result.key] = result
        self._folder.failure(cell).unlink(missing_ok=True)
        return result


def _key(cell: Cell) -> str:
    return cell.known_keys.result


def _scene(cell: Cell) -> SceneEntry:
    return SceneEntry(
        phantom=cell.scene.phantom_record, fingerprint=cell.known_keys.fingerprint, package_version=__version__
    )
