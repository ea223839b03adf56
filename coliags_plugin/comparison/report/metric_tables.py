"""Tables of metrics: their columns, and means over all scenes or a single one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from coliags_plugin.comparison.report.published import published_for
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.reporting.model import Column, Table, TableCell, ranked_cells
from coliags_plugin.reporting.numbers import column_decimals, counted, number_text
from coliags_plugin.results.comparisons import LEVELS, BySeed, Spread, common_scenes, spread
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
_INSTEAD = {"lpips": ("lpips_squeeze",)}
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


def metric_columns(part: Part, chosen: Sequence[str] = ()) -> list[Column]:
    """Columns of a part: every metric that it has, or that no part has; those not chosen are there, but not shown.

    Chosen ones come first, in their order. Unless chosen, metrics that have no value in the part, nor a published one,
    are not shown either.
    """
    metrics, parts = part.study.metrics, part.study.parts
    own = [
        name
        for name in metrics
        if not name.endswith(SEEN_SUFFIX) or part.has(name) or not any(other.has(name) for other in parts)
    ]
    wanted = own if ALL_COLUMNS in chosen else chosen or _default_columns(part)
    shown = [name for name in wanted if name in own]
    return [
        Column(name, metric_title(name), metrics[name].unit, metrics[name].direction, name in shown)
        for name in dict.fromkeys([*shown, *own])
    ]


def _default_columns(part: Part) -> list[str]:
    names = DEFAULT_COLUMNS if part.set_name == MAIN_SET else _BEYOND_THE_PATH
    published = published_for(part)
    printed = set() if published is None else {name for numbers in published.methods.values() for name in numbers}
    available = (name if part.has(name) else next(filter(part.has, _INSTEAD.get(name, ())), name) for name in names)
    return [name for name in available if part.has(name) or name in printed]


def method_rows(study: Study, cells: Mapping[str, Sequence[TableCell]]) -> list[dict[str, TableCell]]:
    """Rows of a table with one method each, of the cells of every method by the keys of the columns."""
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


def means_table(
    part: Part,
    columns: Sequence[Column],
    scene: str | None = None,
    stars: Mapping[str, Mapping[str, str]] | None = None,
) -> Table:
    """Mean of every metric over the scenes that all methods have, or over one scene, with its standard deviation.

    Stars are by metric and method; published numbers stand below our means over all scenes.
    """
    published = published_for(part) if scene is None else None
    scenes, marks = part.scenes if scene is None else [scene], stars or {}
    cells = {column.key: _cells(part, column, scenes, marks.get(column.key, {})) for column in columns}
    rows = method_rows(part.study, cells)
    if published is not None:
        rows += [_published_row(method, columns, numbers) for method, numbers in published.methods.items()]
    frames = counted(sum(len(part.frames(each)) for each in scenes), "frame")
    several = len(scenes) > 1
    notes = [] if scene is not None else _summary_notes(part, columns)
    if any(cell.spread for own in cells.values() for cell in own):
        notes.append(f"± standard deviation over {'scenes' if several else 'seeds'}")
    if any(each for own in marks.values() for each in own.values()):
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


def _cells(part: Part, column: Column, scenes: Sequence[str], stars: Mapping[str, str]) -> list[TableCell]:
    values = {
        method: {scene: seeds for scene, seeds in by_scene.items() if scene in scenes}
        for method, by_scene in part.values(column.key).items()
    }
    found = spreads(values).values()
    over = [own.over_scenes if own.scenes > 1 else own.over_seeds for own in found]
    cells = ranked_cells([own.mean for own in found], column.unit, column.direction, over)
    return [
        replace(cell, stars=stars.get(method, ""), note=_note(part, column, method, values, scenes))
        for method, cell in zip(part.study.methods, cells, strict=True)
    ]


def _published_row(method: str, columns: Sequence[Column], numbers: Mapping[str, str]) -> dict[str, TableCell]:
    cells = {column.key: numbers[column.key] for column in columns if column.key in numbers}
    label = TableCell(f"{method}, published", published=True)
    return {METHOD.key: label, **{key: TableCell(printed, float(printed)) for key, printed in cells.items()}}


def _note(part: Part, column: Column, method: str, values: Mapping[str, BySeed], scenes: Sequence[str]) -> str:
    """Footnote of a mean over scenes: why it is missing, or what it leaves out; empty where it leaves out nothing."""
    own = [scene for scene in scenes if part.runs(scene, method)]
    lacking, shared = [scene for scene in own if scene not in values[method]], shared_scenes(values)
    if not own:
        return f"{method}: no result"
    if not values[method]:
        return f"{column.title}: {part.reason(method, column.key, lacking[0])}"
    if not shared:
        return f"{column.title}: no scene that all methods have"
    if lacking:
        reason = part.reason(method, column.key, lacking[0])
        return f"{column.title}: not available for {', '.join(lacking)}; {reason}"
    records = [run.result.sets[part.set_name] for scene in shared for run in part.runs(scene, method)]
    missing = [(None,) * len(record.frames) for record in records]
    frames = [v for record, none in zip(records, missing, strict=True) for v in record.values.get(column.key, none)]
    if None not in frames:
        return ""
    having = len(frames) - frames.count(None)
    return f"{column.title}: mean over {having} of {len(frames)} frames; {part.reason(method, column.key)}"


def _summary_notes(part: Part, columns: Sequence[Column]) -> list[str]:
    """What is not shown and why, which scenes the means leave out, and of which methods few scenes rule the mean."""
    empty, left_out = dict[str, list[str]](), dict[tuple[str, ...], list[str]]()
    ruled = []
    for column in columns:
        values = part.values(column.key)
        if part.has(column.key):
            shared = shared_scenes(values)
            missing = tuple(scene for scene in part.scenes if scene not in shared)
            left_out.setdefault(missing, []).append(column.title)
        elif not column.shown:
            empty.setdefault(part.reason(part.study.methods[0], column.key), []).append(column.title)
        if column.shown and column.direction == "lower":
            medians = {method: own.median or 0.0 for method, own in spreads(values).items() if own.ruled_by_few}
            decimals = column_decimals(column.unit, medians.values())
            each = ", ".join(f"{method} ({number_text(median, decimals)})" for method, median in medians.items())
            what = "few scenes rule the mean, which is more than twice the median over scenes, of"
            ruled += [f"{column.title}: {what} {each}"] if each else []
    return [
        *(f"Not shown, without values: {'; '.join(titles)}: {reason}" for reason, titles in empty.items()),
        *(
            ("Means" if len(left_out) == 1 else f"{'; '.join(titles)}: means")
            + f" over {len(part.scenes) - len(missing)} of {len(part.scenes)} scenes, without {', '.join(missing)}, "
            "which not every method has"
            for missing, titles in left_out.items()
            if missing
        ),
        *ruled,
    ]
