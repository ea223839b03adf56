"""Reading of what a report is made of: run folders, results files, and folders of a comparison."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from coliags_plugin.comparison.report.comparability import refuse_incomparable
from coliags_plugin.comparison.report.comparison_folders import ResultSource, is_comparison, read_comparison, read_file
from coliags_plugin.comparison.report.labels import disambiguate_labels
from coliags_plugin.comparison.report.study import MissingResult, Study, StudyRun
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.results.reading import RESULT_FILE
from coliags_plugin.results.record import TRUTH_SUFFIX


def read_study(paths: Sequence[Path], protocol: str = "paper", methods: Sequence[str] = ()) -> Study:
    """Read run folders, results files and folders of a comparison, and check that the results are comparable.

    Of folders, the evaluation by a protocol is read. Methods, where named, are kept alone, in that order.
    """
    if not paths:
        raise InputError("no results", "run folders, results files or the folder of a comparison", "Name at least one")
    missing: list[MissingResult] = []
    sources: list[ResultSource] = []
    for path in paths:
        if not path.is_dir():
            sources.append(read_file(path, path.stem))
        elif is_comparison(path):
            results, failed = read_comparison(path, protocol)
            sources += results
            missing += failed
        else:
            sources.append(_read_run(path, protocol))
    _refuse_twice(sources)
    if not sources:
        raise _nothing_yet(paths, missing)
    runs = disambiguate_labels([source.run for source in sources])
    if methods:
        runs, missing = _only(methods, runs, missing)
    refuse_incomparable(runs)
    return Study(tuple(runs), tuple(missing))


def _only(
    methods: Sequence[str], runs: Sequence[StudyRun], missing: Sequence[MissingResult]
) -> tuple[list[StudyRun], list[MissingResult]]:
    """Results and failures of some methods, in their order."""
    known = list(dict.fromkeys([run.method for run in runs] + [one.method for one in missing]))
    for name in methods:
        if name not in known:
            those = ", ".join(known)
            raise InputError(f"no method '{name}' among the results", f"one of {those}", did_you_mean(name, known))
    kept = [run for name in dict.fromkeys(methods) for run in runs if name == run.method]
    return kept, [one for one in missing if one.method in methods]


def _read_run(folder: Path, protocol: str) -> ResultSource:
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


def _refuse_twice(sources: Iterable[ResultSource]) -> None:
    files: set[Path] = set()
    for source in sources:
        file = source.file.resolve()
        if file in files:
            raise InputError(f"{source.run.run or source.file} is given twice", "each result once")
        files.add(file)


def _nothing_yet(paths: Sequence[Path], missing: Sequence[MissingResult]) -> InputError:
    where = ", ".join(map(str, paths))
    if missing:
        first = missing[0]
        return InputError(
            f"none of the {len(missing)} cells of {where} has a result; {first.method} on {first.scene}: "
            f"{first.reason or 'not finished'}",
            "at least one",
        )
    return InputError(f"{where} holds no results", "at least one finished cell", "Wait, or run `coliags compare` again")
