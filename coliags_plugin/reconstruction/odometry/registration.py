"""Pairwise RGB-D registration by open3d's multi-scale odometry, measures of its quality, and initial guesses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.poses.rigid import RIGID_TOLERANCE, rigid
from coliags_plugin.reconstruction.odometry.frames import PreparedFrame

Term = Literal["hybrid", "point-to-plane", "intensity"]

#: Largest depth difference of a correspondence, and thresholds of the Huber losses of depth and intensity: open3d's
#: default values, in units of the video's median depth instead of metres.
DEPTH_TRUNCATION, _DEPTH_HUBER, _INTENSITY_HUBER = 0.07, 0.05, 0.1
#: Iterations of the pyramid levels, coarsest first, and the least side of a level in pixels.
_ITERATIONS, _COARSEST = (20, 10, 10), 30
_CONVERGED = 1e-7
#: Depth is interpolated only between four known pixels; the tolerance is for rounding.
_ALL_KNOWN = 0.999
_METHODS = {"hybrid": "Hybrid", "point-to-plane": "PointToPlane", "intensity": "Intensity"}


@dataclass(frozen=True, eq=False)
class Edge:
    """Relative motion between two frames; lengths in units of the video's median depth."""

    source: int
    target: int
    source_to_target: Float[np.ndarray, "4 4"]
    fitness: float  # share of the source's pixels of known depth that are inliers on the target's surface
    depth_rmse: float  # of the inliers' z-depth
    correlation: float  # of the normalised intensities of source and target at the inliers
    residual: float  # open3d's final mean squared residual


class FrameRegistration:
    """Registers prepared frames by open3d's RGB-D odometry, coarse to fine.

    Hybrid and intensity are Park et al., "Colored point cloud registration revisited" (ICCV 2017) and Steinbruecker et
    al., "Real-time visual odometry from dense RGB-D images" (ICCV workshops 2011), as open3d has them.
    """

    def __init__(self, open3d: Any, intrinsics: Intrinsics, term: Term) -> None:
        self._open3d, self.intrinsics = open3d, intrinsics
        odometry = open3d.t.pipelines.odometry
        self._method = getattr(odometry.Method, _METHODS[term])
        self._loss = odometry.OdometryLossParams(DEPTH_TRUNCATION, _DEPTH_HUBER, _INTENSITY_HUBER)
        side = min(intrinsics.width, intrinsics.height)
        levels = 1 + sum(side >= _COARSEST * 2**level for level in range(1, len(_ITERATIONS)))
        self._criteria = [
            odometry.OdometryConvergenceCriteria(count, _CONVERGED, _CONVERGED) for count in _ITERATIONS[-levels:]
        ]
        # open3d counts pixel centres at integers.
        self._k = open3d.core.Tensor(intrinsics.opencv_matrix())

    def register(
        self, frames: tuple[int, int], source: PreparedFrame, target: PreparedFrame, guess: Float[np.ndarray, "4 4"]
    ) -> Edge | None:
        """The motion from a source to a target frame, not yet verified; None if open3d finds none that is rigid."""
        odometry = self._open3d.t.pipelines.odometry
        try:
            result = odometry.rgbd_odometry_multi_scale(
                self._rgbd(source),
                self._rgbd(target),
                self._k,
                self._open3d.core.Tensor(guess),
                1.0,
                1e9,
                self._criteria,
                self._method,
                self._loss,
            )
        except RuntimeError:  # singular system
            return None
        motion = _rigid(result.transformation.numpy())
        if motion is None:
            return None
        fitness, depth_rmse, correlation = agreement(source, target, motion, self.intrinsics)
        return Edge(*frames, motion, fitness, depth_rmse, correlation, float(result.inlier_rmse))

    def information(self, edge: Edge, source: PreparedFrame, target: PreparedFrame) -> Float[np.ndarray, "6 6"]:
        """Information matrix of an edge for open3d's pose graph."""
        odometry = self._open3d.t.pipelines.odometry
        matrix = odometry.compute_odometry_information_matrix(
            self._rgbd(source).depth,
            self._rgbd(target).depth,
            self._k,
            self._open3d.core.Tensor(edge.source_to_target),
            DEPTH_TRUNCATION,
            1.0,
            1e9,
        ).numpy()
        return np.asarray(matrix, np.float64)

    def _rgbd(self, frame: PreparedFrame) -> Any:
        geometry, tensor = self._open3d.t.geometry, self._open3d.core.Tensor
        color = np.ascontiguousarray(np.broadcast_to(frame.intensity[..., None], (*frame.intensity.shape, 3)))
        return geometry.RGBDImage(
            geometry.Image(tensor(color)), geometry.Image(tensor(np.ascontiguousarray(frame.depth[..., None])))
        )


