"""Unrolled map of the wall: place along the lumen against clock angle, coloured by how it was seen."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.core.cameras import Camera
from coliags_plugin.outputs.axis_ticks import linear_ticks, tick_label
from coliags_plugin.outputs.colormaps import INK, draw_text, side_by_side, stacked, text_width
from coliags_plugin.surface.coverage.centreline import STEP
from coliags_plugin.surface.coverage.measure import PartialCoverage, SeenWall, WallCoverage
from coliags_plugin.surface.coverage.views import CoverageView
from coliags_plugin.surface.coverage.visibility import GUESS_COLOR, GUESS_LABEL, Level
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
