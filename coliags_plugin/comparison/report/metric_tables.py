"""Tables of metrics: means over all scenes or a single one, and a reference's lead over its rivals with tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from coliags_plugin.comparison.report.published import published_for
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.core.errors import check_name
from coliags_plugin.reporting.model import Column, Table, TableCell, ranked_cells
from coliags_plugin.reporting.numbers import column_decimals, counted, number_text, unit_text
from coliags_plugin.results.comparisons import (
    FEWEST_SCENES,
    LEVELS,
    BySeed,
    PairedTests,
    RivalComparison,
    Spread,
    common_scenes,
    compare_with_rivals,
    smallest_p,
    spread,
)
from coliags_plugin.results.record import MAIN_SET, SEEN_SUFFIX

#: Labels the rows.
METHOD = Column("method", "Method", words=True)
#: Shown unless the reader chooses others.
DEFAULT_COLUMNS = (
    *("psnr", "psnr_gain_fitted", "ssim", "lpips", "depth_mse", "depth_mse_inner", "depth_median_error"),
    *("sparse_depth_median", "sparse_depth_p90"),
)
#: Default columns of other sets, whose views leave the path, so that much of what they see was never filmed.
_BEYOND_THE_PATH = ("psnr", "psnr_seen", "psnr_gain_fitted_seen", *DEFAULT_COLUMNS[2:])
#: Metrics shown in place of a default column that no result has.
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
    """Notes: metrics without values and why, scenes that means leave out, and methods whose mean few scenes rule."""
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


#: The reference where it is among the methods.
PREFERRED = "coliags"
#: What the columns of a table of leads are.
EXPLANATION = (
    "Lead: by how much the reference is better, mean over the scenes that both methods have; seeds are averaged "
    "first. 95 % t interval: of the mean lead over scenes, by Student's t. Smallest p: what the two-sided Wilcoxon "
    "signed-rank test of so many scenes can give. Holm: adjusted for all rivals that were planned or given. "
    "Cohen's d: of paired samples, the mean lead over its standard deviation. Rank-biserial: matched-pairs "
    "correlation, 1 where the reference is better on every scene."
)
_SMALLEST_PRINTED = 1e-4
_TESTS = {
    "smallest": "Smallest p",
    "wilcoxon": "Wilcoxon p",
    "wilcoxon_holm": "Holm",
    "t_test": "t-test p",
    "t_test_holm": "Holm",
    "cohen_dz": "Cohen's d",
    "rank_biserial": "Rank-biserial",
}


def choose_reference(study: Study, chosen: str | None) -> str:
    """The method that the others are compared with: that chosen, else that decided, else ``coliags``, else the best."""
    if chosen is not None:
        check_name("method", chosen, study.methods)
    decided = None if study.decided is None else study.decided.reference
    return next((name for name in (chosen, decided, PREFERRED) if name in study.methods), None) or _best_method(study)


def _best_method(study: Study) -> str:
    """The method that is best by the first metric; the first one where none has a value."""
    column = metric_columns(study.parts[0])[0]
    found = spreads(study.parts[0].values(column.key))
    means = {method: own.mean for method, own in found.items() if own.mean is not None}
    sign = 1.0 if column.direction == "higher" else -1.0
    return max(means, key=lambda method: sign * means[method]) if means else study.methods[0]


def compare(part: Part, column: Column, reference: str) -> list[RivalComparison]:
    """Paired comparisons of the reference with every method by one metric; empty where it has no value."""
    values = part.values(column.key)
    if column.direction is None or not values[reference]:
        return []
    rivals = {method: by_scene for method, by_scene in values.items() if by_scene}
    return compare_with_rivals(rivals, reference, column.direction == "higher", part.study.rivals(reference))


def stars(study: Study, metric: str, reference: str, row: RivalComparison) -> str:
    """Stars of a comparison, if its reference and metric were decided before the first run; else none."""
    decided = study.decided
    is_decided = decided is not None and decided.reference == reference and metric in decided.primary
    return row.stars if is_decided else ""


def lead_table(part: Part, column: Column, compared: Sequence[RivalComparison], reference: str) -> Table:
    """Lead of the reference by one metric over each rival, with tests where there are enough scenes."""
    unit = unit_text(column.unit)
    columns = [
        Column("over", "Over", words=True),
        Column("scenes", "Scenes"),
        Column("lead", "Lead", column.unit),
        Column("better", "Better on"),
    ]
    if any(row.tests for row in compared):
        columns.append(Column("interval", "95 % t interval", column.unit))
        columns += [Column(key, title) for key, title in _TESTS.items()]
    decimals = column_decimals(column.unit, [row.lead for row in compared])
    untested = TableCell(note=f"fewer than {FEWEST_SCENES} scenes in common")
    rows: list[dict[str, TableCell | int]] = []
    for row in compared:
        cells = {each.key: untested for each in columns[4:]}
        if row.tests is not None:
            cells = _test_cells(row.tests, len(row.scenes), decimals, stars(part.study, column.key, reference, row))
        own: dict[str, TableCell | int] = {
            "over": TableCell(row.rival, style=part.study.methods.index(row.rival)),
            "scenes": len(row.scenes),
            "lead": TableCell(note="no scene in common") if row.lead is None else _signed(row.lead, decimals),
            "better": TableCell(f"{row.better_on} of {len(row.scenes)}", row.better_on),
        }
        rows.append({**own, **cells})
    return Table(
        title=f"{column.title}: lead of {reference}",
        columns=columns,
        rows=rows,
        count=part.title + (f", {unit}" if unit else ""),
        name=f"lead-{part.name}-{column.key}",
    )


def _test_cells(tests: PairedTests, scenes: int, decimals: int, marks: str) -> dict[str, TableCell]:
    low, high = (_signed(end, decimals) for end in tests.interval)
    undefined = TableCell(note="all differences are equal")
    t_tests = {"t_test": tests.t_test, "t_test_holm": tests.t_test_holm}
    return {
        "interval": TableCell(f"{low.text} to {high.text}", low.value),
        "smallest": TableCell(p_text(smallest_p(scenes), digits=3), smallest_p(scenes)),
        "wilcoxon": TableCell(p_text(tests.wilcoxon), tests.wilcoxon),
        "wilcoxon_holm": TableCell(p_text(tests.wilcoxon_holm), tests.wilcoxon_holm, stars=marks),
        **{name: undefined if p is None else TableCell(p_text(p), p) for name, p in t_tests.items()},
        "cohen_dz": undefined if tests.cohen_dz is None else _signed(tests.cohen_dz, 2),
        "rank_biserial": _signed(tests.rank_biserial, 2),
    }


def _signed(value: float, decimals: int) -> TableCell:
    text = number_text(value, decimals)
    return TableCell(f"+{text}" if value > 0 and text.strip("0.") else text, value)


def statistics_text(study: Study, compared: Sequence[RivalComparison], reference: str) -> str:
    """Sentences on the tests of one metric: unit, scenes, smallest p, family, stars; empty without a common scene."""
    most = max((len(row.scenes) for row in compared), default=0)
    if not most:
        return ""
    smallest = p_text(smallest_p(most), digits=3)
    if most < FEWEST_SCENES:
        return (
            f"No test is run: {counted(most, 'scene')} cannot tell methods apart. The unit is the scene, not the "
            f"frame, and of {counted(most, 'difference')} the two-sided Wilcoxon test cannot give less than p = "
            f"{smallest}; tests are run from {FEWEST_SCENES} scenes on "
            f"(p = {p_text(smallest_p(FEWEST_SCENES), digits=3)})."
        )
    rivals, decided = study.rivals(reference), "nothing"
    if study.decided is not None:
        metrics = ", ".join(map(metric_title, study.decided.primary))
        decided = f"{study.decided.reference} against the others by {metrics}, on {study.decided.date}"
    return (
        f"Paired over {counted(most, 'scene')}: the unit is the scene, not the frame. The smallest p that the "
        f"two-sided Wilcoxon signed-rank test can give is {smallest}, or "
        f"{p_text(min(1.0, rivals * smallest_p(most)), digits=3)} after Holm's adjustment for "
        f"{counted(rivals, 'rival')}: every method that was planned or given. Stars are for what was decided before "
        f"the first run ({decided}); all other p-values are exploratory."
    )


def p_text(p: float, digits: int = 2) -> str:
    """A p-value with significant digits, without a leading zero; ``1`` and ``< .0001`` at the ends."""
    return "< .0001" if p < _SMALLEST_PRINTED else f"{p:.{digits}g}".removeprefix("0")
