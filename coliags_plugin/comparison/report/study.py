"""Results of methods on scenes that a report compares: their reading, what makes them incomparable, and cautions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from coliags_plugin.comparison.plan import ComparisonPlan, Decision, read_plan
from coliags_plugin.core.errors import InputError, check_name
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.provenance import held_out_uses
from coliags_plugin.reporting.model import leaves
from coliags_plugin.reporting.numbers import counted
from coliags_plugin.results.comparisons import BySeed
from coliags_plugin.results.hashing import training_key
from coliags_plugin.results.reading import RESULT_FILE, read_result
from coliags_plugin.results.record import MAIN_SET, SEEN_SUFFIX, TRUTH_SUFFIX, MetricRecord, Result, SetRecord

_SET_TITLES = {"test": "held out along the path", "rotation": "beyond the path"}

_Item = TypeVar("_Item")
_Key = TypeVar("_Key")


def grouped(items: Iterable[_Item], key: Callable[[_Item], _Key]) -> dict[_Key, list[_Item]]:
    """Items by a key, in order of first appearance."""
    groups: dict[_Key, list[_Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


@dataclass(frozen=True)
class StudyRun:
    """One evaluated run."""

    method: str  # name in the report, see disambiguate_labels
    result: Result
    file: Path  # its results file
    stamp: str  # name of its run folder or results file
    run: Path | None = None  # folder with the images of this evaluation; None: only the results file is there

    @property
    def scene(self) -> str:
        """Name of its scene."""
        return self.result.scene.name

    @property
    def place(self) -> tuple[str, str]:
        """Scene and split."""
        return self.scene, self.result.scene.split

    @property
    def data(self) -> dict[str, Any]:
        """Record of its data."""
        recorded = self.result.provenance.get("scene")
        fingerprint = self.result.scene.fingerprint
        return {"fingerprint": fingerprint, **(recorded if isinstance(recorded, Mapping) else {})}

    @property
    def code(self) -> str:
        """Keys of the code that trained and evaluated it."""
        training, evaluated = self.result.provenance.get("training", {}), str(self.result.software.get("code"))
        codes = [training.get("code", evaluated), *(change["code"] for change in training.get("code_changes", []))]
        trained = ", then ".join(dict.fromkeys(map(str, codes)))
        return evaluated if trained == evaluated else f"{trained}, evaluated by {evaluated}"

    @property
    def title(self) -> str:
        """Method, scene and stamp, for messages."""
        return f"{self.method} on {self.scene} ({self.stamp})"

    @property
    def evaluation(self) -> Path | None:
        """Folder of its images."""
        return None if self.run is None else self.run / "eval" / self.result.evaluation_name


@dataclass(frozen=True)
class MissingResult:
    """A cell of a comparison that has no result, and why; None where it has not been finished yet."""

    scene: str
    method: str
    seed: int
    reason: str | None


@dataclass(frozen=True)
class TestSet:
    """One test set under one split: what one table is about."""

    split: str
    set_name: str
    study: Study = field(compare=False, repr=False)

    @property
    def title(self) -> str:
        """Title of the test set, with its split where the study has several."""
        place = _SET_TITLES.get(self.set_name)
        title = f"{self.set_name}: {place}" if place else self.set_name
        return f"{title}, split {self.split}" if self.study.several_splits else title

    @property
    def name(self) -> str:
        """Short name, for identifiers."""
        return f"{self.set_name}-{self.split}" if self.study.several_splits else self.set_name

    @cached_property
    def records(self) -> list[tuple[StudyRun, SetRecord]]:
        """Runs that were evaluated on the set, with its record, in the order given."""
        runs = [run for run in self.study.runs if run.result.scene.split == self.split]
        return [(run, run.result.sets[self.set_name]) for run in runs if self.set_name in run.result.sets]

    @property
    def scenes(self) -> list[str]:
        """Scenes with a result, in the order given."""
        return list(dict.fromkeys(run.scene for run, _ in self.records))

    def evaluated(self, method: str, scene: str | None = None) -> list[tuple[StudyRun, SetRecord]]:
        """Runs of a method with their records, by seed; of one scene, or all."""
        evaluated = grouped(self.records, lambda each: each[0].method).get(method, [])
        by_seed = sorted(evaluated, key=lambda each: each[0].result.seed)
        return [each for each in by_seed if scene in (None, each[0].scene)]

    def frames(self, scene: str) -> Sequence[str]:
        """Names of a scene's frames, the same for every method."""
        return next((record.frames for run, record in self.records if run.scene == scene), ())

    def values(self, metric: str) -> dict[str, BySeed]:
        """Means over the frames, by method, scene and seed; empty where a method has none."""
        values: dict[str, dict[str, dict[int, float]]] = {method: {} for method in self.study.methods}
        for run, record in self.records:
            if (mean := record.mean(metric)) is not None:
                values[run.method].setdefault(run.scene, {})[run.result.seed] = mean
        return dict(values)

    def has(self, metric: str) -> bool:
        """Tell whether any result has a value of a metric."""
        return any(self.values(metric).values())

    def frame_means(self, scene: str, method: str, metric: str) -> dict[str, float]:
        """Metric of every frame of a scene that has it, mean over the seeds that have it."""
        by_frame: dict[str, list[float]] = {}
        for _, record in self.evaluated(method, scene):
            for frame, value in zip(record.frames, record.values.get(metric, ()), strict=False):
                if value is not None:
                    by_frame.setdefault(frame, []).append(value)
        return {frame: sum(values) / len(values) for frame, values in by_frame.items()}

    def reason(self, method: str, metric: str, scene: str | None = None) -> str:
        """Reason why a metric is unavailable, as the first result without it says, but for what to do about it."""
        records = [record for _, record in self.evaluated(method, scene)]
        names = (metric, metric.removesuffix(SEEN_SUFFIX))
        reasons = (record.reasons.get(name) for record in records for name in names)
        reason = next(filter(None, reasons), "no reason was recorded" if records else "no result")
        return reason.partition(". ")[0]


