"""Fusion of the rendered depth of a run into a triangle mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import UInt8
from torch import Tensor

from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.held_light import held_light, render_held
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.geometry.meshes.mesh import Texture, TriangleMesh
from coliags_plugin.outputs.image_files import eight_bit
from coliags_plugin.surface.meshing.colors import best_colors, best_texture
from coliags_plugin.surface.meshing.mending import close_holes, smoothed
from coliags_plugin.surface.meshing.settings import MeshSettings, voxel_size_of
from coliags_plugin.surface.meshing.views import DepthView, rendered_depth
from coliags_plugin.surface.meshing.volume import Volume


@dataclass(frozen=True, eq=False)
class FusedRun:
    """Mesh fused from the depth of a run, the number of holes closed in it, and its texture."""

    mesh: TriangleMesh
    holes: int  # that were closed
    texture: Texture | None  # of the mesh, where one was asked for


def fuse_run(trained: TrainedRun, settings: MeshSettings | None = None) -> FusedRun:
    """The surface of a run: a truncated signed distance field of the depth rendered from all training poses.

    The mesh is in the world of the poses, scene units, coloured by the best views of each place, its triangles
    counter-clockwise seen from where the cameras were.
    """
    settings, frames = settings or MeshSettings(), trained.scene.train
    trained.model.check_outputs(("rgb", "alpha", f"depth_{settings.depth}"), f"meshing with {settings.depth} depth")
    if len(frames) < 2:
        raise InputError(f"scene '{trained.scene.name}' has {len(frames)} training view", "two views or more to fuse")
    size, views = voxel_size_of(settings, trained.scene), list[DepthView]()
    with ProgressReport("render depth", len(frames)) as progress:
        for view in rendered_depth(trained, settings):
            views.append(view)
            progress.update(len(views))
    volume, least = Volume(views, size, settings.truncation), min(settings.min_views, len(frames))
    mesh = volume.mesh(least, settings.min_support, settings.max_conflict)
    if not len(mesh):
        raise InputError(
            f"no surface in the depth of {len(frames)} views in voxels of {size:.3g} {trained.scene.length_unit}",
            f"opaque surface that {settings.min_views} views agree on",
            "Look at `coliags render RUN`; perhaps train longer, lower min_views, min_support or min_alpha, or raise "
            "max_conflict",
        )
    mesh, holes = close_holes(mesh.without_small_parts(settings.min_part), settings.max_hole * size, views)
    mesh = smoothed(mesh, settings.smoothing)
    image_of = images_of(trained, settings)
    texture = best_texture(mesh, size / settings.texture, views, image_of) if settings.texture else None
    return FusedRun(replace(mesh, colors=best_colors(mesh.vertices, views, image_of)), holes, texture)


def images_of(trained: TrainedRun, settings: MeshSettings) -> Callable[[DepthView], UInt8[Tensor, "H W 3"]]:
    """What gives the image to colour by of a view: the frame as recorded, or rendered in flattened light."""
    if settings.color == "plain":
        return lambda view: view.frame.image.cpu()
    light = held_light("flattened", trained.model, [frame.camera for frame in trained.scene.train])

    @torch.no_grad()
    def flattened(view: DepthView) -> Tensor:
        camera = view.camera.to(trained.device, torch.float32)
        return eight_bit(render_held(trained.model, camera, light, ("rgb",)).rgb).cpu()

    return flattened
