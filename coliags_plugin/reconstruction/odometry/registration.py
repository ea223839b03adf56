"""How one frame lies to another, and whether to believe it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.poses.rigid import RIGID_TOLERANCE, rigid
from coliags_plugin.reconstruction.odometry.frames import PreparedFrame

Term = Literal["hybrid", "point-to-plane", "intensity"]

#: Depths that differ by more do not belong together; loss turns linear beyond the others. open3d's own values, which
#: are metres for rooms; here the unit is the video's median depth.
DEPTH_TRUNCATION, _DEPTH_HUBER, _INTENSITY_HUBER = 0.07, 0.05, 0.1
#: Iterations from the coarsest picture to the finest, fewer levels for small pictures.
_ITERATIONS, _COARSEST = (20, 10, 10), 30
_CONVERGED = 1e-7
#: Of the four pixels that depth is interpolated from, all must be known; the rest is rounding.
_ALL_KNOWN = 0.999
_METHODS = {"hybrid": "Hybrid", "point-to-plane": "PointToPlane", "intensity": "Intensity"}


@dataclass(frozen=True, eq=False)
class Edge:
    """The motion between two frames.

    Attributes:
        source, target: Indices of the frames.
        source_to_target: Source camera to target camera, the video's own unit of length. [4, 4]
        fitness: Share of the source's pixels of known depth that meet the target's surface.
        depth_rmse: How far from it those that do, along the optical axis; the video's own unit.
        correlation: Of normalised intensities, source and target, at those.
        residual: Mean squared residual that open3d ended with.
    """

    source: int
    target: int
    source_to_target: Float[np.ndarray, "4 4"]
    fitness: float
    depth_rmse: float
    correlation: float
    residual: float


class Registrar:
    """Registers prepared frames by open3d's RGB-D odometry, coarse to fine.

    Hybrid and intensity are Park et al., "Colored point cloud registration revisited" (ICCV 2017) and Steinbruecker et
    al., "Real-time visual odometry from dense RGB-D images" (ICCV workshops 2011), as open3d has them.

    Args:
        open3d: The library, from :func:`exact_open3d`.
        intrinsics: Of all frames.
        term: What is minimised.
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
        self,
        frames: tuple[int, int],
        source: PreparedFrame,
        target: PreparedFrame,
        guess: Float[np.ndarray, "4 4"],
    ) -> Edge | None:
        """Find the motion from a source to a target frame.

        Args:
            frames: Their indices.
            source: The frame to lay.
            target: The frame to lay it to.
            guess: Where to begin; source camera to target camera. [4, 4]

        Returns:
            What was found, to be judged; None where open3d gives up or what it finds is no motion.
        """
        odometry = self._open3d.t.pipelines.odometry
        try:
            found = odometry.rgbd_odometry_multi_scale(
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
        except RuntimeError:  # a singular system: nothing to hold on to
            return None
        motion = _rigid(found.transformation.numpy())
        if motion is None:
            return None
        fitness, depth_rmse, correlation = agreement(source, target, motion, self.intrinsics)
        return Edge(*frames, motion, fitness, depth_rmse, correlation, float(found.inlier_rmse))

    def information(self, edge: Edge, source: PreparedFrame, target: PreparedFrame) -> Float[np.ndarray, "6 6"]:
        """How firmly the frames' surfaces hold an edge, as open3d's pose graph wants it. [6, 6]"""
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
    """How well two frames agree under a motion, whatever found it.

    Overlap and depth alone say little: a smooth tube slid along itself still fits. Texture does not, so brightness is
    compared even where it was not used to find the motion.

    Args:
        source: One frame.
        target: The other.
        source_to_target: Source camera to target camera. [4, 4]
        intrinsics: Of both.

    Returns:
        Share of the source's pixels of known depth that meet the target's surface, how far from it those are along the
        optical axis (root mean square), and the correlation of intensities there (0 where one is flat).
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
    spreads = float(one.std()), float(other.std())
    flat = min(spreads) < 1e-4
    correlation = (
        0.0 if flat else float(((one - one.mean()) * (other - other.mean())).mean() / (spreads[0] * spreads[1]))
    )
    return float(meets.mean()), float(np.sqrt(np.mean((z - there)[meets] ** 2))), correlation


def _sampled(picture: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Values between pixels, 0 outside the picture. remap takes no more than 32767 rows, hence the pieces."""
    pieces = [
        cv2.remap(
            picture,
            u[at : at + 32_000],
            v[at : at + 32_000],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        )
        for at in range(0, len(u), 32_000)
    ]
    return np.concatenate(pieces)[:, 0]


def _rigid(matrix: np.ndarray) -> Float[np.ndarray, "4 4"] | None:
    """The matrix made exactly rigid; None where it is far from that."""
    if not np.isfinite(matrix).all():
        return None
    left, values, right = np.linalg.svd(matrix[:3, :3])
    if np.abs(values - 1.0).max() > RIGID_TOLERANCE or np.linalg.det(matrix[:3, :3]) < 0.0:
        return None
    return rigid((left @ right)[None], np.asarray(matrix[:3, 3], np.float64)[None])[0]
