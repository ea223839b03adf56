"""Columns of metrics: titles, and which of them a table shows."""

from __future__ import annotations

from collections.abc import Sequence

from coliags_plugin.comparison.report.published import published_for
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.comparison.report.tables import Column
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.results.record import MAIN_SET, SEEN_SUFFIX

#: Shown unless the reader chooses others.
DEFAULT_COLUMNS = (
    *("psnr", "ssim", "lpips", "depth_mse", "depth_mse_inner", "depth_median_error"),
    *("sparse_depth_median", "sparse_depth_p90"),
)
#: The same for other sets, whose views leave the path, so that much of what they see was never filmed.
_BEYOND_THE_PATH = ("psnr", "psnr_seen", *DEFAULT_COLUMNS[1:])
#: Of the default columns, what is shown where no result has the first.
_INSTEAD = {"lpips": "lpips_squeeze"}
#: Chooses all.
ALL_COLUMNS = "all"

_NAMES = {
    "psnr": "PSNR",
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
_SET_TITLES = {"test": "held out along the path", "rotation": "beyond the path"}


def metric_title(metric: str) -> str:
    """Title of a metric, for instance "PSNR, seen pixels"."""
    base = metric.removesuffix(SEEN_SUFFIX)
    title = _NAMES.get(base) or base.replace("_", " ").capitalize()
    return f"{title}, seen pixels" if metric != base else title


def set_title(set_name: str) -> str:
    """Title of a test set."""
    known = _SET_TITLES.get(set_name)
    return f"{set_name}: {known}" if known else set_name


def part_title(study: Study, part: Part) -> str:
    """Title of a test set, with its split where the study has several."""
    several = len({each.split for each in study.parts}) > 1
    return f"{set_title(part.set_name)}, split {part.split}" if several else set_title(part.set_name)


def part_name(study: Study, part: Part) -> str:
    """Short name of a part, for identifiers."""
    several = len({each.split for each in study.parts}) > 1
    return f"{part.set_name}-{part.split}" if several else part.set_name


def check_columns(study: Study, chosen: Sequence[str]) -> None:
    """Refuse the name of a metric that no result has.

    Raises:
        InputError: See above.
    """
    for name in chosen:
        if name not in study.metrics and name != ALL_COLUMNS:
            known = [*study.metrics, ALL_COLUMNS]
            raise InputError(f"--columns {name}: no such metric", f"of {', '.join(known)}", did_you_mean(name, known))


def metric_columns(study: Study, part: Part, chosen: Sequence[str] = ()) -> list[Column]:
    """Columns of a part: every metric that it has, or that no part has; those not chosen are there, but not shown.

    Unless chosen, metrics that have no value in the part, nor a published one, are not shown either.

    Args:
        study: The results.
        part: Test set and split.
        chosen: Metrics to show, in this order, before the others; empty: :data:`DEFAULT_COLUMNS`.
    """
    own = [name for name in study.metrics if not _belongs_elsewhere(study, part, name)]
    wanted = own if ALL_COLUMNS in chosen else chosen or _default_columns(study, part)
    shown = [name for name in wanted if name in own]
    ordered = dict.fromkeys([*shown, *own])
    return [
        Column(name, metric_title(name), study.metrics[name].unit, study.metrics[name].direction, name in shown)
        for name in ordered
    ]


def _default_columns(study: Study, part: Part) -> list[str]:
    default = DEFAULT_COLUMNS if part.set_name == MAIN_SET else _BEYOND_THE_PATH
    published = published_for(study, part)
    kept = set() if published is None else {name for numbers in published.methods.values() for name in numbers}
    empty = set(empty_metrics(study, part)) - kept
    return [name for name in (_available(study, part, name) for name in default) if name not in empty]


def empty_metrics(study: Study, part: Part) -> list[str]:
    """Metrics that no result has a value of in this part."""
    return [name for name in study.metrics if not any(study.values(part, name).values())]


def _available(study: Study, part: Part, metric: str) -> str:
    """A default column, or what stands for it where it is empty."""
    other = _INSTEAD.get(metric, metric)
    return metric if any(study.values(part, metric).values()) or not any(study.values(part, other).values()) else other


def _belongs_elsewhere(study: Study, part: Part, metric: str) -> bool:
    """Whether a metric over the seen pixels is that of other parts only."""
    if not metric.endswith(SEEN_SUFFIX):
        return False
    having = {other for other in study.parts if any(study.values(other, metric).values())}
    return bool(having) and part not in having
