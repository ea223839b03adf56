"""Folder of a comparison: its plan, runs, results, failures and logs."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path

from coliags_plugin.comparison.plan import (
    PLAN_FILE,
    RESULTS,
    ComparisonCell,
    ComparisonPlan,
    Decision,
    FailureRecord,
    read_plan,
)
from coliags_plugin.config.options import CompareOptions
from coliags_plugin.config.yaml_tree import parse_assignments
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.jobs import locked
from coliags_plugin.core.text_files import without_places
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.results.reading import NewerResultError, read_result, write_result
from coliags_plugin.results.record import Result

log = logging.getLogger(__name__)


class ComparisonFolder:
    """A folder that comparisons accumulate in.

    ``plan.json``; ``runs/`` with ordinary run folders; ``results/`` with a results file per finished cell, which alone
    make cells count as done; ``failures/``; ``logs/``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()
        self._results: dict[Path, Result] = {}  # as of read_results, and added since
        self.failures: list[FailureRecord] = []  # of this process

    def run(self, cell: ComparisonCell) -> RunFolder:
        """Run folder of a cell."""
        return RunFolder(self.path / cell.planned.run)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep other comparisons out of the folder, which is created where it is missing, and read its results."""
        with locked(self.path / ".lock", self.path):
            self.read_results()
            yield

    def _check_kind(self) -> None:
        """Refuse a folder that holds something else than comparisons."""
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"{self.path} is a file", "a folder", "Choose another `output`")
        if self.path.is_dir() and not (self.path / PLAN_FILE).is_file():
            names = sorted(path.name for path in self.path.iterdir() if not path.name.startswith("."))
            # Results alone may have been brought here from elsewhere.
            if names and names != [RESULTS]:
                raise InputError(
                    f"{self.path} is not the folder of a comparison: it holds {', '.join(names[:4])}",
                    f"a new folder, or one with {PLAN_FILE}",
                    "Choose another `output`",
                )

    def check_extends(self, options: CompareOptions) -> None:
        """Refuse to mix runs of different length or with different changes, and to decide after the first run."""
        self._check_kind()
        before = read_plan(self.path)
        decided, now = None if before is None else before.decided, _decision(options)
        is_begun = before is not None or (self.path / RESULTS).is_dir()
        if is_begun and now is not None and now != (decided and decided.model_copy(update={"date": now.date})):
            earlier = "nothing" if decided is None else f"{decided.reference} by {', '.join(decided.primary)}"
            raise InputError(
                f"`reference={options.reference}` and `primary={' '.join(options.primary)}`, where {self.path} had "
                f"decided {earlier} when it was begun",
                "no other decision after the first run",
                "Leave both out, or choose another `output`",
            )
        if before is None:
            return
        former, latter = (
            [("steps", each.steps or "each method's own"), *parse_assignments(changes).items()]  # 1e-3 is 0.001
            for each, changes in ((before, before.overrides), (options, options.settings))
        )
        if former != latter:
            texts = (", ".join(f"`{key}={value}`" for key, value in each) for each in (former, latter))
            raise InputError(
                "{} compares runs with {}, not {}".format(self.path, *texts), "the same, or another `output`"
            )

    def record(self, options: CompareOptions, cells: Sequence[ComparisonCell]) -> None:
        """Add to the plan what is asked for now; a cell whose key has changed replaces the former one.

        Only a new plan takes up a decision.
        """
        before = read_plan(self.path) or ComparisonPlan(decided=_decision(options))
        entries = {entry.identity: entry for entry in before.cells}
        planned = {cell.planned.identity: cell.planned for cell in cells}
        changed = [name for name, cell in planned.items() if name in entries and entries[name].key != cell.key]
        if changed:
            log.warning(
                "%d cells are not those of the former plan, as their method, scene or the code has changed, such as "
                "%s %s seed %d",
                len(changed),
                *changed[0][:3],
            )
        plan = ComparisonPlan(
            steps=options.steps,
            overrides=options.settings,
            decided=before.decided,
            cells=tuple({**entries, **planned}.values()),
        )
        write_json(self.path / PLAN_FILE, plan.model_dump(mode="json"))

    def read_results(self) -> None:
        """Read the results that are there; half-written and damaged files are reported and left as they are.

        Raises:
            NewerResultError: A file is from a newer version.
        """
        self._results.clear()
        for path in sorted((self.path / RESULTS).rglob("[!.]*.json")):
            try:
                self._results[path] = read_result(path)
            except NewerResultError:
                raise
            except InputError as error:
                log.warning("not counted as done: %s", error)

    def done(self, cell: ComparisonCell) -> Result | None:
        """The result of a cell; under another name where another method is the same; None where it is not done."""
        if cell.fingerprint is None:
            return None
        key, result = cell.planned.key, self._results.get(self.path / cell.planned.result)
        if result is not None and result.key == key:
            return result
        return next((result for result in self._results.values() if result.key == key), None)

    def add(self, cell: ComparisonCell, result: Result) -> None:
        """Count a cell as done, and write its results file where that is not there.

        The result may be that of a cell whose method is the same under another name.
        """
        path, name = self.path / cell.planned.result, cell.variant.name
        if result.method != name:
            provenance = {**result.provenance, "same_as": result.method}
            result = result.model_copy(update={"method": name, "provenance": provenance})
        if self._results.get(path) != result:
            write_result(path, result)
        self._results[path] = result
        (self.path / cell.planned.failure_file).unlink(missing_ok=True)

    def fail(self, cell: ComparisonCell, reason: str, attempts: int) -> None:
        """Record why a cell failed; a full disk loses the record, not the reason."""
        reason, planned = without_places(reason, (self.path, cell.scene.path)), cell.planned
        failure = FailureRecord(**planned.model_dump(), reason=reason, attempts=attempts, log=planned.log_file)
        try:
            write_json(self.path / planned.failure_file, failure.model_dump(mode="json"))
        except InputError as error:
            log.warning("%s", error)
        self.failures.append(failure)


def _decision(options: CompareOptions) -> Decision | None:
    """Decision that is made before the first run; None without one."""
    reference, primary = options.reference, tuple(dict.fromkeys(options.primary))
    today = datetime.now(timezone.utc).date().isoformat()
    return None if reference is None else Decision(reference=reference, primary=primary, date=today)
