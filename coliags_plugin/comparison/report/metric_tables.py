"""Tables with a row per method: means of metrics and of costs, and a reference's lead over its rivals with tests."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np

from coliags_plugin.comparison.report.published import published_for
from coliags_plugin.comparison.report.study import Study, StudyRun, TestSet, grouped
from coliags_plugin.core.errors import check_name
from coliags_plugin.reporting.model import Column, Table, TableCell, Value, ranked_cells
from coliags_plugin.reporting.numbers import column_decimals, counted, duration, number_text, unit_text
from coliags_plugin.results.comparisons import (
    FEWEST_SCENES,
    LEVELS,
    BySeed,
    RivalComparison,
    Spread,
    common_scenes,
    compare_with_rivals,
    smallest_p,
    spread,
)
from coliags_plugin.results.reading import COSTS, Cost
from coliags_plugin.results.record import MAIN_SET, SEEN_SUFFIX, CostRecord

#: Labels the rows.
METHOD = Column("method", "Method", words=True)
#: Shown unless the reader chooses others.
DEFAULT_COLUMNS = [
    *("psnr", "psnr_gain_fitted", "ssim", "lpips", "depth_mse", "depth_mse_inner", "depth_median_error"),
    *("sparse_depth_median", "sparse_depth_p90"),
]
#: Default columns of other sets, whose views leave the path, so that much of what they see was never filmed.
_BEYOND_THE_PATH = ["psnr", "psnr_seen", "psnr_gain_fitted_seen", *DEFAULT_COLUMNS[2:]]
#: Metrics shown in place of a default column that no result has.
_INSTEAD = {"lpips": "lpips_squeeze"}
#: Chooses all.
ALL_COLUMNS = "all"

_NAMES = {
    "psnr": "PSNR",
    "psnr_gain_fitted": "PSNR, gain fitted",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "lpips_squeeze": "LPIPS, SqueezeNet",
    "depth_mse": "Depth MSE",
    "depth_mse_inner": "Depth MSE, inner",
    "depth_rmse": "Depth RMSE",
    "depth_mae": "Depth MAE",
    "depth_median_error": "Depth median error",
    "depth_abs_rel": "Depth AbsRel",
    "sparse_depth_median": "Sparse depth, median",
    "sparse_depth_p90": "Sparse depth, 90th percentile",
}


def metric_title(metric: str) -> str:
    """Title of a metric, for instance "PSNR, seen pixels"."""
    base = metric.removesuffix(SEEN_SUFFIX)
    title = _NAMES.get(base) or base.replace("_", " ").capitalize()
    return f"{title}, seen pixels" if metric != base else title


def metric_columns(test_set: TestSet, chosen: Sequence[str] = ()) -> list[Column]:
    """Columns of a test set: every metric that it has, or that no set has; those not chosen are there, but not shown.

    Chosen ones come first, in their order. Unless chosen, metrics that have no value in the set, nor a published one,
    are not shown either.
    """
    metrics, (published, _) = test_set.study.metrics, published_for(test_set)
    available = {name for name in metrics if test_set.has(name)}
    elsewhere = {name for name in metrics if any(other.has(name) for other in test_set.study.test_sets)} - available
    names = [name for name in metrics if not name.endswith(SEEN_SUFFIX) or name not in elsewhere]
    if not chosen:
        usual = DEFAULT_COLUMNS if test_set.set_name == MAIN_SET else _BEYOND_THE_PATH
        usual = [
            _INSTEAD[name] if name not in available and _INSTEAD.get(name) in available else name for name in usual
        ]
        printed = {name for row in published.values() for name in row}
        chosen = [name for name in usual if name in available | printed]
    shown = names if ALL_COLUMNS in chosen else [name for name in chosen if name in names]
    return [
        Column(name, metric_title(name), metrics[name].unit, metrics[name].direction, name in shown)
        for name in dict.fromkeys([*shown, *names])
    ]


def _rows(study: Study, cells: Mapping[str, Sequence[TableCell]]) -> list[Mapping[str, Value | TableCell]]:
    """Rows of a table, one per method, from the cells of every method by the keys of the columns."""
    return [
        {METHOD.key: TableCell(method, style=index), **{key: column[index] for key, column in cells.items()}}
        for index, method in enumerate(study.methods)
    ]


def shared_scenes(values: Mapping[str, BySeed]) -> list[str]:
    """Scenes that every method with a value has; a method without any does not count."""
    return common_scenes([by_scene for by_scene in values.values() if by_scene])


def spreads(values: Mapping[str, BySeed]) -> dict[str, Spread]:
    """Mean and spread of every method over the shared scenes; of one without any value, None."""
    scenes = shared_scenes(values)
    return {method: spread(by_scene, scenes if by_scene else ()) for method, by_scene in values.items()}


# Means of metrics


def means_table(
    test_set: TestSet,
    columns: Sequence[Column],
    scene: str | None = None,
    stars: Mapping[str, Mapping[str, str]] | None = None,
) -> Table:
    """Mean of every metric over the scenes that all methods have, or over one scene, with its standard deviation.

    Stars are by metric and method. Means over all scenes have notes, and published numbers below them.
    """
    published, source = published_for(test_set) if scene is None else ({}, "")
    scenes, marks = test_set.scenes if scene is None else [scene], stars or {}
    cells = {column.key: _metric_cells(test_set, column, scene, marks.get(column.key, {})) for column in columns}
    notes = [] if scene is not None else _summary_notes(test_set, columns)
    if scene is None and any(cell.spread for column in cells.values() for cell in column):
        notes.append(f"± standard deviation over {'scenes' if len(scenes) > 1 else 'seeds'}")
    if any(mark for by_method in marks.values() for mark in by_method.values()):
        levels = ", ".join(f"{'*' * (index + 1)} p < {f'{level:g}'[1:]}" for index, level in enumerate(LEVELS))
        notes.append(f"Differs from the reference: {levels} (Wilcoxon signed-rank test over scenes, Holm)")
    rows = _rows(test_set.study, cells)
    for method, numbers in published.items():
        label = TableCell(f"{method}, published", published=True)
        rows.append({METHOD.key: label, **{key: TableCell(text, float(text)) for key, text in numbers.items()}})
    frames = counted(sum(len(test_set.frames(each)) for each in scenes), "frame")
    return Table(
        test_set.title if scene is None else f"{scene}, {test_set.title}",
        [METHOD, *columns],
        rows,
        [*notes, source] if source else notes,
        count=f"{counted(len(scenes), 'scene')}, {frames}" if len(scenes) > 1 else frames,
        name=f"summary-{test_set.name}" if scene is None else f"scene-{scene}-{test_set.name}",
    )


def _metric_cells(test_set: TestSet, column: Column, scene: str | None, stars: Mapping[str, str]) -> list[TableCell]:
    """Cells of one column, by one scene or, with footnotes, all."""
    values = test_set.values(column.key)
    if scene is not None:
        values = {method: {scene: by_scene[scene]} if scene in by_scene else {} for method, by_scene in values.items()}
    means = spreads(values).values()
    over = [each.over_scenes if each.scenes > 1 else each.over_seeds for each in means]
    cells = ranked_cells([each.mean for each in means], column.unit, column.direction, over)
    if scene is not None:
        return cells
    return [
        replace(cell, stars=stars.get(method, ""), note=_footnote(test_set, column, method, values))
        for method, cell in zip(test_set.study.methods, cells, strict=True)
    ]


def _footnote(test_set: TestSet, column: Column, method: str, values: Mapping[str, BySeed]) -> str:
    """Footnote of a mean over scenes: why it is missing, or what it leaves out; empty where it leaves out nothing."""
    evaluated = [scene for scene in test_set.scenes if test_set.evaluated(method, scene)]
    lacking, shared = [scene for scene in evaluated if scene not in values[method]], shared_scenes(values)
    if not evaluated:
        return f"{method}: no result"
    if values[method] and not shared:
        return f"{column.title}: no scene that all methods have"
    if lacking:
        where = f"not available for {', '.join(lacking)}; " if values[method] else ""
        return f"{column.title}: {where}{test_set.reason(method, column.key, lacking[0])}"
    frames = [
        value
        for scene in shared
        for _, record in test_set.evaluated(method, scene)
        for value in record.values.get(column.key, (None,) * len(record.frames))
    ]
    if None not in frames:
        return ""
    share = f"{len(frames) - frames.count(None)} of {len(frames)} frames"
    return f"{column.title}: mean over {share}; {test_set.reason(method, column.key)}"


def _summary_notes(test_set: TestSet, columns: Sequence[Column]) -> list[str]:
    """Notes: metrics without values and why, scenes that means leave out, and methods whose mean few scenes rule."""
    values = {column.key: test_set.values(column.key) for column in columns}
    lacking = [column for column in columns if not any(values[column.key].values())]
    missing = grouped(
        [column for column in columns if column not in lacking],
        lambda column: tuple(scene for scene in test_set.scenes if scene not in shared_scenes(values[column.key])),
    )
    empty = grouped(
        [column for column in lacking if not column.shown and column.key in {*DEFAULT_COLUMNS, *_BEYOND_THE_PATH}],
        lambda column: test_set.reason(test_set.study.methods[0], column.key),
    )
    without = "; ".join(f"{_titles(group)} ({reason})" for reason, group in empty.items())
    notes = [f"Not shown, without values: {without}"] if without else []
    for scenes, group in missing.items():
        if scenes:
            notes.append(
                f"{'Means' if len(missing) == 1 else f'{_titles(group)}: means'} over "
                f"{len(test_set.scenes) - len(scenes)} of {len(test_set.scenes)} scenes, without {', '.join(scenes)}, "
                "which not every method has"
            )
    for column in columns:
        ruled = {
            method: each.median or 0.0 for method, each in spreads(values[column.key]).items() if each.ruled_by_few
        }
        if column.shown and column.direction == "lower" and ruled:
            decimals = column_decimals(column.unit, ruled.values())
            each = ", ".join(f"{method} ({number_text(median, decimals)})" for method, median in ruled.items())
            what = "few scenes rule the mean, which is more than twice the median over scenes, of"
            notes.append(f"{column.title}: {what} {each}")
    return notes


def _titles(columns: Sequence[Column]) -> str:
    return "; ".join(column.title for column in columns)


# Costs

#: PSNR marks that are shown: the highest that a method reached.
_MARKS_SHOWN = 3


def _mark(mark: str) -> Cost:
    def value(cost: CostRecord) -> float | None:
        return cost.seconds_to_psnr.get(mark)

    return Cost(f"seconds_to_{mark}", f"To {mark} dB", value, duration, work="training", missing="not reached")


def cost_table(study: Study) -> Table:
    """Mean costs of every method over the scenes that all methods have, seeds averaged; ranked within one device."""
    covered = [{run.scene for run in runs} for runs in study.by_method.values()]
    shared = [scene for scene in study.scenes if all(scene in scenes for scenes in covered)]
    costs = [run.result.cost for run in study.runs]
    devices = {
        "training": dict.fromkeys(map(training_device, costs)),
        "rendering": dict.fromkeys(map(_rendering_device, costs)),
    }
    mixed = [work for work, names in devices.items() if len(names) > 1]
    marks = [_mark(name) for name in sorted({name for cost in costs for name in cost.seconds_to_psnr}, key=float)]
    shown = [replace(cost, direction=None) if cost.work in mixed else cost for cost in (*COSTS[:2], *marks, *COSTS[2:])]
    cells = {"steps": [_steps(runs) for runs in study.by_method.values()]}
    cells |= {cost.key: _cost_cells(study, shared, cost) for cost in shown}
    reached = [mark.key for mark in marks if any(cell.text for cell in cells[mark.key])]
    hidden = {mark.key for mark in marks} - {*reached[-_MARKS_SHOWN:]}
    columns = [Column("steps", "Steps")]
    columns += [Column(cost.key, cost.title, cost.unit, cost.direction, cost.key not in hidden) for cost in shown]
    notes = []
    if len(shared) < len(study.scenes):
        missing = ", ".join(scene for scene in study.scenes if scene not in shared)
        notes.append(f"Means over {len(shared)} of {len(study.scenes)} scenes, without {missing}")
    if mixed:
        names = "; ".join(sorted({device for work in mixed for device in devices[work]}))
        notes.append(
            f"Not ranked: {' and '.join(mixed)} ran on different devices, whose costs are not comparable ({names})"
        )
    notes += [f"All {work} on {next(iter(names))}" for work, names in devices.items() if work not in mixed]
    if marks:
        notes.append("To N dB: training time until the logged PSNR, smoothed, first reached N dB")
    notes.append("Rendering: views of the test sets a second. Gaussians: drawn in a test view, mean")
    plans = dict.fromkeys((run.method, run.result.provenance.get("training", {}).get("plan")) for run in study.runs)
    return Table(
        "Costs",
        [METHOD, *columns],
        _rows(study, cells),
        notes + [f"{method}: {plan}" for method, plan in plans if plan],
        count=f"means over {counted(len(shared), 'scene')}" if len(shared) > 1 else "",
        name="costs",
    )


def _steps(runs: Sequence[StudyRun]) -> TableCell:
    steps = sorted({run.result.steps for run in runs})
    return TableCell(" to ".join(f"{end:,}" for end in dict.fromkeys((steps[0], steps[-1]))), steps[-1])


def _cost_cells(study: Study, shared: Sequence[str], cost: Cost) -> list[TableCell]:
    """Mean over scenes of the means over seeds; missing unless it is known of every run."""
    means, notes = list[float | None](), list[str]()
    for runs in study.by_method.values():
        by_scene = [[cost.value(run.result.cost) for run in runs if run.scene == scene] for scene in shared]
        scene_means = np.array([np.mean(np.array(values, np.float64)) for values in by_scene])  # NaN where one is None
        count = np.count_nonzero(np.isfinite(scene_means))
        is_known = bool(shared) and count == len(shared)
        means.append(float(scene_means.mean()) if is_known else None)
        where = f"; known of {count} of {len(shared)} scenes" if count else ""
        missing = f"{cost.title}: {cost.missing}{where}" if shared else "no scene that all methods have"
        notes.append("" if is_known else missing)
    cells = ranked_cells(means, "", cost.direction, text=cost.text)
    return [replace(cell, note=note) for cell, note in zip(cells, notes, strict=True)]


def training_device(cost: CostRecord) -> str:
    """Device of a run's training, with its threads."""
    return cost.device if cost.threads is None else f"{cost.device}, {counted(cost.threads, 'thread')}"


