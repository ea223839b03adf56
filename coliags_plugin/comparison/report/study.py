"""Results of methods on scenes that a report compares, and cells of a comparison without a result."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from coliags_plugin.comparison.plan import Decision
from coliags_plugin.results.comparisons import BySeed
from coliags_plugin.results.record import MAIN_SET, SEEN_SUFFIX, MetricRecord, ProtocolRecord, Result, SetRecord

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

    method: str  # name in the report, see sources.disambiguate_labels
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
        """Reason why a metric is unavailable, as the first result without it says."""
        records = [record for _, record in self.evaluated(method, scene)]
        names = (metric, metric.removesuffix(SEEN_SUFFIX))
        reasons = (record.reasons.get(name) for record in records for name in names)
        return next(filter(None, reasons), "no reason was recorded" if records else "no result")


@dataclass(frozen=True)
class Study:
    """Comparable results; see :func:`coliags_plugin.comparison.report.sources.refuse_incomparable`."""

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

    @property
    def protocol(self) -> ProtocolRecord:
        """The protocol of all results."""
        return self.runs[0].result.protocol

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
