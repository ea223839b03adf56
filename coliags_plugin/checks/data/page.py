"""HTML page of the consistency checks: statistics, findings, and frames reprojected into each other."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np
import torch

from coliags_plugin.checks.data.check import SceneCheck
from coliags_plugin.checks.data.findings import Finding
from coliags_plugin.checks.data.reprojection import warp_image
from coliags_plugin.checks.data.text import fact_rows, reading_rows
from coliags_plugin.core.scenes import Frame
from coliags_plugin.outputs.charts import Series, line_chart
from coliags_plugin.outputs.colormaps import colorize_depth, colorize_rgb_error
from coliags_plugin.outputs.image_files import encode_png
from coliags_plugin.outputs.page import fact_list, figure, record, table, write_page

#: Number of pairs shown.
_SHOWN = 3
_AXES = "xyz"


def write_check_page(check: SceneCheck, output: Path) -> None:
    """Write the HTML page of a check.

    Raises:
        InputError: ``output`` is a folder, or cannot be written.
    """
    name = check.scene.name
    verdict = f"{len(check.findings)} suspect" if check.findings else "nothing suspect"
    header = f"<h1>{escape(name)}: {verdict}</h1>" + fact_list(dict(fact_rows(check)))
    sections = [_findings(check), _readings(check), _images(check), _path(check.scene.video), _provenance(check)]
    write_page(output, f"{name}: data check", header, sections)


def _findings(check: SceneCheck) -> str:
    parts = [
        f'<h2>{title}</h2><ul class="cautions">{"".join(map(_item, found))}</ul>'
        for title, found in (("Suspect", check.findings), ("Undecided", check.undecided))
        if found
    ]
    return f"<section>{''.join(parts)}</section>" if parts else ""


def _item(finding: Finding) -> str:
    return f"<li><strong>{escape(finding.what)}</strong>: {escape(finding.evidence)}. {escape(finding.do)}</li>"


def _readings(check: SceneCheck) -> str:
    head, rows = reading_rows(check)
    if not rows:
        return ""
    gaps = [target.index - source.index for source, target in check.pairs] or [0]
    apart = f"{min(gaps)} to {max(gaps)} frames"
    note = (
        f"Each of {len(check.pairs)} frames is reprojected {apart} ahead by depth, poses and calibration; "
        "medians over all pixels. If the given poses are not the best row, they are suspect."
        if check.agreement
        else f"Matched features of {len(check.pairs)} pairs of frames, {apart} apart, as there is no depth."
    )
    return f'<section><h2>Agreement</h2><p class="hint">{escape(note)}</p>{table(head, rows)}</section>'


def _images(check: SceneCheck) -> str:
    chosen = check.pairs[:: max(1, len(check.pairs) // _SHOWN)][:_SHOWN]
    parts = []
    for source, target in chosen:
        cells = [_cell(source.image.numpy(), source.name), _cell(target.image.numpy(), target.name)]
        if source.depth is not None and target.depth is not None:
            painted, shown = warp_image(source, target)
            canvas = torch.where(shown[..., None], painted, torch.full_like(painted, 0.5))
            cells.append(_cell((canvas * 255).round().byte().numpy(), f"{target.name} warped from {source.name}"))
            mixed = torch.where(_checkered(shown)[..., None], canvas, target.rgb.double())
            cells.append(_cell((mixed * 255).round().byte().numpy(), "checkerboard of both: edges must be continuous"))
            error = colorize_rgb_error(painted.float(), target.rgb, shown)
            cells.append(_cell(error, "difference, black 0 to yellow 20 % of full scale"))
        if target.depth is not None:
            depth = target.depth.numpy()
            known = depth[np.isfinite(depth)]
            if len(known):
                low, high = (float(value) for value in np.quantile(known, (0.01, 0.99)))
                title = f"z-depth, {low:.3g} to {high:.3g} scene units"
                cells.append(_cell(colorize_depth(depth, (low, max(high, low * 1.001))), title))
        parts.append(f"<h3>{escape(source.name)} and {escape(target.name)}</h3>")
        parts.append(f'<div class="view" style="--cells: 3">{"".join(cells)}</div>')
    return f"<section><h2>Reprojected frames</h2>{''.join(parts)}</section>" if parts else ""


def _checkered(shown: torch.Tensor) -> torch.Tensor:
    """Checkerboard mask within the pixels shown. [H, W]"""
    height, width = shown.shape
    side = max(8, width // 10)
    rows, columns = torch.arange(height)[:, None] // side, torch.arange(width)[None] // side
    return ((rows + columns) % 2 == 0) & shown


def _path(video: Sequence[Frame]) -> str:
    centers = np.stack([frame.camera.center.double().numpy() for frame in video])
    numbers = [float(frame.index) for frame in video]
    along = [Series(_AXES[axis], axis, numbers, [float(value) for value in centers[:, axis]]) for axis in range(3)]
    x, y, z = ([float(value) for value in centers[:, axis]] for axis in range(3))
    charts = [
        ("Camera centre along the video", line_chart(along, "frame", "position, scene units"), _legend()),
        ("From above", line_chart([Series("path", 3, z, x)], "z, scene units", "x, scene units"), ""),
        ("From the side", line_chart([Series("path", 3, z, y)], "z, scene units", "y, scene units"), ""),
    ]
    figures = "".join(f"<figure><h4>{title}</h4>{chart}{legend}</figure>" for title, chart, legend in charts)
    return f'<section><h2>Trajectory</h2><div class="charts">{figures}</div></section>'


def _legend() -> str:
    items = "".join(f'<li><i class="swatch s{axis}"></i>{name}</li>' for axis, name in enumerate(_AXES))
    return f'<ul class="legend">{items}</ul>'


def _provenance(check: SceneCheck) -> str:
    return f"<section><h2>Data</h2>{record('What the data manager found', check.scene.provenance)}</section>"


def _cell(rgb: np.ndarray, caption: str) -> str:
    return figure(encode_png(rgb), caption)
