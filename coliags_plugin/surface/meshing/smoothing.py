"""Laplacian smoothing of meshes, its strength set by their noise."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import cg

from coliags_plugin.geometry.meshes.mesh import TriangleMesh

#: Weight of bending where its noise is as large as an edge of a triangle.
_WEIGHT = 5e3
#: Times that the positions are found, with less weight where the last ones bend.
_PASSES = 3
#: Relative residual at which the positions count as found, and steps at most.
_TOLERANCE, _STEPS = 1e-3, 300


def smoothed(mesh: TriangleMesh, strength: float = 1.0) -> TriangleMesh:
    """Smooth a mesh by least squares of its Laplacian, weighted by its noise and less at creases.

    The vertices x minimise the sum of |x - x_0|^2 and, with a weight, of the squared bending |x - mean of the
    neighbours|^2. The weight is in proportion to ``strength`` and to the variance of the bending of x_0, most of which
    is noise; it is lowered where x still bends by as much as that noise, as at the crest of a fold (reweighted least
    squares). Vertices of the border do not bend.
    """
    start, inner = mesh.vertices.astype(np.float64), ~mesh.on_border
    bends = bending(mesh, inner)
    edges = mesh.vertices[mesh.triangles] - mesh.vertices[np.roll(mesh.triangles, 1, axis=1)]
    noise = np.median(np.abs(_along_normals(mesh, bends))[inner]) / 0.6745 if inner.any() else 0.0
    if not noise * strength > 0.0:
        return mesh
    weight = strength * _WEIGHT * (noise / np.median(np.linalg.norm(edges, axis=-1))) ** 2
    weights, found = np.full(len(start), weight), start
    for _ in range(_PASSES):
        system = (eye_array(len(start)) + bends.T @ (diags_array(weights) @ bends)).tocsr()
        scale = diags_array(1.0 / system.diagonal())
        solved = [
            cg(system, axis, x0=last, rtol=_TOLERANCE, maxiter=_STEPS, M=scale)[0]
            for axis, last in zip(start.T, found.T, strict=True)
        ]
        found = np.stack(solved, axis=1)
        mesh = replace(mesh, vertices=found.astype(np.float32))
        weights = weight / (1.0 + (_along_normals(mesh, bends) / noise) ** 2)
    return mesh


def _along_normals(mesh: TriangleMesh, bends: csr_array) -> Float[np.ndarray, "V"]:
    """The part of the bending that is along the normals of the vertices, scene units. [V]"""
    normals = mesh.to_open3d().compute_vertex_normals().vertex.normals.numpy()
    return np.asarray(((bends @ mesh.vertices.astype(np.float64)) * normals).sum(axis=1))


def bending(mesh: TriangleMesh, bent: Bool[np.ndarray, "V"]) -> csr_array:
    """Uniform Laplacian of a mesh, each vertex minus the mean of its neighbours; rows not ``bent`` are 0. [V, V]"""
    count, corners = len(mesh.vertices), mesh.triangles
    pairs = np.concatenate([corners[:, pair] for pair in permutations(range(3), 2)])
    neighbours = csr_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    neighbours.data[:] = 1.0  # an edge of two triangles counts once
    means = diags_array(1.0 / np.maximum(neighbours.sum(axis=1), 1.0)) @ neighbours
    return (diags_array(bent.astype(np.float64)) @ (eye_array(count) - means)).tocsr()
