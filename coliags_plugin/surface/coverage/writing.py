"""Coverage of a scene's recording, measured and written."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.core.files import atomic_folder, atomic_write, refuse_existing, write_json
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, write_mesh
from coliags_plugin.reporting.html_page import write_html
from coliags_plugin.reporting.image_files import write_png
from coliags_plugin.reporting.model import Fact, FactList, Paragraph
from coliags_plugin.reporting.text_formats import terminal_text
from coliags_plugin.surface.coverage.measure import PartialCoverage, SeenWall, WallCoverage, measure_coverage
from coliags_plugin.surface.coverage.page import (
    RESEARCH_USE,
    coverage_facts,
    coverage_page,
    draw_map,
    draw_partial,
    face_colors,
    level_table,
)
from coliags_plugin.surface.coverage.visibility import CoverageSettings, Level, recorded_views


@dataclass(frozen=True)
class MeasuredCoverage:
    """A measurement of coverage and the folder that it was written to."""

    folder: Path  # with ``coverage.json``, ``regions.csv``, ``map.png``, ``coverage.ply`` and ``coverage.html``
    coverage: WallCoverage | PartialCoverage = field(repr=False)
    values: dict[str, Any] = field(repr=False)  # the contents of ``coverage.json``

    @property
    def facts(self) -> list[Fact]:
        """Seen wall, section and missed regions."""
        return coverage_facts(self.coverage)

    @property
    def summary(self) -> str:
        """A few lines for a terminal."""
        return terminal_text([FactList(self.facts), level_table(self.coverage), Paragraph(RESEARCH_USE)])


def measure_scene(
    scene: Scene,
    mesh: TriangleMesh,
    output: Path,
    settings: CoverageSettings,
    overwrite: bool = False,
) -> MeasuredCoverage:
    """Measure the coverage of a recording and write it; the mesh is the wall in the world and unit of the scene.

    Where no section of a lumen can be measured, what was seen of the wall is written alone, and why.
    """
    refuse_existing(output, overwrite)
    views = recorded_views(scene)
    coverage = measure_coverage(mesh, views, settings, scene.is_metric)
    picture = draw_partial(coverage, views) if isinstance(coverage, PartialCoverage) else draw_map(coverage)
    values, page = coverage_values(coverage), coverage_page(coverage, picture, views, scene.name)
    with atomic_folder(output, overwrite) as folder:
        write_json(folder / "coverage.json", values)
        if values["regions"] is not None:
            atomic_write(folder / "regions.csv", _regions_csv(values["regions"]))
        write_png(folder / "map.png", picture)
        write_mesh(folder / "coverage.ply", colored_mesh(coverage))
        write_html(page, folder / "coverage.html")
    return MeasuredCoverage(output, coverage, values)


def open_recording(path: Path) -> Scene:
    """A scene without initial points, whose images are read when they are used."""
    return open_scene(path, None, ("initial_points=none", "keep_pixels=false"))


def colored_mesh(coverage: SeenWall) -> TriangleMesh:
    """The wall, guessed parts included, in the colours of the map; triangles share no vertices, so that none mix."""
    mesh = coverage.mesh
    vertices = mesh.vertices[mesh.triangles].reshape(-1, 3)
    colors = np.repeat(face_colors(coverage), 3, axis=0)
    return TriangleMesh(vertices, np.arange(3 * len(mesh)).reshape(-1, 3), colors)


def coverage_values(coverage: WallCoverage | PartialCoverage) -> dict[str, Any]:
    """Everything that is measured as JSON values: null is what only a section has, and limits that were not applied."""
    views, shown, total = coverage.views, coverage.inside & coverage.views.seen, coverage.area()
    settings, seen_area = coverage.settings.model_dump(), coverage.area(coverage.level != Level.UNSEEN)
    values = {
        "note": RESEARCH_USE,
        "unit": "mm" if coverage.metric else "unknown",
        "settings": {name: value if np.isfinite(value) else None for name, value in settings.items()},
        "frames": len(coverage.names),
        "area": total,
        "seen_area": seen_area,
        "shares": {level.name.lower(): coverage.area(coverage.level == level) / total for level in Level},
        "seen_surface": {
            "median_distance": _median(coverage, views.distance, shown),
            "median_incidence_degrees": _median(coverage, views.incidence, shown),
            "median_pixels_per_length": _median(coverage, views.pixels_per_length, shown),
            "median_frames": _median(coverage, views.frames.astype(np.float32), shown),
        },
    }
    if isinstance(coverage, PartialCoverage):
        return values | dict.fromkeys(("seen", "section", "guessed_share", "regions")) | {"no_section": coverage.reason}
    return values | {
        "seen": 1.0 - coverage.area(coverage.level == Level.UNSEEN) / total,
        "no_section": None,
        "section": {
            "start": round(coverage.section.start, 3),
            "end": round(coverage.section.end, 3),
            "rule": "from the first to the last place along the lumen where half of the wall of 10 mm was seen",
        },
        "guessed_share": coverage.area(coverage.guessed) / total,
        "regions": [
            {
                "number": number,
                "area": region.area,
                "diameter": region.diameter,
                "guessed_area": region.guessed_area,
                "along": region.arc,
                "clock_degrees": region.clock,
                "from": region.reach[0],
                "to": region.reach[1],
                "at_end_of_section": region.at_end,
                "centroid": [float(value) for value in region.centroid],
                "nearest_frame": coverage.names[region.nearest],
            }
            for number, region in enumerate(coverage.regions, start=1)
        ],
    }


def _median(coverage: SeenWall, values: Float[np.ndarray, "F"], chosen: Bool[np.ndarray, "F"]) -> float | None:
    """Median over chosen surface, weighted by area; None without any."""
    areas, values = coverage.mesh.areas[chosen], values[chosen]
    if not len(values):
        return None
    order = np.argsort(values)
    half = np.searchsorted(np.cumsum(areas[order]), 0.5 * areas.sum())
    return float(values[order][min(int(half), len(values) - 1)])


def _regions_csv(regions: Sequence[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    lengths = ("area_mm2", "diameter_mm", "guessed_area_mm2", "along_mm", "clock_degrees", "from_mm", "to_mm")
    keys = ("area", "diameter", "guessed_area", "along", "clock_degrees", "from", "to")
    writer.writerow(["number", *lengths, "x_mm", "y_mm", "z_mm", "nearest_frame"])
    for region in regions:
        rounded = [f"{value:.3f}" for value in (*(region[key] for key in keys), *region["centroid"])]
        writer.writerow([region["number"], *rounded, region["nearest_frame"]])
    return text.getvalue()
