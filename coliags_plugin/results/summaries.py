"""Summaries of a result: the content of ``metrics.json`` and ``per_frame.csv``."""

from __future__ import annotations

import csv
import io
from typing import Any

from coliags_plugin.results.record import SEEN_SUFFIX, Result


def means_summary(result: Result) -> dict[str, Any]:
    """Content of ``metrics.json``: means per test set, those of the main set also at the top, with their reasons."""
    main = result.sets[result.main_set]
    protocols_own = [name for name in result.metrics if not _over_seen_pixels(name, result)]
    reasons: dict[str, str] = {}
    for part in reversed(result.sets.values()):
        reasons |= part.reasons
    return {
        "protocol": result.protocol.model_dump(),
        "method": result.method,
        "scene": result.scene.name,
        "step": result.steps,
        "untrained_views": result.provenance.get("untrained_views", {}),
        **{name: main.mean(name) for name in protocols_own},
        "reasons": reasons,
        "directions": {name: metric.direction for name, metric in result.metrics.items()},
        "units": {name: metric.unit for name, metric in result.metrics.items()},
        "sets": {
            name: {"frames": len(part.frames), **{metric: part.mean(metric) for metric in result.metrics}}
            for name, part in result.sets.items()
        },
        "software": result.software,
    }


def _over_seen_pixels(name: str, result: Result) -> bool:
    return name.endswith(SEEN_SUFFIX) and name.removesuffix(SEEN_SUFFIX) in result.metrics


def per_frame_table(result: Result) -> str:
    """Content of ``per_frame.csv``: one line per frame and one column per metric, empty where a frame has none."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["set", "frame", *result.metrics])
    for set_name, part in result.sets.items():
        for index, frame in enumerate(part.frames):
            values = (part.values[name][index] if name in part.values else None for name in result.metrics)
            writer.writerow([set_name, frame, *("" if value is None else repr(value) for value in values)])
    return text.getvalue()
