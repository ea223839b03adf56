"""The unrolled map of the wall, along the lumen and round the clock, coloured by how it was seen; page and summary."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.core.cameras import Camera
from coliags_plugin.reporting.colormaps import INK, draw_text, side_by_side, stacked, text_width
from coliags_plugin.reporting.image_files import EncodedImage
from coliags_plugin.reporting.model import (
    Block,
    Fact,
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
from coliags_plugin.surface.coverage.centreline import STEP
from coliags_plugin.surface.coverage.measure import MissedRegion, PartialCoverage, SeenWall, WallCoverage
from coliags_plugin.surface.coverage.visibility import GUESS_COLOR, GUESS_LABEL, CoverageSettings, CoverageView, Level
from coliags_plugin.surface.meshing.pictures import HEIGHT, draw_mesh, outside_cameras

_SOFT, _GRID, _NOTHING = (110, 110, 110), (225, 225, 225), (245, 245, 245)
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
    colors, arc = _cells(coverage)
    first, last = arc[0] - 0.5 * STEP, arc[-1] + 0.5 * STEP
    width = round(min(_WIDEST, max(620.0, (last - first) * _PER_MM)))
    image = np.full((_TOP + _HEIGHT + _BELOW, _LEFT + width + _RIGHT, 3), 255, np.uint8)
    spread = cv2.resize(colors.transpose(1, 0, 2), (width, _HEIGHT), interpolation=cv2.INTER_NEAREST)
    image[_TOP : _TOP + _HEIGHT, _LEFT : _LEFT + width] = spread

    def column(arc: float) -> int:
        return _LEFT + round((arc - first) / (last - first) * width)

    _axes(image, (first, last), width)
    for end in (coverage.section.start, coverage.section.end):
        if first < end < last:
            cv2.line(image, (column(end), _TOP), (column(end), _TOP + _HEIGHT), INK, 2)
    for number, region in enumerate(coverage.regions, start=1):
        row = _TOP + round(region.clock / 360.0 * _HEIGHT)
        _tag(image, str(number), (column(region.arc), row))
    _legend(image, coverage)
    return image


def _cells(coverage: WallCoverage) -> tuple[UInt8[np.ndarray, "M C 3"], Float[np.ndarray, "M"]]:
    """Colours of the cells around the section, and their places along the centreline, mm."""
    grid, section = coverage.grid, coverage.section
    arc = grid.line.arc
    shown = np.flatnonzero((arc >= section.start - _MARGIN) & (arc <= section.end + _MARGIN))
    arc, triangle = arc[shown], grid.triangle[shown]
    colors = face_colors(coverage)[triangle]
    colors[triangle < 0] = _NOTHING
    beyond = ~section.holds(arc)
    colors[beyond] = (0.35 * colors[beyond] + 0.65 * 255.0).astype(np.uint8)
    return colors, arc


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
    table = np.array([level.color for level in Level], np.uint8)
    colors = table[coverage.level]
    colors[coverage.guessed] = GUESS_COLOR
    return np.asarray(colors)


def legend_entries(coverage: SeenWall) -> list[tuple[str, tuple[int, int, int], Bool[np.ndarray, "F"]]]:
    """Label, colour and triangles of each entry of a legend."""
    entries = [(level.label, level.color, (coverage.level == level) & ~coverage.guessed) for level in reversed(Level)]
    return [*entries, *([(GUESS_LABEL, GUESS_COLOR, coverage.guessed)] if coverage.guessed.any() else [])]


def _axes(image: np.ndarray, limits: tuple[float, float], width: int) -> None:
    first, last = limits
    right, bottom = _LEFT + width, _TOP + _HEIGHT
    for tick in linear_ticks(first, last, 10):
        x = _LEFT + round((tick - first) / (last - first) * width)
        cv2.line(image, (x, bottom), (x, bottom + 5), INK, 1)
        draw_text(image, tick_label(tick), (x, bottom + 20), align=0.5)
    for angle in range(0, 361, 90):
        y = _TOP + round(angle / 360.0 * _HEIGHT)
        cv2.line(image, (_LEFT - 5, y), (_LEFT, y), INK, 1)
        draw_text(image, str(angle), (_LEFT - 9, y + 4), align=1.0)
    cv2.rectangle(image, (_LEFT, _TOP), (right, bottom), INK, 1)
    draw_text(image, "along the lumen [mm]; 0: shallowest camera", (right, bottom + 44), align=1.0)
    draw_text(image, "clock angle [deg]; 0: up, 90: right", (_LEFT - 60, bottom + 44))


def _legend(image: np.ndarray, coverage: SeenWall) -> None:
    total = coverage.area()
    x, y = _LEFT, 28
    for label, color, chosen in legend_entries(coverage):
        area = coverage.area(chosen)
        if not area:
            continue
        text = f"{label} {100.0 * area / total:.1f} %"
        width = text_width(text)
        if x + 22 + width > image.shape[1] - 8:
            x, y = _LEFT, y + 24
        cv2.rectangle(image, (x, y - 11), (x + 14, y + 3), color, -1)
        draw_text(image, text, (x + 22, y))
        x += 22 + width + 26


def _tag(image: np.ndarray, text: str, middle: tuple[int, int]) -> None:
    """A number on a white disc."""
    cv2.circle(image, middle, 11, (255, 255, 255), -1, cv2.LINE_AA)
    cv2.circle(image, middle, 11, INK, 1, cv2.LINE_AA)
    draw_text(image, text, (middle[0], middle[1] + 5), align=0.5)


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
    method = _levels_note(coverage.settings)
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
    settings = record("Settings", coverage.settings.model_dump())
    sections.append(Section("How it is measured", [Paragraph(method), settings]))
    return Page(f"{name}: coverage", sections, coverage_facts(coverage), note=RESEARCH_USE)


def _levels_note(settings: CoverageSettings) -> str:
    """Meaning of the levels."""
    near = f" from at most {settings.far:g} mm" if np.isfinite(settings.far) else ""
    return (
        f"Seen: {settings.glance_frames} frames or more show the surface{near}, in pixels of a grey value of "
        f"{settings.dark:g} or more (of 1), at most {settings.grazing:g} degrees from its normal. At a glance: fewer "
        "frames do. Too dark or too far: frames show it, but none so near and bright."
    )


def clock_text(degrees: float) -> str:
    """Clock angle as the hour on a dial: 0 degrees is 12 o'clock."""
    minutes = round(degrees / 360.0 * 720.0) % 720
    return f"{minutes // 60 or 12}:{minutes % 60:02d}"


