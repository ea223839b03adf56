"""Tables of single frames: wide, with one row per frame; and long, with one row per run, test set, frame and metric."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from coliags_plugin.core.files import atomic_write
from coliags_plugin.results.record import Result


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Rows below a heading as CSV: numbers with all their digits, None empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return text.getvalue()


def frame_rows(result: Result, metrics: Iterable[str]) -> Iterator[list[Any]]:
    """Test set and name of every frame with its metrics; None where it lacks one."""
    names = list(metrics)
    for set_name, part in result.sets.items():
        for index, frame in enumerate(part.frames):
            values = (part.values[name][index] if name in part.values else None for name in names)
            yield [set_name, frame, *values]


def per_frame_table(result: Result) -> str:
    """Content of ``per_frame.csv``: one line per frame and one column per metric, empty where a frame has none."""
    return csv_text(["set", "frame", *result.metrics], frame_rows(result, result.metrics))


class FrameValue(NamedTuple):
    """One value of one frame; None where the frame has none."""

    key: str
    method: str
    scene: str
    split: str
    seed: int
    protocol: str
    protocol_version: int
    set: str
    frame: str
    metric: str
    value: float | None
    unit: str


def rows(result: Result) -> Iterator[FrameValue]:
    """The rows of a result."""
    run = (result.key, result.method, result.scene.name, result.scene.split, result.seed)
    protocol = (result.protocol.name, result.protocol.version)
    for set_name, part in result.sets.items():
        for metric, values in part.values.items():
            for frame, value in zip(part.frames, values, strict=True):
                yield FrameValue(*run, *protocol, set_name, frame, metric, value, result.metrics[metric].unit)


def write_csv(path: Path, results: Sequence[Result]) -> None:
    """Write the rows of results as CSV, values with all their digits, missing ones empty."""
    atomic_write(path, csv_text(FrameValue._fields, (row for result in results for row in rows(result))))