def _rendering_device(cost: CostRecord) -> str:
    """Device that rendered the test views, with its threads."""
    same = {} if cost.render_device is None else {"device": cost.render_device, "threads": cost.render_threads}
    return training_device(cost.model_copy(update=same))


# Leads and their tests

#: What the columns of a table of leads are.
EXPLANATION = (
    "Lead: by how much the reference is better, mean over the scenes that both methods have; seeds are averaged "
    "first. 95 % t interval: of the mean lead over scenes, by Student's t. Smallest p: what the two-sided Wilcoxon "
    "signed-rank test of so many scenes can give. Holm: adjusted for all rivals that were planned or given. "
    "Cohen's d: of paired samples, the mean lead over its standard deviation. Rank-biserial: matched-pairs "
    "correlation, 1 where the reference is better on every scene. Missing: no scene in common, fewer than "
    f"{FEWEST_SCENES} of them for a test, or leads that are all equal."
)
_SMALLEST_PRINTED = 1e-4


def p_text(p: float, digits: int = 2) -> str:
    """A p-value with significant digits, without a leading zero; ``1`` and ``< .0001`` at the ends."""
    return "< .0001" if p < _SMALLEST_PRINTED else f"{p:.{digits}g}".removeprefix("0")


def _signed(value: float, decimals: int = 2) -> str:
    text = number_text(value, decimals)
    return f"+{text}" if value > 0 and text.strip("0.") else text


