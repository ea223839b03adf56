"""Reading of the folder of a comparison: its plan, results, runs and failures."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from coliags_plugin.comparison.report.study import Cell, Failure
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import json_text, parse_json, read_json
from coliags_plugin.results.reading import RESULT_FILE, read_result

_PLAN, _RESULTS, _RUNS, _FAILURES = "plan.json", "results", "runs", "failures"
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
    return (folder / _PLAN).is_file() or (folder / _RESULTS).is_dir() or any(folder.glob(_CELL))


def read_comparison(folder: Path, protocol: str) -> tuple[list[FoundResult], list[Failure]]:
    """Results and failures of one protocol: those of the plan, in its order; all that are there without a plan.

    Raises:
        InputError: A file is damaged, or there are results of other protocols only.
    """
    if (folder / _PLAN).is_file():
        return _planned(folder, protocol)
    if (folder / _RESULTS).is_dir():
        return _unplanned(folder / _RESULTS, folder / _RUNS, protocol), list(_failures(folder))
    return _unplanned(folder, None, protocol), []


def read_file(file: Path, stamp: str, run: Path | None = None) -> FoundResult:
    """A results file under the name of its method."""
    result = read_result(file)
    return FoundResult(file, Cell(result.method, result, stamp, run))


def _planned(folder: Path, protocol: str) -> tuple[list[FoundResult], list[Failure]]:
    plan = _read_json(folder / _PLAN, "what `coliags compare` wrote")
    found, failures = [], []
    protocols: set[str] = set()
    runs: dict[str, Path] = {}  # by key: what is the same as another method under a second name has no run of its own
    for entry in plan.get("cells", []):
        try:
            scene, method, seed = entry["scene"], entry["method"], int(entry["seed"])
            run, place = entry["run"], entry["result"]
            protocols.add(entry["protocol"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{folder / _PLAN}: a cell lacks {error}", "what `coliags compare` wrote") from error
        if entry["protocol"] != protocol:
            continue
        file = folder / place
        if file.is_file():
            one = read_file(file, file.stem)
            own = _with_images(folder / run, protocol)
            if own is not None:
                runs[one.cell.result.key] = own
            found.append(replace(one, cell=replace(one.cell, method=method, run=own)))
        else:
            failure = folder / _FAILURES / Path(place).relative_to(_RESULTS)
            failures.append(Failure(scene, method, seed, _reason(failure) if failure.is_file() else None))
    _refuse_other_protocols(folder, protocol, protocols)
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
    for file in sorted((folder / _FAILURES).glob(_CELL)):
        place = file.relative_to(folder / _FAILURES)
        seed = _SEED.match(file.name)
        if seed is not None and not (folder / _RESULTS / place).is_file():
            yield Failure(place.parts[0], place.parts[1], int(seed.group(1)), _reason(file))


def _reason(file: Path) -> str:
    return str(_read_json(file, "the reason of a failure").get("reason") or "no reason was recorded")


def _read_json(file: Path, expected: str) -> dict[str, Any]:
    content = read_json(file, expected)
    if not isinstance(content, dict):
        raise InputError(f"{file} holds a {type(content).__name__}", expected)
    return content
