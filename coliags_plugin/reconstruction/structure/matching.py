"""Which features of two pictures show the same spot."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, UInt32
from scipy.spatial import cKDTree

from coliags_plugin.core.cameras import Camera
from coliags_plugin.reconstruction.structure.features import Features

Pairs = UInt32[np.ndarray, "M 2"]

#: Features nearer to each other than this are one spot: none makes the other ambiguous. Pixels.
_SAME_SPOT = 2.0
#: A match may not differ by more than this factor in scale: neighbouring frames of a video do not.
_SCALE_FACTOR = 1.6


def video_pairs(count: int, overlap: int) -> list[tuple[int, int]]:
    """Pairs of a video's frames: 1, 2, ..., ``overlap`` apart, and 1, 2, 4, ..., 2^(overlap - 1), COLMAP's way."""
    steps = {*range(1, overlap + 1), *(2**power for power in range(overlap))}
    return sorted((first, first + step) for step in steps for first in range(count - step))


def all_pairs(count: int) -> list[tuple[int, int]]:
    """Every pair of ``count`` pictures."""
    return [(first, second) for first in range(count) for second in range(first + 1, count)]


def mutual_matches(first: Features, second: Features, max_ratio: float, max_distance: float) -> Pairs:
    """Features that are each other's nearest, by their descriptors alone.

    Args:
        first: Of one picture.
        second: Of the other.
        max_ratio: Of the distance of descriptors to that of the next best.
        max_distance: Of descriptors of unit length, 0 to 2.

    Returns:
        Indices in the one and the other. [M, 2]
    """
    if min(len(first), len(second)) < 2:
        return np.empty((0, 2), np.uint32)
    likeness = first.descriptors @ second.descriptors.T
    nearest = likeness.argmax(axis=1)
    best = likeness[np.arange(len(first)), nearest]
    mutual = best == likeness.max(axis=0)[nearest]
    one = _best(nearest[mutual], best[mutual], len(second))
    one = np.sort(np.flatnonzero(mutual)[one[one >= 0]])
    other, likeness, best = nearest[one], likeness[one], best[one]
    # The next best is one that lies elsewhere: neighbouring octaves find one spot twice.
    twins = cKDTree(second.keypoints[:, :2]).query_pairs(_SAME_SPOT, output_type="ndarray").astype(np.int64)
    likeness[np.arange(len(one)), other] = -1.0
    for of, twin in ((0, 1), (1, 0)):
        row, which = _joined(other, twins[:, of])
        likeness[row, twins[which, twin]] = -1.0
    kept = _close_and_clear(best, likeness.max(axis=1, initial=-1.0), max_ratio, max_distance)
    return np.stack([one[kept], other[kept]], axis=1).astype(np.uint32)


def epipolar_matches(
    first: Features,
    second: Features,
    cameras: tuple[Camera, Camera],
    max_error: float,
    max_ratio: float,
    max_distance: float,
) -> Pairs:
    """The same for pictures whose poses are known: only what they allow is compared, so far more is unambiguous.

    Args:
        first: Of one picture.
        second: Of the other.
        cameras: Of the one and the other.
        max_error: Largest Sampson distance from the epipolar geometry, pixels.
        max_ratio: Of the distance of descriptors to that of the next best which the poses allow.
        max_distance: Of descriptors of unit length, 0 to 2.

    Returns:
        Indices in the one and the other. [M, 2]
    """
    one, other = _allowed(first, second, cameras, max_error)
    if not len(one):
        return np.empty((0, 2), np.uint32)
    likeness = np.einsum("ij,ij->i", first.descriptors[one], second.descriptors[other])
    best_of_one = _best(one, likeness, len(first))
    best_of_other = _best(other, likeness, len(second))
    found = best_of_one[best_of_one >= 0]
    nearest = np.zeros(len(first), np.int64)
    nearest[one[found]] = other[found]
    elsewhere = ((second.keypoints[other, :2] - second.keypoints[nearest[one], :2]) ** 2).sum(axis=1) >= _SAME_SPOT**2
    next_best = np.full(len(first), -1.0, np.float32)
    np.maximum.at(next_best, one[elsewhere], likeness[elsewhere])
    mutual = best_of_other[other[found]] == found
    kept = found[mutual & _close_and_clear(likeness[found], next_best[one[found]], max_ratio, max_distance)]
    return np.stack([one[kept], other[kept]], axis=1).astype(np.uint32)


def relative_pose(cameras: tuple[Camera, Camera]) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """From the axes of the one camera to those of the other: rotation [3, 3] and translation [3]."""
    one, other = (camera.to("cpu").camera_to_world.double().numpy() for camera in cameras)
    rotation = other[:3, :3].T @ one[:3, :3]
    return rotation, other[:3, :3].T @ (one[:3, 3] - other[:3, 3])


def rays(pixels: Float[np.ndarray, "N 2"], camera: Camera) -> Float[np.ndarray, "N 3"]:
    """Directions of pixels in camera axes, z = 1. [N, 3]"""
    x = (pixels[:, 0] - camera.cx) / camera.fx
    y = (pixels[:, 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones(len(pixels))], axis=1)


def _allowed(
    first: Features, second: Features, cameras: tuple[Camera, Camera], max_error: float
) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]]:
    """Pairs of features near each other's epipolar lines, whose rays meet in front of both cameras."""
    rotation, translation = relative_pose(cameras)
    if not np.linalg.norm(translation) > 0.0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    x, y, z = translation / np.linalg.norm(translation)
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ rotation
    ray_one, ray_other = rays(first.pixels, cameras[0]), rays(second.pixels, cameras[1])
    # Lines in pixels: coefficients of x and y divided by the focal lengths.
    line_in_other, line_in_one = ray_one @ essential.T, ray_other @ essential
    slope_other = np.linalg.norm(line_in_other[:, :2] / (cameras[1].fx, cameras[1].fy), axis=1)
    slope_one = np.linalg.norm(line_in_one[:, :2] / (cameras[0].fx, cameras[0].fy), axis=1)
    # All with all in single precision and generously (a + b > hypot(a, b)); what is left exactly.
    rough = line_in_other.astype(np.float32) @ ray_other.T.astype(np.float32)
    np.abs(rough, out=rough)
    rough -= (1.01 * max_error * slope_other + 1e-6).astype(np.float32)[:, None]
    one, other = np.nonzero(rough <= (1.01 * max_error * slope_one).astype(np.float32))
    factor = first.keypoints[one, 2] / second.keypoints[other, 2]
    alike = (factor < _SCALE_FACTOR) & (factor > 1.0 / _SCALE_FACTOR)
    one, other = one[alike], other[alike]
    error = np.abs(np.einsum("ij,ij->i", line_in_other[one], ray_other[other]))
    near = error <= max_error * np.hypot(slope_other[one], slope_one[other])
    one, other = one[near], other[near]
    front = _meet_in_front(ray_one[one] @ rotation.T, ray_other[other], translation)
    return one[front], other[front]