#: Columns of the tests by key: title, text of a number, and the number of a comparison.
_TESTS: dict[str, tuple[str, Callable[[float], str], Callable[[RivalComparison], float | None]]] = {
    "smallest": ("Smallest p", lambda p: p_text(p, 3), lambda row: smallest_p(len(row.scenes))),
    "wilcoxon": ("Wilcoxon p", p_text, attrgetter("tests.wilcoxon")),
    "wilcoxon_holm": ("Holm", p_text, attrgetter("tests.wilcoxon_holm")),
    "t_test": ("t-test p", p_text, attrgetter("tests.t_test")),
    "t_test_holm": ("Holm", p_text, attrgetter("tests.t_test_holm")),
    "cohen_dz": ("Cohen's d", _signed, attrgetter("tests.cohen_dz")),
    "rank_biserial": ("Rank-biserial", _signed, attrgetter("tests.rank_biserial")),
}


def choose_reference(study: Study, chosen: str | None) -> str:
    """The method that the others are compared with: that chosen, else that decided, else ``coliags``, else the best."""
    if chosen is not None:
        check_name("method", chosen, study.methods)
    decided = None if study.decided is None else study.decided.reference
    preferred = next((name for name in (chosen, decided, "coliags") if name in study.methods), None)
    if preferred is not None:
        return preferred
    column = metric_columns(study.test_sets[0])[0]
    by_method = spreads(study.test_sets[0].values(column.key))
    sign = 1.0 if column.direction == "higher" else -1.0
    means = {method: -np.inf if each.mean is None else sign * each.mean for method, each in by_method.items()}
    return max(study.methods, key=means.__getitem__)


