"""Colours of places on a surface, from the views that show them best."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from coliags_plugin.surface.meshing.views import DepthView

#: Largest difference of z-depth between a place and what a view sees there, as a share of the depth.
_SAME = 0.03
#: Quality counts by this power: of two views, one twice as near has nearly all of the weight.
_POWER = 4


def best_colors(
    points: Float[np.ndarray, "N 3"],
    views: Sequence[DepthView],
    image_of: Callable[[DepthView], UInt8[Tensor, "H W 3"]],
) -> UInt8[np.ndarray, "N 3"]:
    """Mean RGB of the images of the views that see each point, by their quality there.

    A point that no view sees gets the colour of the nearest one that a view does; black where there is none.
    """
    places = torch.from_numpy(points).double()
    total, weight = torch.zeros(len(places), 3), torch.zeros(len(places))
    for view in views:
        pixels, z = view.camera.project(places)
        inside = torch.nonzero(view.camera.is_inside(pixels, z))[:, 0]
        column, row = pixels[inside].long().unbind(1)
        seen = (view.depth[row, column] - z[inside]).abs() <= _SAME * z[inside]
        chosen, at = inside[seen], pixels[inside][seen]
        quality = view.quality[row[seen], column[seen]] ** _POWER
        total[chosen] += quality[:, None] * _sampled(image_of(view), at)
        weight[chosen] += quality
    colors = (total / weight.clamp(min=torch.finfo().tiny)[:, None]).round().clamp(0, 255).to(torch.uint8).numpy()
    known = weight.numpy() > 0
    if known.any() and not known.all():
        colors[~known] = colors[known][cKDTree(points[known]).query(points[~known])[1]]
    return np.asarray(colors)


def _sampled(image: UInt8[Tensor, "H W 3"], pixels: Float[Tensor, "K 2"]) -> Float[Tensor, "K 3"]:
    """Bilinear samples of an image at columns and rows, pixel centres at integers + 0.5. [K, 3]"""
    size = torch.tensor([image.shape[1], image.shape[0]], dtype=pixels.dtype)
    grid = (2.0 * pixels / size - 1.0).float()[None, None]
    planes = image.permute(2, 0, 1)[None].float()
    return torch.nn.functional.grid_sample(planes, grid, padding_mode="border", align_corners=False)[0, :, 0].T
