"""Mending of meshes: Laplacian smoothing as strong as they are noisy, and holes closed where views show surface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import cg, spsolve

from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.surface.meshing.views import DepthView, looked_at

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
    weights, places = np.full(len(start), weight), start
    for _ in range(_PASSES):
        system = (eye_array(len(start)) + bends.T @ (diags_array(weights) @ bends)).tocsr()
        scale = diags_array(1.0 / system.diagonal())
        solved = [
            cg(system, axis, x0=last, rtol=_TOLERANCE, maxiter=_STEPS, M=scale)[0]
            for axis, last in zip(start.T, places.T, strict=True)
        ]
        places = np.stack(solved, axis=1)
        mesh = replace(mesh, vertices=places.astype(np.float32))
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


def close_holes(mesh: TriangleMesh, perimeter: float, views: Sequence[DepthView]) -> tuple[TriangleMesh, int]:
    """The mesh, without colours, with its holes up to a perimeter, scene units, closed; and how many those were.

    A hole is closed by rings of triangles about its centre, as wide as its edges are long, that go on smoothly from the
    triangles around it. It stays open unless, counted over the new vertices, more views see wall there, from its front,
    than see through it: where no view looked, and at ends, there is no surface.
    """
    holes = [hole for hole in loops(mesh) if _length(mesh.vertices[hole]) <= perimeter]
    if not holes:
        return mesh, 0
    vertices, triangles, count = [mesh.vertices], [mesh.triangles], len(mesh.vertices)
    for hole in holes:
        rings = max(1, round(len(hole) / (2.0 * np.pi)))
        edge, inward = mesh.vertices[hole], np.arange(1, rings)[:, None, None] / rings
        added = np.concatenate([*(edge + inward * (edge.mean(axis=0) - edge)), edge.mean(axis=0, keepdims=True)])
        corners = np.concatenate([hole, count + np.arange(len(added))])
        triangles.append(corners[_disk(len(hole), rings)])
        vertices.append(added.astype(np.float32))
        count += len(added)
    closed = _bent_least(TriangleMesh(np.concatenate(vertices), np.concatenate(triangles)), len(mesh.vertices))
    of_vertex = np.repeat(np.arange(len(holes) + 1), [len(part) for part in vertices])
    of_triangle = np.repeat(np.arange(len(holes) + 1), [len(part) for part in triangles])
    agreed = np.bincount(of_vertex, _sightings(closed, views)) > 0.0
    agreed[0] = True
    return closed.part(agreed[of_triangle]), int(agreed[1:].sum())


def loops(mesh: TriangleMesh) -> Iterator[Int[np.ndarray, "L"]]:
    """The closed loops of the border, each as its vertices in order, none of them twice. [L]"""
    follows: dict[int, list[int]] = {}
    for first, second in mesh.border.tolist():
        follows.setdefault(first, []).append(second)
    while follows:
        path = [next(iter(follows))]
        places = {path[0]: 0}
        while path[-1] in follows:
            ahead = follows[path[-1]]
            following = ahead.pop()
            if not ahead:
                del follows[path[-1]]
            if following not in places:
                places[following] = len(path)
                path.append(following)
                continue
            start = places[following]
            yield np.array(path[start:])
            for vertex in path[start + 1 :]:
                del places[vertex]
            del path[start + 1 :]


def _length(loop: Float[np.ndarray, "L 3"]) -> float:
    """Length of a closed loop of points."""
    return float(np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1).sum())


def _disk(sides: int, rings: int) -> Int[np.ndarray, "F 3"]:
    """Triangles that close a loop: between rings of vertices, the outermost first, and the centre, the last. [F, 3]"""
    here = np.arange(sides)
    there = np.roll(here, -1)
    inner = sides * (rings - 1)
    faces = [np.stack([there + inner, here + inner, np.full(sides, inner + sides)], axis=1)]
    for outer in sides * np.arange(rings - 1):
        faces.append(outer + np.stack([there, here, here + sides], axis=1))
        faces.append(outer + np.stack([there, here + sides, there + sides], axis=1))
    return np.concatenate(faces)


def _bent_least(mesh: TriangleMesh, fixed_count: int) -> TriangleMesh:
    """Fair the vertices after the first ``fixed_count``: minimise their squared Laplacian (:func:`bending`)."""
    new = np.arange(len(mesh.vertices)) >= fixed_count
    bent = np.zeros(len(new), bool)
    bent[mesh.triangles[new[mesh.triangles].any(axis=1)]] = True
    bends, places = bending(mesh, bent), mesh.vertices.astype(np.float64)
    free, fixed = bends[:, fixed_count:], bends[:, :fixed_count] @ places[:fixed_count]
    places[fixed_count:] = spsolve((free.T @ free).tocsc(), -(free.T @ fixed))
    return TriangleMesh(places.astype(np.float32), mesh.triangles)


def _sightings(mesh: TriangleMesh, views: Sequence[DepthView]) -> Float[np.ndarray, "V"]:
    """Number of views that see wall at each vertex, from its front, less those that see through it. [V]"""
    places = torch.from_numpy(mesh.vertices).double()
    normals = torch.from_numpy(mesh.to_open3d().compute_vertex_normals().vertex.normals.numpy()).double()
    total = torch.zeros(len(places))
    for view in views:
        chosen, _, shown, through = looked_at(view, places)
        front = ((view.camera.center - places[chosen]) * normals[chosen]).sum(dim=1) > 0.0
        total[chosen] += (shown & front).float() - through.float()
    return np.asarray(total)
