"""Reading of what a report is made of: run folders, results files, and folders of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from coliags_plugin.comparison.plan_file import (
    FAILURES,
    PLAN_FILE,
    RESULTS,
    ComparisonPlan,
    PlannedCell,
    read_plan,
)
from coliags_plugin.comparison.report.comparability import refuse_incomparable
from coliags_plugin.comparison.report.study import MissingResult, Study, StudyRun
from coliags_plugin.core.errors import InputError, check_name
from coliags_plugin.core.json_files import read_json
from coliags_plugin.results.hashing import training_key
from coliags_plugin.results.reading import RESULT_FILE, read_result
from coliags_plugin.results.record import TRUTH_SUFFIX

#: Below results and failures: scene, method, and seed with key.
_CELL = "*/*/s*-*.json"


def read_study(paths: Sequence[Path], protocol: str = "paper", methods: Sequence[str] = ()) -> Study:
    """Read run folders, results files and folders of a comparison, and check that the results are comparable.

    Of folders, the evaluation by a protocol is read. Methods, where named, are shown alone, in that order; the others
    stay in the family that p-values are adjusted for.
    """
    if not paths:
        raise InputError("no results", "run folders, results files or the folder of a comparison", "Name at least one")
    runs: list[StudyRun] = []
    missing: list[MissingResult] = []
    plans: list[ComparisonPlan] = []
    for path in paths:
        if not path.is_dir():
            runs.append(_read_file(path, path.stem))
        elif _is_comparison(path):
            plan = read_plan(path)
            results, failed = _read_comparison(path, plan, protocol)
            plans += [] if plan is None else [plan]
            runs += results
            missing += failed
        else:
            runs.append(_read_run(path, protocol))
    files = [run.file.resolve() for run in runs]
    for number, run in enumerate(runs):
        if files[number] in files[:number]:
            raise InputError(f"{run.run or run.file} is given twice", "each result once")
    if not runs:
        raise _nothing_yet(paths, missing)
    runs = disambiguate_labels(runs)
    family = dict.fromkeys([*(run.method for run in runs), *(cell.method for plan in plans for cell in plan.cells)])
    decisions = {plan.decided for plan in plans}
    if methods:
        for name in methods:
            known = dict.fromkeys([*(run.method for run in runs), *(one.method for one in missing)])
            check_name("method", name, known)
        runs = [run for name in dict.fromkeys(methods) for run in runs if name == run.method]
        missing = [one for one in missing if one.method in methods]
    refuse_incomparable(runs)
    return Study(tuple(runs), tuple(missing), tuple(family), decisions.pop() if len(decisions) == 1 else None)


def _read_run(folder: Path, protocol: str) -> StudyRun:
    file = folder / "eval" / protocol / RESULT_FILE
    if file.is_file():
        return _read_file(file, folder.resolve().name, folder)
    name = protocol.removesuffix(TRUTH_SUFFIX)
    truth = "" if name == protocol else " --truth SCENE"
    if not (folder / "eval").is_dir() and not (folder / "config.yaml").is_file():
        raise InputError(
            f"{folder} holds no results",
            "a run folder, a results file, or the folder of a comparison",
            "Check the path",
        )
    raise InputError(
        f"{folder} has no evaluation by protocol '{protocol}' ({file.relative_to(folder)} is missing)",
        "one",
        f"Run `coliags eval {folder} --protocol {name}{truth}` first",
    )


def _read_file(file: Path, stamp: str, run: Path | None = None) -> StudyRun:
    """A results file under the name of its method."""
    result = read_result(file)
    return StudyRun(result.method, result, file, stamp, run)


def _is_comparison(folder: Path) -> bool:
    """Whether a folder is that of a comparison, or holds its results alone."""
    return (folder / PLAN_FILE).is_file() or (folder / RESULTS).is_dir() or any(folder.glob(_CELL))


def _read_comparison(
    folder: Path, plan: ComparisonPlan | None, protocol: str
) -> tuple[list[StudyRun], list[MissingResult]]:
    """Results and failures of one protocol: those of the plan, in its order; without a plan, all results."""
    if plan is None:
        every = [_read_file(file, file.stem) for file in sorted([*folder.glob(_CELL), *(folder / RESULTS).glob(_CELL)])]
        found, missing = [one for one in every if one.result.protocol.name == protocol], list[MissingResult]()
        protocols = {one.result.protocol.name for one in every}
    else:
        found, missing = _read_planned(folder, [cell for cell in plan.cells if cell.protocol == protocol])
        protocols = {cell.protocol for cell in plan.cells}
    if protocols and protocol not in protocols:
        raise InputError(
            f"{folder} has results of protocol {', '.join(sorted(protocols))} only",
            f"some of '{protocol}'",
            f"Pass --protocol {min(protocols)}",
        )
    return found, missing


def _read_planned(folder: Path, cells: Sequence[PlannedCell]) -> tuple[list[StudyRun], list[MissingResult]]:
    found, missing = list[StudyRun](), list[MissingResult]()
    runs: dict[str, Path] = {}  # by key: what is the same as another method under a second name has no run of its own
    for cell in cells:
        file, failure = folder / cell.result, folder / FAILURES / Path(cell.result).relative_to(RESULTS)
        if file.is_file():
            one = replace(_read_file(file, file.stem), method=cell.method)
            if (folder / cell.run / "eval" / cell.protocol / "renders").is_dir():
                runs[one.result.key] = folder / cell.run
            found.append(one)
        else:
            record = read_json(failure, "the reason of a failure") if failure.is_file() else None
            told = record.get("reason") if isinstance(record, dict) else None
            reason = str(told or "no reason was recorded") if failure.is_file() else None
            missing.append(MissingResult(cell.scene, cell.method, cell.seed, reason))
    return [replace(one, run=runs.get(one.result.key)) for one in found], missing


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


def disambiguate_labels(runs: Sequence[StudyRun]) -> list[StudyRun]:
    """The runs with labels under which every method has one config and one run per scene, split and seed.

    Runs of one config that differ in seed share a label. Where a method has several configs or several runs of one
    seed, its label is followed by what tells them apart: steps, the stamp of the run, or a hash of the config.
    """
    labels: dict[Path, str] = {}
    for name in dict.fromkeys(run.method for run in runs):
        group = [run for run in runs if name == run.method]
        steps, stamps = [f"{run.result.steps:,} steps" for run in group], [run.stamp for run in group]
        configs = [f"config {_config_key(run)[:8]}" for run in group]
        numbered = [f"{stamp} ({index})" for index, stamp in enumerate(stamps, 1)]
        one_scene = len({run.scene for run in group}) == 1
        for suffixes in ([""] * len(group), steps, *((stamps, configs) if one_scene else (configs, stamps)), numbered):
            same = [[run for run, own in zip(group, suffixes, strict=True) if own == each] for each in {*suffixes}]
            if all(map(_is_one_method, same)):
                break
        labels |= {run.file: f"{name} · {own}" if own else name for run, own in zip(group, suffixes, strict=True)}
    return [replace(run, method=labels[run.file]) for run in runs]


def _is_one_method(runs: Sequence[StudyRun]) -> bool:
    """Whether runs of one label are one method: one config on each scene and split, and one run per seed."""
    places = [(run.scene, run.result.scene.split) for run in runs]
    configs = {(place, _config_key(run)) for place, run in zip(places, runs, strict=True)}
    seeds = {(place, run.result.seed) for place, run in zip(places, runs, strict=True)}
    return len(configs) == len({*places}) and len(seeds) == len(runs)


def _config_key(run: StudyRun) -> str:
    return training_key(run.result.config, "", run.result.steps, "")
