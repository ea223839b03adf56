"""Depth maps of posed views, and the depths that other views give to the pixels of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.intrinsics import Intrinsics


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


#: Values of an image.
Map = Float32[np.ndarray, "H W"]
#: Iterations until a ray has met a neighbour's surface, and the relative change at which it has.
_ITERATIONS, _CONVERGED = 12, 1e-3


@dataclass(frozen=True, eq=False)
class WeightedDepth:
    """Depth of a frame with weights."""

    pose: Pose  # camera of its size
    depth: Map  # z-depth; NaN where unknown
    weight: Map  # 0 where it does not count


def depths_by(
    neighbours: Sequence[WeightedDepth], frame: WeightedDepth
) -> tuple[Float32[np.ndarray, "P"], Float32[np.ndarray, "N P"], Float32[np.ndarray, "N P"]]:
    """Depths of a frame's pixels, flat and with zeros up to a multiple of sixteen, by itself and by its neighbours.

    A neighbour's depth of a pixel is where the pixel's ray meets the neighbour's surface, found by fixed-point
    iteration from the frame's own depth; NaN where it does not, or the neighbour's depth is unknown.

    Returns the frame's z-depth [P], the neighbours' [N, P], and the weights of the pixels that gave these [N, P].
    """
    from coliags_plugin.core.numba_kernels.lanes import WIDTH
    from coliags_plugin.core.numba_kernels.reprojection import reproject

    width, size = frame.depth.shape[1], frame.depth.size
    depth = np.pad(frame.depth.ravel(), (0, -size % WIDTH))
    candidates = np.empty((len(neighbours), len(depth)), np.float32)
    trusts = np.empty_like(candidates)
    for index, other in enumerate(neighbours):
        there, back = frame.pose.homography(other.pose), frame.pose.depth_from(other.pose)
        outputs = candidates[index], trusts[index]
        reproject(depth, width, other.depth, other.weight, *there, *back, _ITERATIONS, np.float32(_CONVERGED), *outputs)
    return depth, candidates, trusts
