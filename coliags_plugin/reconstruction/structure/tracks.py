"""Point tracks as arrays, with reprojection residuals, triangulation angles and depth uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from coliags_plugin.core.cameras import Camera

if TYPE_CHECKING:
    import pycolmap

#: Lower bound of the estimated noise of an observation, pixels.
LEAST_NOISE = 0.1
#: Weight of the common noise in that of a point, in residuals: a short track tells little about its own.
NOISE_WEIGHT = 4


@dataclass(frozen=True, eq=False)
class Tracks:
    """Tracks of N points with K observations in all."""

    positions: Float[np.ndarray, "N 3"]  # world
    points: Int[np.ndarray, "K"]  # point index of each observation
    frames: Int[np.ndarray, "K"]  # frame index of each observation
    pixels: Float[np.ndarray, "K 2"]  # observed pixels, centres at integers + 0.5

    @classmethod
    def of(cls, model: pycolmap.Reconstruction, frame_count: int) -> Tracks:
        """Tracks of a COLMAP model with image IDs from 1, points ordered by ID."""
        numbers = sorted(model.points3D)
        row = {number: index for index, number in enumerate(numbers)}
        points, frames, pixels = [], [], []
        for frame in range(frame_count):
            for observation in model.images[frame + 1].get_observation_points2D():
                points.append(row[observation.point3D_id])
                frames.append(frame)
                pixels.append(observation.xy)
        positions = np.array([model.points3D[number].xyz for number in numbers], np.float64).reshape(-1, 3)
        return cls(
            positions,
            np.array(points, np.int64),
            np.array(frames, np.int64),
            np.array(pixels, np.float64).reshape(-1, 2),
        )

    def __len__(self) -> int:
        """Number of points."""
        return len(self.positions)

    @property
    def lengths(self) -> Int[np.ndarray, "N"]:
        """Number of frames that observe each point."""
        return np.bincount(self.points, minlength=len(self))

    def only(self, kept: Bool[np.ndarray, "N"]) -> Tracks:
        """Subset of the points, reindexed."""
        is_kept = kept[self.points]
        number = np.cumsum(kept) - 1
        return Tracks(self.positions[kept], number[self.points[is_kept]], self.frames[is_kept], self.pixels[is_kept])

    def local(self, cameras: Sequence[Camera]) -> Float[np.ndarray, "K 3"]:
        """Points in the frames of their observing cameras."""
        poses = _poses(cameras)[self.frames]
        return np.einsum("kji,kj->ki", poses[:, :3, :3], self.positions[self.points] - poses[:, :3, 3])

    def residuals(self, cameras: Sequence[Camera]) -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, "K"]]:
        """Reprojection residuals (projection minus observation, pixels) and z-depths."""
        local, k = self.local(cameras), _intrinsics(cameras)[self.frames]
        return local[:, :2] / local[:, 2:] * k[:, :2] + k[:, 2:] - self.pixels, local[:, 2]


def widest_angles(tracks: Tracks, cameras: Sequence[Camera]) -> Float[np.ndarray, "N"]:
    """Upper bound of the widest angle between a point's rays, degrees."""
    poses = _poses(cameras)[tracks.frames]
    rays = tracks.positions[tracks.points] - poses[:, :3, 3]
    return widest_between(rays / np.linalg.norm(rays, axis=1, keepdims=True), tracks.points, len(tracks))


def widest_between(rays: Float[np.ndarray, "K 3"], points: Int[np.ndarray, "K"], count: int) -> Float[np.ndarray, "N"]:
    """Upper bound of the widest angle between each point's rays, degrees: twice the largest angle to their mean.

    ``rays`` have unit length; ``points`` are those that they belong to, of ``count``. NaN for a point with NaN rays.
    """
    mean = np.zeros((count, 3))
    np.add.at(mean, points, rays)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    sines = np.linalg.norm(np.cross(rays, mean[points]), axis=1)
    widest = np.zeros(count)
    np.maximum.at(widest, points, sines)
    return np.degrees(2.0 * np.arcsin(np.minimum(widest, 1.0)))


def uncertainty(tracks: Tracks, cameras: Sequence[Camera]) -> tuple[float, Float[np.ndarray, "N"]]:
    """Observation noise, and the depth uncertainty it propagates to for exact poses.

    The noise is the standard deviation of an observation along each axis, estimated from the residuals, pixels, at
    least ``LEAST_NOISE``; the uncertainty each point's standard deviation of z-depth relative to it, mean over cameras,
    by its own residuals together with ``NOISE_WEIGHT`` residuals of that noise.
    """
    if not len(tracks):
        return LEAST_NOISE, np.empty(0)
    residuals, _ = tracks.residuals(cameras)
    freedom = 2 * len(residuals) - 3 * len(tracks)
    squared = np.bincount(tracks.points, (residuals**2).sum(axis=1), len(tracks))
    noise = max(LEAST_NOISE, float(np.sqrt(squared.sum() / max(freedom, 1))))
    own = (NOISE_WEIGHT * noise**2 + squared) / (NOISE_WEIGHT + 2 * tracks.lengths - 3)
    local, k = tracks.local(cameras), _intrinsics(cameras)[tracks.frames]
    z = local[:, 2]
    jacobians = np.zeros((len(z), 2, 3))
    jacobians[:, 0, 0], jacobians[:, 1, 1] = k[:, 0] / z, k[:, 1] / z
    jacobians[:, :, 2] = -k[:, :2] * local[:, :2] / z[:, None] ** 2
    rotations = _poses(cameras)[tracks.frames][:, :3, :3]
    jacobians = jacobians @ rotations.transpose(0, 2, 1)
    information = np.zeros((len(tracks), 3, 3))
    np.add.at(information, tracks.points, jacobians.transpose(0, 2, 1) @ jacobians)
    # Nearly parallel rays make it singular; the damping gives them a very large uncertainty.
    scale = np.trace(information, axis1=1, axis2=2)[:, None, None]
    covariances = np.linalg.inv(information + 1e-12 * scale * np.eye(3))
    axes = rotations[:, :, 2]
    deviations = np.sqrt(np.einsum("ki,kij,kj->k", axes, covariances[tracks.points], axes)) / np.abs(z)
    return noise, np.sqrt(own) * np.bincount(tracks.points, deviations, len(tracks)) / tracks.lengths


def _poses(cameras: Sequence[Camera]) -> Float[np.ndarray, "F 4 4"]:
    return np.stack([camera.camera_to_world.double().numpy() for camera in cameras])


def _intrinsics(cameras: Sequence[Camera]) -> Float[np.ndarray, "F 4"]:
    return np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras], np.float64)
