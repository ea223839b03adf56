"""Folder with the results of a measurement of coverage."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coliags_plugin.core.files import atomic_folder, atomic_write, write_json
from coliags_plugin.geometry.meshes.files import write_mesh
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.outputs.image_files import write_png
from coliags_plugin.surface.coverage.evaluation import Evaluation
from coliags_plugin.surface.coverage.map import draw_map, face_colors
from coliags_plugin.surface.coverage.measure import Coverage
from coliags_plugin.surface.coverage.page import write_coverage_page
from coliags_plugin.surface.coverage.text import as_json
from coliags_plugin.surface.coverage.views import CoverageView


def write_coverage(
    coverage: Coverage,
    views: Sequence[CoverageView],
    output: Path,
    name: str,
    evaluation: Evaluation | None = None,
    overwrite: bool = False,
) -> None:
    """Write ``coverage.json``, ``regions.csv``, ``map.png``, ``coverage.ply`` and ``coverage.html``, atomically.

    Args:
        coverage: The measurement.
        views: The frames that it was measured from.
        output: The folder to make.
        name: Of the scene or run, for titles.
        evaluation: Against the truth, where there is one.
        overwrite: Replace the folder where it exists.

    Raises:
        InputError: The folder exists or cannot be written, or an image of a frame cannot be read.
    """
    with atomic_folder(output, overwrite) as folder:
        values = as_json(coverage, evaluation)
        write_json(folder / "coverage.json", values)
        atomic_write(folder / "regions.csv", _csv(values["regions"]))
        write_png(folder / "map.png", draw_map(coverage))
        write_mesh(folder / "coverage.ply", colored_mesh(coverage))
        write_coverage_page(coverage, views, folder / "coverage.html", name, evaluation)


def colored_mesh(coverage: Coverage) -> TriangleMesh:
    """The wall, guessed parts included, in the colours of the map; triangles share no vertices, so that none mix."""
    mesh = coverage.mesh
    vertices = mesh.vertices[mesh.triangles].reshape(-1, 3)
    colors = np.repeat(face_colors(coverage), 3, axis=0)
    return TriangleMesh(vertices, np.arange(3 * len(mesh)).reshape(-1, 3), colors)


_COLUMNS = (
    "number",
    "area_mm2",
    "diameter_mm",
    "guessed_area_mm2",
    "along_mm",
    "clock_degrees",
    "from_mm",
    "to_mm",
    "x_mm",
    "y_mm",
    "z_mm",
    "nearest_frame",
)


def _csv(regions: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for region in regions:
        numbers = [region[key] for key in ("area", "diameter", "guessed_area", "along", "clock_degrees", "from", "to")]
        rounded = [f"{value:.3f}" for value in (*numbers, *region["centroid"])]
        writer.writerow([region["number"], *rounded, region["nearest_frame"]])
    return text.getvalue()