@dataclass(frozen=True)
class Study:
    """Comparable results; see :func:`refuse_incomparable`."""

    runs: tuple[StudyRun, ...]  # at least one
    missing: tuple[MissingResult, ...] = ()  # cells without a result
    family: tuple[str, ...] = ()  # all methods that were planned or given, shown or not
    decided: Decision | None = None  # before the first result

    @cached_property
    def by_method(self) -> dict[str, list[StudyRun]]:
        """Results of every method, in the order given."""
        return grouped(self.runs, lambda run: run.method)

    @property
    def methods(self) -> list[str]:
        """Methods with a result, in the order given."""
        return [*self.by_method]

    @property
    def scenes(self) -> list[str]:
        """Scenes with a result, in the order given."""
        return list(dict.fromkeys(run.scene for run in self.runs))

    @cached_property
    def test_sets(self) -> list[TestSet]:
        """Every split and test set; the split's own set first."""
        sets = dict.fromkeys(TestSet(run.place[1], name, self) for run in self.runs for name in run.result.sets)
        splits = list(dict.fromkeys(each.split for each in sets))
        return sorted(sets, key=lambda each: (splits.index(each.split), each.set_name != MAIN_SET))

    @property
    def several_splits(self) -> bool:
        """Tell whether results are of different splits."""
        return len({run.place[1] for run in self.runs}) > 1

    @cached_property
    def metrics(self) -> dict[str, MetricRecord]:
        """Every metric, in the protocol's order, each followed by the same over the seen pixels."""
        metrics: dict[str, MetricRecord] = {}
        for run in self.runs:
            metrics |= {name: metric for name, metric in run.result.metrics.items() if name not in metrics}
        bases = dict.fromkeys(name.removesuffix(SEEN_SUFFIX) for name in metrics)
        return {name: metrics[name] for base in bases for name in (base, base + SEEN_SUFFIX) if name in metrics}

    def rivals(self, reference: str) -> int:
        """Number of rivals that p-values are adjusted for: all methods that were planned or given."""
        return len({*self.family, *self.methods} - {reference})

    def is_decided(self, reference: str, metric: str) -> bool:
        """Tell whether a reference and a metric were decided before the first run: only then do leads have stars."""
        return self.decided is not None and self.decided.reference == reference and metric in self.decided.primary

    @property
    def length_unit(self) -> str:
        """Unit of lengths, as printed: that of the metrics that are lengths."""
        return "units" if any(metric.unit.startswith("units") for metric in self.metrics.values()) else "mm"


