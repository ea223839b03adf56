"""Rays cast at a mesh, and distances to it, by open3d."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from coliags_plugin.core.open3d_library import import_open3d


class RayScene:
    """A mesh indexed for rays and distances.

    Args:
        mesh: ``open3d.t.geometry.TriangleMesh``.
    """

    def __init__(self, mesh: Any) -> None:
        self._open3d = import_open3d("casts rays at meshes")
        self._scene = self._open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(mesh)

    def cast(
        self, origins: Float[np.ndarray, "N 3"] | Float[np.ndarray, "3"], directions: Float[np.ndarray, "N 3"]
    ) -> tuple[Int[np.ndarray, "N"], Float32[np.ndarray, "N"]]:
        """Triangle that each ray hits first, -1 without a hit, and how many lengths of the ray it is away. [N], [N]"""
        answer = self._scene.cast_rays(self._rays(origins, directions))
        parameter = answer["t_hit"].numpy()
        triangle = answer["primitive_ids"].numpy().astype(np.int64)  # unsigned; its largest value without a hit
        return np.where(np.isfinite(parameter), triangle, -1), parameter

    def blocked(
        self, origins: Float[np.ndarray, "N 3"] | Float[np.ndarray, "3"], directions: Float[np.ndarray, "N 3"]
    ) -> Bool[np.ndarray, "N"]:
        """Whether something lies on each ray before its end, the last thousandth of it left out. [N]"""
        rays = self._rays(origins, directions)
        return np.asarray(self._scene.test_occlusions(rays, tnear=0.0, tfar=0.999).numpy())

    def distance(self, points: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N"]:
        """Distance of points to the surface. [N]"""
        query = self._open3d.core.Tensor(np.ascontiguousarray(points, np.float32))
        return np.asarray(self._scene.compute_distance(query).numpy())

    def nearest(self, points: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, "N"], Int[np.ndarray, "N"]]:
        """Distance to the nearest point of any triangle, scene units, and that triangle. [N], [N]"""
        points = np.ascontiguousarray(points, np.float32)
        found = self._scene.compute_closest_points(self._open3d.core.Tensor(points))
        distances = np.linalg.norm(found["points"].numpy().astype(np.float64) - points, axis=1)
        return distances, found["primitive_ids"].numpy().astype(np.int64)

    def _rays(
        self, origins: Float[np.ndarray, "N 3"] | Float[np.ndarray, "3"], directions: Float[np.ndarray, "N 3"]
    ) -> Any:
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origins, directions
        return self._open3d.core.Tensor(rays)
