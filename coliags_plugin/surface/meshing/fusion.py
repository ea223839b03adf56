"""Fusion of the rendered depth of a run into a triangle mesh."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.held_light import held_light, render_held
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.rendering import render_view
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.outputs.image_files import eight_bit
from coliags_plugin.surface.meshing.settings import MeshSettings, max_depth_of, voxel_size_of
from coliags_plugin.surface.meshing.volume import Volume


def fuse_run(trained: TrainedRun, settings: MeshSettings | None = None) -> TriangleMesh:
    """The surface of a run: a truncated signed distance field of the depth rendered from all training poses.

    The mesh is in the world of the poses, scene units, coloured by the rendered views, its triangles counter-clockwise
    seen from where the cameras were.

    Raises:
        InputError: The method renders no such depth, or no such colours; there are fewer than two training views, the
            voxels are too small for the memory, or no surface is found.
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