# Reading


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
            is_in_run = path.match(f"eval/*/{RESULT_FILE}") and (path.parent / "renders").is_dir()
            run = path.parents[2] if is_in_run else None
            runs.append(_read_file(path, path.stem if run is None else run.resolve().name, run))
        elif (plan := read_plan(path)) is not None:
            plans.append(plan)
            runs += _read_comparison(path, plan, protocol, missing)
        else:
            runs.append(_read_run(path, protocol))
    for same in grouped(runs, lambda run: run.file.resolve()).values():
        if len(same) > 1:
            raise InputError(f"{same[0].run or same[0].file} is given twice", "each result once")
    if not runs:
        problem = f"{', '.join(map(str, paths))} holds no results"
        if missing:
            problem += f" of {len(missing)} cells; {missing[0].method} on {missing[0].scene}: "
            problem += missing[0].reason or "not finished"
        raise InputError(problem, "at least one finished cell", "Wait, or run `coliags compare` again")
    runs = disambiguate_labels(runs)
    family = dict.fromkeys([*(run.method for run in runs), *(cell.method for plan in plans for cell in plan.cells)])
    decisions = {plan.decided for plan in plans}
    if methods:
        evaluated = dict.fromkeys([*(run.method for run in runs), *(cell.method for cell in missing)])
        for name in methods:
            check_name("method", name, evaluated)
        runs = [run for name in dict.fromkeys(methods) for run in runs if name == run.method]
        missing = [each for each in missing if each.method in methods]
    refuse_incomparable(runs)
    return Study(tuple(runs), tuple(missing), tuple(family), decisions.pop() if len(decisions) == 1 else None)


def _read_run(folder: Path, protocol: str) -> StudyRun:
    file = folder / "eval" / protocol / RESULT_FILE
    if file.is_file():
        return _read_file(file, folder.resolve().name, folder)
    if not (folder / "eval").is_dir() and not (folder / "config.yaml").is_file():
        raise InputError(f"{folder} holds no results", "a run folder, a results file, or the folder of a comparison")
    name = protocol.removesuffix(TRUTH_SUFFIX)
    truth = "" if name == protocol else " --truth SCENE"
    raise InputError(
        f"{folder} has no evaluation by protocol '{protocol}' ({file.relative_to(folder)} is missing)",
        "one",
        f"Run `coliags eval {folder} --protocol {name}{truth}` first",
    )


def _read_file(file: Path, stamp: str, run: Path | None = None) -> StudyRun:
    result = read_result(file)
    return StudyRun(result.method, result, file, stamp, run)


def _read_comparison(folder: Path, plan: ComparisonPlan, protocol: str, missing: list[MissingResult]) -> list[StudyRun]:
    """Results of one protocol, in the plan's order; appends the cells without one."""
    cells = [cell for cell in plan.cells if cell.protocol == protocol]
    protocols = {cell.protocol for cell in plan.cells}
    if protocols and not cells:
        raise InputError(
            f"{folder} has results of protocol {', '.join(sorted(protocols))} only",
            f"some of '{protocol}'",
            f"Pass `protocol={min(protocols)}`",
        )
    runs: list[StudyRun] = []
    folders: dict[str, Path] = {}  # by key: a method that is the same as another one has no run of its own
    for cell in cells:
        file, failure = folder / cell.result, folder / cell.failure_file
        if file.is_file():
            runs.append(replace(_read_file(file, file.stem), method=cell.method))
            if (folder / cell.run / "eval" / protocol / "renders").is_dir():
                folders[runs[-1].result.key] = folder / cell.run
        else:
            reason = None
            if failure.is_file():
                record = read_json(failure, "the reason of a failure")
                reason = str((isinstance(record, dict) and record.get("reason")) or "no reason was recorded")
            missing.append(MissingResult(cell.scene, cell.method, cell.seed, reason))
    return [replace(run, run=folders.get(run.result.key)) for run in runs]


