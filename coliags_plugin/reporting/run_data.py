"""Reading of evaluated run folders, and the checks that they are comparable."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.settings import first_error

#: Suffix of metrics over the pixels that a training frame also sees.
SEEN_SUFFIX = "_seen"


class ProtocolRecord(BaseModel):
    """Name and version of an evaluation protocol."""

    name: str
    version: int
    description: str = ""


class EvaluationRecord(BaseModel):
    """The parts of ``eval/<protocol>/metrics.json`` that a report uses; other keys are ignored."""

    model_config = ConfigDict(extra="ignore")

    protocol: ProtocolRecord
    method: str
    scene: str
    step: int | None = None
    reasons: dict[str, str] = {}
    directions: dict[str, Literal["higher", "lower"]] = {}
    units: dict[str, str] = {}
    sets: dict[str, dict[str, Any]]


@dataclass(frozen=True)
class FrameMetrics:
    """Metrics of one held-out frame; unavailable ones are absent."""

    name: str
    values: Mapping[str, float]


@dataclass(frozen=True)
class EvaluatedRun:
    """One run folder with one of its evaluations.

    Attributes:
        folder: The run folder.
        evaluation: The evaluation's folder.
        label: Name of the run in the report: its method, and its stamp where another run has the same method.
        record: Metrics, protocol and method.
        per_frame: Frames of each test set in the evaluator's order.
        provenance: As recorded; any key may be missing.
        history: Training log by column; ``seconds`` counts from the start of training. NaN where a line lacks the
            column; empty where there is no log.
    """

    folder: Path
    evaluation: Path
    label: str
    record: EvaluationRecord
    per_frame: Mapping[str, Sequence[FrameMetrics]]
    provenance: Mapping[str, Any]
    history: Mapping[str, np.ndarray] = field(default_factory=dict)

    def mean(self, set_name: str, metric: str) -> float | None:
        """Mean of a metric over a test set, None where it is unavailable."""
        return _number(self.record.sets.get(set_name, {}).get(metric))

    def frames_with(self, set_name: str, metric: str) -> int:
        """Number of frames of a set that have the metric."""
        return sum(metric in frame.values for frame in self.per_frame[set_name])

    def reason(self, metric: str) -> str:
        """Why a metric is unavailable."""
        reasons = self.record.reasons
        return reasons.get(metric) or reasons.get(metric.removesuffix(SEEN_SUFFIX)) or "no reason was recorded"

    def last(self, column: str) -> float | None:
        """The last finite value of a column of the training log."""
        values = self.history.get(column)
        if values is None:
            return None
        finite = values[np.isfinite(values)]
        return float(finite[-1]) if finite.size else None


def read_runs(folders: Sequence[Path], protocol: str) -> list[EvaluatedRun]:
    """Read runs and check that they are comparable.

    Args:
        folders: Run folders.
        protocol: Name of the evaluation in each.

    Raises:
        InputError: No run, one given twice, one not evaluated or damaged; or runs of different scenes, protocols,
            protocol versions or held-out frames.
    """
    if not folders:
        raise InputError("no run folders", "at least one", "Name the folders `coliags train` wrote")
    seen: set[Path] = set()
    for folder in folders:
        if folder.resolve() in seen:
            raise InputError(f"{folder} is given twice", "each run once")
        seen.add(folder.resolve())
    runs = [_read_run(folder, protocol) for folder in folders]
    for run in runs[1:]:
        _refuse_mismatch(runs[0], run)
    labels = _labels([(run.record.method, run.folder.resolve().name) for run in runs])
    return [replace(run, label=label) for run, label in zip(runs, labels, strict=True)]


def _labels(names: Sequence[tuple[str, str]]) -> list[str]:
    """Unique labels: the method, with the stamp where two are alike, and a number where the stamps are alike too."""
    methods = [method for method, _ in names]
    labels = [f"{method} · {stamp}" if methods.count(method) > 1 else method for method, stamp in names]
    return [
        f"{label} ({labels[: index + 1].count(label)})" if labels.count(label) > 1 else label
        for index, label in enumerate(labels)
    ]


def _read_run(folder: Path, protocol: str) -> EvaluatedRun:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder", "a run folder, as `coliags train` writes it")
    evaluation = folder / "eval" / protocol
    path = evaluation / "metrics.json"
    if not path.is_file():
        raise InputError(
            f"{folder} has no evaluation by protocol '{protocol}' ({path.relative_to(folder)} is missing)",
            "an evaluated run",
            f"Run `coliags eval {folder} --protocol {protocol}` first",
        )
    try:
        record = EvaluationRecord.model_validate(_read_json(path))
    except ValidationError as error:
        key, message, _ = first_error(error)
        raise InputError(
            f"{path}: {key or 'the file'}: {message}", "what `coliags eval` writes", _again(folder, protocol)
        ) from error
    provenance_path = folder / "provenance.json"
    provenance = _read_json(provenance_path) if provenance_path.is_file() else {}
    if not isinstance(provenance, dict):
        raise InputError(f"{provenance_path} holds a {type(provenance).__name__}", "a JSON object")
    log = folder / "metrics.jsonl"
    return EvaluatedRun(
        folder=folder,
        evaluation=evaluation,
        label=record.method,
        record=record,
        per_frame=_read_per_frame(evaluation / "per_frame.csv", folder, protocol),
        provenance=provenance,
        history=_read_history(log) if log.is_file() else {},
    )


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path} is not JSON: {error}", "a complete JSON file", "Make it again, or restore it"
        ) from error


def _read_history(path: Path) -> dict[str, np.ndarray]:
    lines: list[dict[str, Any]] = []
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}", "the training log") from error
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            values = json.loads(line)
        except ValueError as error:
            raise InputError(f"{path}, line {number} is not JSON: {error}", "one JSON object per line") from error
        if not isinstance(values, dict):
            raise InputError(f"{path}, line {number} holds a {type(values).__name__}", "one JSON object per line")
        lines.append(values)
    columns = ("step", "loss", "psnr", "seconds", "gaussians", "anchors")
    table = {name: np.array([_or_nan(values.get(name)) for values in lines], dtype=np.float64) for name in columns}
    return {name: values for name, values in table.items() if np.isfinite(values).any()}


def _read_per_frame(path: Path, folder: Path, protocol: str) -> dict[str, list[FrameMetrics]]:
    sets: dict[str, list[FrameMetrics]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for number, row in enumerate(csv.DictReader(file), start=2):
                if not row.get("set") or not row.get("frame"):
                    raise InputError(
                        f"{path}, line {number} has no set or no frame",
                        "columns set, frame, ...",
                        _again(folder, protocol),
                    )
                values = {
                    name: float(cell) for name, cell in row.items() if name not in ("set", "frame", None) and cell
                }
                finite = {name: value for name, value in values.items() if math.isfinite(value)}
                sets.setdefault(row["set"], []).append(FrameMetrics(row["frame"], finite))
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"{path} cannot be read: {error}", "a table of metrics", _again(folder, protocol)) from error
    if not sets:
        raise InputError(f"{path} lists no frames", "one line for each held-out frame", _again(folder, protocol))
    return sets


def _refuse_mismatch(first: EvaluatedRun, other: EvaluatedRun) -> None:
    one, two = first.record, other.record
    if (one.protocol.name, one.protocol.version) != (two.protocol.name, two.protocol.version):
        raise InputError(
            f"{first.folder} was evaluated by protocol {one.protocol.name} version {one.protocol.version}, "
            f"{other.folder} by {two.protocol.name} version {two.protocol.version}",
            "one protocol and version for every run: metrics of two protocols are not comparable",
            "Run `coliags eval` again on the older run",
        )
    if one.scene != two.scene:
        raise InputError(
            f"{first.folder} is of scene '{one.scene}', {other.folder} of scene '{two.scene}'",
            "runs of one scene",
            "Write one report for each scene",
        )
    frames = [
        {name: [frame.name for frame in frames] for name, frames in run.per_frame.items()} for run in (first, other)
    ]
    if frames[0] != frames[1]:
        raise InputError(
            f"{first.folder} and {other.folder} were evaluated on different frames ({_first_difference(*frames)})",
            "the same held-out frames for every run",
            "Evaluate both on the same data and split",
        )


def _first_difference(one: dict[str, list[str]], two: dict[str, list[str]]) -> str:
    name = next(name for name in [*one, *two] if one.get(name) != two.get(name))
    if name not in one or name not in two:
        return f"set '{name}' is in one of them only"
    if len(one[name]) != len(two[name]):
        return f"set '{name}' has {len(one[name])} and {len(two[name])} frames"
    left, right = next(pair for pair in zip(one[name], two[name], strict=True) if pair[0] != pair[1])
    return f"set '{name}' has '{left}' in one where the other has '{right}'"


def _again(folder: Path, protocol: str) -> str:
    return f"Run `coliags eval {folder} --protocol {protocol}` again"


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return None
    return float(value)


def _or_nan(value: Any) -> float:
    number = _number(value)
    return math.nan if number is None else number
