"""What a report is made of: results of methods on scenes, and the cells that failed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from coliags_plugin.core.anonymity import without_places
from coliags_plugin.results.record import MAIN_SET, SEEN_SUFFIX, MetricRecord, ProtocolRecord, Result, SetRecord


@dataclass(frozen=True)
class Cell:
    """One evaluated run.

    Attributes:
        method: Name in the report, see :mod:`coliags_plugin.comparison.report.labels`.
        result: Its results file.
        stamp: Name of its run folder or results file.
        run: The run folder with the images of this evaluation; None where only the results file is there.
    """

    method: str
    result: Result
    stamp: str
    run: Path | None = None

    @property
    def scene(self) -> str:
        """Name of its scene."""
        return self.result.scene.name

    @property
    def evaluation(self) -> Path | None:
        """Folder of its images."""
        return None if self.run is None else self.run / "eval" / self.result.evaluation_name


def _without_places(result: Result) -> Result:
    kept = {name: without_places(getattr(result, name)) for name in ("config", "software", "provenance")}
    return result.model_copy(update=kept)


@dataclass(frozen=True)
class Failure:
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


#: Values of a metric by method, scene and seed.
MetricValues = dict[str, dict[str, dict[int, float]]]


@dataclass(frozen=True)
class Study:
    """Comparable results; see :func:`coliags_plugin.comparison.report.comparability.refuse_incomparable`.

    Attributes:
        cells: At least one.
        failures: Cells without a result.
    """

    cells: tuple[Cell, ...]
    failures: tuple[Failure, ...] = ()

    def anonymous(self) -> Study:
        """The same without absolute paths."""
        cells = tuple(replace(cell, result=_without_places(cell.result)) for cell in self.cells)
        return Study(cells, tuple(replace(one, reason=without_places(one.reason)) for one in self.failures))

    @cached_property
    def by_method(self) -> dict[str, list[Cell]]:
        """Results of every method, in the order given."""
        found: dict[str, list[Cell]] = {}
        for cell in self.cells:
            found.setdefault(cell.method, []).append(cell)
        return found

    @property
    def methods(self) -> list[str]:
        """Methods with a result, in the order given."""
        return [*self.by_method]

    @cached_property
    def parts(self) -> list[Part]:
        """Every split and test set; the split's own set first."""
        found = dict.fromkeys(
            Part(cell.result.scene.split, set_name) for cell in self.cells for set_name in cell.result.sets
        )
        splits = list(dict.fromkeys(part.split for part in found))
        return sorted(found, key=lambda part: (splits.index(part.split), part.set_name != MAIN_SET))

    @property
    def protocol(self) -> ProtocolRecord:
        """The protocol of all results."""
        return self.cells[0].result.protocol

    @cached_property
    def metrics(self) -> dict[str, MetricRecord]:
        """Every metric, in the protocol's order, each followed by the same over the seen pixels."""
        found: dict[str, MetricRecord] = {}
        for cell in self.cells:
            found |= {name: metric for name, metric in cell.result.metrics.items() if name not in found}
        bases = dict.fromkeys(name.removesuffix(SEEN_SUFFIX) for name in found)
        ordered = [name for base in bases for name in (base, base + SEEN_SUFFIX) if name in found]
        return {name: found[name] for name in ordered}

    def scenes(self, part: Part | None = None) -> list[str]:
        """Scenes with a result, of one part or of all, in the order given."""
        return list(
            dict.fromkeys(cell.scene for cell in self.cells if part is None or self.record(cell, part) is not None)
        )

    def runs(self, part: Part, scene: str, method: str) -> list[Cell]:
        """Results of a method on a scene, by seed."""
        own = self.by_method.get(method, [])
        found = [cell for cell in own if cell.scene == scene and self.record(cell, part) is not None]
        return sorted(found, key=lambda cell: cell.result.seed)

    def frames(self, part: Part, scene: str) -> Sequence[str]:
        """Names of a scene's frames, the same for every method."""
        for cell in self.cells:
            record = self.record(cell, part) if cell.scene == scene else None
            if record is not None:
                return record.frames
        return ()

    def record(self, cell: Cell, part: Part) -> SetRecord | None:
        """What a cell has of a part."""
        return cell.result.sets.get(part.set_name) if cell.result.scene.split == part.split else None

    def values(self, part: Part, metric: str) -> MetricValues:
        """Means over the frames, by method, scene and seed; empty where a method has none."""
        values: MetricValues = {method: {} for method in self.methods}
        for cell in self.cells:
            record = self.record(cell, part)
            mean = None if record is None else record.mean(metric)
            if mean is not None:
                values[cell.method].setdefault(cell.scene, {})[cell.result.seed] = mean
        return values

    def reason(self, part: Part, method: str, metric: str, scene: str | None = None) -> str:
        """Why a metric is unavailable, as the first result without it says."""
        records = [
            record
            for cell in self.by_method.get(method, [])
            if scene in (None, cell.scene) and (record := self.record(cell, part)) is not None
        ]
        if not records:
            return "no result"
        for record in records:
            reason = record.reasons.get(metric) or record.reasons.get(metric.removesuffix(SEEN_SUFFIX))
            if reason:
                return reason
        return "no reason was recorded"
