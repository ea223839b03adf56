"""Distances from points to a mesh."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from coliags_plugin.core.open3d_library import import_open3d
from coliags_plugin.meshes.mesh import TriangleMesh


def nearest_on(
    mesh: TriangleMesh, points: Float[np.ndarray, "N 3"]
) -> tuple[Float[np.ndarray, "N"], Int[np.ndarray, "N"]]:
    """Distance to the nearest point of any triangle, and that triangle.

    Args:
        mesh: With triangles.
        points: In the frame of the mesh. [N, 3]

    Returns:
        Distances, scene units [N], and triangles [N].
    """
    open3d = import_open3d("measures distances to meshes")
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.to_open3d())
    points = np.ascontiguousarray(points, np.float32)
    found = scene.compute_closest_points(open3d.core.Tensor(points))
    distances = np.linalg.norm(found["points"].numpy().astype(np.float64) - points, axis=1)
    return distances, found["primitive_ids"].numpy().astype(np.int64)
