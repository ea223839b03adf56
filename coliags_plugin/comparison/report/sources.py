"""Reading of what a report is made of: run folders, results files, and folders of a comparison."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from coliags_plugin.comparison.plan_file import FAILURES, PLAN_FILE, RESULTS, ComparisonPlan, read_plan
from coliags_plugin.comparison.report.comparability import refuse_incomparable
from coliags_plugin.comparison.report.study import MissingResult, Study, StudyRun
from coliags_plugin.core.errors import InputError, check_name
from coliags_plugin.core.json_files import read_json
from coliags_plugin.results.hashing import training_config
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
    _refuse_twice(runs)
    if not runs:
        raise _nothing_yet(paths, missing)
    runs = disambiguate_labels(runs)
    family = dict.fromkeys(run.method for run in runs)
    family |= dict.fromkeys([*(cell.method for plan in plans for cell in plan.cells), *(one.method for one in missing)])
    decisions = {plan.decided for plan in plans}
    shown, missing = _only(methods, runs, missing) if methods else (runs, missing)
    refuse_incomparable(shown)
    return Study(tuple(shown), tuple(missing), tuple(family), decisions.pop() if len(decisions) == 1 else None)


def _only(
    methods: Sequence[str], runs: Sequence[StudyRun], missing: Sequence[MissingResult]
) -> tuple[list[StudyRun], list[MissingResult]]:
    """Results and failures of some methods, in their order."""
    known = list(dict.fromkeys([run.method for run in runs] + [one.method for one in missing]))
    for name in methods:
        check_name("method", name, known)
    kept = [run for name in dict.fromkeys(methods) for run in runs if name == run.method]
    return kept, [one for one in missing if one.method in methods]


def _read_run(folder: Path, protocol: str) -> StudyRun:
    evaluation = folder / "eval" / protocol
    file = evaluation / RESULT_FILE
    if file.is_file():
        return _read_file(file, folder.resolve().name, folder)
    name = protocol.removesuffix(TRUTH_SUFFIX)
    truth = "" if name == protocol else " --truth SCENE"
    do = f"Run `coliags eval {folder} --protocol {name}{truth}`"
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
    if plan is not None:
        return _read_planned(folder, plan, protocol)
    found = [_read_file(file, file.stem) for file in sorted([*folder.glob(_CELL), *(folder / RESULTS).glob(_CELL)])]
    _refuse_other_protocols(folder, protocol, {one.result.protocol.name for one in found})
    return [one for one in found if one.result.protocol.name == protocol], []


def _read_planned(folder: Path, plan: ComparisonPlan, protocol: str) -> tuple[list[StudyRun], list[MissingResult]]:
    found, missing = [], []
    runs: dict[str, Path] = {}  # by key: what is the same as another method under a second name has no run of its own
    for entry in (entry for entry in plan.cells if entry.protocol == protocol):
        file = folder / entry.result
        if file.is_file():
            own = _with_images(folder / entry.run, protocol)
            one = replace(_read_file(file, file.stem, own), method=entry.method)
            if own is not None:
                runs[one.result.key] = own
            found.append(one)
        else:
            failure = folder / FAILURES / Path(entry.result).relative_to(RESULTS)
            reason = _failure_reason(failure) if failure.is_file() else None
            missing.append(MissingResult(entry.scene, entry.method, entry.seed, reason))
    _refuse_other_protocols(folder, protocol, {entry.protocol for entry in plan.cells})
    return [replace(one, run=one.run or runs.get(one.result.key)) for one in found], missing


def _refuse_other_protocols(folder: Path, protocol: str, protocols: set[str]) -> None:
    if protocols and protocol not in protocols:
        raise InputError(
            f"{folder} has results of protocol {', '.join(sorted(protocols))} only",
            f"some of '{protocol}'",
            f"Pass --protocol {min(protocols)}",
        )


def _with_images(run: Path, protocol: str) -> Path | None:
    """The run, if it still has the images of its evaluation."""
    return run if (run / "eval" / protocol / "renders").is_dir() else None


def _failure_reason(file: Path) -> str:
    record = read_json(file, "the reason of a failure")
    reason = record.get("reason") if isinstance(record, dict) else None
    return str(reason or "no reason was recorded")


def _refuse_twice(runs: Iterable[StudyRun]) -> None:
    files: set[Path] = set()
    for one in runs:
        file = one.file.resolve()
        if file in files:
            raise InputError(f"{one.run or one.file} is given twice", "each result once")
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


def disambiguate_labels(runs: Sequence[StudyRun]) -> list[StudyRun]:
    """The runs with labels under which every method has one config and one run per scene, split and seed.

    Runs of one config that differ in seed share a label. Where a method has several configs or several runs of one
    seed, its label is followed by what tells them apart: steps, the stamp of the run, or a hash of the config.
    """
    groups: dict[str, list[int]] = {}
    for index, run in enumerate(runs):
        groups.setdefault(run.method, []).append(index)
    labelled = list(runs)
    for own in groups.values():
        group = [runs[index] for index in own]
        if not _is_one_method(group):
            for index, label in zip(own, _distinct_labels(group), strict=True):
                labelled[index] = replace(labelled[index], method=label)
    return labelled


def _is_one_method(runs: Sequence[StudyRun]) -> bool:
    """Whether runs of one label are one method: one config on each scene and split, and one run per seed."""
    configs: dict[tuple[str, str], str] = {}
    seeds = set()
    for run in runs:
        scene = run.result.scene
        key, config = (scene.name, scene.split), _config_hash(run)
        if configs.setdefault(key, config) != config or (key, run.result.seed) in seeds:
            return False
        seeds.add((key, run.result.seed))
    return True


def _distinct_labels(runs: Sequence[StudyRun]) -> list[str]:
    one_scene = len({run.scene for run in runs}) == 1
    steps, stamps = [f"{run.result.steps:,} steps" for run in runs], [run.stamp for run in runs]
    configs = [f"config {_config_hash(run)[:8]}" for run in runs]
    for suffixes in (steps, stamps, configs) if one_scene else (steps, configs, stamps):
        labels = [f"{run.method} · {suffix}" for run, suffix in zip(runs, suffixes, strict=True)]
        groups = ([run for run, own in zip(runs, labels, strict=True) if own == label] for label in set(labels))
        if all(map(_is_one_method, groups)):
            return labels
    labels = [f"{run.method} · {run.stamp}" for run in runs]
    return [
        f"{label} ({labels[: index + 1].count(label)})" if labels.count(label) > 1 else label
        for index, label in enumerate(labels)
    ]


def _config_hash(run: StudyRun) -> str:
    text = json.dumps([training_config(run.result.config), run.result.steps], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
