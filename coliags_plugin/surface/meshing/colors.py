"""Colours of places on a surface, from the views that show them best."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from coliags_plugin.core.sampling import bilinear
from coliags_plugin.surface.meshing.views import DepthView, looked_at

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
        inside, pixels, seen, _ = looked_at(view, places)
        chosen, at = inside[seen], pixels[seen]
        column, row = at.long().unbind(1)
        quality = view.quality[row, column] ** _POWER
        total[chosen] += quality[:, None] * bilinear(image_of(view).float(), at[None])[0]
        weight[chosen] += quality
    colors = (total / weight.clamp(min=torch.finfo().tiny)[:, None]).round().clamp(0, 255).to(torch.uint8).numpy()
    known = weight.numpy() > 0
    if known.any() and not known.all():
        colors[~known] = colors[known][cKDTree(points[known]).query(points[~known])[1]]
    return np.asarray(colors)
