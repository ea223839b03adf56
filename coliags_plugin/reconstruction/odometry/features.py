"""Initial guess of a large motion between two frames, by SIFT matches and RANSAC PnP."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.poses.rigid import rigid
from coliags_plugin.reconstruction.odometry.frames import PreparedFrame

#: The contrast threshold is low because the images are normalised to uniform contrast.
_FEATURES, _CONTRAST = 1500, 0.01
#: Lowe's ratio; loose, as RANSAC rejects outliers afterwards.
_RATIO = 0.9
_ROUNDS, _REPROJECTION_PX, _FEWEST = 500, 3.0, 12


def motion_by_features(
    source: PreparedFrame, target: PreparedFrame, intrinsics: Intrinsics
) -> Float[np.ndarray, "4 4"] | None:
    """Estimate the motion between two frames by SIFT matches and RANSAC PnP on the source's back-projected features.

    OpenCV's RANSAC uses a fixed seed.

    Args:
        source: Frame whose depth back-projects the features.
        target: The other frame.
        intrinsics: Intrinsics of both.

    Returns:
        Source camera to target camera, as an initial guess; None with too few matches or inliers. [4, 4]
    """
    sift = cv2.SIFT_create(nfeatures=_FEATURES, contrastThreshold=_CONTRAST)  # type: ignore[attr-defined]
    here, there = _features(sift, source), _features(sift, target)
    if min(len(here[0]), len(there[0])) < _FEWEST:
        return None
    matches = [
        first
        for first, second in cv2.BFMatcher().knnMatch(here[1], there[1], k=2)
        if first.distance < _RATIO * second.distance
    ]
    if len(matches) < _FEWEST:
        return None
    pixels = here[0][[match.queryIdx for match in matches]]
    seen = there[0][[match.trainIdx for match in matches]]
    column, row = np.rint(pixels).astype(int).T
    z = source.depth[row, column].astype(np.float64)
    k = intrinsics.opencv_matrix()
    points = np.stack([(pixels[:, 0] - k[0, 2]) / k[0, 0] * z, (pixels[:, 1] - k[1, 2]) / k[1, 1] * z, z], axis=1)
    known = z > 0.0
    if known.sum() < _FEWEST:
        return None
    found, rotvec, translation, inliers = cv2.solvePnPRansac(
        points[known],
        seen[known],
        k,
        None,
        iterationsCount=_ROUNDS,
        reprojectionError=_REPROJECTION_PX,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or inliers is None or len(inliers) < _FEWEST:
        return None
    return rigid(cv2.Rodrigues(rotvec)[0][None], np.asarray(translation, np.float64).reshape(1, 3))[0]


def _features(sift: Any, frame: PreparedFrame) -> tuple[Float[np.ndarray, "K 2"], np.ndarray]:
    """Pixels (centres at integers, as in OpenCV) and descriptors of features with known depth."""
    image = np.rint(frame.intensity * 255.0).astype(np.uint8)
    keypoints, descriptors = sift.detectAndCompute(image, (frame.depth > 0.0).astype(np.uint8))
    return np.array([point.pt for point in keypoints], np.float64).reshape(-1, 2), descriptors
