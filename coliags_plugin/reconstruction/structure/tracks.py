"""Points and where they were seen, as arrays; and how far to trust them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from coliags_plugin.core.cameras import Camera

if TYPE_CHECKING:
    import pycolmap

#: Observations are never believed to be better than this, pixels.
LEAST_NOISE = 0.1


@dataclass(frozen=True, eq=False)
class Tracks:
    """N points, seen K times in all.

    Attributes:
        positions: World. [N, 3]
        points: Which point was seen. [K]
        frames: In which frame. [K]
        pixels: Where; centres at integers + 0.5. [K, 2]
    """

    positions: Float[np.ndarray, "N 3"]
    points: Int[np.ndarray, "K"]
    frames: Int[np.ndarray, "K"]
    pixels: Float[np.ndarray, "K 2"]

    @classmethod
    def of(cls, model: pycolmap.Reconstruction, frame_count: int) -> Tracks:
        """The points of a model whose images are numbered from 1, in the order of their numbers."""
        numbers = sorted(model.points3D)
        row = {number: index for index, number in enumerate(numbers)}
        points, frames, pixels = [], [], []
        for frame in range(frame_count):
            for seen in model.images[frame + 1].get_observation_points2D():
                points.append(row[seen.point3D_id])
                frames.append(frame)
                pixels.append(seen.xy)
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
        """In how many frames each point was seen. [N]"""
        return np.bincount(self.points, minlength=len(self))

    def only(self, kept: Bool[np.ndarray, "N"]) -> Tracks:
        """Some of the points, numbered anew."""
        seen = kept[self.points]
        number = np.cumsum(kept) - 1
        return Tracks(self.positions[kept], number[self.points[seen]], self.frames[seen], self.pixels[seen])

    def local(self, cameras: Sequence[Camera]) -> Float[np.ndarray, "K 3"]:
        """The points in the axes of the cameras that saw them. [K, 3]"""
        poses = _poses(cameras)[self.frames]
        return np.einsum("kji,kj->ki", poses[:, :3, :3], self.positions[self.points] - poses[:, :3, 3])

    def residuals(self, cameras: Sequence[Camera]) -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, "K"]]:
        """Projections less observations, pixels, and z-depths. [K, 2], [K]"""
        local, k = self.local(cameras), _intrinsics(cameras)[self.frames]
        return local[:, :2] / local[:, 2:] * k[:, :2] + k[:, 2:] - self.pixels, local[:, 2]


def widest_angles(tracks: Tracks, cameras: Sequence[Camera]) -> Float[np.ndarray, "N"]:
    """A lower bound of the widest angle between the rays of each point, degrees: twice that to their mean. [N]"""
    poses = _poses(cameras)[tracks.frames]
    rays = tracks.positions[tracks.points] - poses[:, :3, 3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    mean = np.zeros((len(tracks), 3))
    np.add.at(mean, tracks.points, rays)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    sines = np.linalg.norm(np.cross(rays, mean[tracks.points]), axis=1)
    widest = np.zeros(len(tracks))
    np.maximum.at(widest, tracks.points, sines)
    return np.degrees(2.0 * np.arcsin(np.minimum(widest, 1.0)))


def uncertainty(tracks: Tracks, cameras: Sequence[Camera]) -> tuple[float, Float[np.ndarray, "N"]]:
    """How well the observations fix the points, poses taken for exact.

    Returns:
        The standard deviation of an observation along each axis that the residuals show, pixels, at least
        ``LEAST_NOISE``; and the standard deviation of each point's z-depth that follows, as a share of it, mean over
        the cameras that saw it. [N]
    """
    if not len(tracks):
        return LEAST_NOISE, np.empty(0)
    residuals, _ = tracks.residuals(cameras)
    freedom = 2 * len(residuals) - 3 * len(tracks)
    noise = max(LEAST_NOISE, float(np.sqrt((residuals**2).sum() / max(freedom, 1))))
    local, k = tracks.local(cameras), _intrinsics(cameras)[tracks.frames]
    z = local[:, 2]
    jacobians = np.zeros((len(z), 2, 3))
    jacobians[:, 0, 0], jacobians[:, 1, 1] = k[:, 0] / z, k[:, 1] / z
    jacobians[:, :, 2] = -k[:, :2] * local[:, :2] / z[:, None] ** 2
    rotations = _poses(cameras)[tracks.frames][:, :3, :3]
    jacobians = jacobians @ rotations.transpose(0, 2, 1)
    information = np.zeros((len(tracks), 3, 3))
    np.add.at(information, tracks.points, jacobians.transpose(0, 2, 1) @ jacobians)
    # Rays that are nearly parallel leave it singular: their depth is as good as unknown.
    scale = np.trace(information, axis1=1, axis2=2)[:, None, None]
    covariances = np.linalg.inv(information + 1e-12 * scale * np.eye(3))
    axes = rotations[:, :, 2]
    deviations = np.sqrt(np.einsum("ki,kij,kj->k", axes, covariances[tracks.points], axes)) / np.abs(z)
    return noise, noise * np.bincount(tracks.points, deviations, len(tracks)) / tracks.lengths


def _poses(cameras: Sequence[Camera]) -> Float[np.ndarray, "F 4 4"]:
    return np.stack([camera.camera_to_world.double().numpy() for camera in cameras])


def _intrinsics(cameras: Sequence[Camera]) -> Float[np.ndarray, "F 4"]:
    return np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras], np.float64)
