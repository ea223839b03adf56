"""Initial points: back-projected training depth, or a file."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from coliags_plugin.errors import InputError
from coliags_plugin.scenes import Frame, PointCloud

log = logging.getLogger(__name__)


def fuse_depth(frames: Sequence[Frame], count: int, generator: np.random.Generator) -> PointCloud:
    """Points on the surface that the frames' depth shows.

    Every valid pixel of every frame is equally likely, and none is drawn twice; all are taken where there are no more
    than ``count``. Rays go through the true principal point (the authors' code: the image centre, docs/methods.md 6).

    Args:
        frames: With z-depth, mm, NaN where unknown.
        count: Points to draw.
        generator: Draws them.

    Returns:
        World positions, float32, and the pixels' colours, in frame order.

    Raises:
        InputError: No frame has a valid depth.
    """
    # One frame after the other, twice: the pixels of a long video do not fit into memory side by side.
    available = np.array([np.count_nonzero(_usable(frame)) for frame in frames])
    if available.sum() == 0:
        raise InputError(
            f"none of the {len(frames)} training frames has a valid depth",
            "depth files with known depth in them",
            "Check the depth files, or set initial_points: file",
        )
    taken = available if available.sum() <= count else generator.multivariate_hypergeometric(available, count)
    positions, colors = [], []
    for frame, number in zip(frames, taken, strict=True):
        pixels = np.flatnonzero(_usable(frame))
        # Sorting keeps the reading order; which pixels are taken is already random.
        chosen = np.sort(generator.choice(pixels, number, replace=False)) if number < len(pixels) else pixels
        positions.append(_back_projected(frame, chosen))
        colors.append(frame.image.reshape(-1, 3)[torch.from_numpy(chosen)])
    return PointCloud(torch.from_numpy(np.concatenate(positions).astype(np.float32)), torch.cat(colors))


def _usable(frame: Frame) -> np.ndarray:
    depth = frame.depth
    if depth is None:
        return np.zeros(0, bool)
    return np.asarray((torch.isfinite(depth) & frame.valid).numpy())


def _back_projected(frame: Frame, pixels: np.ndarray) -> np.ndarray:
    """World positions of pixels by their flat index, in double precision. [N, 3]"""
    camera, depth = frame.camera, frame.depth
    row, column = np.divmod(pixels, camera.width)
    z = depth.numpy().ravel()[pixels].astype(np.float64) if depth is not None else np.zeros(0)
    x = (column + 0.5 - camera.cx) / camera.fx * z
    y = (row + 0.5 - camera.cy) / camera.fy * z
    camera_to_world = camera.camera_to_world.numpy().astype(np.float64)
    return np.asarray(np.stack([x, y, z], axis=1) @ camera_to_world[:3, :3].T + camera_to_world[:3, 3])


def read_points(path: Path, count: int, generator: np.random.Generator) -> PointCloud:
    """Points from a PLY file, or from an NPZ file with ``positions`` [N, 3] and perhaps ``colors`` uint8 [N, 3].

    See :func:`thinned` for which.

    Raises:
        InputError: The file is missing or holds no points.
    """
    return thinned(load_points(path), count, generator, path)


def load_points(path: Path) -> PointCloud:
    """All points of a PLY or NPZ file.

    Raises:
        InputError: The file is missing or is neither.
    """
    if not path.is_file():
        raise InputError(f"no file {path}", "a PLY or NPZ file of points in the world of the poses", "Check the path")
    if path.suffix.lower() == ".npz":
        positions, colors = _read_npz(path)
    elif path.suffix.lower() == ".ply":
        positions, colors = _read_ply(path)
    else:
        raise InputError(f"{path} is neither .ply nor .npz", "a PLY or NPZ file of points")
    return PointCloud(
        torch.from_numpy(np.asarray(positions, np.float32)), None if colors is None else torch.from_numpy(colors)
    )


def thinned(points: PointCloud, count: int, generator: np.random.Generator, source: Path | None) -> PointCloud:
    """At most ``count`` of the points, drawn without replacement; those that are not finite are left out.

    Raises:
        InputError: None is finite.
    """
    finite = np.flatnonzero(torch.isfinite(points.positions).all(dim=1).numpy())
    if len(finite) < len(points):
        log.warning(
            "%s: %d of %d points are not finite and are left out", source, len(points) - len(finite), len(points)
        )
    if len(finite) == 0:
        raise InputError(f"{source} holds no points", "positions x, y, z in the world of the poses")
    if len(finite) > count:
        finite = np.sort(generator.choice(finite, count, replace=False))
    chosen = torch.from_numpy(finite)
    return PointCloud(points.positions[chosen], None if points.colors is None else points.colors[chosen])


def _read_npz(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    try:
        with np.load(path, allow_pickle=False) as data:
            positions = np.asarray(data["positions"], np.float64)
            colors = data["colors"] if "colors" in data else None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"cannot read {path}: {error}", "an NPZ file with an array 'positions' [N, 3]") from error
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise InputError(f"{path}: positions of shape {positions.shape}", "[N, 3]")
    if colors is not None and (colors.shape != positions.shape or colors.dtype != np.uint8):
        raise InputError(f"{path}: colors of shape {colors.shape}, {colors.dtype}", f"uint8 of shape {positions.shape}")
    return positions, colors


def _read_ply(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.io.read_point_cloud(path)
    positions = np.asarray(cloud.points)
    colors = np.rint(np.asarray(cloud.colors) * 255.0).astype(np.uint8) if cloud.has_colors() else None
    return positions, colors
