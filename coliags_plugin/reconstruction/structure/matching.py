"""Choice of image pairs, and feature matching between two images by mutual nearest neighbours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt32
from scipy.spatial import cKDTree

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.reconstruction.structure.features import Features
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings

#: Indices of the features that match in two images; and of all pairs of images that were compared.
Pairs = UInt32[np.ndarray, "M 2"]
Matches = Mapping[tuple[int, int], Pairs]

#: Features closer than this are duplicates and do not count as the second-best match of each other. Pixels.
_DUPLICATE_DISTANCE = 2.0


def mutual_matches(first: Features, second: Features, max_ratio: float, max_distance: float) -> Pairs:
    """Match features by mutual nearest descriptors, Lowe's ratio test and a limit of their distance, 0 to 2."""
    if min(len(first), len(second)) < 2:
        return np.empty((0, 2), np.uint32)
    similarity = first.descriptors @ second.descriptors.T
    nearest = similarity.argmax(axis=1)
    best = similarity[np.arange(len(first)), nearest]
    mutual = best == similarity.max(axis=0)[nearest]
    rows = _best(nearest[mutual], best[mutual], len(second))
    rows = np.sort(np.flatnonzero(mutual)[rows[rows >= 0]])
    partners, similarity, best = nearest[rows], similarity[rows], best[rows]
    # Duplicates of the best match, from neighbouring octaves, are excluded from the second-best.
    tree = cKDTree(second.keypoints[:, :2])
    duplicates = tree.query_pairs(_DUPLICATE_DISTANCE, output_type="ndarray").astype(np.int64)
    similarity[np.arange(len(rows)), partners] = -1.0
    for of, duplicate in ((0, 1), (1, 0)):
        row, which = _joined(partners, duplicates[:, of])
        similarity[row, duplicates[which, duplicate]] = -1.0
    products = best, similarity.max(axis=1, initial=-1.0)
    distance, second_best = (np.sqrt(np.maximum(2.0 - 2.0 * product, 0.0)) for product in products)
    is_match = (distance < max_distance) & (distance < max_ratio * second_best)
    return np.stack([rows[is_match], partners[is_match]], axis=1).astype(np.uint32)


@dataclass(frozen=True, eq=False)
class Pose:
    """Intrinsics and rigid pose of a view in float64."""

    intrinsics: Intrinsics
    camera_to_world: Float[np.ndarray, "4 4"]

    @classmethod
    def of(cls, camera: Camera, size: tuple[int, int] | None = None) -> Pose:
        """Pose of a camera, with intrinsics for an image of another width and height if they are given."""
        intrinsics = camera.intrinsics if size is None else camera.intrinsics.resized(*size)
        return cls(intrinsics, camera.camera_to_world.cpu().double().numpy())

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """K for pixel centres at integers + 0.5."""
        k = self.intrinsics
        return np.array([[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]])

    def rays(self) -> Float[np.ndarray, "H W 3"]:
        """Directions through the pixel centres in the camera's axes, z = 1."""
        k = self.intrinsics
        x = (np.arange(k.width) + 0.5 - k.cx) / k.fx
        y = (np.arange(k.height) + 0.5 - k.cy) / k.fy
        return np.stack([*np.meshgrid(x, y), np.ones((k.height, k.width))], axis=-1)

    def to(self, other: Pose) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
        """Rotation and translation from this camera's axes to another's."""
        turn = other.camera_to_world[:3, :3].T
        return turn @ self.camera_to_world[:3, :3], turn @ (self.camera_to_world[:3, 3] - other.camera_to_world[:3, 3])

    def homography(self, other: Pose) -> tuple[Float32[np.ndarray, "3 3"], Float32[np.ndarray, "3"]]:
        """A and b that map pixel p at z-depth z to the homogeneous pixel A (p, 1) z + b of another view."""
        rotation, translation = self.to(other)
        turn = other.matrix @ rotation @ np.linalg.inv(self.matrix)
        return turn.astype(np.float32), (other.matrix @ translation).astype(np.float32)

    def depth_from(self, other: Pose) -> tuple[Float32[np.ndarray, "3"], np.float32]:
        """Vector a and number b that map pixel p of another view at z-depth z to z-depth a . (p, 1) z + b here."""
        rotation, translation = other.to(self)
        return (rotation[2] @ np.linalg.inv(other.matrix)).astype(np.float32), np.float32(translation[2])


def rays(pixels: Float[np.ndarray, "N 2"], camera: Camera) -> Float[np.ndarray, "N 3"]:
    """Ray directions of pixels in the camera frame, z = 1. [N, 3]"""
    return PinholeLens.of(camera.intrinsics).unproject(pixels)


