"""A tilted wall with a printed pattern, in every format: each depth, colour and pose has a closed form."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

import tests.layouts  # noqa: F401  (registers them)
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.registry import datamanagers, phantom_layouts
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.datamanagers.recorded import RecordedDataManager
from coliags_plugin.geometry.lenses.models import Lens, PinholeLens
from coliags_plugin.phantom.layouts import Layout, PhantomFrame, WallPoints

#: The wall is where NORMAL . x = OFFSET (mm).
NORMAL = np.array([0.2, -0.1, 1.0])
OFFSET = 40.0
#: Off-centre and not square, so that whoever confuses something is caught.
PINHOLE = Intrinsics(61.0, 55.0, 33.5, 21.5, 64, 48)
#: Of the scenes in every format.
WIDTH, HEIGHT, FRAMES = 40, 32, 11
#: z-depth from which the wall counts as absent, mm: below the range of every format.
FAR = 99.0


def poses(count: int) -> np.ndarray:
    """Cameras that look at the wall, each from elsewhere and turned differently. [N, 4, 4]"""
    result = np.tile(np.eye(4), (count, 1, 1))
    for index in range(count):
        turn = np.array([0.02 * index, -0.05 + 0.01 * index, 0.3])
        result[index, :3, :3] = cv2.Rodrigues(turn)[0]
        result[index, :3, 3] = [1.0 + index, 2.0 - 0.5 * index, 3.0 + 0.7 * index]
    return result


def look(camera_to_world: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """z-depth and colour along camera directions with z = 1. [..., 3] -> [...], [..., 3]"""
    world = directions @ camera_to_world[:3, :3].T
    depth = (OFFSET - NORMAL @ camera_to_world[:3, 3]) / (world @ NORMAL)
    points = camera_to_world[:3, 3] + depth[..., None] * world
    return depth, colors(points)


def colors(points: np.ndarray) -> np.ndarray:
    """The wall's pattern: smooth, so that resampling it costs little. [..., 3]"""
    waves = np.stack([points[..., 0] / 9.0, points[..., 1] / 7.0, (points[..., 0] + points[..., 1]) / 11.0], -1)
    return np.rint(128.0 + 100.0 * np.sin(np.nan_to_num(waves))).astype(np.uint8)


def off_wall(points: np.ndarray) -> np.ndarray:
    """Distance of points that are not NaN from the wall, mm. [N, 3] -> [K]"""
    distance = np.abs(np.asarray(points, np.float64).reshape(-1, 3) @ NORMAL - OFFSET) / np.linalg.norm(NORMAL)
    return distance[np.isfinite(distance)]


def rays(camera: Lens | Intrinsics) -> np.ndarray:
    """Directions of the pixels, z = 1. [H, W, 3]"""
    lens = camera if isinstance(camera, Lens) else PinholeLens.of(camera)
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    return lens.unproject(np.stack([columns.ravel(), rows.ravel()], 1)).reshape(lens.height, lens.width, 3)


def seen_from(frame: Frame, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth and colours that a frame should have at a pose. [H, W], [H, W, 3]"""
    return look(pose, rays(frame.camera.intrinsics))


def worst_off_wall(frame: Frame) -> float:
    return off_wall(frame.camera.unproject(frame.depth).numpy()).max()


def names(frames: list[Frame]) -> list[str]:
    return [frame.name for frame in frames]


def manager(name: str, **options) -> RecordedDataManager:
    kind = datamanagers.get(name)
    return kind(kind.Settings(**options))


def load_scene(name: str, folder: Path, **options) -> Scene:
    return manager(name, **options).load(folder)


def layout_of(name: str) -> Layout:
    return phantom_layouts.get(name)()


def write_wall(
    folder: Path, layout: str, frames: int = FRAMES, width: int = WIDTH, height: int = HEIGHT, lens: Lens | None = None
) -> Path:
    """The wall in a layout: turned views and points, if it has any, and seen masks whose left half is white."""
    writer = layout_of(layout)
    nominal, lit = writer.lens(width, height)
    lens = lens or nominal
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.2, 0.0]))[0]
    parts = {"video": poses(frames)} | (
        {"rotation": poses(frames)[[2 % frames, 6 % frames]] @ turn} if writer.has_rotation else {}
    )
    directions, mask = rays(lens), np.zeros((height, width), np.uint8)
    mask[:, : width // 2] = 255
    for part, matrices in parts.items():
        for index, matrix in enumerate(matrices):
            depth, color = look(matrix, directions)
            depth = np.where(lit & (depth > 0.0) & (depth < FAR), depth, 0.0)
            color = np.where(lit[..., None], color, 0).astype(np.uint8)
            writer.write_frame(folder, PhantomFrame(part, index, color, depth))
            if part == "rotation" or writer.is_test(index):
                path = writer.seen_mask(folder, part, index)
                path.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(path), mask)
    for part, matrices in parts.items():
        writer.write_sequence(folder, part, matrices, lens)
    if writer.has_points:
        writer.write_points(folder, _points(lens, frames), poses(frames), lens)
    return folder


def _points(lens: Lens, frames: int) -> WallPoints:
    """Points of the wall in the first view, and in which views they are."""
    pixels = np.random.default_rng(0).uniform(2, [lens.width - 2, lens.height - 2], (200, 2))
    directions, first = lens.unproject(pixels), poses(1)[0]
    depth, color = look(first, directions)
    positions = first[:3, 3] + depth[:, None] * directions @ first[:3, :3].T

    def seen_in(index: int) -> np.ndarray:
        pose = poses(frames)[index]
        pixels = lens.project((positions - pose[:3, 3]) @ pose[:3, :3])
        return ((pixels > 0) & (pixels < (lens.width, lens.height))).all(axis=1)

    return WallPoints(positions, color, seen_in)
