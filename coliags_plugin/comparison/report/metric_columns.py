"""Columns of metrics: titles, and which of them a table shows."""

from __future__ import annotations

from collections.abc import Sequence

from coliags_plugin.comparison.report.published import published_for
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.reporting.model import Column
from coliags_plugin.results.record import MAIN_SET, SEEN_SUFFIX

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