def have_positive_depths(turned: np.ndarray, other: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """True where the lines ``a * turned + translation`` and ``b * other`` are closest at positive a and b. [K]"""
    aa, bb, ab = (np.einsum("ij,ij->i", *pair) for pair in ((turned, turned), (other, other), (turned, other)))
    at, bt = turned @ translation, other @ translation
    # The common denominator aa * bb - ab^2 is not negative.
    return np.asarray((ab * bt - bb * at > 0.0) & (aa * bt - ab * at > 0.0))


def _best(groups: Int[np.ndarray, "K"], similarity: Float[np.ndarray, "K"], count: int) -> Int[np.ndarray, "count"]:
    """Index of the largest similarity in each group, the first of equals; -1 for empty groups."""
    order = np.lexsort((-similarity, groups))
    sorted_groups = groups[order]
    first = np.ones(len(order), bool)
    first[1:] = sorted_groups[1:] != sorted_groups[:-1]
    best = np.full(count, -1)
    best[sorted_groups[first]] = order[first]
    return best


def _joined(values: Int[np.ndarray, "A"], others: Int[np.ndarray, "B"]) -> tuple[np.ndarray, np.ndarray]:
    """Index pairs of equal numbers in two arrays, as in a database join. [P], [P]"""
    order = np.argsort(others, kind="stable")
    start, end = (np.searchsorted(others[order], values, side=side) for side in ("left", "right"))
    counts = end - start
    index = np.repeat(start - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    return np.repeat(np.arange(len(values)), counts), order[index]


#: Focal length relative to the larger side of the fisheye that stands for an unknown endoscope: between neighbouring
#: frames its error hardly matters.
_TYPICAL_FOCAL_FACTOR = 0.6
#: Fewest matches for an epipolar geometry.
_FEWEST_MATCHES = 20


def epipolar_inliers(
    first: Float[np.ndarray, "K 2"], second: Float[np.ndarray, "K 2"], shape: tuple[int, ...], max_error: float
) -> Bool[np.ndarray, "K"]:
    """True for inliers of an essential matrix with a typical endoscope's camera; none of fewer than 20 matches. [K]

    Args:
        first: Column and row, pixel centres at integers.
        second: The same points in the other image.
        shape: Height and width of both images.
        max_error: RANSAC inlier threshold, pixels.
    """
    import pycolmap

    inliers = np.zeros(len(first), bool)
    if len(first) < _FEWEST_MATCHES:
        return inliers
    height, width = shape[:2]
    camera = pycolmap.Camera.create_from_model_name(
        0, "SIMPLE_RADIAL_FISHEYE", _TYPICAL_FOCAL_FACTOR * max(width, height), width, height
    )
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_error, options.ransac.random_seed = max_error, 0
    matches = np.repeat(np.arange(len(first), dtype=np.uint32)[:, None], 2, axis=1)
    pixels_first, pixels_second = (np.asarray(pixels, np.float64) + 0.5 for pixels in (first, second))
    geometry = pycolmap.estimate_calibrated_two_view_geometry(
        camera, pixels_first, camera, pixels_second, matches, options
    )
    inliers[np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)[:, 0]] = True
    return inliers


#: Features of an image that are compared first, those of the largest scale.
_LARGEST = 300
#: Images of the video that are compared with each other for loop closures, at most; and loop closures of each.
_LOOP_IMAGES, _LOOPS = 40, 2


def alike_pairs(
    features: Sequence[Features], settings: SfmSettings, progress: Progress | None = None
) -> list[tuple[int, int]]:
    """Pairs of images to match: all of a short video; else neighbours, and others whose largest features match.

    Each image is paired with the next two; with those 4, 8, 16, ... images ahead, up to the first that is not alike
    (every second or fourth image has the same pairs, therefore); and images evenly distributed over the video with the
    two most alike of each other's that are not reached this way, as loop closures.
    """
    count = len(features)
    if count <= settings.exhaustive_up_to:
        return list(combinations(range(count), 2))
    largest = [_largest(image_features) for image_features in features]

    def alikeness(first: int, second: int) -> int:
        return len(mutual_matches(largest[first], largest[second], settings.max_ratio, settings.max_distance))

    pairs = {(first, first + step) for step in (1, 2) for first in range(count - step)}
    reached = []
    for first in with_progress(range(count), "compare images", progress):
        step = 4
        while first + step < count and alikeness(first, first + step) >= settings.min_alike:
            pairs.add((first, first + step))
            step *= 2
        reached.append(first + step)
    distributed = range(0, count, -(-count // _LOOP_IMAGES))
    for row, first in enumerate(distributed):
        distant = [second for second in distributed[row + 1 :] if second > reached[first]]
        ranked = sorted(((alikeness(first, second), second) for second in distant), reverse=True)[:_LOOPS]
        pairs.update((first, second) for alike, second in ranked if alike >= settings.min_alike)
    return sorted(pairs)


def _largest(features: Features) -> Features:
    chosen = np.sort(np.argsort(-features.keypoints[:, 2], kind="stable")[:_LARGEST])
    return Features(features.keypoints[chosen], features.descriptors[chosen])
