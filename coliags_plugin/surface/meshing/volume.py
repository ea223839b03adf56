"""The surface of depth images: a truncated signed distance field in blocks of voxels, holes closed, noise smoothed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import cg, spsolve
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.libraries import import_open3d
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.surface.meshing.views import DepthView, incidence_cosines, looked_at

#: Edge of a block, voxels, and its voxels.
_BLOCK = 8
_VOXELS = _BLOCK**3
#: Places of the voxels in a block, x changing first. [512, 3]
_PLACES = np.stack(np.unravel_index(np.arange(_VOXELS), (_BLOCK,) * 3)[::-1], axis=1).astype(np.float64)
#: A block of ten numbers a voxel, float32, five of them here and five in open3d, is 20 kB: at most 6.1 GB.
_MAX_BLOCKS = 300_000
#: Blocks whose voxels are projected at once.
_AT_ONCE = 2_000
#: Blocks are counted from minus this along each axis, so that a key of 60 bits holds all three.
_HALF_RANGE = 2**19
_KEY = np.array([4 * _HALF_RANGE**2, 2 * _HALF_RANGE, 1])


class Volume:
    """Weighted mean of the signed distances to the surfaces of depth images, in blocks of voxels near those surfaces.

    A voxel in front of the surface of a view is at that distance, at most the truncation; one farther behind it than
    the truncation has no part in the view. So every view clears the space before what it sees: surface there that only
    worse views claim vanishes. Distances are along the normal of the surface at the pixel.

    Args:
        views: Weighted by their quality to the power of four, so that of unequal views the better one counts.
        voxel_size: Edge of a voxel, scene units.
        truncation: Largest distance, in voxels.
    """

    def __init__(self, views: Sequence[DepthView], voxel_size: float, truncation: float) -> None:
        self.voxel_size, self.truncation = voxel_size, truncation
        keys = [self._keys_near(view) for view in views if (view.depth > 0).any()]
        blocks = np.unique(np.concatenate(keys)) if keys else np.zeros(0, np.int64)
        if len(blocks) > _MAX_BLOCKS:
            raise InputError(
                f"voxels of {voxel_size:.3g} scene units need more than {_MAX_BLOCKS:,} blocks of {_BLOCK}^3 voxels",
                "larger voxels",
                f"Try `voxel={2 * voxel_size:.2g}`",
            )
        self._blocks = np.stack(np.unravel_index(blocks, (2 * _HALF_RANGE,) * 3), axis=1) - _HALF_RANGE
        size = len(blocks) * _VOXELS
        self._distance, self._square, self._weight = torch.zeros(size), torch.zeros(size), torch.zeros(size)
        self._support, self._seen = torch.zeros(size), torch.zeros(size)
        for view in views:
            self._add(view)

    def _keys_near(self, view: DepthView) -> Int[np.ndarray, "B"]:
        """Keys of the blocks within the truncation of a pixel's surface point along its ray. [B]"""
        row, column = torch.nonzero(view.depth > 0, as_tuple=True)
        rays = view.camera.rays_at(torch.stack([column, row], dim=1)).numpy()
        center, z = view.camera.center.numpy(), view.depth[row, column].double().numpy()
        edge, band = _BLOCK * self.voxel_size, self.truncation * self.voxel_size
        keys = []
        for shift in np.linspace(-band, band, 2 * math.ceil(2 * self.truncation / _BLOCK) + 1):
            places = np.floor((center + (z + shift)[:, None] * rays) / edge).astype(np.int64) + _HALF_RANGE
            # One number per block, as rows take ten times as long to sort.
            keys.append(np.unique(places @ _KEY))
        return np.unique(np.concatenate(keys))

    def _add(self, view: DepthView) -> None:
        camera, edge, band = view.camera, _BLOCK * self.voxel_size, self.truncation * self.voxel_size
        # From a step in z-depth to the distance along the normal.
        slant = incidence_cosines(view.depth.double(), camera).nan_to_num() * camera.rays().norm(dim=-1)
        depth, quality, slant = view.depth.flatten(), view.quality.flatten(), slant.float().flatten()
        turn = camera.camera_to_world[:3, :3]
        corners = (torch.from_numpy(self._blocks * edge) - camera.center) @ turn
        steps = (torch.from_numpy(_PLACES * self.voxel_size) @ turn).float()
        near = (view.depth.max() + 2.0 * edge > corners[:, 2]) & _in_frustum(corners + steps.mean(0), camera, edge)
        for part in torch.split(torch.nonzero(near)[:, 0], _AT_ONCE):
            x, y, z = (corners[part].float()[:, None] + steps).reshape(-1, 3).unbind(1)
            column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            voxels = (part[:, None] * _VOXELS + torch.arange(_VOXELS)).flatten()[inside]
            pixels = row[inside].long() * camera.width + column[inside].long()
            distance = ((depth[pixels] - z[inside]) * slant[pixels] / band).clamp(max=1.0)
            good = (quality[pixels] > 0) & (distance > -1.0)
            squared = torch.where(good, quality[pixels] ** 2, 0.0)
            self._distance[voxels] += squared**2 * distance
            self._square[voxels] += squared**2 * distance**2
            self._weight[voxels] += squared**2
            shown = good & (distance < 1.0)
            self._support[voxels] += squared * shown
            self._seen[voxels] += shown

    def mesh(self, min_views: int, min_support: float, max_conflict: float = math.inf) -> TriangleMesh:
        """The zero level of the distance, where enough views show it and agree on it.

        At least so many views show it, and the sum of their squared qualities, the support, is at least so much. The
        variance of the distance between the views, in truncations squared, over the support is at most the conflict.
        Triangles are counter-clockwise seen from the side of the cameras; vertices between neighbouring voxels are
        shared. The mesh of a field is always the same, to the bit.
        """
        if not len(self._blocks):
            return TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))
        # open3d takes voxels of no weight for known where the threshold is 0.
        least = max(min_support, float(np.finfo(np.float32).tiny))
        weight = self._weight.clamp(min=torch.finfo().tiny)
        variance = (self._square / weight - (self._distance / weight) ** 2).clamp(min=0.0)
        agreed = (self._seen >= min_views) & (variance <= max_conflict * self._support)
        surface = self._grid(torch.where(agreed, self._support, 0.0)).extract_triangle_mesh(least)
        mesh = _in_order(surface.vertex.positions.numpy(), surface.triangle.indices.numpy().astype(np.int64))
        return mesh.part(mesh.areas > 0.0)

    def _grid(self, weight: Float[Tensor, "N"]) -> Any:
        """The field as an ``open3d.t.geometry.VoxelBlockGrid``."""
        open3d = import_open3d("fuses depth")
        grid = open3d.t.geometry.VoxelBlockGrid(
            # Without colours, open3d fails where there is no surface.
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(open3d.core.float32,) * 3,
            attr_channels=((1,), (1,), (3,)),
            voxel_size=self.voxel_size,
            block_resolution=_BLOCK,
            block_count=len(self._blocks),
            device=open3d.core.Device("CPU:0"),
        )
        keys = open3d.core.Tensor(self._blocks.astype(np.int32))
        grid.hashmap().activate(keys)
        places = grid.hashmap().find(keys)[0].numpy()
        mean = self._distance / self._weight.clamp(min=torch.finfo().tiny)
        for name, values in (("tsdf", mean), ("weight", weight)):
            grid.attribute(name).numpy()[places] = values.view(-1, _BLOCK, _BLOCK, _BLOCK, 1).numpy()
        return grid