def disambiguate_labels(runs: Sequence[StudyRun]) -> list[StudyRun]:
    """The runs with labels under which every method has one config and one run per scene, split and seed.

    Runs of one config that differ in seed share a label. Where a method has several configs or several runs of one
    seed, its label is followed by what tells them apart: steps, the stamp of the run, or a hash of the config.
    """
    labels: dict[Path, str] = {}
    for name, group in grouped(runs, lambda run: run.method).items():
        steps, stamps = [f"{run.result.steps:,} steps" for run in group], [run.stamp for run in group]
        configs = [f"config {_config_key(run)[:8]}" for run in group]
        numbered = [f"{stamp} ({index})" for index, stamp in enumerate(stamps, 1)]
        order = (stamps, configs) if len({run.scene for run in group}) == 1 else (configs, stamps)
        for suffixes in ([""] * len(group), steps, *order, numbered):
            pairs = zip(suffixes, group, strict=True)
            same = [[run for _, run in each] for each in grouped(pairs, lambda pair: pair[0]).values()]
            if all(map(_is_one_method, same)):
                break
        labels |= {run.file: f"{name} · {text}" if text else name for text, run in zip(suffixes, group, strict=True)}
    return [replace(run, method=labels[run.file]) for run in runs]


def _is_one_method(runs: Sequence[StudyRun]) -> bool:
    """Tell whether runs of one label are one method: one config on each scene and split, and one run per seed."""
    configs, seeds = ({(run.place, key(run)) for run in runs} for key in (_config_key, lambda run: run.result.seed))
    return len(configs) == len({run.place for run in runs}) and len(seeds) == len(runs)


def _config_key(run: StudyRun) -> str:
    return training_key(run.result.config, "", run.result.steps, "")


def refuse_incomparable(runs: Sequence[StudyRun]) -> None:
    """Refuse results that do not belong into one table."""
    for run in runs:
        first, other = runs[0].result.protocol, run.result.protocol
        if (first.name, first.version) != (other.name, other.version):
            raise InputError(
                f"{runs[0].title} was evaluated by protocol {first.name} version {first.version}, "
                f"{run.title} by {other.name} version {other.version}",
                "one protocol and version for every run: metrics of two protocols are not comparable",
                "Run `coliags eval` again on the older run",
            )
    for same_place in grouped(runs, lambda run: run.place).values():
        for run in same_place:
            _refuse_other_data(same_place[0], run)
    by_method = grouped(runs, lambda run: run.method)
    places = {name: {run.place for run in group} for name, group in by_method.items()}
    for method, covered in places.items():
        others = {place for other, theirs in places.items() if other != method for place in theirs}
        if others and not covered & others:
            names = (
                ", ".join(sorted(f"{scene} by split '{split}'" for scene, split in each)) for each in (covered, others)
            )
            raise InputError(
                "no scene and split in common: {} has {}, the other methods have {}".format(method, *names),
                "methods on the same scenes and splits",
                _against_truth(by_method[method], [run for run in runs if run.method != method])
                or "Write one report for each scene, or train on the same split",
            )


def _against_truth(runs: Sequence[StudyRun], others: Sequence[StudyRun]) -> str:
    """Hint to evaluate a run against the truth that the others have; empty where it is no version of their scenes."""

    def frames(run: StudyRun) -> object:
        return run.result.scene.model_dump(exclude={"name", "fingerprint"})

    estimated = [run for run in (*runs, *others) if run.data.get("depth_is_estimated")]
    versions = estimated or [run for run in runs for other in others if frames(run) == frames(other)]
    if not versions:
        return ""
    run, folder = versions[0], versions[0].run or "RUN"
    return (
        f"If {run.scene} is a version of their scene: run `coliags eval {folder} --truth SCENE`, SCENE being that with "
        f"the true depth, and report {folder}/eval/{run.result.protocol.name}{TRUTH_SUFFIX}/{RESULT_FILE} in its place"
    )


def _refuse_other_data(first: StudyRun, other: StudyRun) -> None:
    """Refuse two results of one scene and split whose images or frames differ."""
    both, results = f"{first.title} and {other.title}", (first.result, other.result)
    sizes = ["{} x {}".format(*result.scene.size) for result in results]
    if sizes[0] != sizes[1]:
        raise InputError(f"{both} are {sizes[0]} and {sizes[1]} px", "images of one size")
    frames = [
        {"training set": result.scene.train, **{f"set '{name}'": part.frames for name, part in result.sets.items()}}
        for result in results
    ]
    for name in {**frames[0], **frames[1]}:
        first_frames, other_frames = (each.get(name, ()) for each in frames)
        if first_frames != other_frames:
            differing = ", ".join(sorted({*first_frames} ^ {*other_frames})[:2]) or "their order"
            raise InputError(
                f"{both} have different frames ({name} has {len(first_frames)} and {len(other_frames)} frames, which "
                f"differ in {differing})",
                "the same training and held-out frames for every run",
                "Train and evaluate both on the same data and split",
            )
    for name, record in results[0].sets.items():
        if record.truth_sha256 != results[1].sets[name].truth_sha256:
            raise InputError(
                f"{both}: their true images or depths of set '{name}' differ",
                "runs of the same data",
                _against_truth([first], [other]),
            )


