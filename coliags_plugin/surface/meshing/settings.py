"""Options of meshing, and the defaults that depend on the scene."""

from __future__ import annotations

from typing import Literal

from pydantic import Field as Option

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Settings


class MeshSettings(Settings):
    """Options of meshing."""

    # Edge of a voxel in scene units (mm); null: voxel_pixels times the size of a training pixel on the surface.
    voxel_size: float | None = Option(default=None, gt=0)
    voxel_pixels: float = Option(default=2.0, gt=0)  # see voxel_size
    truncation: float = Option(default=2.0, ge=1, le=32)  # of the signed distance, in voxels
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
            f"scene '{scene.name}' has no points to choose the size of the voxels by", "--voxel SIZE, in scene units"
        )
    return settings.voxel_pixels * scene.pixel_footprint


def max_depth_of(settings: MeshSettings, scene: Scene) -> float:
    """z-depth beyond which nothing is fused, scene units; infinite where the scene has no points in view."""
    if settings.max_depth is not None:
        return settings.max_depth
    depths = scene.depths_in_view()
    return float(depths.max()) if len(depths) else float("inf")
