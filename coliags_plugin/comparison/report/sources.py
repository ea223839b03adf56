"""Reading of what a report is made of: run folders, results files, and folders of a comparison."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from coliags_plugin.comparison.report.comparability import refuse_incomparable
from coliags_plugin.comparison.report.comparison_folders import FoundResult, is_comparison, read_comparison, read_file
from coliags_plugin.comparison.report.labels import told_apart
from coliags_plugin.comparison.report.study import Cell, Failure, Study
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.results.reading import RESULT_FILE
from coliags_plugin.results.record import TRUTH_SUFFIX


def read_study(paths: Sequence[Path], protocol: str = "paper", methods: Sequence[str] = ()) -> Study:
    """Read results and check that they are comparable.

    Args:
        paths: Run folders, results files, and folders of a comparison, in any mixture.
        protocol: Name of the evaluation to read from folders.
        methods: Names of methods to keep, in this order; empty: all.

    Raises:
        InputError: Nothing is there, a path is neither, a file is damaged or given twice, a method is not there, or the
            results are not comparable.
    """
    if not paths:
        raise InputError("no results", "run folders, results files or the folder of a comparison", "Name at least one")
    failures: list[Failure] = []
    found: list[FoundResult] = []
    for path in paths:
        if not path.is_dir():
            found.append(read_file(path, path.stem))
        elif is_comparison(path):
            results, failed = read_comparison(path, protocol)
            found += results
            failures += failed
        else:
            found.append(_read_run(path, protocol))
    _refuse_twice(found)
    cells = [one.cell for one in found]
    if not cells:
        raise _nothing_yet(paths, failures)
    labelled = told_apart(cells)
    if methods:
        labelled, failures = _only(methods, labelled, failures)
    refuse_incomparable(labelled)
    return Study(tuple(labelled), tuple(failures))


def _only(
    methods: Sequence[str], cells: Sequence[Cell], failures: Sequence[Failure]
) -> tuple[list[Cell], list[Failure]]:
    """Results and failures of some methods, in their order."""
    known = list(dict.fromkeys([cell.method for cell in cells] + [failure.method for failure in failures]))
    for name in methods:
        if name not in known:
            those = ", ".join(known)
            raise InputError(f"no method '{name}' among the results", f"one of {those}", did_you_mean(name, known))
    kept = [cell for name in dict.fromkeys(methods) for cell in cells if name == cell.method]
    return kept, [failure for failure in failures if failure.method in methods]


def _read_run(folder: Path, protocol: str) -> FoundResult:
    evaluation = folder / "eval" / protocol
    file = evaluation / RESULT_FILE
    if file.is_file():
        return read_file(file, folder.resolve().name, folder)
    name = protocol.removesuffix(TRUTH_SUFFIX)
    truth = "" if name == protocol else " --truth SCENE"
    do = f"Run `coliags eval {folder} --protocol {name}{truth}`"
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


def _refuse_twice(found: Iterable[FoundResult]) -> None:
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
            f"none of the {len(failures)} cells of {where} has a result; {first.method} on {first.scene}: "
            f"{first.reason or 'not finished'}",
            "at least one",
        )
    return InputError(f"{where} holds no results", "at least one finished cell", "Wait, or run `coliags compare` again")