def _in_order(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> TriangleMesh:
    """A mesh whose order does not depend on the threads that found its parts: sorted, equal vertices made one."""
    vertices, places = np.unique(vertices, axis=0, return_inverse=True)
    triangles = places.reshape(-1)[triangles]
    turned = (triangles.argmin(axis=1)[:, None] + np.arange(3)) % 3
    triangles = np.take_along_axis(triangles, turned, axis=1)
    return TriangleMesh(vertices, triangles[np.lexsort(triangles.T[::-1])])


def _in_frustum(centers: Float[Tensor, "B 3"], camera: Camera, edge: float) -> Bool[Tensor, "B"]:
    """Mask of cubes, given in the camera's axes, that may be inside its image. [B]"""
    right, below = camera.width - camera.cx, camera.height - camera.cy
    sides = [[camera.fx, 0, camera.cx], [-camera.fx, 0, right], [0, camera.fy, camera.cy], [0, -camera.fy, below]]
    normals = torch.nn.functional.normalize(torch.tensor(sides, dtype=centers.dtype), dim=1)
    radius = 0.5 * 3**0.5 * edge
    return (centers @ normals.T > -radius).all(dim=1) & (centers[:, 2] > -radius)


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
    """Close the holes up to a perimeter, scene units; returns the mesh, without colours, and their number.

    A hole is closed by rings of triangles about its centre, as wide as its edges are long, that go on smoothly from the
    triangles around it. It stays open unless, counted over the new vertices, more views see wall there, from its front,
    than see through it: where no view looked, and at ends, there is no surface.
    """
    rims = ((hole, mesh.vertices[hole]) for hole in loops(mesh))
    holes = [hole for hole, rim in rims if np.linalg.norm(rim - np.roll(rim, 1, axis=0), axis=1).sum() <= perimeter]
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
