"""Normals of the surface that points lie on."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from coliags_plugin.core.errors import InputError

#: Positions whose neighbours are in memory at once.
_CHUNK = 4096
#: A wall's normal is estimated from one in so many of the points, and from no fewer than so many.
_SHARE, _FEWEST = 500, 20


def point_normals(
    points: Float[Tensor, "P 3"], neighbours: int, at: Float[Tensor, "N 3"] | None = None
) -> Float[Tensor, "N 3"]:
    """Unit normals, of either sign: the direction in which so many points nearest to a position vary least.

    Without positions, at the points themselves, each of which does not count at its own.
    """
    least = neighbours + (at is None)
    if len(points) < least:
        raise InputError(
            f"{len(points)} initial points for normals from {neighbours} neighbours",
            f"at least {least}",
            "Give the data manager more points, or lower field.normal_neighbours",
        )
    positions, wanted = (values.detach().cpu().double().numpy() for values in (points, points if at is None else at))
    tree = cKDTree(positions)
    normals = torch.empty(len(wanted), 3, dtype=torch.float64)
    for start in range(0, len(wanted), _CHUNK):
        _, nearest = tree.query(wanted[start : start + _CHUNK], k=least, workers=-1)
        around = torch.from_numpy(positions[np.asarray(nearest).reshape(-1, least)[:, least - neighbours :]])
        around = around - around.mean(1, keepdim=True)
        _, axes = torch.linalg.eigh(around.mT @ around)  # eigenvalues ascend
        normals[start : start + _CHUNK] = axes[:, :, 0]
    return normals.to(points)


def wall_normals(points: Float[Tensor, "P 3"], at: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Unit normals, of either sign, of the smooth wall that noisy points lie on, at positions.

    Each is that of the nearest five hundredth of the points, and of 20 at least: in a colon's section, of some
    millimetres.
    """
    return point_normals(points, min(len(points), max(_FEWEST, len(points) // _SHARE)), at)
