"""Reading of the folder of a comparison: its plan, results, runs and failures."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from coliags_plugin.comparison.plan_file import FAILURES, PLAN_FILE, RESULTS, RUNS, PlannedCell, read_plan
from coliags_plugin.comparison.report.study import Cell, Failure
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import json_text, parse_json, read_json
from coliags_plugin.results.reading import RESULT_FILE, read_result

#: Below results and failures: scene, method, and seed with key.
_CELL = "*/*/s*-*.json"
_SEED = re.compile(r"s(\d+)-")


@dataclass(frozen=True)
class FoundResult:
    """A results file and what it holds."""

    file: Path
    cell: Cell


def is_comparison(folder: Path) -> bool:
    """Whether a folder is that of a comparison, or holds its results alone."""
    return (folder / PLAN_FILE).is_file() or (folder / RESULTS).is_dir() or any(folder.glob(_CELL))


def read_comparison(folder: Path, protocol: str) -> tuple[list[FoundResult], list[Failure]]:
    """Results and failures of one protocol: those of the plan, in its order; all that are there without a plan.

    Raises:
        InputError: A file is damaged, or there are results of other protocols only.
    """
    plan = read_plan(folder)
    if plan is not None:
        return _planned(folder, plan.cells, protocol)
    if (folder / RESULTS).is_dir():
        return _unplanned(folder / RESULTS, folder / RUNS, protocol), list(_failures(folder))
    return _unplanned(folder, None, protocol), []


def read_file(file: Path, stamp: str, run: Path | None = None) -> FoundResult:
    """A results file under the name of its method."""
    result = read_result(file)
    return FoundResult(file, Cell(result.method, result, stamp, run))


def _planned(folder: Path, cells: Sequence[PlannedCell], protocol: str) -> tuple[list[FoundResult], list[Failure]]:
    found, failures = [], []
    runs: dict[str, Path] = {}  # by key: what is the same as another method under a second name has no run of its own
    for entry in cells:
        if entry.protocol != protocol:
            continue
        file = folder / entry.result
        if file.is_file():
            one = read_file(file, file.stem)
            own = _with_images(folder / entry.run, protocol)
            if own is not None:
                runs[one.cell.result.key] = own
            found.append(replace(one, cell=replace(one.cell, method=entry.method, run=own)))
        else:
            failure = folder / FAILURES / Path(entry.result).relative_to(RESULTS)
            reason = _reason(failure) if failure.is_file() else None
            failures.append(Failure(entry.scene, entry.method, entry.seed, reason))
    _refuse_other_protocols(folder, protocol, {entry.protocol for entry in cells})
    return [one if one.cell.run else _with_run(one, runs) for one in found], failures


def _with_run(found: FoundResult, runs: Mapping[str, Path]) -> FoundResult:
    return replace(found, cell=replace(found.cell, run=runs.get(found.cell.result.key)))


def _unplanned(folder: Path, runs: Path | None, protocol: str) -> list[FoundResult]:
    """The name of a method's folder tells variants of one method apart."""
    found, protocols = [], set()
    for file in sorted(folder.glob(_CELL)):
        one = read_file(file, file.stem)
        result, directory = one.cell.result, file.parent.name
        protocols.add(result.protocol.name)
        if result.protocol.name != protocol:
            continue
        method = result.method if result.method.replace("/", "-") == directory else directory
        run = None if runs is None else _run_of(runs / file.parent.relative_to(folder), file.stem, result.key, protocol)
        found.append(replace(one, cell=replace(one.cell, method=method, run=run)))
    _refuse_other_protocols(folder, protocol, protocols)
    return found


def _refuse_other_protocols(folder: Path, protocol: str, found: set[str]) -> None:
    if found and protocol not in found:
        raise InputError(
            f"{folder} has results of protocol {', '.join(sorted(found))} only",
            f"some of '{protocol}'",
            f"Pass --protocol {min(found)}",
        )


def _run_of(folder: Path, stem: str, key: str, protocol: str) -> Path | None:
    """The run whose evaluation has the key; runs have keys of their own in their names."""
    seed = stem.partition("-")[0]
    for run in sorted(folder.glob(f"{seed}-*")):
        try:
            content = parse_json(json_text(run / "eval" / protocol / RESULT_FILE))
        except (OSError, ValueError):
            continue
        if isinstance(content, dict) and content.get("key") == key:
            return _with_images(run, protocol)
    return None


def _with_images(run: Path, protocol: str) -> Path | None:
    """The run, if it still has the images of its evaluation."""
    return run if (run / "eval" / protocol / "renders").is_dir() else None


def _failures(folder: Path) -> Iterator[Failure]:
    """Cells that failed and have no result."""
    for file in sorted((folder / FAILURES).glob(_CELL)):
        place = file.relative_to(folder / FAILURES)
        seed = _SEED.match(file.name)
        if seed is not None and not (folder / RESULTS / place).is_file():
            yield Failure(place.parts[0], place.parts[1], int(seed.group(1)), _reason(file))


def _reason(file: Path) -> str:
    record = read_json(file, "the reason of a failure")
    reason = record.get("reason") if isinstance(record, dict) else None
    return str(reason or "no reason was recorded")
