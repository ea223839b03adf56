"""Truncated signed distance field of depth images, in sparse blocks of voxels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.open3d_library import import_open3d
from coliags_plugin.geometry.meshes.mesh import TriangleMesh

#: Edge of a block, voxels.
_BLOCK = 8
#: A block of distance, weight and colour, all float32, is 10 kB: at most 3 GB.
_MAX_BLOCKS = 300_000
#: Blocks are counted from minus this along each axis, so that a key of 60 bits holds all three.
_HALF_RANGE = 2**19
_KEY = np.array([4 * _HALF_RANGE**2, 2 * _HALF_RANGE, 1])


class Volume:
    """Average of the signed distances to the surfaces of depth images, near those surfaces (open3d's VoxelBlockGrid).

    Voxels, of an edge in scene units, are updated up to ``truncation`` voxels from a surface.
    """

    def __init__(self, voxel_size: float, truncation: float) -> None:
        self._open3d = import_open3d("fuses depth")
        core = self._open3d.core
        self.voxel_size, self.truncation = voxel_size, truncation
        self._grid = self._open3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(core.float32,) * 3,
            attr_channels=((1,), (1,), (3,)),
            voxel_size=voxel_size,
            block_resolution=_BLOCK,
            block_count=10_000,
            device=core.Device("CPU:0"),
        )

    def add(self, depth: Float[np.ndarray, "H W"], colors: UInt8[np.ndarray, "H W 3"], camera: Camera) -> None:
        """Add a view: z-depth in scene units, 0 where unknown, and RGB; refuses voxels too small for the memory."""
        if not (depth > 0).any():
            return
        image, tensor = self._open3d.t.geometry.Image, self._open3d.core.Tensor
        depth_image = image(tensor(np.ascontiguousarray(depth, np.float32)))
        # open3d has pixel centres at integers.
        matrix = camera.intrinsics_matrix.cpu().double().numpy().copy()
        matrix[:2, 2] -= 0.5
        world_to_camera = camera.to("cpu", torch.float64).world_to_camera.numpy()
        pose = tensor(np.ascontiguousarray(matrix)), tensor(np.ascontiguousarray(world_to_camera))
        reach = float(depth.max()) * 1.001 + self.voxel_size
        blocks = self._blocks_near(depth, camera)
        if self._grid.hashmap().size() + len(blocks) > _MAX_BLOCKS:
            raise InputError(
                f"voxels of {self.voxel_size:.3g} scene units need more than {_MAX_BLOCKS:,} blocks of {_BLOCK}^3 "
                "voxels",
                "larger voxels",
                f"Try --voxel {2 * self.voxel_size:.2g}",
            )
        color_image = image(tensor(np.ascontiguousarray(colors, np.float32) / np.float32(255.0)))
        # open3d divides depth by 1.0: ours is in scene units already.
        self._grid.integrate(tensor(blocks), depth_image, color_image, pose[0], *pose, 1.0, reach, self.truncation)

    def _blocks_near(self, depth: Float[np.ndarray, "H W"], camera: Camera) -> Int[np.ndarray, "B 3"]:
        """Blocks within the truncation of a pixel's surface point along its ray. [B, 3]

        open3d's own search looks at every fourth pixel of every fourth row only, which misses small blocks.
        """
        row, column = np.nonzero(depth > 0)
        pixels = torch.from_numpy(np.stack([column, row], axis=1))
        rays = camera.to("cpu", torch.float64).rays_at(pixels).numpy()
        center, z = camera.center.cpu().double().numpy(), depth[row, column].astype(np.float64)
        edge, band = _BLOCK * self.voxel_size, self.truncation * self.voxel_size
        found = []
        for shift in np.linspace(-band, band, 2 * math.ceil(2 * self.truncation / _BLOCK) + 1):
            places = np.floor((center + (z + shift)[:, None] * rays) / edge).astype(np.int64) + _HALF_RANGE
            # One number per block, as rows take ten times as long to sort.
            found.append(np.unique(places @ _KEY))
        keys = np.unique(np.concatenate(found))
        return np.asarray(np.stack(np.unravel_index(keys, (2 * _HALF_RANGE,) * 3), axis=1) - _HALF_RANGE, np.int32)

    def mesh(self, min_views: int) -> TriangleMesh:
        """The zero level of the distance, where at least so many views were averaged.

        Triangles are counter-clockwise seen from the side of the cameras; vertices between neighbouring voxels are
        shared.
        """
        made: Any = None
        if self._grid.hashmap().size():
            made = self._grid.extract_triangle_mesh(weight_threshold=float(min_views) - 0.5)
        if made is None or "indices" not in made.triangle or len(made.triangle.indices) == 0:
            return TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))
        vertices, triangles = made.vertex.positions.numpy(), made.triangle.indices.numpy().astype(np.int64)
        colors = np.rint(made.vertex.colors.numpy() * 255.0).clip(0, 255).astype(np.uint8)
        mesh = TriangleMesh(vertices, triangles, colors)
        return mesh.part(mesh.areas > 0.0)