def agreement(
    source: PreparedFrame, target: PreparedFrame, source_to_target: Float[np.ndarray, "4 4"], intrinsics: Intrinsics
) -> tuple[float, float, float]:
    """Fitness, depth RMSE and intensity correlation (0 where one is constant) of two frames under a given motion.

    Overlap and depth alone do not detect sliding along a smooth tube; intensity does, so it is compared even if the
    motion was estimated from depth alone. See :class:`Edge`.
    """
    step = 2 if min(source.depth.shape) > 2 * _COARSEST else 1
    row, column = np.nonzero(source.depth[::step, ::step])
    row, column = row * step, column * step
    if not len(row):
        return 0.0, 0.0, 0.0
    k, z = intrinsics, source.depth[row, column].astype(np.float64)
    points = np.stack([(column + 0.5 - k.cx) / k.fx * z, (row + 0.5 - k.cy) / k.fy * z, z], axis=1)
    x, y, z = (points @ source_to_target[:3, :3].T + source_to_target[:3, 3]).T
    ahead = z > 0.0
    safe = np.where(ahead, z, 1.0)
    # Pixel positions with centres at integers, as remap counts them; points behind the camera land outside.
    u = np.where(ahead, x / safe * k.fx + k.cx - 0.5, -9.0).clip(-9.0, 1e4).astype(np.float32)[:, None]
    v = np.where(ahead, y / safe * k.fy + k.cy - 0.5, -9.0).clip(-9.0, 1e4).astype(np.float32)[:, None]
    there = _sampled(target.depth, u, v)
    known = _sampled((target.depth > 0.0).astype(np.float32), u, v) > _ALL_KNOWN
    meets = known & (np.abs(z - there) < DEPTH_TRUNCATION)
    if not meets.any():
        return 0.0, 0.0, 0.0
    one = source.intensity[row, column][meets]
    other = _sampled(target.intensity, u, v)[meets]
    spreads, correlation = (float(one.std()), float(other.std())), 0.0
    if min(spreads) >= 1e-4:
        correlation = float(((one - one.mean()) * (other - other.mean())).mean() / (spreads[0] * spreads[1]))
    return float(meets.mean()), float(np.sqrt(np.mean((z - there)[meets] ** 2))), correlation


def _sampled(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Bilinear samples, 0 outside the image; in chunks, as cv2.remap takes at most 32767 rows."""
    parts = [slice(at, at + 32_000) for at in range(0, len(u), 32_000)]
    return np.concatenate([cv2.remap(image, u[part], v[part], cv2.INTER_LINEAR) for part in parts])[:, 0]


def _rigid(matrix: np.ndarray) -> Float[np.ndarray, "4 4"] | None:
    """Nearest rigid transform; None where the matrix is far from rigid."""
    if not np.isfinite(matrix).all():
        return None
    left, values, right = np.linalg.svd(matrix[:3, :3])
    if np.abs(values - 1.0).max() > RIGID_TOLERANCE or np.linalg.det(matrix[:3, :3]) < 0.0:
        return None
    return rigid((left @ right)[None], np.asarray(matrix[:3, 3], np.float64)[None])[0]


#: The contrast threshold is low because the images are normalised to uniform contrast.
_FEATURES, _CONTRAST = 1500, 0.01
#: Lowe's ratio; loose, as RANSAC rejects outliers afterwards.
_RATIO = 0.9
_ROUNDS, _REPROJECTION_PX, _FEWEST = 500, 3.0, 12


def motion_by_features(
    source: PreparedFrame, target: PreparedFrame, intrinsics: Intrinsics
) -> Float[np.ndarray, "4 4"] | None:
    """Initial guess of the motion by SIFT matches and RANSAC PnP on the source's back-projected features.

    None with too few matches or inliers. OpenCV's RANSAC uses a fixed seed.
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
    observed = there[0][[match.trainIdx for match in matches]]
    column, row = np.rint(pixels).astype(int).T
    z = source.depth[row, column].astype(np.float64)
    k = intrinsics.opencv_matrix()
    points = np.stack([(pixels[:, 0] - k[0, 2]) / k[0, 0] * z, (pixels[:, 1] - k[1, 2]) / k[1, 1] * z, z], axis=1)
    known = z > 0.0
    if known.sum() < _FEWEST:
        return None
    succeeded, rotvec, translation, inliers = cv2.solvePnPRansac(
        points[known],
        observed[known],
        k,
        None,
        iterationsCount=_ROUNDS,
        reprojectionError=_REPROJECTION_PX,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not succeeded or inliers is None or len(inliers) < _FEWEST:
        return None
    return rigid(cv2.Rodrigues(rotvec)[0][None], np.asarray(translation, np.float64).reshape(1, 3))[0]


def _features(sift: Any, frame: PreparedFrame) -> tuple[Float[np.ndarray, "K 2"], np.ndarray]:
    """Pixels (centres at integers, as in OpenCV) and descriptors of features with known depth."""
    image = np.rint(frame.intensity * 255.0).astype(np.uint8)
    keypoints, descriptors = sift.detectAndCompute(image, (frame.depth > 0.0).astype(np.uint8))
    return np.array([point.pt for point in keypoints], np.float64).reshape(-1, 2), descriptors
