"""Coverage of a scene's recording, measured and written: the unrolled map of the wall, a page, and all values."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.files import atomic_folder, atomic_write, refuse_existing, write_json
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, write_mesh
from coliags_plugin.reporting.colormaps import INK, draw_text, side_by_side, stacked, text_width
from coliags_plugin.reporting.html_page import write_html
from coliags_plugin.reporting.image_files import EncodedImage, write_png
from coliags_plugin.reporting.model import (
    Block,
    Fact,
    FactList,
    Figures,
    Image,
    Page,
    Paragraph,
    Section,
    Table,
    record,
    simple_table,
)
from coliags_plugin.reporting.numbers import area_text, linear_ticks, tick_label
from coliags_plugin.reporting.text_formats import terminal_text
from coliags_plugin.surface.coverage.centreline import STEP
from coliags_plugin.surface.coverage.measure import (
    MissedRegion,
    PartialCoverage,
    SeenWall,
    WallCoverage,
    measure_coverage,
)
from coliags_plugin.surface.coverage.visibility import (
    MAP_LEGEND,
    CoverageSettings,
    CoverageView,
    Level,
    recorded_views,
)
from coliags_plugin.surface.meshing.pictures import HEIGHT, draw_mesh, outside_cameras

#: Colour of places without wall.
_NOTHING = (245, 245, 245)
#: Edges of the axes rectangle, px: left, top, and what is right of and below it.
_LEFT, _TOP, _RIGHT, _BELOW = 70, 76, 24, 56
#: Height of the map, and width of a millimetre of it, px; and the widest map.
_HEIGHT, _PER_MM, _WIDEST = 420, 9.0, 1500
#: Wall beyond the ends of the section that is shown, mm.
_MARGIN = 12.0


def draw_map(coverage: WallCoverage) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the unrolled map, with axes in mm and degrees, a legend with areas, and the numbers of the missed regions.

    Every place shows the wall that a ray from the centreline at that clock angle meets first. Wall beyond the ends of
    the section is paler.
    """
    arc, section = coverage.grid.line.arc, coverage.section
    shown = np.flatnonzero((arc >= section.start - _MARGIN) & (arc <= section.end + _MARGIN))
    arc, triangle = arc[shown], coverage.grid.triangle[shown]
    colors = face_colors(coverage)[triangle]
    colors[triangle < 0] = _NOTHING
    beyond = ~section.holds(arc)
    colors[beyond] = (0.35 * colors[beyond] + 0.65 * 255.0).astype(np.uint8)

    first, last = arc[0] - 0.5 * STEP, arc[-1] + 0.5 * STEP
    width = round(min(_WIDEST, max(620.0, (last - first) * _PER_MM)))
    right, bottom = _LEFT + width, _TOP + _HEIGHT
    image = np.full((bottom + _BELOW, right + _RIGHT, 3), 255, np.uint8)
    spread = cv2.resize(colors.transpose(1, 0, 2), (width, _HEIGHT), interpolation=cv2.INTER_NEAREST)
    image[_TOP:bottom, _LEFT:right] = spread

    def place(arc: float, clock: float) -> tuple[int, int]:
        return _LEFT + round((arc - first) / (last - first) * width), _TOP + round(clock / 360.0 * _HEIGHT)

    for tick in linear_ticks(first, last, 10):
        x, _ = place(tick, 0.0)
        cv2.line(image, (x, bottom), (x, bottom + 5), INK, 1)
        draw_text(image, tick_label(tick), (x, bottom + 20), align=0.5)
    for angle in range(0, 361, 90):
        _, y = place(first, angle)
        cv2.line(image, (_LEFT - 5, y), (_LEFT, y), INK, 1)
        draw_text(image, str(angle), (_LEFT - 9, y + 4), align=1.0)
    cv2.rectangle(image, (_LEFT, _TOP), (right, bottom), INK, 1)
    draw_text(image, "along the lumen [mm]; 0: shallowest camera", (right, bottom + 44), align=1.0)
    draw_text(image, "clock angle [deg]; 0: up, 90: right", (_LEFT - 60, bottom + 44))
    for end in (section.start, section.end):
        if first < end < last:
            cv2.line(image, place(end, 0.0), place(end, 360.0), INK, 2)
    for number, region in enumerate(coverage.regions, start=1):
        middle = place(region.arc, region.clock)
        cv2.circle(image, middle, 11, (255, 255, 255), -1, cv2.LINE_AA)
        cv2.circle(image, middle, 11, INK, 1, cv2.LINE_AA)
        draw_text(image, str(number), (middle[0], middle[1] + 5), align=0.5)
    _legend(image, coverage)
    return image