def _meet_in_front(turned: np.ndarray, other: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Whether ``a * turned + translation`` and ``b * other`` come nearest to each other at positive a and b. [K]"""
    aa, bb, ab = (np.einsum("ij,ij->i", *pair) for pair in ((turned, turned), (other, other), (turned, other)))
    at, bt = turned @ translation, other @ translation
    # The common divisor aa * bb - ab^2 is not negative.
    return np.asarray((ab * bt - bb * at > 0.0) & (aa * bt - ab * at > 0.0))


def _best(groups: Int[np.ndarray, "K"], likeness: Float[np.ndarray, "K"], count: int) -> Int[np.ndarray, "count"]:
    """Of each group the place of its largest likeness, the first of equals; -1 where a group has none."""
    order = np.lexsort((-likeness, groups))
    sorted_groups = groups[order]
    first = np.ones(len(order), bool)
    first[1:] = sorted_groups[1:] != sorted_groups[:-1]
    best = np.full(count, -1)
    best[sorted_groups[first]] = order[first]
    return best


def _joined(values: Int[np.ndarray, "A"], others: Int[np.ndarray, "B"]) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of places at which the two hold the same number. [P], [P]"""
    order = np.argsort(others, kind="stable")
    start, end = (np.searchsorted(others[order], values, side=side) for side in ("left", "right"))
    counts = end - start
    place = np.repeat(start - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    return np.repeat(np.arange(len(values)), counts), order[place]


def _close_and_clear(best: np.ndarray, next_best: np.ndarray, max_ratio: float, max_distance: float) -> np.ndarray:
    """Whether descriptors with these scalar products are near enough, and nearer than the next."""
    distance, following = (np.sqrt(np.maximum(2.0 - 2.0 * product, 0.0)) for product in (best, next_best))
    return np.asarray((distance < max_distance) & (distance < max_ratio * following))