def compare(test_set: TestSet, column: Column, reference: str) -> list[RivalComparison]:
    """Paired comparisons of the reference with every method by one metric; empty where it has no value."""
    values = test_set.values(column.key)
    if column.direction is None or not values[reference]:
        return []
    rivals = {method: by_scene for method, by_scene in values.items() if by_scene}
    return compare_with_rivals(rivals, reference, column.direction == "higher", test_set.study.rivals(reference))


def lead_table(test_set: TestSet, column: Column, compared: Sequence[RivalComparison], reference: str) -> Table:
    """Lead of the reference by one metric over each rival, with tests where there are enough scenes."""
    study, unit = test_set.study, unit_text(column.unit)
    columns = [Column("over", "Over", words=True), Column("scenes", "Scenes")]
    columns += [Column("lead", "Lead", column.unit), Column("better", "Better on")]
    if any(row.tests for row in compared):
        columns.append(Column("interval", "95 % t interval", column.unit))
        columns += [Column(key, title) for key, (title, *_) in _TESTS.items()]
    decimals = column_decimals(column.unit, [row.lead for row in compared])
    rows = []
    for row in compared:
        cells: dict[str, Value | TableCell] = {
            "over": TableCell(row.rival, style=study.methods.index(row.rival)),
            "scenes": len(row.scenes),
            "lead": None if row.lead is None else TableCell(_signed(row.lead, decimals), row.lead),
            "better": TableCell(f"{row.better_on} of {len(row.scenes)}", row.better_on),
        }
        if row.tests is not None:
            ends = row.tests.interval
            cells["interval"] = TableCell(" to ".join(_signed(end, decimals) for end in ends), ends[0])
            for key, (_, text, value) in _TESTS.items():
                p = value(row)
                cells[key] = None if p is None else TableCell(text(p), p)
            holm, marks = row.tests.wilcoxon_holm, row.stars if study.is_decided(reference, column.key) else ""
            cells["wilcoxon_holm"] = TableCell(p_text(holm), holm, stars=marks)
        rows.append(cells)
    return Table(
        title=f"{column.title}: lead of {reference}",
        columns=columns,
        rows=rows,
        count=test_set.title + (f", {unit}" if unit else ""),
        name=f"lead-{test_set.name}-{column.key}",
    )


