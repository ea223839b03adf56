"""Plot of two aligned trajectories: views from above and from the side, and errors over frames."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from coliags_plugin.geometry.poses.alignment import Alignment
from coliags_plugin.outputs.axis_ticks import linear_ticks, tick_label
from coliags_plugin.outputs.raster_text import INK, draw_text

#: Colours distinguishable with any colour vision, and in greyscale.
REFERENCE_RGB = (86, 160, 211)
ESTIMATE_RGB = (213, 94, 0)

#: Name, colour, width of the line and radius of the first frame's circle, px.
_STYLES = (("reference", REFERENCE_RGB, 3, 9), ("estimate, aligned", ESTIMATE_RGB, 1, 5))
_GRID = (225, 225, 225)
_WIDTH, _HEIGHT = 1200, 900
#: Fractional bits of coordinates, so that lines do not snap to pixels.
_BITS = 4


@dataclass(frozen=True)
class _Panel:
    """Axes rectangle in the image, px, and the values at its edges: left, right, bottom, top."""

    left: int
    top: int
    width: int
    height: int
    values: tuple[float, float, float, float]

    def place(self, points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Pixel positions of values, (x, y). [N, 2]"""
        left, right, bottom, top = self.values
        x = self.left + (points[:, 0] - left) / (right - left) * self.width
        y = self.top + (top - points[:, 1]) / (top - bottom) * self.height
        return np.stack([x, y], axis=1)


def plot_trajectory(alignment: Alignment, unit: str) -> UInt8[np.ndarray, "900 1200 3"]:
    """Plot an aligned estimate over its reference; the name of the unit of length must be ASCII.

    The views look along the axes of the reference's world, both at one scale: from above x over z, from the side y over
    z with y downwards. A circle marks the first frame.
    """
    image = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
    paths = (alignment.reference[:, :3, 3], alignment.estimate[:, :3, 3])
    kind = "Sim(3)" if alignment.with_scale else "SE(3)"
    spread = alignment.ate
    title = f"{len(alignment.matches)} frames, {kind}   ATE rmse {spread.rmse:.4g} {unit}, max {spread.max:.4g} {unit}"
    draw_text(image, title, (70, 30), 0.55)
    _legend(image)
    _views(image, paths, unit)
    charts = [
        (alignment.position_errors, f"position error [{unit}]"),
        (alignment.rotation_errors_deg, "rotation error [deg]"),
    ]
    for index, (errors, label) in enumerate(charts):
        last = index == len(charts) - 1
        _errors(image, (70, 590 + 160 * index, 1110, 100), errors, label, "matched frame" if last else "")
    return image


def _views(image: np.ndarray, paths: tuple[np.ndarray, np.ndarray], unit: str) -> None:
    """Draw both paths from above and from the side, at one scale."""
    points = np.concatenate(paths)
    low, high = points.min(axis=0), points.max(axis=0)
    center = 0.5 * (low + high)
    width, height = 510, 430
    # A margin around the larger path; an arbitrary scale where nothing moves.
    per_pixel = 1.12 * max((high[2] - low[2]) / width, max(high[:2] - low[:2]) / height)
    if per_pixel <= 1e-9 * max(1.0, float(np.abs(points).max())):
        per_pixel = 1.0 / width
    half_width, half_height = 0.5 * width * per_pixel, 0.5 * height * per_pixel
    # y points down in the camera's convention, and so it does here.
    for left, axis, sense, name in ((70, 0, 1.0, "x [{}], from above"), (670, 1, -1.0, "y [{}], from the side")):
        edges = (
            center[2] - half_width,
            center[2] + half_width,
            center[axis] - sense * half_height,
            center[axis] + sense * half_height,
        )
        panel = _Panel(left, 70, width, height, edges)
        _axes(image, panel, f"z [{unit}]", name.format(unit))
        for path, (_, color, thickness, radius) in zip(paths, _STYLES, strict=True):
            pixels = panel.place(path[:, [2, axis]])
            _line(image, pixels, color, thickness)
            cv2.circle(image, _fixed(pixels[:1])[0], radius << _BITS, color, thickness, cv2.LINE_AA, _BITS)


def _errors(image: np.ndarray, box: tuple[int, int, int, int], errors: np.ndarray, y_label: str, x_label: str) -> None:
    top = 1.1 * float(errors.max()) or 1.0
    # From slightly below 0, so that a line at zero error is visible.
    panel = _Panel(*box, (0.0, len(errors) - 1.0, -0.06 * top, top))
    _axes(image, panel, x_label, y_label)
    _line(image, panel.place(np.column_stack([np.arange(len(errors)), errors])), ESTIMATE_RGB, 1)


def _axes(image: np.ndarray, panel: _Panel, x_label: str, y_label: str) -> None:
    """Draw frame, grid, ticks and labels; the label of the y axis is above it."""
    left, right, bottom, top = panel.values
    end_x, end_y = panel.left + panel.width, panel.top + panel.height
    for tick in linear_ticks(left, right):
        x = round(float(panel.place(np.array([[tick, bottom]]))[0, 0]))
        cv2.line(image, (x, panel.top), (x, end_y), _GRID, 1)
        draw_text(image, tick_label(tick), (x, end_y + 18), 0.4, align=0.5)
    for tick in linear_ticks(min(bottom, top), max(bottom, top), 4):
        y = round(float(panel.place(np.array([[left, tick]]))[0, 1]))
        cv2.line(image, (panel.left, y), (end_x, y), _GRID, 1)
        draw_text(image, tick_label(tick), (panel.left - 8, y + 4), 0.4, align=1.0)
    cv2.rectangle(image, (panel.left, panel.top), (end_x, end_y), INK, 1)
    draw_text(image, y_label, (panel.left, panel.top - 10))
    draw_text(image, x_label, (end_x, end_y + 36), align=1.0)


def _legend(image: np.ndarray) -> None:
    x = 770
    for name, color, thickness, _ in _STYLES:
        cv2.line(image, (x, 26), (x + 30, 26), color, thickness, cv2.LINE_AA)
        draw_text(image, name, (x + 38, 30))
        x += 130
    cv2.circle(image, (1090, 26), 6, INK, 1, cv2.LINE_AA)
    draw_text(image, "first frame", (1102, 30))


def _line(image: np.ndarray, points: np.ndarray, color: tuple[int, int, int], thickness: int) -> None:
    cv2.polylines(image, [_fixed(points)], False, color, thickness, cv2.LINE_AA, _BITS)


def _fixed(points: np.ndarray) -> np.ndarray:
    return np.rint(points * (1 << _BITS)).astype(np.int32)
