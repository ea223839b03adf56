"""Fusion of the rendered depth of a run into a triangle mesh."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.rendering import render_view
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.meshes.cleaning import without_small_parts
from coliags_plugin.meshes.mesh import TriangleMesh
from coliags_plugin.meshing.settings import MeshSettings, max_depth_of, voxel_size_of
from coliags_plugin.meshing.volume import Volume


def fuse_run(trained: TrainedRun, settings: MeshSettings | None = None) -> TriangleMesh:
    """The surface of a run: a truncated signed distance field of the depth rendered from all training poses.

    Args:
        trained: The run.
        settings: Options; None: the defaults.

    Returns:
        Mesh in the world of the poses, scene units, coloured by the rendered views. Triangles are counter-clockwise
        seen from where the cameras were.

    Raises:
        InputError: The method renders no such depth, there are fewer than two training views, the voxels are too small
            for the memory, or no surface is found.
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
    with ProgressReport("fuse depth", len(frames)) as progress:
        for count, frame in enumerate(frames, start=1):
            output = render_view(trained, frame, wants)
            camera = frame.camera if output.camera is None else output.camera
            known = _usable(output[depth], output.alpha, frame, camera, settings, reach)
            volume.add(known, _colors(output.rgb), camera)
            progress.update(count)
    mesh = volume.mesh(min(settings.min_views, len(frames)))
    if not len(mesh):
        raise InputError(
            f"no surface in the depth of {len(frames)} views in voxels of {size:.3g} {trained.scene.length_unit}",
            f"opaque surface that {settings.min_views} views agree on",
            "Look at `coliags render RUN`; perhaps train longer, or lower min_views or min_alpha",
        )
    return without_small_parts(mesh, settings.min_part)


def _usable(
    depth: Tensor, alpha: Tensor, frame: Frame, camera: Camera, settings: MeshSettings, max_depth: float
) -> Float[np.ndarray, "H W"]:
    """Depth to fuse, 0 elsewhere: opaque, not ignored, not too far and not seen too obliquely. [H, W]"""
    depth, camera = depth.detach().cpu().double(), camera.to("cpu", torch.float64)
    good = (alpha.detach().cpu() >= settings.min_alpha) & frame.valid & (depth > 0) & (depth <= max_depth)
    good &= incidence_cosines(depth, camera) >= np.cos(np.radians(settings.max_incidence))
    return torch.where(good, depth, 0.0).float().numpy()


def incidence_cosines(depth: Float[Tensor, "H W"], camera: Camera) -> Float[Tensor, "H W"]:
    """Cosine of the angle between ray and normal of the surface that a depth map describes; NaN at the border.

    The normal is that of the points left, right, above and below, so that a jump of the depth counts as a very oblique
    surface, on both of its sides. [H, W]
    """
    points = camera.unproject(depth)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    normals = torch.linalg.cross(across, down)
    rays = camera.rays()[1:-1, 1:-1]
    cosines = torch.full_like(depth, torch.nan)
    lengths = normals.norm(dim=-1) * rays.norm(dim=-1)
    cosines[1:-1, 1:-1] = (normals * rays).sum(-1).abs() / lengths
    return cosines


def _colors(rgb: Tensor) -> UInt8[np.ndarray, "H W 3"]:
    return np.asarray((rgb.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy())