def statistics_text(study: Study, compared: Sequence[RivalComparison], reference: str) -> str:
    """Sentences on the tests of one metric: unit, smallest p, family, stars; empty without a common scene."""
    most = max((len(row.scenes) for row in compared), default=0)
    smallest, rivals = smallest_p(most), study.rivals(reference)
    if not most:
        return ""
    if most < FEWEST_SCENES:
        return (
            f"No test is run: {counted(most, 'scene')} cannot tell methods apart. The unit is the scene, not the "
            f"frame, and of {counted(most, 'difference')} the two-sided Wilcoxon test cannot give less than p = "
            f"{p_text(smallest, 3)}; tests are run from {FEWEST_SCENES} scenes on "
            f"(p = {p_text(smallest_p(FEWEST_SCENES), 3)})."
        )
    decided = "nothing"
    if study.decided is not None:
        metrics = ", ".join(map(metric_title, study.decided.primary))
        decided = f"{study.decided.reference} against the others by {metrics}, on {study.decided.date}"
    return (
        f"Two-sided Wilcoxon signed-rank tests, paired over {counted(most, 'scene')}, not over frames, give no p below "
        f"{p_text(smallest, 3)}, or {p_text(min(1.0, rivals * smallest), 3)} after Holm's adjustment for "
        f"{counted(rivals, 'rival')}: every method that was planned or given. Stars are for what was decided before "
        f"the first run ({decided})."
    )
