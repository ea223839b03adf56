"""Content of a report: results of methods on scenes, and cells of a comparison without a result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from coliags_plugin.comparison.plan_file import Decision
from coliags_plugin.results.comparisons import BySeed
from coliags_plugin.results.record import MAIN_SET, SEEN_SUFFIX, MetricRecord, ProtocolRecord, Result, SetRecord

_SET_TITLES = {"test": "held out along the path", "rotation": "beyond the path"}


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
class Part:
    """One test set under one split: what one table is about."""

    split: str
    set_name: str
    study: Study = field(compare=False, repr=False)

    @property
    def title(self) -> str:
        """Title of the test set, with its split where the study has several."""
        known = _SET_TITLES.get(self.set_name)
        title = f"{self.set_name}: {known}" if known else self.set_name
        return f"{title}, split {self.split}" if self.study.several_splits else title

    @property
    def name(self) -> str:
        """Short name, for identifiers."""
        return f"{self.set_name}-{self.split}" if self.study.several_splits else self.set_name

    @cached_property
    def scenes(self) -> list[str]:
        """Scenes with a result, in the order given."""
        return list(dict.fromkeys(run.scene for run in self.study.runs if self.record(run) is not None))

    def record(self, run: StudyRun) -> SetRecord | None:
        """Record of this test set in a run; None where it has none."""
        return run.result.sets.get(self.set_name) if run.result.scene.split == self.split else None

    def runs(self, scene: str, method: str) -> list[StudyRun]:
        """Runs of a method on a scene, by seed."""
        own = self.study.by_method.get(method, [])
        matches = [run for run in own if run.scene == scene and self.record(run) is not None]
        return sorted(matches, key=lambda run: run.result.seed)

    def frames(self, scene: str) -> Sequence[str]:
        """Names of a scene's frames, the same for every method."""
        records = (self.record(run) for run in self.study.runs if run.scene == scene)
        return next((record.frames for record in records if record is not None), ())

    def values(self, metric: str) -> dict[str, BySeed]:
        """Means over the frames, by method, scene and seed; empty where a method has none."""
        values: dict[str, dict[str, dict[int, float]]] = {}
        for run in self.study.runs:
            own, record = values.setdefault(run.method, {}), self.record(run)
            mean = None if record is None else record.mean(metric)
            if mean is not None:
                own.setdefault(run.scene, {})[run.result.seed] = mean
        return dict(values)

    def has(self, metric: str) -> bool:
        """Tell whether any result has a value of a metric."""
        return any(self.values(metric).values())

    def frame_means(self, scene: str, method: str, metric: str) -> dict[str, float]:
        """A metric of every frame of a scene that has it, mean over the seeds that have it."""
        by_frame: dict[str, list[float]] = {}
        for run in self.runs(scene, method):
            record = run.result.sets[self.set_name]
            for frame, value in zip(record.frames, record.values.get(metric, ()), strict=False):
                if value is not None:
                    by_frame.setdefault(frame, []).append(value)
        return {frame: sum(values) / len(values) for frame, values in by_frame.items()}

    def reason(self, method: str, metric: str, scene: str | None = None) -> str:
        """Reason why a metric is unavailable, as the first result without it says."""
        runs = [run for run in self.study.by_method.get(method, []) if scene in (None, run.scene)]
        records = [record for run in runs if (record := self.record(run)) is not None]
        if not records:
            return "no result"
        names = (metric, metric.removesuffix(SEEN_SUFFIX))
        reasons = (record.reasons.get(name) for record in records for name in names)
        return next(filter(None, reasons), "no reason was recorded")


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
        by_method: dict[str, list[StudyRun]] = {}
        for run in self.runs:
            by_method.setdefault(run.method, []).append(run)
        return by_method

    @property
    def methods(self) -> list[str]:
        """Methods with a result, in the order given."""
        return [*self.by_method]

    @cached_property
    def parts(self) -> list[Part]:
        """Every split and test set; the split's own set first."""
        parts = dict.fromkeys(Part(run.result.scene.split, name, self) for run in self.runs for name in run.result.sets)
        splits = list(dict.fromkeys(part.split for part in parts))
        return sorted(parts, key=lambda part: (splits.index(part.split), part.set_name != MAIN_SET))

    @property
    def several_splits(self) -> bool:
        """Tell whether results are of different splits."""
        return len({run.result.scene.split for run in self.runs}) > 1

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

    @property
    def length_unit(self) -> str:
        """Unit of lengths, as printed: that of the metrics that are lengths."""
        units = {metric.unit for metric in self.metrics.values()}
        return "units" if any(unit.startswith("units") for unit in units) else "mm"

    @property
    def scenes(self) -> list[str]:
        """Scenes with a result, in the order given."""
        return list(dict.fromkeys(run.scene for run in self.runs))
