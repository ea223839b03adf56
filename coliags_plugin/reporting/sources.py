"""Reading of what a report is made of: run folders, results files, and folders of a comparison."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.reporting.comparability import refuse_incomparable
from coliags_plugin.reporting.labels import told_apart
from coliags_plugin.reporting.study import Cell, Failure, Study
from coliags_plugin.results.reading import RESULT_FILE, read_result

#: Folders of a comparison.
_RESULTS, _RUNS, _FAILURES = "results", "runs", "failures"
#: Below each of them: scene, method, and seed with key.
_CELL = "*/*/s*-*"
_SEED = re.compile(r"s(\d+)-")


@dataclass(frozen=True)
class _Found:
    """A results file and what it holds."""

    file: Path
    cell: Cell


def read_study(paths: Sequence[Path], protocol: str = "paper") -> Study:
    """Read results and check that they are comparable.

    Args:
        paths: Run folders, results files, and folders of a comparison, in any mixture.
        protocol: Name of the evaluation to read from folders.

    Raises:
        InputError: Nothing is there, a path is neither, a file is damaged or given twice, or the results are not
            comparable.
    """
    if not paths:
        raise InputError("no results", "run folders, results files or the folder of a comparison", "Name at least one")
    failures: list[Failure] = []
    found: list[_Found] = []
    for path in paths:
        if not path.is_dir():
            found.append(_found(path, path.stem))
        elif (path / _RESULTS).is_dir():
            found += _of_comparison(path, protocol)
            failures += _failures(path)
        elif any(path.glob(f"{_CELL}.json")):
            found += _of_results(path, None, protocol)
        else:
            found.append(_of_run(path, protocol))
    _refuse_twice(found)
    cells = [one.cell for one in found]
    if not cells:
        raise _nothing_yet(paths, failures)
    refuse_incomparable(cells)
    study = Study(tuple(told_apart(cells)), tuple(failures))
    return study


def _of_run(folder: Path, protocol: str) -> _Found:
    evaluation = folder / "eval" / protocol
    file = evaluation / RESULT_FILE
    if file.is_file():
        return _found(file, folder.resolve().name, folder)
    do = f"Run `coliags eval {folder} --protocol {protocol}`"
    if (evaluation / "metrics.json").is_file():
        raise InputError(
            f"{folder} was evaluated by an older release, which wrote no {RESULT_FILE}",
            "an evaluated run",
            f"{do} again",
        )
    if not (folder / "eval").is_dir() and not (folder / "config.yaml").is_file():
        raise InputError(
            f"{folder} holds no results",
            "a run folder, a results file, or the folder of a comparison",
            "Check the path",
        )
    missing = file.relative_to(folder)
    raise InputError(
        f"{folder} has no evaluation by protocol '{protocol}' ({missing} is missing)", "one", f"{do} first"
    )


def _of_comparison(folder: Path, protocol: str) -> list[_Found]:
    return _of_results(folder / _RESULTS, folder / _RUNS, protocol)


def _of_results(folder: Path, runs: Path | None, protocol: str) -> list[_Found]:
    """Results of one protocol; the name of a method's folder tells variants of one method apart."""
    found = []
    others = set()
    for file in sorted(folder.glob(f"{_CELL}.json")):
        one = _found(file, file.stem)
        result, directory = one.cell.result, file.parent.name
        if result.protocol.name != protocol:
            others.add(result.protocol.name)
            continue
        method = result.method if result.method.replace("/", "-") == directory else directory
        run = None if runs is None else _run_of(runs / file.parent.relative_to(folder), file.stem, result.key, protocol)
        found.append(_Found(file, replace(one.cell, method=method, run=run)))
    if others and not found:
        raise InputError(
            f"{folder} has results of protocol {', '.join(sorted(others))} only",
            f"some of '{protocol}'",
            f"Pass --protocol {min(others)}",
        )
    return found


def _run_of(folder: Path, stem: str, key: str, protocol: str) -> Path | None:
    """The run whose evaluation has the key; runs have keys of their own in their names."""
    seed = stem.partition("-")[0]
    for run in sorted(folder.glob(f"{seed}-*")):
        evaluation = run / "eval" / protocol
        try:
            content = json.loads((evaluation / RESULT_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
        if isinstance(content, dict) and content.get("key") == key and (evaluation / "renders").is_dir():
            return run
    return None


def _failures(folder: Path) -> Iterator[Failure]:
    """Cells that failed and have no result."""
    for file in sorted((folder / _FAILURES).glob(f"{_CELL}.json")):
        place = file.relative_to(folder / _FAILURES)
        seed = _SEED.match(file.name)
        if seed is None or (folder / _RESULTS / place).is_file():
            continue
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(
                f"{file} cannot be read: {error}", "the reason of a failure, as JSON", "Delete it"
            ) from error
        reason = content.get("reason") if isinstance(content, dict) else None
        yield Failure(place.parts[0], place.parts[1], int(seed.group(1)), str(reason or "no reason was recorded"))


def _found(file: Path, stamp: str, run: Path | None = None) -> _Found:
    result = read_result(file)
    return _Found(file, Cell(result.method, result, stamp, run))


def _refuse_twice(found: Iterable[_Found]) -> None:
    seen: set[Path] = set()
    for one in found:
        if one.file.resolve() in seen:
            raise InputError(f"{one.cell.run or one.file} is given twice", "each result once")
        seen.add(one.file.resolve())


def _nothing_yet(paths: Sequence[Path], failures: Sequence[Failure]) -> InputError:
    where = ", ".join(map(str, paths))
    if failures:
        first = failures[0]
        return InputError(
            f"all {len(failures)} cells of {where} failed; {first.method} on {first.scene}: {first.reason}",
            "at least one result",
        )
    return InputError(f"{where} holds no results", "at least one finished cell", "Wait, or run `coliags compare` again")
