"""What makes results incomparable, and what merely limits their comparison."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from coliags_plugin.comparison.report.study import Study, StudyRun
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import held_out_uses
from coliags_plugin.reporting.model import leaves
from coliags_plugin.results.record import Result


def refuse_incomparable(runs: Sequence[StudyRun]) -> None:
    """Refuse results that do not belong into one table."""
    first: dict[tuple[str, str], StudyRun] = {}
    for run in runs:
        _refuse_protocols(runs[0], run)
        scene = run.result.scene
        _refuse_scenes(first.setdefault((scene.name, scene.split), run), run)
    _refuse_isolated(runs)


def _refuse_protocols(first: StudyRun, other: StudyRun) -> None:
    one, two = first.result.protocol, other.result.protocol
    if (one.name, one.version) != (two.name, two.version):
        raise InputError(
            f"{_title(first)} was evaluated by protocol {one.name} version {one.version}, "
            f"{_title(other)} by {two.name} version {two.version}",
            "one protocol and version for every run: metrics of two protocols are not comparable",
            "Run `coliags eval` again on the older run",
        )


def _refuse_scenes(first: StudyRun, other: StudyRun) -> None:
    one, two = first.result, other.result
    both = f"{_title(first)} and {_title(other)}"
    if one.scene.size != two.scene.size:
        (w1, h1), (w2, h2) = one.scene.size, two.scene.size
        raise InputError(f"{both} are {w1} x {h1} and {w2} x {h2} px", "images of one size")
    frames = [{name: part.frames for name, part in result.sets.items()} for result in (one, two)]
    if frames[0] != frames[1]:
        raise InputError(
            f"{both} were evaluated on different frames ({_first_difference(*frames)})",
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
    scenes: dict[str, set[tuple[str, str]]] = {}
    for run in runs:
        scenes.setdefault(run.method, set()).add((run.result.scene.name, run.result.scene.split))
    for method, own in scenes.items():
        others = {each for other, theirs in scenes.items() if other != method for each in theirs}
        if not others or own & others:
            continue
        if {scene for scene, _ in own} & {scene for scene, _ in others}:
            one, two = ("', '".join(sorted({split for _, split in each})) for each in (own, others))
            raise InputError(
                f"{method} was trained on split '{one}', the other methods on split '{two}'",
                "one split for every method",
                "Train on the same split",
            )
        one, two = (", ".join(sorted({scene for scene, _ in each})) for each in (own, others))
        raise InputError(
            f"no scene in common: {method} has {one}, the other methods have {two}",
            "methods on the same scenes",
            "Write one report for each scene",
        )


def _title(run: StudyRun) -> str:
    return f"{run.method} on {run.scene} ({run.stamp})"


def _first_difference(one: Mapping[str, Sequence[str]], two: Mapping[str, Sequence[str]]) -> str:
    name = next(name for name in [*one, *two] if one.get(name) != two.get(name))
    if name not in one or name not in two:
        return f"set '{name}' is in one of them only"
    if len(one[name]) != len(two[name]):
        return f"set '{name}' has {len(one[name])} and {len(two[name])} frames"
    left, right = next(pair for pair in zip(one[name], two[name], strict=True) if pair[0] != pair[1])
    return f"set '{name}' has '{left}' in one where the other has '{right}'"


def cautions(study: Study) -> list[str]:
    """Differences between the results that limit their comparison, and scenes that methods lack."""
    results = [run.result for run in study.runs]
    texts = [
        *_missing_scenes(study),
        *_unpaired_seeds(study),
        *_codes(study),
        *_steps(study),
        *_untrained_views(study),
        *_transparent(study),
        *_held_out_used(study),
    ]
    sizes = dict.fromkeys(result.scene.size for result in results)
    if len(sizes) > 1:
        each = ", ".join(f"{width} x {height}" for width, height in sizes)
        texts.append(f"The scenes have images of different sizes: {each} px.")
    differing = [
        key for scene in study.scenes for key in _differing_data([r for r in results if r.scene.name == scene])
    ]
    if differing:
        texts.append(f"Runs of one scene record different data, see Provenance: {', '.join(dict.fromkeys(differing))}.")
    return texts


def _missing_scenes(study: Study) -> list[str]:
    missing = []
    for split in dict.fromkeys(part.split for part in study.parts):
        parts = [part for part in study.parts if part.split == split]
        scenes = list(dict.fromkeys(scene for part in parts for scene in part.scenes))
        for method in study.methods:
            lacking = [scene for scene in scenes if not any(part.runs(scene, method) for part in parts)]
            if lacking:
                missing.append(
                    f"{method} has no result of {', '.join(lacking)}: means and tests are over the scenes that the "
                    "compared methods have in common."
                )
    return missing


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
    first = differing[0]
    return [f"The methods were trained with different seeds on {first}{more}; a mean over more seeds varies less."]


def _codes(study: Study) -> list[str]:
    """Which results come from which code, if not all are of one."""
    by_code: dict[str, list[StudyRun]] = {}
    for run in study.runs:
        by_code.setdefault(code_of(run.result), []).append(run)
    if len(by_code) < 2:
        return []
    texts = []
    for code, runs in by_code.items():
        counts = Counter(run.method for run in runs)
        own = [
            method if count == len(study.by_method[method]) else f"{method} ({count} of {len(study.by_method[method])})"
            for method, count in counts.items()
        ]
        commits = dict.fromkeys(str(run.result.software["git"]) for run in runs if run.result.software.get("git"))
        commit = f" (commit {', '.join(commits)})" if commits else ""
        texts.append(f"{code}{commit}: {', '.join(own)}")
    return [f"The results come from different code: {'; '.join(texts)}."]


def code_of(result: Result) -> str:
    """Key of the code that trained and evaluated."""
    training, evaluated = result.provenance.get("training", {}), str(result.software.get("code"))
    codes = [training.get("code", evaluated), *(change["code"] for change in training.get("code_changes", []))]
    trained = ", then ".join(dict.fromkeys(map(str, codes)))
    return evaluated if trained == evaluated else f"{trained}, evaluated by {evaluated}"


def _steps(study: Study) -> list[str]:
    steps = {method: sorted({run.result.steps for run in own}) for method, own in study.by_method.items()}
    if len({tuple(own) for own in steps.values()}) == 1 and all(len(own) == 1 for own in steps.values()):
        return []
    each = ", ".join(f"{method} {' or '.join(f'{count:,}' for count in own)}" for method, own in steps.items())
    return [f"The runs were trained for different numbers of steps: {each}."]


def _untrained_views(study: Study) -> list[str]:
    """Cautions on how view modules treat held-out views (gains, pose corrections), if the methods differ in it."""
    by_method = {method: runs[0].result.provenance.get("untrained_views") for method, runs in study.by_method.items()}
    treated = {method: dict(own) if isinstance(own, Mapping) else {} for method, own in by_method.items()}
    if all(own == treated[study.methods[0]] for own in treated.values()):
        return []
    return [f"{method}, {name}: {what}." for method, own in treated.items() for name, what in own.items()]


def _transparent(study: Study) -> list[str]:
    return [
        f"{run.method} on {run.scene}, set {name}: {part.transparency_warning}."
        for run in study.runs
        for name, part in run.result.sets.items()
        if part.transparency_warning
    ]


def _held_out_used(study: Study) -> list[str]:
    texts = [
        f"{run.scene}, split {run.result.scene.split}: {use}."
        for run in study.runs
        for use in held_out_uses(run.result.provenance.get("held_out_used", {}))
    ]
    return list(dict.fromkeys(texts))


def _differing_data(results: Sequence[Result]) -> list[str]:
    data = [dict(leaves(scene_provenance(result))) for result in results]
    keys = dict.fromkeys(key for one in data for key in one)
    return [key for key in keys if any(one.get(key) != data[0].get(key) for one in data)]


def scene_provenance(result: Result) -> dict[str, Any]:
    """What is recorded of a result's data."""
    recorded = result.provenance.get("scene")
    return {"fingerprint": result.scene.fingerprint, **(recorded if isinstance(recorded, Mapping) else {})}
