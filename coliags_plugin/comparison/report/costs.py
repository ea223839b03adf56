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

#: Largest number of PSNR marks.
_MARKS_SHOWN = 3


@dataclass(frozen=True)
class _Cost:
    """A cost: its column, how it is read and printed, and the work whose device it depends on."""

    column: Column
    value: Callable[[CostRecord], float | None]
    text: Callable[[float], str]
    work: Literal["training", "rendering"] | None = None
    missing: str = "not measured"


def _mark(mark: str) -> _Cost:
    column = Column(f"seconds_to_{mark}", f"To {mark} dB", "", "lower")
    return _Cost(column, lambda cost: cost.seconds_to_psnr.get(mark), duration, "training", "not reached")


def _mib(cost: CostRecord) -> float | None:
    return None if cost.checkpoint_bytes is None else cost.checkpoint_bytes / 2**20


_NO_GAUSSIANS = "not counted, or a radiance field, which has none"
#: Costs before and behind the marks.
_TIMES = [
    _Cost(Column(key, title, "", "lower"), attrgetter(key), duration, "training")
    for key, title in (("train_seconds", "Training"), ("processor_seconds", "Processor time"))
]
_OTHERS = [
    _Cost(Column("fps", "Rendering", "views/s", "higher"), attrgetter("render_fps"), "{:.3g}".format, "rendering"),
    _Cost(Column("memory", "Peak memory", "MiB", "lower"), attrgetter("peak_memory_mib"), "{:,.0f}".format, "training"),
    _Cost(Column("gaussians", "Gaussians"), attrgetter("gaussians"), "{:,.0f}".format, missing=_NO_GAUSSIANS),
    _Cost(Column("checkpoint", "Checkpoint", "MiB", "lower"), _mib, "{:,.1f}".format),
]


def cost_table(study: Study) -> Table:
    """Mean costs of every method over the scenes that all methods have, seeds averaged."""
    shared = [s for s in study.scenes if all(any(run.scene == s for run in own) for own in study.by_method.values())]
    costs = [run.result.cost for run in study.runs]
    devices = {
        "training": {training_device(cost) for cost in costs},
        "rendering": {_rendering_device(cost) for cost in costs},
    }
    marks = [_mark(name) for name in sorted({name for cost in costs for name in cost.seconds_to_psnr}, key=float)]
    cells = {"steps": [_steps(study, method) for method in study.methods]}
    columns = [METHOD, Column("steps", "Steps")]
    for cost in (*_TIMES, *marks, *_OTHERS):
        is_ranked = cost.work is None or len(devices[cost.work]) == 1
        columns.append(cost.column if is_ranked else replace(cost.column, direction=None))
        cells[cost.column.key] = _ranked(columns[-1], [_cell(study, shared, cost, method) for method in study.methods])
    # The highest marks that all methods reached, then the lowest that some did.
    reached = {mark.column.key: [bool(cell.text) for cell in cells[mark.column.key]] for mark in marks}
    by_all = [key for key in reversed(reached) if all(reached[key])]
    by_some = [key for key in reached if any(reached[key]) and key not in by_all]
    hidden = reached.keys() - {*[*by_all, *by_some][:_MARKS_SHOWN]}
    if len(devices["training"]) > 1:
        columns.append(Column("device", "Device", words=True))
        own = ([training_device(run.result.cost) for run in runs] for runs in study.by_method.values())
        cells["device"] = [TableCell("; ".join(dict.fromkeys(each))) for each in own]
    return Table(
        title="Costs",
        columns=[replace(column, shown=column.key not in hidden) for column in columns],
        rows=method_rows(study, cells),
        notes=_notes(study, shared, devices),
        count=f"means over {counted(len(shared), 'scene')}" if len(shared) > 1 else "",
        name="costs",
    )


def _steps(study: Study, method: str) -> TableCell:
    steps = sorted({run.result.steps for run in study.by_method[method]})
    return TableCell(f"{steps[0]:,}" if len(steps) == 1 else f"{steps[0]:,} to {steps[-1]:,}", steps[-1])


def _cell(study: Study, shared: Sequence[str], cost: _Cost, method: str) -> TableCell:
    """Mean over scenes of the means over seeds; missing unless it is known of every run."""
    if not shared:
        return TableCell(note="no scene that all methods have")
    by_scene = [[cost.value(run.result.cost) for run in study.by_method[method] if run.scene == s] for s in shared]
    means = np.array([np.mean(np.array(values, dtype=np.float64)) for values in by_scene])  # NaN where one is missing
    known = np.count_nonzero(np.isfinite(means))
    if known == len(shared):
        return TableCell(cost.text(float(means.mean())), float(means.mean()))
    where = f"; known of {known} of {len(shared)} scenes" if known else ""
    return TableCell(note=f"{cost.column.title}: {cost.missing}{where}")


def _ranked(column: Column, cells: Sequence[TableCell]) -> list[TableCell]:
    """Cells with their ranks; values that look alike share one."""
    first = {cell.text: cell.value for cell in reversed(cells)}
    ranks = ranks_of([first[cell.text] for cell in cells], column.direction)
    return [replace(cell, rank=rank) for cell, rank in zip(cells, ranks, strict=True)]


def _notes(study: Study, shared: Sequence[str], devices: dict[str, set[str]]) -> list[str]:
    """Notes: scenes that the means leave out, devices, and the recorded plans of densification and pruning."""
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
    notes.append("Rendering: views of the test sets a second. Gaussians: drawn in a test view, mean")
    plans = dict.fromkeys((run.method, run.result.provenance.get("training", {}).get("plan")) for run in study.runs)
    return notes + [f"{method}: {plan}" for method, plan in plans if plan]


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
