"""Depth maps of a scene of any format, or of a folder of files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.progress import Progress
from coliags_plugin.core.scenes import Frame, SparseDepth
from coliags_plugin.datamanagers.reading.depth_formats import DepthArray
from coliags_plugin.datamanagers.reading.images import read_gray
from coliags_plugin.datamanagers.recognition import recognised
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.outputs.image_files import read_depth_tiff

_TIFF = (".tiff", ".tif")


@dataclass(frozen=True)
class FrameDepth:
    """Depth of one frame."""

    #: z-depth, scene units; NaN where unknown or masked. None where there are only single points. [H, W]
    depth: Float[np.ndarray, "H W"] | None
    #: estimated probability of an error below 5 %; 0 where unknown. None where there is none. [H, W]
    confidence: Float[np.ndarray, "H W"] | None
    sparse: SparseDepth | None  # depth at single points
    size: tuple[int, int]  # width and height of the image, px
    intrinsics: Intrinsics | None = None  # of the image; None for a folder of depth maps
    image: UInt8[np.ndarray, "H W 3"] | None = None  # RGB; None for a folder of depth maps. [H, W, 3]


@dataclass(frozen=True)
class DepthSource:
    """Depth maps by the names of their frames."""

    path: Path  # the scene or folder
    metric: bool  # whether lengths are in mm; False where the unit is unknown
    names: Sequence[str]  # of the frames, in order
    read: Callable[[int], FrameDepth]  # reads the depth map of a frame by its index


def open_depth(
    path: Path, data_format: str | None = None, options: Sequence[str] = (), progress: Progress | None = None
) -> DepthSource:
    """The depth maps of a scene's video, or of a folder of float32 TIFF or ``.npy`` files, mm.

    8-bit PNGs of the same stems in a folder ``confidence`` beside the latter are the confidence, 255 = 1. ``options``
    are those of the scene's data manager.
    """
    if data_format is None and path.is_dir() and not recognised(path):
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in (*_TIFF, ".npy"))
        if files:
            return _of_folder(path, files)
    scene = open_scene(path, data_format, (*options, "initial_points=none"), progress)
    kept = [frame for frame in scene.video if frame.depth is not None or frame.sparse_depth is not None]
    if not kept:
        raise InputError(f"{path} has no depth", "a scene with depth files or sparse depth", "Name a scene with depth")
    return DepthSource(path, scene.is_metric, [frame.name for frame in kept], lambda index: _of_frame(kept[index]))


def _of_frame(frame: Frame) -> FrameDepth:
    valid = frame.valid.numpy()
    depth = None if frame.depth is None else np.where(valid, frame.depth.numpy(), np.float32(np.nan))
    stated = frame.depth_confidence
    confidence = None if stated is None else stated.numpy()
    camera = frame.camera
    return FrameDepth(
        depth, confidence, frame.sparse_depth, (camera.width, camera.height), camera.intrinsics, frame.image.numpy()
    )


def _of_folder(folder: Path, files: Sequence[Path]) -> DepthSource:
    stems = [path.stem for path in files]
    double = next((stem for index, stem in enumerate(stems) if stem in stems[:index]), None)
    if double is not None:
        raise InputError(f"{folder} holds several files {double}.*", "one depth map per frame", "Move the others away")
    return DepthSource(folder, True, stems, lambda index: _of_file(files[index]))


def _of_file(path: Path) -> FrameDepth:
    reader = DepthArray(1.0)
    stored = read_depth_tiff(path) if path.suffix.lower() in _TIFF else reader.read(path)
    depth = reader.z_depth(stored)
    height, width = depth.shape
    return FrameDepth(depth, _confidence_beside(path, depth.shape), None, (width, height))


def _confidence_beside(path: Path, shape: tuple[int, ...]) -> Float[np.ndarray, "H W"] | None:
    beside = path.parent.parent / "confidence" / f"{path.stem}.png"
    if not beside.is_file():
        return None
    stored = read_gray(beside, 8, "an 8-bit grey image of the confidence")
    if stored.shape != shape:
        raise InputError(f"{beside} is {stored.shape[1]} x {stored.shape[0]}", f"the size of {path.name}")
    return np.asarray(stored.astype(np.float32) / np.float32(255.0))


def known_depth(depth: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Where depth is finite and positive. [H, W]"""
    return np.asarray(np.isfinite(depth) & (np.nan_to_num(depth) > 0.0))