def draw_partial(coverage: PartialCoverage, views: Sequence[CoverageView]) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the reconstructed wall in the colours of the map, from outside and from three cameras, with a legend."""
    poses = [views[index].camera_to_world for index in (0, len(views) // 2, -1)]
    inside = [
        Camera(HEIGHT / 2, HEIGHT / 2, HEIGHT / 2, HEIGHT / 2, HEIGHT, HEIGHT, torch.from_numpy(np.asarray(pose)))
        for pose in poses
    ]
    colors = face_colors(coverage)
    drawn = [
        draw_mesh(coverage.mesh, camera, lambda _, triangles: colors[triangles])
        for camera in (*outside_cameras(coverage.mesh, HEIGHT), *inside)
    ]
    labels = ("from outside", "from outside", "first frame", "in the middle", "last frame")
    pictures = side_by_side(drawn, labels)
    legend = np.full((_TOP, pictures.shape[1], 3), 255, np.uint8)
    _legend(legend, coverage)
    return stacked([legend, pictures])


def face_colors(coverage: SeenWall) -> UInt8[np.ndarray, "F 3"]:
    """Colour of each triangle by its level. [F, 3]"""
    return np.array([color for _, color in MAP_LEGEND], np.uint8)[_legend_index(coverage)]


def _legend_index(coverage: SeenWall) -> Int[np.ndarray, "F"]:
    """Entry of each triangle in the legend. [F]"""
    return np.where(coverage.guessed, len(Level), Level.SEEN_WELL - coverage.level.astype(int))


def legend_areas(coverage: SeenWall) -> dict[str, float]:
    """Area of each entry of the legend by its label; guessed wall only where there is some."""
    index, shown = _legend_index(coverage), len(Level) + bool(coverage.guessed.any())
    return {label: coverage.area(index == number) for number, (label, _) in enumerate(MAP_LEGEND[:shown])}


def _legend(image: np.ndarray, coverage: SeenWall) -> None:
    total = coverage.area()
    x, y = _LEFT, 28
    areas = legend_areas(coverage)
    for label, color in MAP_LEGEND:
        if not (area := areas.get(label)):
            continue
        text = f"{label} {100.0 * area / total:.1f} %"
        width = text_width(text)
        if x + 22 + width > image.shape[1] - 8:
            x, y = _LEFT, y + 24
        cv2.rectangle(image, (x, y - 11), (x + 14, y + 3), color, -1)
        draw_text(image, text, (x + 22, y))
        x += 22 + width + 26


#: Said wherever a clinician could read the results.
RESEARCH_USE = "Research use only: not a medical device, and not for decisions about a patient."
#: Regions with a picture; widest picture, px; and how strongly the region covers the image.
_PICTURED, _WIDTH, _OPACITY = 12, 480, 0.55


def coverage_page(
    coverage: WallCoverage | PartialCoverage,
    picture: UInt8[np.ndarray, "H W 3"],
    views: Sequence[CoverageView],
    name: str,
) -> Page:
    """The page of a measurement, with its picture and frames it was measured from, named after the scene or run."""
    settings = coverage.settings
    near = f" from at most {settings.far:g} mm" if np.isfinite(settings.far) else ""
    method = (
        "Seen: one frame or more shows the surface. Seen well: "
        f"{settings.glance_frames} frames or more show it{near}, in pixels of a grey value of {settings.dark:g} or more "
        f"(of 1), at most {settings.grazing:g} degrees from its normal. At a glance: fewer frames do. Too dark or too "
        "far: frames show it, but none so near and bright."
    )
    if isinstance(coverage, PartialCoverage):
        note = (
            f"There is no map along the lumen, no length and no missed region: {coverage.reason}. What was seen of the "
            "reconstructed wall is a result all the same; what was not reconstructed is not counted."
        )
        shown = Image(EncodedImage.png(picture), "reconstructed wall", wide=True)
        sections = [Section("Seen wall", [Paragraph(note, hint=False), Figures([shown]), level_table(coverage)])]
    else:
        note = (
            "The wall, cut open at 12 o'clock and laid flat: along the lumen from left to right, round the clock from "
            "top to bottom, as seen by a viewer who looks deeper into the lumen. Wall that turns away from the lumen, "
            "as the sides of folds, is narrower here than it is; areas in the tables are those of the surface. Numbers "
            "mark missed regions, lines the ends of the section."
        )
        shown = Image(EncodedImage.png(picture), "unrolled map", wide=True)
        sections = [
            Section("Map", [Paragraph(note), Figures([shown]), level_table(coverage)]),
            Section("Missed regions", list(_missed_regions(coverage, views))),
        ]
        method += (
            " The section reaches from the first to the last place along the lumen where half of the wall (over 10 mm) "
            "was seen; beyond it, nothing is called missed. Where no wall was reconstructed, its place is guessed from "
            "the wall around it."
        )
    sections.append(Section("How it is measured", [Paragraph(method), record("Settings", settings.model_dump())]))
    return Page(f"{name}: coverage", sections, coverage_facts(coverage), note=RESEARCH_USE)


def clock_text(degrees: float) -> str:
    """Clock angle as the hour on a dial: 0 degrees is 12 o'clock."""
    minutes = round(degrees / 360.0 * 720.0) % 720
    return f"{minutes // 60 or 12}:{minutes % 60:02d}"


