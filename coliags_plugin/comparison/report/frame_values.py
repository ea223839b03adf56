"""Metrics of single frames: as CSV, and as means over seeds."""

from __future__ import annotations

import csv
import io

from coliags_plugin.comparison.report.study import Part, Study

_HEAD = ("scene", "split", "set", "frame", "method", "seed")


def per_frame_csv(study: Study) -> str:
    """One line per scene, test set, frame, method and seed, one column per metric; empty where there is no value."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_HEAD, *study.metrics])
    for cell in study.cells:
        scene = cell.result.scene
        for set_name, part in cell.result.sets.items():
            for index, frame in enumerate(part.frames):
                values = (part.values[name][index] if name in part.values else None for name in study.metrics)
                numbers = ("" if value is None else repr(value) for value in values)
                writer.writerow([scene.name, scene.split, set_name, frame, cell.method, cell.result.seed, *numbers])
    return text.getvalue()


def frame_means(study: Study, part: Part, scene: str, method: str, metric: str) -> dict[str, float]:
    """A metric of every frame of a scene that has it, mean over the seeds that have it."""
    found: dict[str, list[float]] = {}
    for cell in study.runs(part, scene, method):
        record = cell.result.sets[part.set_name]
        for frame, value in zip(record.frames, record.values.get(metric, ()), strict=False):
            if value is not None:
                found.setdefault(frame, []).append(value)
    return {frame: sum(values) / len(values) for frame, values in found.items()}
