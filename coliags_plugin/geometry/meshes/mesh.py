"""Triangle meshes as plain arrays, and rays cast at them by open3d."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from coliags_plugin.core.libraries import import_open3d

#: Where rays begin: each of its own, or all of one.
Origins: TypeAlias = Float[np.ndarray, "N 3"] | Float[np.ndarray, "3"]


class RayScene:
    """An ``open3d.t.geometry.TriangleMesh`` indexed for rays and distances."""

    def __init__(self, mesh: Any) -> None:
        self._open3d = import_open3d("casts rays at meshes")
        self._scene = self._open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(mesh)

    def cast(
        self, origins: Origins, directions: Float[np.ndarray, "N 3"]
    ) -> tuple[Int[np.ndarray, "N"], Float32[np.ndarray, "N"]]:
        """Triangle that each ray hits first, -1 without a hit, and how many lengths of the ray it is away. [N], [N]"""
        triangle, parameter, _ = self.first_hits(origins, directions)
        return triangle, parameter

    def first_hits(
        self, origins: Origins, directions: Float[np.ndarray, "N 3"]
    ) -> tuple[Int[np.ndarray, "N"], Float32[np.ndarray, "N"], Float32[np.ndarray, "N 2"]]:
        """Hits as of :meth:`cast`, and the weights of the second and third corner there. [N], [N], [N, 2]"""
        answer = self._scene.cast_rays(self._rays(origins, directions))
        parameter = answer["t_hit"].numpy()
        triangle = answer["primitive_ids"].numpy().astype(np.int64)  # unsigned; its largest value without a hit
        return np.where(np.isfinite(parameter), triangle, -1), parameter, answer["primitive_uvs"].numpy()

    def blocked(self, origins: Origins, directions: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, "N"]:
        """True where the mesh occludes a segment; the last thousandth of a segment is ignored. [N]"""
        rays = self._rays(origins, directions)
        return np.asarray(self._scene.test_occlusions(rays, tnear=0.0, tfar=0.999).numpy())

    def nearest(self, points: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, "N"], Int[np.ndarray, "N"]]:
        """Distance to the nearest point of any triangle, scene units, and that triangle. [N], [N]"""
        points = np.ascontiguousarray(points, np.float32)
        closest = self._scene.compute_closest_points(self._open3d.core.Tensor(points))
        distances = np.linalg.norm(closest["points"].numpy().astype(np.float64) - points, axis=1)
        return distances, closest["primitive_ids"].numpy().astype(np.int64)

    def distance(self, points: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N"]:
        """Distance to the nearest point of any triangle in float32, faster than :meth:`nearest`. [N]"""
        points = np.ascontiguousarray(points, np.float32)
        return np.asarray(self._scene.compute_distance(self._open3d.core.Tensor(points)).numpy())

    def _rays(self, origins: Origins, directions: Float[np.ndarray, "N 3"]) -> Any:
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origins, directions
        return self._open3d.core.Tensor(rays)


@dataclass(frozen=True, eq=False)
class Texture:
    """Texture image of a mesh, and the texture coordinates of its triangles' corners."""

    image: UInt8[np.ndarray, "H W 3"]
    corners: Float[np.ndarray, "F 3 2"]  # of the triangles, from 0 to 1: to the right, and upwards from the last row

    @cached_property
    def coordinates(self) -> tuple[Float[np.ndarray, "P 2"], Int[np.ndarray, "F 3"]]:
        """The different texture coordinates, and for each triangle the indices of those of its corners."""
        places, of_corner = np.unique(self.corners.reshape(-1, 2), axis=0, return_inverse=True)
        return places, of_corner.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A triangle mesh in the world frame, scene units (mm for C3VD)."""

    vertices: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "F 3"]  # vertices, counter-clockwise seen from the side that the camera was on
    colors: UInt8[np.ndarray, "V 3"] | None = None  # RGB of the vertices

    def __len__(self) -> int:
        return len(self.triangles)

    @cached_property
    def _crosses(self) -> Float[np.ndarray, "F 3"]:
        """Cross products of two edges: normal times twice the area. [F, 3]"""
        first, second, third = (self.vertices[self.triangles[:, corner]].astype(np.float64) for corner in range(3))
        return np.cross(second - first, third - first)

    @cached_property
    def areas(self) -> Float[np.ndarray, "F"]:
        """Area of each triangle. [F]"""
        return 0.5 * np.linalg.norm(self._crosses, axis=1)

    @cached_property
    def normals(self) -> Float[np.ndarray, "F 3"]:
        """Unit normal of each triangle; zero where it has no area. [F, 3]"""
        return self._crosses / np.maximum(2.0 * self.areas, np.finfo(np.float64).tiny)[:, None]

    @cached_property
    def centers(self) -> Float[np.ndarray, "F 3"]:
        """Centroid of each triangle. [F, 3]"""
        return self.vertices[self.triangles].mean(axis=1, dtype=np.float64)

    @cached_property
    def border(self) -> Int[np.ndarray, "E 2"]:
        """Boundary edges, those of one triangle only, as its directed pairs of vertices. [E, 2]"""
        edges, count = np.concatenate([self.triangles[:, [a, (a + 1) % 3]] for a in range(3)]), len(self.vertices)
        return edges[~np.isin(edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0])]

    @cached_property
    def on_border(self) -> Bool[np.ndarray, "V"]:
        """True for vertices on the border. [V]"""
        on_border = np.zeros(len(self.vertices), bool)
        on_border[self.border] = True
        return on_border

    @cached_property
    def rays(self) -> RayScene:
        """Casts rays at the mesh and measures distances to it; made once."""
        return RayScene(self.to_open3d())

    def part(self, chosen: Bool[np.ndarray, "F"]) -> TriangleMesh:
        """The mesh of some triangles, without the vertices that no longer belong to any."""
        used, corners = np.unique(self.triangles[chosen], return_inverse=True)
        colors = None if self.colors is None else self.colors[used]
        return TriangleMesh(self.vertices[used], corners.reshape(-1, 3), colors)

    def without_small_parts(self, share: float) -> TriangleMesh:
        """The mesh without parts, connected by vertices, whose area is below a share of that of the largest part."""
        if not len(self):
            return self
        first, second, third = self.triangles.T
        rows, columns = np.concatenate([first, second]), np.concatenate([second, third])
        count = len(self.vertices)
        graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(count, count))
        parts = connected_components(graph, directed=False)[1][first]
        areas = np.bincount(parts, self.areas)
        return self.part(areas[parts] >= share * areas.max())

    def to_open3d(self) -> Any:
        """The mesh as an ``open3d.t.geometry.TriangleMesh``, for ray casting and measures."""
        open3d = import_open3d("casts rays at meshes")
        converted = open3d.t.geometry.TriangleMesh(
            open3d.core.Tensor(np.ascontiguousarray(self.vertices, np.float32)),
            open3d.core.Tensor(np.ascontiguousarray(self.triangles, np.int64)),
        )
        if self.colors is not None:
            converted.vertex.colors = open3d.core.Tensor(np.ascontiguousarray(self.colors))
        return converted
