"""Frames of an estimate and of the truth, matched, and their depth at the same places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from coliags_plugin.checks.depth.sources import DepthSource, FrameDepth, known_depth
from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.reading.images import resize_nearest

#: Largest difference of the relative intrinsics (focal length and centre over the image size) of one view.
_SAME_CAMERA = 0.01
#: Largest relative difference of aspect ratios, for rounding to whole pixels.
_SAME_ASPECT = 0.02


@dataclass(frozen=True)
class FramePairs:
    """Frames in both sources."""

    by: str  # ``"name"`` or ``"index"``
    indices: list[tuple[int, int]]  # of each frame in the estimate and in the truth
    left_out: tuple[int, int]  # number of frames of the estimate, and of the truth, without a partner


@dataclass(frozen=True)
class Samples:
    """Estimated and true depth at the places of known truth, N of them."""

    estimated: Float[np.ndarray, "N"]  # scene units of the estimate; NaN where there is no estimate. [N]
    true: Float[np.ndarray, "N"]  # positive. [N]
    confidence: Float[np.ndarray, "N"] | None  # 0 where unknown; None where the estimate has none. [N]


def match_frames(estimate: DepthSource, truth: DepthSource) -> FramePairs:
    """Match frames by name; if no name is common, by index, provided that the counts agree."""
    names = {name: index for index, name in enumerate(truth.names)}
    indices = [(index, names[name]) for index, name in enumerate(estimate.names) if name in names]
    if indices:
        return FramePairs("name", indices, (len(estimate.names) - len(indices), len(truth.names) - len(indices)))
    if len(estimate.names) == len(truth.names):
        return FramePairs("index", [(index, index) for index in range(len(truth.names))], (0, 0))
    raise InputError(
        f"{estimate.path} ({len(estimate.names)} frames with depth, the first {estimate.names[0]}) and {truth.path} "
        f"({len(truth.names)}, the first {truth.names[0]}) have no frame in common",
        "frames of equal names, or as many of them, in the same order",
        "Rename the files, or choose frames by --set datamanager.frame_step=N --set datamanager.max_frames=N",
    )


def true_depth_at(estimate: FrameDepth, truth: FrameDepth) -> Float[np.ndarray, "H W"] | None:
    """Dense true depth at the estimate's pixel centres, nearest neighbour; NaN where unknown. [H, W]"""
    if truth.depth is None:
        return None
    sampled = resize_nearest(truth.depth, *estimate.size)
    return np.where(known_depth(sampled), sampled, np.float32(np.nan))


def dense_samples(estimate: FrameDepth, true: Float[np.ndarray, "H W"]) -> Samples:
    """Samples at the estimate's pixels; ``true`` as of :func:`true_depth_at`."""
    known = np.isfinite(true)
    return Samples(_estimated(estimate)[known], true[known], _confidence(estimate, known))


def sparse_samples(estimate: FrameDepth, truth: FrameDepth) -> Samples | None:
    """Samples at the points of the truth, from the estimate's pixels that hold them; None without points."""
    if truth.sparse is None or not len(truth.sparse.depth):
        return None
    width, height = estimate.size
    pixels, true = truth.sparse.pixels.double().numpy(), truth.sparse.depth.float().numpy()
    column = np.floor(pixels[:, 0] * width / truth.size[0]).astype(np.int64).clip(0, width - 1)
    row = np.floor(pixels[:, 1] * height / truth.size[1]).astype(np.int64).clip(0, height - 1)
    known = known_depth(true)
    holding = row[known], column[known]
    return Samples(_estimated(estimate)[holding], true[known], _confidence(estimate, holding))


def check_same_view(name: str, estimate: FrameDepth, truth: FrameDepth) -> None:
    """Raise InputError if an estimate and its truth differ in aspect ratio or, apart from their sizes, in camera."""
    (width, height), (true_width, true_height) = estimate.size, truth.size
    if abs(width * true_height / (height * true_width) - 1.0) > _SAME_ASPECT:
        raise InputError(
            f"frame {name}: the estimate is {width} x {height}, the truth {true_width} x {true_height} px",
            "images of one shape",
            "Set both to the same size by --set width=W and --set height=H, or estimate from the images of the truth",
        )
    if estimate.intrinsics is None or truth.intrinsics is None:
        return
    a, b = estimate.intrinsics, truth.intrinsics.resized(width, height)
    off = max(abs(a.fx - b.fx) / width, abs(a.fy - b.fy) / height, abs(a.cx - b.cx) / width, abs(a.cy - b.cy) / height)
    if off > _SAME_CAMERA:
        raise InputError(
            f"frame {name}: the estimate's camera (f {a.fx:.4g}, {a.fy:.4g}, centre {a.cx:.4g}, {a.cy:.4g} px) is "
            f"another than the truth's (f {b.fx:.4g}, {b.fy:.4g}, centre {b.cx:.4g}, {b.cy:.4g} px at this size)",
            "the same undistorted images",
            "Estimate from the images of the truth, with the same lens and focal_scale",
        )


def _estimated(estimate: FrameDepth) -> Float[np.ndarray, "H W"]:
    if estimate.depth is None:
        return np.full(estimate.size[::-1], np.nan, np.float32)
    return np.where(known_depth(estimate.depth), estimate.depth, np.float32(np.nan))


def _confidence(estimate: FrameDepth, chosen: np.ndarray | tuple[np.ndarray, ...]) -> Float[np.ndarray, "N"] | None:
    return None if estimate.confidence is None else np.asarray(estimate.confidence[chosen])
