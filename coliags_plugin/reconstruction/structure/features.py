"""SIFT features of endoscopic images, without specular highlights, and their matches between pairs of images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt32
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from coliags_plugin.core.arrays import dilated
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.images import highlights
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.core.scenes import Frame
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.reconstruction.structure.image_files import Image, Mask
from coliags_plugin.reconstruction.structure.sfm_settings import FeatureSettings, SfmSettings


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints and descriptors of one image."""

    keypoints: Float32[np.ndarray, "N 4"]  # column, row (centres at integers + 0.5), scale; angle, radians
    descriptors: Float32[np.ndarray, "N 128"]  # L2-normalised

    @property
    def pixels(self) -> Float[np.ndarray, "N 2"]:
        """Column and row, pixel centres at integers + 0.5; float64."""
        return self.keypoints[:, :2].astype(np.float64)

    def __len__(self) -> int:
        """Number of features."""
        return len(self.keypoints)


def image_and_mask(frame: Frame) -> tuple[Image, Mask | None]:
    """A frame's RGB image and its mask, if any."""
    return frame.image.cpu().numpy(), None if frame.mask is None else frame.mask.cpu().numpy()


#: Clip limit of the local contrast enhancement (CLAHE) of the grey image, on 8 x 8 tiles.
_CLIP_LIMIT = 4.0
#: Extracts the features of an RGB image where its mask, if any, is True.
Extractor = Callable[[Image, Mask | None], Features]


def feature_extractor(settings: FeatureSettings) -> Extractor:
    """Create a reusable feature extractor: CLAHE, COLMAP's SIFT, and rejection of masked features.

    Call it within :func:`quiet_colmap`.
    """
    import cv2
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.sift.peak_threshold = settings.peak_threshold
    options.sift.max_num_features = settings.max_features
    options.sift.upright = settings.upright
    sift = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    local_contrast = cv2.createCLAHE(_CLIP_LIMIT, (8, 8))

    def extract(image: np.ndarray, mask: np.ndarray | None) -> Features:
        gray = local_contrast.apply(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        keypoints, descriptors = sift.extract_from_uint8_array(np.ascontiguousarray(gray))
        points = pycolmap.keypoints_to_matrix(keypoints).astype(np.float32).reshape(-1, 4)
        vectors = np.asarray(descriptors.data, np.float32).reshape(-1, 128)
        height, width = gray.shape
        column = np.clip(points[:, 0].astype(np.int64), 0, width - 1)
        row = np.clip(points[:, 1].astype(np.int64), 0, height - 1)
        is_usable = usable(image, mask, settings)[row, column]
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        return Features(points[is_usable], (vectors / np.maximum(lengths, 1e-12))[is_usable])

    return extract


def usable(image: Image, mask: Mask | None, settings: FeatureSettings) -> Mask:
    """Pixels where features are accepted: neither masked nor near a highlight."""
    excluded = highlights(image, settings.highlight_level, settings.highlight_ratio)
    if mask is not None:
        excluded |= ~mask
    return ~dilated(excluded, settings.margin)


#: glog's level FATAL.
_FATAL = 3


@contextmanager
def quiet_colmap(seed: int) -> Iterator[None]:
    """Silence COLMAP's log and seed its global random generator."""
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = _FATAL
    pycolmap.set_random_seed(seed)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


#: Indices of the features that match in two images; and of all pairs of images that were compared.
Pairs = UInt32[np.ndarray, "M 2"]
Matches = Mapping[tuple[int, int], Pairs]

#: Largest distance of the descriptors of matching features, 0 to 2.
_MAX_DISTANCE = 0.7
#: Features closer than this are duplicates and do not count as the second-best match of each other. Pixels.
_DUPLICATE_DISTANCE = 2.0


def mutual_matches(first: Features, second: Features, max_ratio: float = 0.8) -> Pairs:
    """Match features by mutual nearest descriptors, Lowe's ratio test and a limit of their distance."""
    if min(len(first), len(second)) < 2:
        return np.empty((0, 2), np.uint32)
    similarity = first.descriptors @ second.descriptors.T
    nearest = similarity.argmax(axis=1)
    best = similarity[np.arange(len(first)), nearest]
    mutual = best == similarity.max(axis=0)[nearest]
    # The most similar of each partner, the first of equals.
    rows = np.flatnonzero(mutual)
    rows = rows[np.lexsort((-best[rows], nearest[rows]))]
    rows = np.sort(rows[np.unique(nearest[rows], return_index=True)[1]])
    partners, similarity, best = nearest[rows], similarity[rows], best[rows]
    # Duplicates of the best match, from neighbouring octaves, are excluded from the second-best.
    duplicates = cKDTree(second.keypoints[:, :2]).query_pairs(_DUPLICATE_DISTANCE, output_type="ndarray").T
    is_duplicate = coo_array((np.ones(duplicates.shape[1], bool), duplicates), shape=(len(second), len(second))).tocsr()
    similarity[np.arange(len(rows)), partners] = -1.0
    similarity[(is_duplicate + is_duplicate.T)[partners].nonzero()] = -1.0
    products = best, similarity.max(axis=1, initial=-1.0)
    distance, second_best = (np.sqrt(np.maximum(2.0 - 2.0 * product, 0.0)) for product in products)
    is_match = (distance < _MAX_DISTANCE) & (distance < max_ratio * second_best)
    return np.stack([rows[is_match], partners[is_match]], axis=1).astype(np.uint32)


def rays(pixels: Float[np.ndarray, "N 2"], camera: Camera) -> Float[np.ndarray, "N 3"]:
    """Ray directions of pixels in the camera frame, z = 1. [N, 3]"""
    return PinholeLens.of(camera.intrinsics).unproject(pixels)


def have_positive_depths(turned: np.ndarray, other: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """True where the lines ``a * turned + translation`` and ``b * other`` are closest at positive a and b. [K]"""
    aa, bb, ab = (np.einsum("ij,ij->i", *pair) for pair in ((turned, turned), (other, other), (turned, other)))
    at, bt = turned @ translation, other @ translation
    # The common denominator aa * bb - ab^2 is not negative.
    return np.asarray((ab * bt - bb * at > 0.0) & (aa * bt - ab * at > 0.0))


#: Focal length relative to the larger side of the fisheye that stands for an unknown endoscope: between neighbouring
#: frames its error hardly matters.
_TYPICAL_FOCAL_FACTOR = 0.6
#: Fewest matches for an epipolar geometry.
_FEWEST_MATCHES = 20


def epipolar_inliers(
    first: Float[np.ndarray, "K 2"], second: Float[np.ndarray, "K 2"], shape: tuple[int, ...], max_error: float
) -> Bool[np.ndarray, "K"]:
    """True for inliers of an essential matrix with a typical endoscope's camera; none of fewer than 20 matches. [K]

    Matches are columns and rows, pixel centres at integers, in two images of a shape (height and width); ``max_error``,
    pixels, is RANSAC's inlier threshold.
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
    rows = [np.sort(np.argsort(-each.keypoints[:, 2], kind="stable")[:_LARGEST]) for each in features]
    largest = [Features(each.keypoints[row], each.descriptors[row]) for each, row in zip(features, rows, strict=True)]

    def alikeness(first: int, second: int) -> int:
        return len(mutual_matches(largest[first], largest[second], settings.max_ratio))

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