# Cautions

#: Properties whose differences are told in a caution: name, and text of a run's.
_COMPARED: dict[str, Callable[[StudyRun], str]] = {
    "code": lambda run: run.code,
    "steps of training": lambda run: f"{run.result.steps:,}",
    "image size": lambda run: "{} x {} px".format(*run.result.scene.size),
}


def cautions(study: Study) -> list[str]:
    """Differences between the results that limit their comparison, and scenes that methods lack."""
    places = dict.fromkeys(run.place for run in study.runs)
    texts: list[str] = []
    for method, runs in study.by_method.items():
        lacking = dict.fromkeys(scene for scene, split in places if (scene, split) not in {run.place for run in runs})
        if lacking:
            texts.append(
                f"{method} has no result of {', '.join(lacking)}: means and tests are over the scenes that the "
                "compared methods have in common."
            )
    texts += _unpaired_seeds(study)
    for what, value in _COMPARED.items():
        by_value = grouped(study.runs, value)
        if len(by_value) > 1:
            holders = (f"{text}: {_counted_methods(study, runs)}" for text, runs in by_value.items())
            texts.append(f"The results differ in {what}: {'; '.join(holders)}.")
    # How view modules treat held-out views (gains, pose corrections), if the methods differ in it.
    treated = {name: runs[0].result.provenance.get("untrained_views") or {} for name, runs in study.by_method.items()}
    if any(each != treated[study.methods[0]] for each in treated.values()):
        texts += [f"{method}, {name}: {text}." for method, each in treated.items() for name, text in each.items()]
    sets = [(run, name, record) for run in study.runs for name, record in run.result.sets.items()]
    if warned := [each for each in sets if each[-1].transparency_warning]:
        run, name, worst = max(warned, key=lambda each: (each[-1].blank, each[-1].transparent or 0.0))
        others = f" At most as many in {counted(len(warned) - 1, 'more set')} of views." if len(warned) > 1 else ""
        texts.append(f"{run.method} on {run.scene}, set {name}: {worst.transparency_warning}.{others}")
    for run in study.runs:
        uses = held_out_uses(run.result.provenance.get("held_out_used", {}))
        texts += [f"{run.scene}, split {run.place[1]}: {use}." for use in uses]
    differing: dict[str, None] = {}
    for runs in grouped(study.runs, lambda run: run.scene).values():
        data = [dict(leaves(run.data)) for run in runs]
        keys = dict.fromkeys(key for each in data for key in each)
        differing |= {key: None for key in keys if any(each.get(key) != data[0].get(key) for each in data)}
    if differing:
        texts.append(f"Runs of one scene record different data: {', '.join(differing)}.")
    return list(dict.fromkeys(texts))


def _unpaired_seeds(study: Study) -> list[str]:
    """Caution that methods were trained with different seeds on a scene, with the first such scene."""
    differing = []
    for (scene, _), runs in grouped(study.runs, lambda run: run.place).items():
        seeds = {
            method: ", ".join(map(str, sorted(run.result.seed for run in group)))
            for method, group in grouped(runs, lambda run: run.method).items()
        }
        if len({*seeds.values()}) > 1:
            differing.append(f"{scene} ({'; '.join(f'{method}: {text}' for method, text in seeds.items())})")
    if not differing:
        return []
    more = f" and {len(differing) - 1} more" if len(differing) > 1 else ""
    return [
        f"The methods were trained with different seeds on {differing[0]}{more}; a mean over more seeds varies less."
    ]


def _counted_methods(study: Study, runs: Sequence[StudyRun]) -> str:
    """Methods of some runs, each with how many of its runs they are where they are not all."""
    groups = grouped(runs, lambda run: run.method)
    totals = {method: len(study.by_method[method]) for method in groups}
    return ", ".join(
        method if len(group) == totals[method] else f"{method} ({len(group)} of {totals[method]})"
        for method, group in groups.items()
    )
