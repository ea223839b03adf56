"""Tables of metrics: their columns, and means over all scenes or a single one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from coliags_plugin.comparison.report.published import published_for
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.reporting.model import Column, Table, TableCell, ranked_cells
from coliags_plugin.reporting.numbers import column_decimals, counted, number_text
from coliags_plugin.results.comparisons import LEVELS, BySeed, RivalComparison, Spread, common_scenes, spread
from coliags_plugin.results.record import MAIN_SET, SEEN_SUFFIX

#: Labels the rows.
METHOD = Column("method", "Method", words=True)
#: Shown unless the reader chooses others.
DEFAULT_COLUMNS = (
    *("psnr", "psnr_gain_fitted", "ssim", "lpips", "depth_mse", "depth_mse_inner", "depth_median_error"),
    *("sparse_depth_median", "sparse_depth_p90"),
)
#: The same for other sets, whose views leave the path, so that much of what they see was never filmed.
_BEYOND_THE_PATH = ("psnr", "psnr_seen", "psnr_gain_fitted_seen", *DEFAULT_COLUMNS[2:])
#: Of the default columns, what is shown where no result has the first.
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


def check_columns(study: Study, chosen: Sequence[str]) -> None:
    """Refuse the name of a metric that no result has."""
    for name in chosen:
        if name not in study.metrics and name != ALL_COLUMNS:
            known = [*study.metrics, ALL_COLUMNS]
            raise InputError(f"--columns {name}: no such metric", f"of {', '.join(known)}", did_you_mean(name, known))


def metric_columns(part: Part, chosen: Sequence[str] = ()) -> list[Column]:
    """Columns of a part: every metric that it has, or that no part has; those not chosen are there, but not shown.

    Chosen ones come first, in their order. Unless chosen, metrics that have no value in the part, nor a published one,
    are not shown either.
    """
    metrics = part.study.metrics
    own = [name for name in metrics if not _belongs_elsewhere(part, name)]
    wanted = own if ALL_COLUMNS in chosen else chosen or _default_columns(part)
    shown = [name for name in wanted if name in own]
    return [
        Column(name, metric_title(name), metrics[name].unit, metrics[name].direction, name in shown)
        for name in dict.fromkeys([*shown, *own])
    ]


def empty_metrics(part: Part) -> list[str]:
    """Metrics that no result has a value of in this part."""
    return [name for name in part.study.metrics if not _has_values(part, name)]


def _default_columns(part: Part) -> list[str]:
    default = DEFAULT_COLUMNS if part.set_name == MAIN_SET else _BEYOND_THE_PATH
    published = published_for(part)
    kept = set() if published is None else {name for numbers in published.methods.values() for name in numbers}
    empty = set(empty_metrics(part)) - kept
    return [name for name in (_available(part, name) for name in default) if name not in empty]


def _has_values(part: Part, metric: str) -> bool:
    return any(part.values(metric).values())


def _available(part: Part, metric: str) -> str:
    """A default column, or what stands for it where it is empty."""
    other = _INSTEAD.get(metric, metric)
    return metric if _has_values(part, metric) or not _has_values(part, other) else other


def _belongs_elsewhere(part: Part, metric: str) -> bool:
    """Whether a metric over the seen pixels is that of other parts only."""
    if not metric.endswith(SEEN_SUFFIX):
        return False
    having = [other for other in part.study.parts if _has_values(other, metric)]
    return bool(having) and part not in having


def method_rows(
    study: Study, columns: Sequence[Column], cells: Sequence[Sequence[TableCell]]
) -> list[dict[str, TableCell]]:
    """Rows of a table with one method each, of one cell per column and method."""
    keys = [column.key for column in columns]
    return [
        {METHOD.key: TableCell(method, style=style), **dict(zip(keys, own, strict=True))}
        for style, (method, *own) in enumerate(zip(study.methods, *cells, strict=True))
    ]


def shared_scenes(values: Mapping[str, BySeed]) -> list[str]:
    """Scenes that every method with a value has; a method without any does not count."""
    return common_scenes([by_scene for by_scene in values.values() if by_scene])


def spreads(values: Mapping[str, BySeed], scenes: Sequence[str]) -> list[Spread]:
    """Mean and spread of every method over scenes; of one without any value, None."""
    return [spread(by_scene, scenes if by_scene else ()) for by_scene in values.values()]


def means_table(
    part: Part,
    columns: Sequence[Column],
    scene: str | None = None,
    comparisons: Mapping[str, Sequence[RivalComparison]] | None = None,
) -> Table:
    """Mean of every metric over the scenes that all methods have, or over one scene, with its standard deviation.

    Stars are of the comparisons, by metric; published numbers stand below our means over all scenes.
    """
    published = published_for(part) if scene is None else None
    scenes, compared = part.scenes if scene is None else [scene], comparisons or {}
    cells = [_cells(part, column, scenes, compared.get(column.key, ())) for column in columns]
    rows = method_rows(part.study, columns, cells)
    if published is not None:
        rows += [_published_row(method, columns, numbers) for method, numbers in published.methods.items()]
    frames = counted(sum(len(part.frames(each)) for each in scenes), "frame")
    several = len(scenes) > 1
    notes = [] if scene is not None else _summary_notes(part, columns)
    if any(cell.spread for own in cells for cell in own):
        notes.append(f"± standard deviation over {'scenes' if several else 'seeds'}")
    if any(row.stars for own in compared.values() for row in own):
        levels = ", ".join(f"{'*' * (index + 1)} p < {f'{level:g}'[1:]}" for index, level in enumerate(LEVELS))
        notes.append(f"Differs from the reference: {levels} (Wilcoxon signed-rank test over scenes, Holm)")
    return Table(
        title=part.title if scene is None else f"{scene}, {part.title}",
        columns=[METHOD, *columns],
        rows=rows,
        notes=[*notes, *([] if published is None else [published.note])],
        count=f"{counted(len(scenes), 'scene')}, {frames}" if several else frames,
        name=f"summary-{part.name}" if scene is None else f"scene-{scene}-{part.name}",
    )


def _cells(part: Part, column: Column, scenes: Sequence[str], compared: Sequence[RivalComparison]) -> list[TableCell]:
    values = {
        method: {scene: seeds for scene, seeds in by_scene.items() if scene in scenes}
        for method, by_scene in part.values(column.key).items()
    }
    shared = shared_scenes(values)
    found = spreads(values, shared)
    over = [own.over_scenes if own.scenes > 1 else own.over_seeds for own in found]
    cells = ranked_cells([own.mean for own in found], column.unit, column.direction, over)
    stars = {row.rival: row.stars for row in compared}
    return [
        replace(cell, stars=stars.get(method, ""), note=_note(part, column, method, values[method], scenes, shared))
        for method, cell in zip(part.study.methods, cells, strict=True)
    ]


def _published_row(method: str, columns: Sequence[Column], numbers: Mapping[str, str]) -> dict[str, TableCell]:
    cells = {column.key: numbers[column.key] for column in columns if column.key in numbers}
    label = TableCell(f"{method}, published", published=True)
    return {METHOD.key: label, **{key: TableCell(printed, float(printed)) for key, printed in cells.items()}}


def _note(part: Part, column: Column, method: str, values: BySeed, scenes: Sequence[str], shared: Sequence[str]) -> str:
    """Footnote of a mean over scenes: why it is missing, or what it leaves out."""
    own = [scene for scene in scenes if part.runs(scene, method)]
    if not own:
        return f"{method}: no result"
    if not values:
        return f"{column.title}: {part.reason(method, column.key, scenes[0] if len(scenes) == 1 else None)}"
    if not shared:
        return f"{column.title}: no scene that all methods have"
    lacking = [scene for scene in own if scene not in values]
    if lacking:
        reason = part.reason(method, column.key, lacking[0])
        return f"{column.title}: not available for {', '.join(lacking)}; {reason}"
    return _partial_note(part, column, method, shared)


def _partial_note(part: Part, column: Column, method: str, scenes: Iterable[str]) -> str:
    """What a mean leaves out where some frames lack the metric; empty where none does."""
    records = [run.result.sets[part.set_name] for scene in scenes for run in part.runs(scene, method)]
    having = sum(value is not None for record in records for value in record.values.get(column.key, ()))
    total = sum(len(record.frames) for record in records)
    if having == total:
        return ""
    return f"{column.title}: mean over {having} of {total} frames; {part.reason(method, column.key)}"


def _summary_notes(part: Part, columns: Sequence[Column]) -> list[str]:
    """What is not shown, which scenes the means leave out, and which means few scenes rule."""
    return [*_not_shown_notes(part, columns), *_left_out_notes(part, columns), *_ruled_notes(part, columns)]


def _not_shown_notes(part: Part, columns: Sequence[Column]) -> list[str]:
    """Which metrics are not shown for lack of any value, and why, together where the reason is the same."""
    empty, by_reason = empty_metrics(part), dict[str, list[str]]()
    for column in columns:
        if column.key in empty and not column.shown:
            by_reason.setdefault(part.reason(part.study.methods[0], column.key), []).append(column.title)
    return [f"Not shown, without values: {'; '.join(titles)}: {reason}" for reason, titles in by_reason.items()]


def _left_out_notes(part: Part, columns: Sequence[Column]) -> list[str]:
    """Which scenes the means leave out, together for the columns that leave out the same."""
    titles: dict[tuple[str, ...], list[str]] = {}
    for column in columns:
        values = part.values(column.key)
        shared = shared_scenes(values)
        if any(values.values()):
            titles.setdefault(tuple(scene for scene in part.scenes if scene not in shared), []).append(column.title)
    return [
        ("Means" if len(titles) == 1 else f"{'; '.join(columns_of)}: means")
        + f" over {len(part.scenes) - len(missing)} of {len(part.scenes)} scenes, without {', '.join(missing)}, "
        "which not every method has"
        for missing, columns_of in titles.items()
        if missing
    ]


def _ruled_notes(part: Part, columns: Sequence[Column]) -> list[str]:
    """Which methods have a mean error of more than twice the median over scenes, and that median."""
    notes = []
    for column in (column for column in columns if column.shown and column.direction == "lower"):
        values = part.values(column.key)
        found = dict(zip(values, spreads(values, shared_scenes(values)), strict=True))
        medians = {method: own.median for method, own in found.items() if own.ruled_by_few and own.median is not None}
        decimals = column_decimals(column.unit, medians.values())
        if medians:
            each = ", ".join(f"{method} ({number_text(median, decimals)})" for method, median in medians.items())
            notes.append(
                f"{column.title}: few scenes rule the mean, which is more than twice the median over scenes, of {each}"
            )
    return notes
