"""Fusion of the rendered depth of a run into a triangle mesh, by a truncated signed distance field in sparse blocks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.open3d_library import import_open3d
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.held_light import held_light, render_held
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.rendering import render_view
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.outputs.image_files import eight_bit
from coliags_plugin.surface.meshing.settings import MeshSettings, max_depth_of, voxel_size_of

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


def fuse_run(trained: TrainedRun, settings: MeshSettings | None = None) -> TriangleMesh:
    """The surface of a run: a truncated signed distance field of the depth rendered from all training poses.

    The mesh is in the world of the poses, scene units, coloured by the rendered views, its triangles counter-clockwise
    seen from where the cameras were.
    """
    settings = settings or MeshSettings()
    depth = f"depth_{settings.depth}"
    wants = ("rgb", "alpha", depth)
    trained.model.check_outputs(wants, f"meshing with {settings.depth} depth")
    frames = trained.scene.train
    if len(frames) < 2:
        raise InputError(f"scene '{trained.scene.name}' has {len(frames)} training view", "two views or more to fuse")
    size, reach = voxel_size_of(settings, trained.scene), max_depth_of(settings, trained.scene)
    volume = Volume(size, settings.truncation)
    light = None
    if settings.color == "flattened":
        light = held_light("flattened", trained.model, [frame.camera for frame in frames])
    with ProgressReport("fuse depth", len(frames)) as progress:
        for count, frame in enumerate(frames, start=1):
            output = render_view(trained, frame, wants)
            camera = frame.camera if output.camera is None else output.camera
            known = _usable(output[depth], output.alpha, frame, camera, settings, reach)
            colors = output.rgb
            if light is not None:
                with torch.no_grad():
                    colors = render_held(trained.model, camera.to(trained.device, torch.float32), light, ("rgb",)).rgb
            volume.add(known, eight_bit(colors).cpu().numpy(), camera)
            progress.update(count)
    mesh = volume.mesh(min(settings.min_views, len(frames)))
    if not len(mesh):
        raise InputError(
            f"no surface in the depth of {len(frames)} views in voxels of {size:.3g} {trained.scene.length_unit}",
            f"opaque surface that {settings.min_views} views agree on",
            "Look at `coliags render RUN`; perhaps train longer, or lower min_views or min_alpha",
        )
    return mesh.without_small_parts(settings.min_part)


def _usable(
    depth: Tensor, alpha: Tensor, frame: Frame, camera: Camera, settings: MeshSettings, max_depth: float
) -> Float[np.ndarray, "H W"]:
    """Depth to fuse, 0 elsewhere: opaque, not ignored, within the depth range and not seen too obliquely. [H, W]"""
    depth, camera = depth.detach().cpu().double(), camera.to("cpu", torch.float64)
    good = (alpha.detach().cpu() >= settings.min_alpha) & frame.valid & (depth > 0) & (depth <= max_depth)
    if frame.depth_at_least is not None:
        good &= ~frame.depth_at_least.cpu().isfinite()
    good &= incidence_cosines(depth, camera) >= np.cos(np.radians(settings.max_incidence))
    return torch.where(good, depth, 0.0).float().numpy()


def incidence_cosines(depth: Float[Tensor, "H W"], camera: Camera) -> Float[Tensor, "H W"]:
    """Cosine of the angle between ray and normal of the surface that a depth map describes. [H, W]

    The normal is that of the point and those of its two neighbours, of left or right and above or below, that are
    nearer in depth, so that the last pixel before a jump counts as the surface that it belongs to, and one in the midst
    of the jump as a very oblique one. NaN where no neighbours have depth.
    """
    points = camera.unproject(depth)
    across, down = (_smaller_step(points, depth, axis) for axis in (1, 0))
    normals, rays = torch.linalg.cross(across, down), camera.rays()
    return (normals * rays).sum(-1).abs() / (normals.norm(dim=-1) * rays.norm(dim=-1))


def _smaller_step(points: Float[Tensor, "H W 3"], depth: Float[Tensor, "H W"], axis: int) -> Float[Tensor, "H W 3"]:
    """From each point to the next along an axis, or from the last one to it: whichever depths differ less. [H, W, 3]"""
    steps, jumps = torch.diff(points, dim=axis), torch.diff(depth, dim=axis).abs()
    jumps = torch.where(jumps.isfinite(), jumps, torch.inf)
    nothing = torch.full_like(points.narrow(axis, 0, 1), torch.nan)
    endless = torch.full_like(depth.narrow(axis, 0, 1), torch.inf)
    ahead, behind = torch.cat([steps, nothing], axis), torch.cat([nothing, steps], axis)
    nearer = torch.cat([jumps, endless], axis) <= torch.cat([endless, jumps], axis)
    return torch.where(nearer[..., None], ahead, behind)
