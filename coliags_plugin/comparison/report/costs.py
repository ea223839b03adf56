"""Table of costs: times, memory and sizes, compared only within one device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Literal

import numpy as np

from coliags_plugin.comparison.report.metric_tables import METHOD, method_rows
from coliags_plugin.comparison.report.study import Study
from coliags_plugin.reporting.model import Column, Table, TableCell
from coliags_plugin.reporting.numbers import counted, duration, ranks_of
from coliags_plugin.results.record import CostRecord

#: Of the PSNR marks.
_MARKS_SHOWN = 3


@dataclass(frozen=True)
class _CostColumn:
    """A cost: how it is read, printed and, better lower or higher, ranked; and what depends on the device for it."""

    column: Column
    value: Callable[[CostRecord], float | None]
    text: Callable[[float], str]
    work: Literal["training", "rendering"] | None
    missing: str = "not measured"


def _mib(cost: CostRecord) -> float | None:
    return None if cost.checkpoint_bytes is None else cost.checkpoint_bytes / 2**20


def _mark_column(mark: str) -> _CostColumn:
    column = Column(f"seconds_to_{mark}", f"To {mark} dB", "", "lower")
    return _CostColumn(column, lambda cost: cost.seconds_to_psnr.get(mark), duration, "training", "not reached")


def _time(key: str, title: str) -> _CostColumn:
    return _CostColumn(Column(key, title, "", "lower"), attrgetter(key), duration, "training")


_TIMES = (_time("train_seconds", "Training"), _time("processor_seconds", "Processor time"))
_NO_GAUSSIANS = "not counted, or a radiance field, which has none"
_FPS, _MEMORY = Column("fps", "Rendering", "views/s", "higher"), Column("memory", "Peak memory", "MiB", "lower")
_OTHERS = (
    _CostColumn(_FPS, attrgetter("render_fps"), "{:.3g}".format, "rendering"),
    _CostColumn(_MEMORY, attrgetter("peak_memory_mib"), "{:,.0f}".format, "training"),
    _CostColumn(Column("gaussians", "Gaussians"), attrgetter("gaussians"), "{:,.0f}".format, None, _NO_GAUSSIANS),
    _CostColumn(Column("checkpoint", "Checkpoint", "MiB", "lower"), _mib, "{:,.1f}".format, None),
)


def cost_table(study: Study) -> Table:
    """Mean costs of every method over the scenes that all methods have, seeds averaged."""
    shared = [scene for scene in study.scenes if all(_costs(study, method, scene) for method in study.methods)]
    costs = [run.result.cost for run in study.runs]
    devices = {
        "training": {training_device(cost) for cost in costs},
        "rendering": {_rendering_device(cost) for cost in costs},
    }
    marks = [
        _mark_column(mark) for mark in sorted({mark for cost in costs for mark in cost.seconds_to_psnr}, key=float)
    ]
    kinds = [*_TIMES, *marks, *_OTHERS]
    cells = {kind.column.key: [_cell(study, shared, kind, method) for method in study.methods] for kind in kinds}
    hidden = _hidden_marks({kind.column.key: cells[kind.column.key] for kind in marks})
    columns, in_order = [Column("steps", "Steps")], [[_steps(study, method) for method in study.methods]]
    for kind in kinds:
        comparable = kind.work is None or len(devices[kind.work]) == 1
        column = kind.column if comparable else replace(kind.column, direction=None)
        columns.append(replace(column, shown=column.key not in hidden))
        in_order.append(_ranked(column, cells[column.key]))
    if len(devices["training"]) > 1:
        columns.append(Column("device", "Device", words=True))
        own = ([training_device(run.result.cost) for run in study.by_method[method]] for method in study.methods)
        in_order.append([TableCell("; ".join(dict.fromkeys(each))) for each in own])
    return Table(
        title="Costs",
        columns=[METHOD, *columns],
        rows=method_rows(study, columns, in_order),
        notes=[*_notes(study, shared, devices), *_plans(study)],
        count=f"means over {counted(len(shared), 'scene')}" if len(shared) > 1 else "",
        name="costs",
    )


def _plans(study: Study) -> list[str]:
    """Recorded plans of densification and pruning, one line for each method and plan."""
    return [
        f"{method}: {plan}"
        for method, own in study.by_method.items()
        for plan in dict.fromkeys(run.result.provenance.get("training", {}).get("plan") for run in own)
        if plan
    ]


def _hidden_marks(cells: dict[str, list[TableCell]]) -> set[str]:
    """Marks not to show: all but the highest that all methods reached, and the lowest that some did."""
    reached = {key: [cell.value is not None for cell in own] for key, own in cells.items()}
    by_all = [key for key in reversed(reached) if all(reached[key])]
    by_some = [key for key in reached if any(reached[key]) and not all(reached[key])]
    return set(reached) - {*[*by_all, *by_some][:_MARKS_SHOWN]}


def _steps(study: Study, method: str) -> TableCell:
    steps = sorted({run.result.steps for run in study.by_method[method]})
    return TableCell(f"{steps[0]:,}" if len(steps) == 1 else f"{steps[0]:,} to {steps[-1]:,}", steps[-1])


def _cell(study: Study, shared: Sequence[str], kind: _CostColumn, method: str) -> TableCell:
    """Mean over scenes of the means over seeds; missing unless it is known of every run."""
    if not shared:
        return TableCell(note="no scene that all methods have")
    by_scene = [[kind.value(cost) for cost in _costs(study, method, scene)] for scene in shared]
    means = [np.mean([number for number in own if number is not None]) for own in by_scene if None not in own]
    if len(means) == len(shared):
        mean = float(np.mean(means))
        return TableCell(kind.text(mean), mean)
    known = f"; known of {len(means)} of {len(shared)} scenes" if means else ""
    return TableCell(note=f"{kind.column.title}: {kind.missing}{known}")


def _ranked(column: Column, cells: Sequence[TableCell]) -> list[TableCell]:
    """By the printed text: values that look alike share a rank."""
    first: dict[str, float | None] = {}
    for cell in cells:
        first.setdefault(cell.text, cell.value)
    ranks = ranks_of([first[cell.text] for cell in cells], column.direction)
    return [replace(cell, rank=rank) for cell, rank in zip(cells, ranks, strict=True)]


def _notes(study: Study, shared: Sequence[str], devices: dict[str, set[str]]) -> list[str]:
    notes = []
    if len(shared) < len(study.scenes):
        missing = ", ".join(scene for scene in study.scenes if scene not in shared)
        notes.append(f"Means over {len(shared)} of {len(study.scenes)} scenes, without {missing}")
    mixed = [work for work, names in devices.items() if len(names) > 1]
    if mixed:
        each = "; ".join(sorted({device for work in mixed for device in devices[work]}))
        notes.append(
            f"Not ranked: {' and '.join(mixed)} ran on different devices, whose costs are not comparable ({each})"
        )
    notes += [f"All {work} on {next(iter(names))}" for work, names in devices.items() if len(names) == 1]
    if any(run.result.cost.seconds_to_psnr for run in study.runs):
        notes.append("To N dB: training time until the logged PSNR, smoothed, first reached N dB")
    return [*notes, "Rendering: views of the test sets a second. Gaussians: drawn in a test view, mean"]


def training_device(cost: CostRecord) -> str:
    """Device of a run's training, with its threads."""
    return _with_threads(cost.device, cost.threads)


def _rendering_device(cost: CostRecord) -> str:
    """Device that rendered the test views, with its threads."""
    if cost.render_device is None:
        return training_device(cost)
    return _with_threads(cost.render_device, cost.render_threads)


def _with_threads(device: str, threads: int | None) -> str:
    return device if threads is None else f"{device}, {counted(threads, 'thread')}"


def _costs(study: Study, method: str, scene: str) -> list[CostRecord]:
    return [run.result.cost for run in study.by_method[method] if run.scene == scene]
