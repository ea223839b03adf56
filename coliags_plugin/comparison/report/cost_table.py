"""Table of costs: times, memory and sizes, compared only within one device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from coliags_plugin.comparison.report.study import Study
from coliags_plugin.comparison.report.tables import Column, Entry, Row, Table, counted, printed_ranks
from coliags_plugin.results.record import CostRecord

_KIB = 1024.0
_STEPS = Column("steps", "Steps")
#: Of the PSNR marks.
_MARKS_SHOWN = 3


@dataclass(frozen=True)
class _Kind:
    """A cost: how it is read, printed and, better lower or higher, ranked."""

    column: Column
    value: Callable[[CostRecord], float | None]
    text: Callable[[float], str]
    #: What it depends on the device of; None: on no device.
    device: Literal["training", "rendering"] | None
    missing: str = "not measured"


def _kinds(marks: Sequence[str]) -> list[_Kind]:
    return [
        _Kind(Column("train_seconds", "Training", "", "lower"), lambda cost: cost.train_seconds, duration, "training"),
        _Kind(
            Column("processor_seconds", "Processor time", "", "lower"),
            lambda cost: cost.processor_seconds,
            duration,
            "training",
        ),
        *(_mark_kind(mark) for mark in marks),
        _Kind(
            Column("fps", "Rendering", "views/s", "higher"), lambda cost: cost.render_fps, "{:.3g}".format, "rendering"
        ),
        _Kind(
            Column("memory", "Peak memory", "MiB", "lower"),
            lambda cost: cost.peak_memory_mib,
            "{:,.0f}".format,
            "training",
        ),
        _Kind(
            Column("gaussians", "Gaussians"),
            lambda cost: cost.gaussians,
            "{:,.0f}".format,
            None,
            "not counted, or a radiance field, which has none",
        ),
        _Kind(
            Column("checkpoint", "Checkpoint", "MiB", "lower"),
            lambda cost: None if cost.checkpoint_bytes is None else cost.checkpoint_bytes / _KIB**2,
            "{:,.1f}".format,
            None,
        ),
    ]


def _mark_kind(mark: str) -> _Kind:
    return _Kind(
        Column(_mark_key(mark), f"To {mark} dB", "", "lower"),
        lambda cost: cost.seconds_to_psnr.get(mark),
        duration,
        "training",
        "not reached",
    )


def cost_table(study: Study) -> Table:
    """Mean costs of every method over the scenes that all methods have, seeds averaged."""
    shared = [scene for scene in study.scenes() if all(_costs(study, method, scene) for method in study.methods)]
    costs = [cell.result.cost for cell in study.cells]
    devices = {
        "training": {training_device(cost) for cost in costs},
        "rendering": {rendering_device(cost) for cost in costs},
    }
    columns, entries = [_STEPS], [[_steps(study, method) for method in study.methods]]
    marks = sorted({mark for cost in costs for mark in cost.seconds_to_psnr}, key=float)
    telling = _telling_marks(study, shared, marks)
    for kind in _kinds(marks):
        comparable = kind.device is None or len(devices[kind.device]) == 1
        column = kind.column if comparable else replace(kind.column, direction=None)
        columns.append(replace(column, shown=column.key not in map(_mark_key, marks) or column.key in telling))
        entries.append(_ranked(column, [_entry(study, shared, kind, method) for method in study.methods]))
    if len(devices["training"]) > 1:
        columns.append(Column("device", "Device", words=True))
        entries.append([_device(study, method) for method in study.methods])
    rows = [Row(method, tuple(own[index] for own in entries), index) for index, method in enumerate(study.methods)]
    return Table(
        title="Costs",
        count=f"means over {counted(len(shared), 'scene')}" if len(shared) > 1 else "",
        head="Method",
        columns=tuple(columns),
        rows=tuple(rows),
        notes=tuple(_notes(study, shared, devices)),
        name="costs",
    )


def _telling_marks(study: Study, shared: Sequence[str], marks: Sequence[str]) -> set[str]:
    """Keys of the marks to show: the highest that all methods reached, then the lowest that some did."""
    reached = {
        mark: [_entry(study, shared, _mark_kind(mark), method).value is not None for method in study.methods]
        for mark in marks
    }
    by_all = [mark for mark in reversed(marks) if all(reached[mark])]
    by_some = [mark for mark in marks if any(reached[mark]) and not all(reached[mark])]
    return {_mark_key(mark) for mark in (*by_all, *by_some)[:_MARKS_SHOWN]}


def _mark_key(mark: str) -> str:
    return f"seconds_to_{mark}"


def _steps(study: Study, method: str) -> Entry:
    steps = sorted({cell.result.steps for cell in study.by_method[method]})
    text = f"{steps[0]:,}" if len(steps) == 1 else f"{steps[0]:,} to {steps[-1]:,}"
    return Entry(text, steps[-1])


def _device(study: Study, method: str) -> Entry:
    own = [training_device(cell.result.cost) for cell in study.by_method[method]]
    return Entry("; ".join(dict.fromkeys(own)))


def _entry(study: Study, shared: Sequence[str], kind: _Kind, method: str) -> Entry:
    """Mean over scenes of the means over seeds; missing unless it is known of every run."""
    by_scene = [[kind.value(cost) for cost in _costs(study, method, scene)] for scene in shared]
    means = [np.mean([number for number in own if number is not None]) for own in by_scene if None not in own]
    if shared and len(means) == len(shared):
        mean = float(np.mean(means))
        return Entry(kind.text(mean), mean)
    if not shared:
        return Entry(note="no scene that all methods have")
    known = f"; known of {len(means)} of {len(shared)} scenes" if means else ""
    return Entry(note=f"{kind.column.title}: {kind.missing}{known}")


def _ranked(column: Column, entries: Sequence[Entry]) -> list[Entry]:
    first: dict[str, float] = {}
    for entry in entries:
        if entry.value is not None:
            first.setdefault(entry.text, entry.value)
    # By the printed text: values that look alike share a rank.
    keys = [repr(first[entry.text]) if entry.text in first else None for entry in entries]
    return [
        replace(entry, rank=rank) for entry, rank in zip(entries, printed_ranks(keys, column.direction), strict=True)
    ]


def _notes(study: Study, shared: Sequence[str], devices: dict[str, set[str]]) -> list[str]:
    notes = []
    if len(shared) < len(study.scenes()):
        missing = ", ".join(scene for scene in study.scenes() if scene not in shared)
        notes.append(f"Means over {len(shared)} of {len(study.scenes())} scenes, without {missing}")
    mixed = [what for what, found in devices.items() if len(found) > 1]
    if mixed:
        each = "; ".join(sorted({device for what in mixed for device in devices[what]}))
        notes.append(
            f"Not ranked: {' and '.join(mixed)} ran on different devices, whose costs are not comparable ({each})"
        )
    notes += [f"All {what} on {next(iter(found))}" for what, found in devices.items() if len(found) == 1]
    if any(cell.result.cost.seconds_to_psnr for cell in study.cells):
        notes.append("To N dB: training time until the logged PSNR, smoothed, first reached N dB")
    notes.append("Rendering: views of the test sets a second. Gaussians: drawn in a test view, mean")
    return notes


def training_device(cost: CostRecord) -> str:
    """Device of a run's training, with its threads."""
    return _with_threads(cost.device, cost.threads)


def rendering_device(cost: CostRecord) -> str:
    """Device that rendered the test views, with its threads."""
    if cost.render_device is None:
        return training_device(cost)
    return _with_threads(cost.render_device, cost.render_threads)


def _with_threads(device: str, threads: int | None) -> str:
    return device if threads is None else f"{device}, {counted(threads, 'thread')}"


def _costs(study: Study, method: str, scene: str) -> list[CostRecord]:
    return [cell.result.cost for cell in study.by_method[method] if cell.scene == scene]


def duration(seconds: float) -> str:
    """Duration in at most two units, for instance ``2 min 05 s``."""
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes:02d} min"
