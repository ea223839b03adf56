"""Depth of a run from its training poses, weighted by pixel, and colours of places from the views that see them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from pydantic import Field as Option
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from torch import Tensor

from coliags_plugin.core.arrays import dilated
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import highlights
from coliags_plugin.core.libraries import import_open3d
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.tensors import bilinear
from coliags_plugin.engine.held_light import held_light, render_held
from coliags_plugin.engine.rendering import render_view
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.geometry.meshes.mesh import Texture, TriangleMesh
from coliags_plugin.reporting.image_files import eight_bit


class MeshSettings(Settings):
    """Options of meshing."""

    # Edge of a voxel in scene units (mm); null: voxel_pixels times the size of a training pixel on the surface.
    voxel_size: float | None = Option(default=None, gt=0)
    # edge of a voxel in pixels of a training view on the surface, where voxel_size is null
    voxel_pixels: float = Option(default=2.0, gt=0)
    truncation: float = Option(default=2.0, ge=1, le=32)  # truncation of the signed distance, in voxels
    depth: Literal["expected", "median"] = "median"  # kind of rendered depth (docs/conventions.md 3)
    # z-depth in scene units beyond which nothing is fused; null: that of the farthest initial point in a training view.
    max_depth: float | None = Option(default=None, gt=0)
    # Colours as recorded, under the lamp of each view; or rendered, at one distance and angle to the lamp everywhere.
    color: Literal["plain", "flattened"] = "plain"
    # OBJ and GLB get a texture of this many texels along the edge of a voxel in place of colours at vertices; 0: none.
    texture: float = Option(default=0.0, ge=0, le=64)
    min_alpha: float = Option(default=0.9, ge=0.5, lt=1)  # pixels with less are not fused
    max_incidence: float = Option(default=80.0, gt=0, le=90)  # degrees; surface seen more obliquely is not fused
    min_views: int = Option(default=3, ge=1)  # views that must agree on a place; fewer where there are fewer
    # Least sum of the squared qualities of the views of a place: 1 for one view, head-on from the median distance.
    min_support: float = Option(default=0.1, ge=0)
    # Most of the variance of the signed distance between the views of a place, in truncations squared, over that sum.
    max_conflict: float = Option(default=0.2, gt=0)
    min_part: float = Option(default=0.01, ge=0, le=1)  # connected parts below this share of the largest are removed
    # Holes up to this perimeter, in voxels, are closed where views see wall.
    max_hole: float = Option(default=20.0, ge=0)
    # Strength of smoothing by as much as the mesh is noisy; 0 leaves it as it was fused.
    smoothing: float = Option(default=1.0, ge=0)


def voxel_size_of(settings: MeshSettings, scene: Scene) -> float:
    """Edge of a voxel, scene units: as given, or by the scene's points."""
    if settings.voxel_size is not None:
        return settings.voxel_size
    if not len(scene.points):
        raise InputError(
            f"scene '{scene.name}' has no points to choose the size of the voxels by", "`voxel=SIZE`, in scene units"
        )
    return settings.voxel_pixels * scene.pixel_footprint


def max_depth_of(settings: MeshSettings, scene: Scene) -> float:
    """z-depth beyond which nothing is fused, scene units; infinite where the scene has no points in view."""
    if settings.max_depth is not None:
        return settings.max_depth
    depths = scene.depths_in_view()
    return float(depths.max()) if len(depths) else float("inf")


#: Largest difference of z-depth between a place and what a view sees there, as a share of the depth.
_SAME = 0.03
#: Share of its weight that a pixel keeps at a highlight, and the pixels about one that belong to it.
_GLINT, _MARGIN = 0.1, 2


@dataclass(frozen=True, eq=False)
class DepthView:
    """Depth to fuse, as a camera sees it.

    Attributes:
        camera: Camera that it was rendered from, on the CPU in float64; with corrected poses not the frame's own.
        depth: z-depth, scene units; 0 where nothing is fused. [H, W]
        quality: Confidence times the cosine of the angle between ray and normal times nearness, which is 1 where a
            pixel is as large on the surface as it is in the median of the scene; 0 where nothing is fused. [H, W]
        image: Function that gives the image to colour by. [H, W, 3]
    """

    camera: Camera
    depth: Float[Tensor, "H W"]
    quality: Float[Tensor, "H W"]
    image: Callable[[], UInt8[Tensor, "H W 3"]]


def looked_at(
    view: DepthView, places: Float[Tensor, "N 3"]
) -> tuple[Int[Tensor, "M"], Float[Tensor, "M 2"], Bool[Tensor, "M"], Bool[Tensor, "M"]]:
    """Places inside the image of a view, their pixels, whether it sees wall there, and whether it sees through them."""
    pixels, z = view.camera.project(places)
    inside = torch.nonzero(view.camera.is_inside(pixels, z))[:, 0]
    column, row = pixels[inside].long().unbind(1)
    behind = view.depth[row, column] / z[inside] - 1.0  # -1 where nothing is fused
    return inside, pixels[inside], behind.abs() <= _SAME, behind > _SAME


