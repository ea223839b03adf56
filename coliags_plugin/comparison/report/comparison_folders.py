"""Reading of the folder of a comparison: its plan, results, runs and failures."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from coliags_plugin.comparison.cells import file_name
from coliags_plugin.comparison.plan_file import FAILURES, PLAN_FILE, RESULTS, RUNS, PlannedCell, read_plan
from coliags_plugin.comparison.report.study import MissingResult, StudyRun
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import json_text, parse_json, read_json
from coliags_plugin.results.reading import RESULT_FILE, read_result

#: Below results and failures: scene, method, and seed with key.
_CELL = "*/*/s*-*.json"
_SEED = re.compile(r"s(\d+)-")


def is_comparison(folder: Path) -> bool:
    """Whether a folder is that of a comparison, or holds its results alone."""
    return (folder / PLAN_FILE).is_file() or (folder / RESULTS).is_dir() or any(folder.glob(_CELL))


def read_comparison(folder: Path, protocol: str) -> tuple[list[StudyRun], list[MissingResult]]:
    """Results and failures of one protocol: those of the plan, in its order; all that are there without a plan."""
    plan = read_plan(folder)
    if plan is not None:
        return _read_planned(folder, plan.cells, protocol)
    if (folder / RESULTS).is_dir():
        return _read_unplanned(folder / RESULTS, folder / RUNS, protocol), list(_read_failures(folder))
    return _read_unplanned(folder, None, protocol), []


def read_file(file: Path, stamp: str, run: Path | None = None) -> StudyRun:
    """A results file under the name of its method."""
    result = read_result(file)
    return StudyRun(result.method, result, file, stamp, run)


def _read_planned(
    folder: Path, cells: Sequence[PlannedCell], protocol: str
) -> tuple[list[StudyRun], list[MissingResult]]:
    found, missing = [], []
    runs: dict[str, Path] = {}  # by key: what is the same as another method under a second name has no run of its own
    for entry in (entry for entry in cells if entry.protocol == protocol):
        file = folder / entry.result
        if file.is_file():
            own = _with_images(folder / entry.run, protocol)
            one = replace(read_file(file, file.stem, own), method=entry.method)
            if own is not None:
                runs[one.result.key] = own
            found.append(one)
        else:
            failure = folder / FAILURES / Path(entry.result).relative_to(RESULTS)
            reason = _failure_reason(failure) if failure.is_file() else None
            missing.append(MissingResult(entry.scene, entry.method, entry.seed, reason))
    _refuse_other_protocols(folder, protocol, {entry.protocol for entry in cells})
    return [replace(one, run=one.run or runs.get(one.result.key)) for one in found], missing


def _read_unplanned(folder: Path, runs: Path | None, protocol: str) -> list[StudyRun]:
    """The name of a method's folder tells variants of one method apart."""
    found = [read_file(file, file.stem) for file in sorted(folder.glob(_CELL))]
    _refuse_other_protocols(folder, protocol, {one.result.protocol.name for one in found})
    named = []
    for one in found:
        if one.result.protocol.name == protocol:
            place = one.file.parent
            method = one.method if file_name(one.method) == place.name else place.name
            run = runs and _find_run(runs / place.relative_to(folder), one.stamp, one.result.key, protocol)
            named.append(replace(one, method=method, run=run))
    return named


def _refuse_other_protocols(folder: Path, protocol: str, protocols: set[str]) -> None:
    if protocols and protocol not in protocols:
        raise InputError(
            f"{folder} has results of protocol {', '.join(sorted(protocols))} only",
            f"some of '{protocol}'",
            f"Pass --protocol {min(protocols)}",
        )


def _find_run(folder: Path, stem: str, key: str, protocol: str) -> Path | None:
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


def _read_failures(folder: Path) -> Iterator[MissingResult]:
    """Cells that failed and have no result."""
    for file in sorted((folder / FAILURES).glob(_CELL)):
        place = file.relative_to(folder / FAILURES)
        seed = _SEED.match(file.name)
        if seed is not None and not (folder / RESULTS / place).is_file():
            yield MissingResult(place.parts[0], place.parts[1], int(seed.group(1)), _failure_reason(file))


def _failure_reason(file: Path) -> str:
    record = read_json(file, "the reason of a failure")
    reason = record.get("reason") if isinstance(record, dict) else None
    return str(reason or "no reason was recorded")
