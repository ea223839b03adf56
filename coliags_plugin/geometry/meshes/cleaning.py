"""Removal of what is not surface from reconstructed meshes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from coliags_plugin.geometry.meshes.mesh import TriangleMesh


def parts_of(mesh: TriangleMesh) -> Int[np.ndarray, "F"]:
    """Number of the connected part that each triangle belongs to, from 0; triangles are connected by vertices. [F]"""
    first, second, third = mesh.triangles.T
    rows, columns = np.concatenate([first, second]), np.concatenate([second, third])
    count = len(mesh.vertices)
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(count, count))
    labels = connected_components(graph, directed=False)[1][first]
    return np.asarray(np.unique(labels, return_inverse=True)[1].reshape(-1))


def without_small_parts(mesh: TriangleMesh, share: float) -> TriangleMesh:
    """The mesh without connected parts whose area is below a share of that of the largest part.

    Args:
        mesh: Any mesh.
        share: In [0, 1]; 0 keeps all.
    """
    if not len(mesh):
        return mesh
    parts = parts_of(mesh)
    areas = np.bincount(parts, mesh.areas)
    return mesh.part(areas[parts] >= share * areas.max())
