"""Connected regions of triangles."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from coliags_plugin.geometry.meshes.mesh import TriangleMesh


def neighbours(mesh: TriangleMesh) -> Int[np.ndarray, "E 2"]:
    """Pairs of triangles with a common edge; an edge of more than two joins them in a chain. [E, 2]"""
    corners = mesh.triangles.astype(np.int64)
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    owners = np.tile(np.arange(len(corners)), 3)
    keys = edges[:, 0] * len(mesh.vertices) + edges[:, 1]
    order = np.argsort(keys, kind="stable")
    keys, owners = keys[order], owners[order]
    same = np.flatnonzero(keys[1:] == keys[:-1])
    return np.stack([owners[same], owners[same + 1]], axis=1)


def near_pairs(
    centers: Float[np.ndarray, "F 3"], one: Bool[np.ndarray, "F"], other: Bool[np.ndarray, "F"], within: float
) -> Int[np.ndarray, "E 2"]:
    """Each triangle of one set and the nearest of the other, where their centroids are within a distance, mm. [E, 2]"""
    first, second = np.flatnonzero(one), np.flatnonzero(other)
    if not len(first) or not len(second):
        return np.zeros((0, 2), np.int64)
    distance, nearest = cKDTree(centers[second]).query(centers[first], distance_upper_bound=within)
    near = np.isfinite(distance)
    return np.stack([first[near], second[np.asarray(nearest)[near]]], axis=1)


def connected(chosen: Bool[np.ndarray, "F"], pairs: Int[np.ndarray, "E 2"]) -> Int[np.ndarray, "F"]:
    """Number of the connected region of each chosen triangle, from 0; -1 for the others. [F]"""
    both = chosen[pairs[:, 0]] & chosen[pairs[:, 1]]
    first, second = pairs[both].T
    graph = coo_matrix((np.ones(len(first), np.int8), (first, second)), shape=(len(chosen), len(chosen)))
    _, labels = connected_components(graph, directed=False)
    numbers = np.full(len(chosen), -1, np.int64)
    _, numbers[chosen] = np.unique(labels[chosen], return_inverse=True)
    return numbers


def large_regions(
    chosen: Bool[np.ndarray, "F"], pairs: Int[np.ndarray, "E 2"], areas: Float[np.ndarray, "F"], smallest: float
) -> list[Int[np.ndarray, "K"]]:
    """Connected regions above an area, mm^2, the largest first, each as the indices of its triangles."""
    numbers = connected(chosen, pairs)
    inside = np.flatnonzero(numbers >= 0)
    if not len(inside):
        return []
    area = np.bincount(numbers[inside], areas[inside])
    kept = np.flatnonzero(area > smallest)
    kept = kept[np.argsort(-area[kept], kind="stable")]
    return [np.flatnonzero(numbers == number) for number in kept]
