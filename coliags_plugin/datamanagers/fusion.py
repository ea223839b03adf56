"""Initial points from back-projected depth or from a file."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from coliags_plugin.core import bounds
from coliags_plugin.core.arrays import read_arrays
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.jobs import Progress
from coliags_plugin.core.ply import read_vertices, vertex_colors
from coliags_plugin.core.scene_files import parallel_map, required_file
from coliags_plugin.core.scenes import Frame, PointCloud

log = logging.getLogger(__name__)

#: Source of points that are fused from depth, as it is recorded.
DEPTH_POINTS = "depth of the training frames"
#: Confidence from which on estimated depth makes initial points.
_TRUSTED = 0.5


def fuse_depth(
    frames: Sequence[Frame], count: int, generator: np.random.Generator, progress: Progress | None = None
) -> PointCloud:
    """Surface points back-projected from a uniform sample of the frames' valid depth pixels, in frame order.

    Of estimated depth, only pixels of confidence 0.5 or more count, in frames that have any. ``count`` pixels are
    sampled without replacement over all frames. Rays use the true principal point (the authors' code: the image centre,
    docs/methods.md 6).
    """
    # Two passes over the frames, since the pixels of a long video may not fit into memory.
    available = np.array(parallel_map(lambda frame: len(_usable(frame)), frames, "count depth pixels", progress))
    if available.sum() == 0:
        raise InputError(
            f"none of the {len(frames)} training frames has a valid depth",
            "depth files with known depth in them",
            "Check the depth files, or `datamanager.initial_points=file`",
        )
    counts = available if available.sum() <= count else generator.multivariate_hypergeometric(available, count)
    # Sorted to keep the pixel order; the choice is already random.
    chosen = [
        np.sort(generator.choice(there, number, replace=False)) if number < there else np.arange(there)
        for there, number in zip(available, counts, strict=True)
    ]
    selections = [pair for pair in zip(frames, chosen, strict=True) if len(pair[1])]
    fused = parallel_map(_fused, selections, "fuse depth", progress)
    positions, colors = zip(*fused, strict=True)
    return PointCloud(torch.from_numpy(np.concatenate(positions)), torch.from_numpy(np.concatenate(colors)))


def _usable(frame: Frame) -> np.ndarray:
    """Flat indices of unmasked pixels with known depth, if possible of those that are trusted."""
    depth, mask, confidence = frame.depth, frame.mask, frame.depth_confidence
    if depth is None:
        return np.zeros(0, np.int64)
    usable = np.isfinite(depth.numpy())
    if mask is not None:
        usable &= mask.numpy()
    if confidence is not None and (trusted := usable & (confidence.numpy() >= _TRUSTED)).any():
        usable = trusted
    return np.flatnonzero(usable)


def _fused(selection: tuple[Frame, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """World positions, computed in float64, and colours of chosen usable pixels."""
    frame, chosen = selection[0].to("cpu"), selection[1]
    if frame.depth is None:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    pixels = _usable(frame)[chosen]
    camera = frame.camera
    row, column = np.divmod(pixels, camera.width)
    z = frame.depth.numpy().ravel()[pixels].astype(np.float64)
    x = (column + 0.5 - camera.cx) / camera.fx * z
    y = (row + 0.5 - camera.cy) / camera.fy * z
    camera_to_world = camera.camera_to_world.numpy().astype(np.float64)
    world = np.stack([x, y, z], axis=1) @ camera_to_world[:3, :3].T + camera_to_world[:3, 3]
    return world.astype(np.float32), frame.image.numpy().reshape(-1, 3)[pixels]


def load_points(path: Path) -> PointCloud:
    """All points of a PLY file or an NPZ file (``positions`` [N, 3], optional uint8 ``colors``)."""
    required_file(path, "a PLY or NPZ file of points in the world of the poses", "Check the path")
    if path.suffix.lower() == ".npz":
        positions, colors = _read_npz(path)
    elif path.suffix.lower() == ".ply":
        vertices = read_vertices(path)
        positions, colors = np.stack([vertices[axis] for axis in "xyz"], axis=1), vertex_colors(path, vertices)
    else:
        raise InputError(f"{path} is neither .ply nor .npz", "a PLY or NPZ file of points")
    return PointCloud(
        torch.from_numpy(np.asarray(positions, np.float32)), None if colors is None else torch.from_numpy(colors)
    )


def subsampled(points: PointCloud, count: int, generator: np.random.Generator, source: Path | None) -> PointCloud:
    """At most ``count`` usable points, sampled without replacement: finite, and not absurdly far away."""
    usable = np.flatnonzero((points.positions.abs() <= bounds.LENGTH).all(dim=1).numpy())  # NaN is not
    if len(usable) < len(points):
        log.warning(
            "%s: %d of %d points are not finite, or beyond %g, and are left out",
            source,
            len(points) - len(usable),
            len(points),
            bounds.LENGTH,
        )
    if len(usable) == 0:
        raise InputError(f"{source} holds no points", "positions x, y, z in the world of the poses")
    if len(usable) > count:
        usable = np.sort(generator.choice(usable, count, replace=False))
    chosen = torch.from_numpy(usable)
    return PointCloud(points.positions[chosen], None if points.colors is None else points.colors[chosen])


def _read_npz(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    arrays = read_arrays(path, "an NPZ file with an array 'positions' [N, 3]", ["positions"], ["colors"])
    positions, colors = arrays["positions"], arrays.get("colors")
    if positions.dtype.kind not in "fiu":
        raise InputError(f"{path}: positions are {positions.dtype}", "numbers")
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise InputError(f"{path}: positions of shape {positions.shape}", "[N, 3]")
    if colors is not None and (colors.shape != positions.shape or colors.dtype != np.uint8):
        raise InputError(f"{path}: colors of shape {colors.shape}, {colors.dtype}", f"uint8 of shape {positions.shape}")
    return positions, colors
