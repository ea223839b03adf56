"""Colours of places on a surface, and textures of meshes, from the views that show each place best."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.libraries import import_open3d
from coliags_plugin.core.tensors import bilinear
from coliags_plugin.geometry.meshes.mesh import Texture, TriangleMesh
from coliags_plugin.surface.meshing.views import DepthView, looked_at

#: Quality counts by this power: of two views, one twice as near has nearly all of the weight.
_POWER = 4
#: Share of a texture that triangles cover, about; and its width and height at most.
_COVERED, _LARGEST = 0.6, 8192
#: Texels between charts, largest stretch of triangles in them, and triangles that are laid out at once.
_GUTTER, _STRETCH, _AT_ONCE = 2.0, 0.3, 8_000


def best_colors(
    points: Float[np.ndarray, "N 3"],
    views: Sequence[DepthView],
) -> UInt8[np.ndarray, "N 3"]:
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


def best_texture(
    mesh: TriangleMesh,
    texel: float,
    views: Sequence[DepthView],
) -> Texture:
    """A texture of texels of about such an edge, scene units, each coloured as :func:`best_colors` does.

    Charts are laid out by UVAtlas (open3d), which takes edges of two triangles at most. Texels without
    a triangle have the colour of the nearest one with.
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
