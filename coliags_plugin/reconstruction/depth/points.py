"""Surface points of estimated depth: confident pixels of several frames, merged in voxels."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from coliags_plugin.reconstruction.depth.views import Pose

#: Least confidence of a pixel, and least number of frames that see a point's voxel.
LEAST_CONFIDENCE, FEWEST_FRAMES = 0.8, 3
#: Voxels are held as one integer: so many along each axis, the world's origin in the middle.
_SPAN = 1 << 20


class VoxelPoints:
    """Points merged in cubic voxels of the world, frame by frame; memory grows with the surface, not the frames.

    Args:
        size: Of the voxels, scene units.
        origin: A position amid the scene. [3]
    """

    def __init__(self, size: float, origin: Float[np.ndarray, "3"]) -> None:
        self.size, self.origin = size, np.asarray(origin, np.float64)
        self._keys: Int[np.ndarray, "V"] = np.zeros(0, np.int64)
        #: Sums of weight, weighted offset from the origin and weighted colour, and the number of frames. [V, 8]
        self._sums: Float[np.ndarray, "V 8"] = np.zeros((0, 8))

    def add(
        self,
        pose: Pose,
        depth: Float32[np.ndarray, "H W"],
        confidence: Float32[np.ndarray, "H W"],
        image: UInt8[np.ndarray, "H W 3"],
    ) -> None:
        """Add a frame's confident pixels.

        Args:
            pose: Camera of the frame.
            depth: z-depth. [H, W]
            confidence: 0 to 1; below ``LEAST_CONFIDENCE`` a pixel does not count. [H, W]
            image: RGB. [H, W, 3]
        """
        chosen = (confidence >= LEAST_CONFIDENCE) & ~_steep(depth)
        weight = confidence[chosen].astype(np.float64)[:, None]
        local = (pose.rays() * depth[..., None])[chosen]
        offset = local @ pose.camera_to_world[:3, :3].T + pose.camera_to_world[:3, 3] - self.origin
        cell = np.floor(offset / self.size).astype(np.int64) + _SPAN // 2
        inside = ((cell >= 0) & (cell < _SPAN)).all(axis=1)
        keys = (cell[:, 0] * _SPAN + cell[:, 1]) * _SPAN + cell[:, 2]
        rows = np.concatenate([weight, weight * offset, weight * image[chosen]], axis=1)[inside]
        own, sums = _summed(keys[inside], rows)
        once = np.ones((len(own), 1))
        self._keys, self._sums = _summed(
            np.concatenate([self._keys, own]), np.concatenate([self._sums, np.hstack([sums, once])])
        )

    def points(self) -> tuple[Float32[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"]]:
        """Weighted mean position and colour of every voxel that ``FEWEST_FRAMES`` frames have points in."""
        sums = self._sums[self._sums[:, 7] >= FEWEST_FRAMES]
        weight = sums[:, :1]
        positions = sums[:, 1:4] / weight + self.origin
        return positions.astype(np.float32), np.rint(sums[:, 4:7] / weight).astype(np.uint8)


def _summed(keys: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of equal keys added up; keys ascending."""
    order = np.argsort(keys, kind="stable")
    keys, rows = keys[order], rows[order]
    first = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]])) if len(keys) else np.zeros(0, np.int64)
    return keys[first], np.add.reduceat(rows, first, axis=0) if len(keys) else rows


def _steep(depth: Float32[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels at a depth discontinuity: a tenth or more between the neighbours on both sides. [H, W]"""
    log = np.log(depth)
    steep = np.zeros(depth.shape, bool)
    steep[1:-1] |= np.abs(log[2:] - log[:-2]) > 0.1
    steep[:, 1:-1] |= np.abs(log[:, 2:] - log[:, :-2]) > 0.1
    return steep
