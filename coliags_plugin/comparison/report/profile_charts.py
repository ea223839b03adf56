"""Charts of errors against the two factors of light attenuation: distance, and angle to the optical axis."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from coliags_plugin.comparison.report.html_blocks import legend
from coliags_plugin.comparison.report.metric_columns import part_title
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.outputs.charts import Series, line_chart
from coliags_plugin.results.record import ProfileRecord

_AXES = {"distance": "distance to the camera [mm]", "angle": "angle to the optical axis [degrees]"}
#: Bins with a smaller share of the pixels are left out.
_SMALLEST_SHARE = 1e-3
#: Ratio of largest to smallest error from which on the axis is logarithmic.
_LOG_FROM = 20.0


def profile_section(study: Study) -> str:
    """HTML section; empty where no result has profiles."""
    parts = [html for part in study.parts if (html := _part(study, part))]
    if not parts:
        return ""
    how = (
        "Over the pixels with known depth, all frames and scenes together: PSNR from the mean squared colour error, "
        "and the root mean square of the depth error, drawn at the middle of each bin. Bins with less than "
        f"{_SMALLEST_SHARE:.1%} of the pixels are left out. The light of a scope falls with both."
    )
    head = f'<section><h2>Error against distance and angle</h2><p class="hint">{how}</p>{legend(study.methods)}'
    return "\n".join([head, *parts, "</section>"])


def _part(study: Study, part: Part) -> str:
    figures = []
    for name, x_label in _AXES.items():
        pooled = {method: _pooled(_profiles(study, part, method, name)) for method in study.methods}
        for kind, title, y_label in (
            ("rgb", "PSNR", "PSNR [dB]"),
            ("depth", "Depth error", "RMS depth error [mm]"),
        ):
            lines = [
                _series(method, style, own, kind)
                for style, (method, own) in enumerate(pooled.items())
                if own is not None
            ]
            values = [value for line in lines for value in line.y if math.isfinite(value) and value > 0.0]
            log = kind == "depth" and bool(values) and max(values) / min(values) >= _LOG_FROM
            chart = line_chart(lines, x_label, f"{y_label}, log scale" if log else y_label, log_y=log, markers=True)
            if chart:
                figures.append(f"<figure><h4>{title} against {name}</h4>{chart}</figure>")
    return f'<h3>{part_title(study, part)}</h3><div class="charts">{"".join(figures)}</div>' if figures else ""


def _profiles(study: Study, part: Part, method: str, name: str) -> list[ProfileRecord]:
    """Of the scenes on which every method has them, so that all are of the same pixels."""
    by_scene = {
        scene: [
            record.profiles[name]
            for cell in study.runs(part, scene, method)
            if (record := study.record(cell, part)) is not None and name in record.profiles
        ]
        for scene in study.scenes(part)
    }
    return [profile for scene in _shared(study, part, name) for profile in by_scene[scene]]


def _shared(study: Study, part: Part, name: str) -> list[str]:
    having = {
        method: {
            scene
            for scene in study.scenes(part)
            for cell in study.runs(part, scene, method)
            if name in cell.result.sets[part.set_name].profiles
        }
        for method in study.methods
    }
    known = [scenes for scenes in having.values() if scenes]
    return [scene for scene in study.scenes(part) if known and all(scene in scenes for scenes in known)]


class _Pooled:
    """Mean squared errors per bin over several profiles, weighted by their pixels; NaN where one is missing."""

    def __init__(self, profiles: Sequence[ProfileRecord]) -> None:
        self.edges = np.array(profiles[0].edges)
        pixels = np.array([profile.pixels for profile in profiles], dtype=np.float64)
        self.pixels = pixels.sum(axis=0)
        self.rgb = self._mean(pixels, [profile.rgb_mse for profile in profiles])
        self.depth = self._mean(pixels, [profile.depth_mse for profile in profiles])

    def _mean(self, pixels: np.ndarray, errors: Sequence[Sequence[float | None]]) -> np.ndarray:
        values = np.array([[math.nan if error is None else error for error in own] for own in errors])
        weighted = np.where(pixels > 0, pixels * values, 0.0).sum(axis=0)
        mean: np.ndarray = np.divide(weighted, self.pixels, out=np.full_like(weighted, math.nan), where=self.pixels > 0)
        return mean


def _pooled(profiles: Sequence[ProfileRecord]) -> _Pooled | None:
    """None without profiles, or where their bins differ."""
    if not profiles or len({profile.edges for profile in profiles}) > 1:
        return None
    return _Pooled(profiles)


def _series(method: str, style: int, pooled: _Pooled, kind: str) -> Series:
    middles = (pooled.edges[:-1] + pooled.edges[1:]) / 2.0
    enough = pooled.pixels >= _SMALLEST_SHARE * pooled.pixels.sum()
    errors = pooled.rgb if kind == "rgb" else pooled.depth
    with np.errstate(divide="ignore", invalid="ignore"):
        values = -10.0 * np.log10(errors) if kind == "rgb" else np.sqrt(errors)
    return Series(method, style, middles[enough].tolist(), values[enough].tolist())