def coverage_facts(coverage: WallCoverage | PartialCoverage) -> list[Fact]:
    """Seen wall, section and missed regions, for the page and the terminal."""
    total, seen_area = coverage.area(), coverage.area(coverage.level != Level.UNSEEN)
    frames = Fact("frames", str(len(coverage.names)))
    if isinstance(coverage, PartialCoverage):
        seen = Fact("seen", area_text(seen_area, coverage.metric))
        return [seen, Fact("section", "none", note=coverage.reason), frames]
    missed = sum(region.area for region in coverage.regions)
    return [
        Fact("seen", f"{100.0 * seen_area / total:.0f} % of the wall"),
        Fact("section", f"{coverage.section.length:.0f} mm of the lumen, {total / 100.0:.0f} cm²"),
        Fact("missed regions", f"{len(coverage.regions)}, {missed / 100.0:.1f} cm² together"),
        Fact("place guessed", f"{100.0 * coverage.area(coverage.guessed) / total:.0f} % of the wall"),
        frames,
    ]


def level_table(coverage: SeenWall) -> Table:
    """Area and share of each level."""
    areas = {label: coverage.area(chosen) for label, _, chosen in legend_entries(coverage)}
    rows = [
        [label, area_text(area, coverage.metric), f"{100.0 * area / coverage.area():.1f}"]
        for label, area in areas.items()
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
    """The recorded frame nearest to a region, with the region drawn over it where it lies, hidden or not; RGB."""
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
        cv2.fillConvexPoly(painted, triangle, Level.UNSEEN.color)
    return np.asarray(cv2.addWeighted(painted, _OPACITY, image, 1.0 - _OPACITY, 0.0))