def rendered_depth(trained: TrainedRun, settings: MeshSettings) -> Iterator[DepthView]:
    """The depth rendered from each training pose, through the view modules of the run.

    Left out is what is not opaque, ignored by the frame's mask, beyond the range of depth or of the sensor, or seen too
    obliquely. Of estimated depth, the confidence is the frame's; highlights count little, as what they show is not the
    wall. Images are the frames as recorded, or rendered in flattened light.
    """
    light = None
    if settings.color == "flattened":
        light = held_light("flattened", trained.model, [frame.camera for frame in trained.scene.train])

    @torch.no_grad()
    def image_of(frame: Frame, camera: Camera) -> UInt8[Tensor, "H W 3"]:
        if light is None:
            return frame.image.cpu()
        camera = camera.to(trained.device, torch.float32)
        return eight_bit(render_held(trained.model, camera, light, ("rgb",)).rgb).cpu()

    kind = f"depth_{settings.depth}"
    reach, footprint = max_depth_of(settings, trained.scene), trained.scene.pixel_footprint
    for frame in trained.scene.train:
        output = render_view(trained, frame, ("alpha", kind))
        camera = (frame.camera if output.camera is None else output.camera).to("cpu", torch.float64)
        depth, alpha = output[kind].detach().cpu().double(), output.alpha.detach().cpu()
        cosines = incidence_cosines(depth, camera)
        good = (alpha >= settings.min_alpha) & frame.valid.cpu() & (depth > 0) & (depth <= reach)
        good &= cosines >= np.cos(np.radians(settings.max_incidence))
        if frame.depth_at_least is not None:
            good &= ~frame.depth_at_least.cpu().isfinite()
        nearness = footprint * (camera.fx * camera.fy) ** 0.5 / depth if np.isfinite(footprint) else 1.0
        quality = torch.where(good, cosines * nearness * trust(frame), 0.0)
        yield DepthView(
            camera, torch.where(good, depth, 0.0).float(), quality.float(), partial(image_of, frame, camera)
        )


def trust(frame: Frame) -> Float[Tensor, "H W"]:
    """Trust that the pixels of a frame show the wall: the confidence of its depth, and little at highlights. [H, W]"""
    glints = torch.from_numpy(dilated(highlights(frame.image.cpu().numpy()), _MARGIN))
    confidence = 1.0 if frame.depth_confidence is None else frame.depth_confidence.cpu()
    return torch.where(glints, _GLINT, 1.0) * confidence


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
    """Steps from each point to the next along an axis, or from the last to it: the smaller jump of depth. [H, W, 3]"""
    steps, jumps = torch.diff(points, dim=axis), torch.diff(depth, dim=axis).abs()
    jumps = torch.where(jumps.isfinite(), jumps, torch.inf)
    nothing = torch.full_like(points.narrow(axis, 0, 1), torch.nan)
    endless = torch.full_like(depth.narrow(axis, 0, 1), torch.inf)
    ahead, behind = torch.cat([steps, nothing], axis), torch.cat([nothing, steps], axis)
    nearer = torch.cat([jumps, endless], axis) <= torch.cat([endless, jumps], axis)
    return torch.where(nearer[..., None], ahead, behind)


#: Quality counts by this power: of two views, one twice as near has nearly all of the weight.
_POWER = 4
#: Share of a texture that triangles cover, about; and its width and height at most.
_COVERED, _LARGEST = 0.6, 8192
#: Texels between charts, largest stretch of triangles in them, and triangles that are laid out at once.
_GUTTER, _STRETCH, _AT_ONCE = 2.0, 0.3, 8_000


def best_colors(points: Float[np.ndarray, "N 3"], views: Sequence[DepthView]) -> UInt8[np.ndarray, "N 3"]:
    """Mean RGB of the images of the views that see each point, by their quality there.

    A point that no view sees gets the colour of the nearest one that a view does; black where there is none.
    """
    places = torch.from_numpy(points).double()
    total, weight = torch.zeros(len(places), 3), torch.zeros(len(places))
    for view in views:
        inside, pixels, shown, _ = looked_at(view, places)
        chosen, at = inside[shown], pixels[shown]
        column, row = at.long().unbind(1)
        quality = view.quality[row, column] ** _POWER
        total[chosen] += quality[:, None] * bilinear(view.image().float(), at[None])[0]
        weight[chosen] += quality
    colors = (total / weight.clamp(min=torch.finfo().tiny)[:, None]).round().clamp(0, 255).to(torch.uint8).numpy()
    colored = weight.numpy() > 0
    if colored.any() and not colored.all():
        colors[~colored] = colors[colored][cKDTree(points[colored]).query(points[~colored])[1]]
    return np.asarray(colors)


def best_texture(mesh: TriangleMesh, texel: float, views: Sequence[DepthView]) -> Texture:
    """A texture of texels of about such an edge, scene units, each coloured as :func:`best_colors` does.

    Charts are laid out by UVAtlas (open3d), which takes edges of two triangles at most. Texels without a triangle have
    the colour of the nearest one with.
    """
    size = min(math.ceil(math.sqrt(mesh.areas.sum() / _COVERED) / texel), _LARGEST)
    open3d, layout = import_open3d("lays out textures"), mesh.to_open3d()
    if broken := len(layout.get_non_manifold_edges()):  # at which UVAtlas ends the process
        raise InputError(
            f"{broken} edges of the mesh have more than two triangles",
            "a surface",
            "Try another `voxel`, or no texture",
        )
    parts = 1 + len(mesh) // _AT_ONCE
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        layout.compute_uvatlas(size=size, gutter=_GUTTER, max_stretch=_STRETCH, parallel_partitions=parts)
    baked = layout.bake_vertex_attr_textures(size, {"positions"}, fill=math.nan, update_material=False)
    places = baked["positions"].numpy()
    covered = np.isfinite(places).all(axis=-1)
    image = np.zeros((size, size, 3), np.uint8)
    image[covered] = best_colors(places[covered], views)
    nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return Texture(image[tuple(nearest)], layout.triangle.texture_uvs.numpy())
