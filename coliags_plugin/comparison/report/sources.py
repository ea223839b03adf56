"""Reading of what a report is made of; what makes results incomparable, and what merely limits their comparison."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from coliags_plugin.comparison.plan_file import (
    FAILURES,
    PLAN_FILE,
    RESULTS,
    ComparisonPlan,
    PlannedCell,
    read_plan,
)
from coliags_plugin.comparison.report.study import MissingResult, Study, StudyRun
from coliags_plugin.core.errors import InputError, check_name
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.provenance import held_out_uses
from coliags_plugin.reporting.model import leaves
from coliags_plugin.results.hashing import training_key
from coliags_plugin.results.reading import RESULT_FILE, read_result
from coliags_plugin.results.record import TRUTH_SUFFIX, Result

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
    """Tell whether a folder is that of a comparison, or holds its results alone."""
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
            f"Pass `protocol={min(protocols)}`",
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
    """Tell whether runs of one label are one method: one config on each scene and split, and one run per seed."""
    places = [(run.scene, run.result.scene.split) for run in runs]
    configs = {(place, _config_key(run)) for place, run in zip(places, runs, strict=True)}
    seeds = {(place, run.result.seed) for place, run in zip(places, runs, strict=True)}
    return len(configs) == len({*places}) and len(seeds) == len(runs)


def _config_key(run: StudyRun) -> str:
    return training_key(run.result.config, "", run.result.steps, "")


def refuse_incomparable(runs: Sequence[StudyRun]) -> None:
    """Refuse results that do not belong into one table."""
    first: dict[tuple[str, str], StudyRun] = {}
    for run in runs:
        one, two = runs[0].result.protocol, run.result.protocol
        if (one.name, one.version) != (two.name, two.version):
            raise InputError(
                f"{_title(runs[0])} was evaluated by protocol {one.name} version {one.version}, "
                f"{_title(run)} by {two.name} version {two.version}",
                "one protocol and version for every run: metrics of two protocols are not comparable",
                "Run `coliags eval` again on the older run",
            )
        _refuse_other_data(first.setdefault((run.scene, run.result.scene.split), run), run)
    _refuse_isolated(runs)


def _refuse_other_data(first: StudyRun, other: StudyRun) -> None:
    one, two = first.result, other.result
    both = f"{_title(first)} and {_title(other)}"
    if one.scene.size != two.scene.size:
        (w1, h1), (w2, h2) = one.scene.size, two.scene.size
        raise InputError(f"{both} are {w1} x {h1} and {w2} x {h2} px", "images of one size")
    for name in {**one.sets, **two.sets}:
        left, right = (result.sets[name].frames if name in result.sets else () for result in (one, two))
        if left != right:
            alone = ", ".join(sorted({*left} ^ {*right})[:2]) or "their order"
            raise InputError(
                f"{both} were evaluated on different frames (set '{name}' has {len(left)} and {len(right)} frames, "
                f"which differ in {alone})",
                "the same held-out frames for every run",
                "Evaluate both on the same data and split",
            )
    if one.scene.train != two.scene.train:
        raise InputError(
            f"{both} were trained on different frames ({len(one.scene.train)} and {len(two.scene.train)})",
            "the same training frames for every run",
            "Train both on the same split",
        )
    for name, part in one.sets.items():
        if part.truth_sha256 != two.sets[name].truth_sha256:
            raise InputError(
                f"{both}: their true images or depths of set '{name}' differ",
                "runs of the same data",
                "Train on one copy",
            )


def _refuse_isolated(runs: Sequence[StudyRun]) -> None:
    """Refuse a method that no other one can be compared with."""
    places: dict[str, set[tuple[str, str]]] = {}
    for run in runs:
        places.setdefault(run.method, set()).add((run.scene, run.result.scene.split))
    for method, own in places.items():
        others = {each for other, theirs in places.items() if other != method for each in theirs}
        if others and not own & others:
            one, two = (
                ", ".join(sorted(f"{scene} by split '{split}'" for scene, split in each)) for each in (own, others)
            )
            raise InputError(
                f"no scene and split in common: {method} has {one}, the other methods have {two}",
                "methods on the same scenes and splits",
                "Write one report for each scene, or train on the same split",
            )


def _title(run: StudyRun) -> str:
    return f"{run.method} on {run.scene} ({run.stamp})"


def cautions(study: Study) -> list[str]:
    """Differences between the results that limit their comparison, and scenes that methods lack."""
    results = [run.result for run in study.runs]
    texts = [*_missing_scenes(study), *_unpaired_seeds(study), *_codes(study)]
    steps = {method: sorted({run.result.steps for run in own}) for method, own in study.by_method.items()}
    if len({run.steps for run in results}) > 1:
        each = ", ".join(f"{method} {' or '.join(f'{count:,}' for count in own)}" for method, own in steps.items())
        texts.append(f"The runs were trained for different numbers of steps: {each}.")
    # How view modules treat held-out views (gains, pose corrections), if the methods differ in it.
    treated = {name: own[0].result.provenance.get("untrained_views") or {} for name, own in study.by_method.items()}
    if any(own != treated[study.methods[0]] for own in treated.values()):
        texts += [f"{method}, {name}: {what}." for method, own in treated.items() for name, what in own.items()]
    for run in study.runs:
        warnings = {name: part.transparency_warning for name, part in run.result.sets.items()}
        texts += [f"{run.method} on {run.scene}, set {name}: {text}." for name, text in warnings.items() if text]
    uses = {
        f"{run.scene}, split {run.result.scene.split}: {use}.": None
        for run in study.runs
        for use in held_out_uses(run.result.provenance.get("held_out_used", {}))
    }
    texts += uses
    sizes = dict.fromkeys(result.scene.size for result in results)
    if len(sizes) > 1:
        each = ", ".join(f"{width} x {height}" for width, height in sizes)
        texts.append(f"The scenes have images of different sizes: {each} px.")
    differing: dict[str, None] = {}
    for scene in study.scenes:
        data = [dict(leaves(scene_provenance(result))) for result in results if result.scene.name == scene]
        keys = (key for one in data for key in one)
        differing |= {key: None for key in keys if any(one.get(key) != data[0].get(key) for one in data)}
    if differing:
        texts.append(f"Runs of one scene record different data, see Provenance: {', '.join(differing)}.")
    return texts


def _missing_scenes(study: Study) -> list[str]:
    places = dict.fromkeys((run.scene, run.result.scene.split) for run in study.runs)
    texts = []
    for method, runs in study.by_method.items():
        own = {(run.scene, run.result.scene.split) for run in runs}
        lacking = dict.fromkeys(scene for scene, split in places if (scene, split) not in own)
        if lacking:
            texts.append(
                f"{method} has no result of {', '.join(lacking)}: means and tests are over the scenes that the "
                "compared methods have in common."
            )
    return texts


def _unpaired_seeds(study: Study) -> list[str]:
    seeds: dict[tuple[str, str], dict[str, set[int]]] = {}
    for run in study.runs:
        by_method = seeds.setdefault((run.scene, run.result.scene.split), {})
        by_method.setdefault(run.method, set()).add(run.result.seed)
    differing = []
    for (scene, _), methods in seeds.items():
        if len({frozenset(own) for own in methods.values()}) > 1:
            each = "; ".join(f"{method}: {', '.join(map(str, sorted(own)))}" for method, own in methods.items())
            differing.append(f"{scene} ({each})")
    if not differing:
        return []
    more = f" and {len(differing) - 1} more" if len(differing) > 1 else ""
    return [
        f"The methods were trained with different seeds on {differing[0]}{more}; a mean over more seeds varies less."
    ]


def _codes(study: Study) -> list[str]:
    """Caution that results come from different code, if they do."""
    by_code: dict[str, list[StudyRun]] = {}
    for run in study.runs:
        by_code.setdefault(code_of(run.result), []).append(run)
    texts = []
    for code, runs in by_code.items():
        counts = {
            method: (count, len(study.by_method[method]))
            for method, count in Counter(run.method for run in runs).items()
        }
        own = [
            method if count == total else f"{method} ({count} of {total})" for method, (count, total) in counts.items()
        ]
        commits = dict.fromkeys(str(run.result.software["git"]) for run in runs if run.result.software.get("git"))
        commit = f" (commit {', '.join(commits)})" if commits else ""
        texts.append(f"{code}{commit}: {', '.join(own)}")
    return [f"The results come from different code: {'; '.join(texts)}."] if len(texts) > 1 else []


def code_of(result: Result) -> str:
    """Key of the code that trained and evaluated."""
    training, evaluated = result.provenance.get("training", {}), str(result.software.get("code"))
    codes = [training.get("code", evaluated), *(change["code"] for change in training.get("code_changes", []))]
    trained = ", then ".join(dict.fromkeys(map(str, codes)))
    return evaluated if trained == evaluated else f"{trained}, evaluated by {evaluated}"


def scene_provenance(result: Result) -> dict[str, Any]:
    """Record of a result's data."""
    recorded = result.provenance.get("scene")
    return {"fingerprint": result.scene.fingerprint, **(recorded if isinstance(recorded, Mapping) else {})}