def coverage_facts(coverage: WallCoverage | PartialCoverage) -> list[Fact]:
    """Seen wall, section and missed regions, for the page and the terminal."""
    total, seen_area = coverage.area(), coverage.area(coverage.level != Level.UNSEEN)
    well_area = coverage.area(coverage.level == Level.SEEN_WELL)
    frames = Fact("frames", str(len(coverage.names)))
    if isinstance(coverage, PartialCoverage):
        texts = (area_text(area, coverage.metric) for area in (seen_area, well_area))
        seen = Fact("seen", "{}, {} of it well".format(*texts))
        return [seen, Fact("section", "none", note=coverage.reason), frames]
    missed = sum(region.area for region in coverage.regions)
    return [
        Fact("seen", f"{100.0 * seen_area / total:.0f} % of the wall"),
        Fact("seen well", f"{100.0 * well_area / total:.0f} % of the wall"),
        Fact("section", f"{coverage.section.length:.0f} mm of the lumen, {total / 100.0:.0f} cm²"),
        Fact("missed regions", f"{len(coverage.regions)}, {missed / 100.0:.1f} cm² together"),
        Fact("place guessed", f"{100.0 * coverage.area(coverage.guessed) / total:.0f} % of the wall"),
        frames,
    ]


def level_table(coverage: SeenWall) -> Table:
    """Area and share of each level."""
    rows = [
        [label, area_text(area, coverage.metric), f"{100.0 * area / coverage.area():.1f}"]
        for label, area in legend_areas(coverage).items()
    ]
    return simple_table(["wall", "area", "share, %"], rows)


def _missed_regions(coverage: WallCoverage, views: Sequence[CoverageView]) -> Iterator[Block]:
    limit = f"{coverage.settings.region_diameter:g} mm"
    if not coverage.regions:
        yield Paragraph(f"None is larger than a circle of {limit} diameter.", hint=False)
        return
    yield Paragraph(
        f"Connected wall of the section that no frame shows, larger than a circle of {limit} diameter. Pictures are "
        "the nearest recorded frames that look where each region is; it is drawn where it lies, behind folds where it "
        "is hidden. Where the place of a region is guessed, so are its shape and area."
    )
    yield _region_table(coverage)
    images = []
    for number, region in enumerate(coverage.regions[:_PICTURED], start=1):
        picture = region_picture(coverage, region, views[region.nearest])
        if picture is not None:
            where = f"{region.area:.0f} mm² at {region.arc:.0f} mm, {clock_text(region.clock)} o'clock"
            caption = f"{number}: {where}, frame {coverage.names[region.nearest]}"
            images.append(Image(EncodedImage.png(picture), caption))
    if images:
        yield Figures(images)


def _region_table(coverage: WallCoverage) -> Table:
    head = ["region", "area, mm²", "diameter, mm", "along, mm", "from, mm", "to, mm", "at an end", "clock"]
    rows = [
        [
            str(number),
            f"{region.area:.0f}",
            f"{region.diameter:.1f}",
            *(f"{position:.0f}" for position in (region.arc, *region.reach)),
            "yes" if region.at_end else "no",
            clock_text(region.clock),
            f"{100.0 * region.guessed_area / region.area:.0f}",
            ", ".join(f"{value:.1f}" for value in region.centroid),
            coverage.names[region.nearest],
        ]
        for number, region in enumerate(coverage.regions, start=1)
    ]
    return simple_table([*head, "place guessed, %", "x, y, z, mm", "nearest frame"], rows)


def region_picture(
    coverage: WallCoverage, region: MissedRegion, view: CoverageView
) -> UInt8[np.ndarray, "H W 3"] | None:
    """Recorded frame nearest to a missed region, RGB, with the region, occluded or not, drawn on it. [H, W, 3]"""
    if view.read_image is None:
        return None
    image = view.read_image()
    scale = min(1.0, _WIDTH / image.shape[1])
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    used, corners = np.unique(coverage.mesh.triangles[region.triangles], return_inverse=True)
    local = (coverage.mesh.vertices[used] - view.center) @ view.camera_to_world[:3, :3]
    pixels = view.lens.project(local) * scale
    drawable = np.isfinite(pixels).all(axis=1) & (np.abs(pixels) < 1e4).all(axis=1)
    corners = corners.reshape(-1, 3)
    painted = image.copy()
    for triangle in np.rint(pixels[corners[drawable[corners].all(axis=1)]]).astype(np.int32):
        cv2.fillConvexPoly(painted, triangle, MAP_LEGEND[Level.SEEN_WELL - Level.UNSEEN][1])
    return np.asarray(cv2.addWeighted(painted, _OPACITY, image, 1.0 - _OPACITY, 0.0))


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
        # Triangles share no vertices, so that their colours do not mix.
        vertices = coverage.mesh.vertices[coverage.mesh.triangles].reshape(-1, 3)
        wall = TriangleMesh(
            vertices, np.arange(len(vertices)).reshape(-1, 3), np.repeat(face_colors(coverage), 3, axis=0)
        )
        write_mesh(folder / "coverage.ply", wall)
        write_html(page, folder / "coverage.html")
    return MeasuredCoverage(output, coverage, values)


def open_recording(path: Path) -> Scene:
    """A scene without initial points, whose images are read when they are used."""
    return open_scene(path, None, ("initial_points=none", "keep_pixels=false"))


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
