"""Normals of the surface that points lie on."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from coliags_plugin.core.errors import InputError


def point_normals(
    points: Float[Tensor, "P 3"], neighbours: int, at: Float[Tensor, "N 3"] | None = None
) -> Float[Tensor, "N 3"]:
    """Unit normals, of either sign: the direction in which the points nearest to a position vary least. [N, 3]

    Args:
        points: Scene units. [P, 3]
        neighbours: Points that count at each position.
        at: Positions, scene units; None: those of the points, each of which does not count at its own. [N, 3]

    Raises:
        InputError: There are not enough points.
    """
    least = neighbours + (at is None)
    if len(points) < least:
        raise InputError(
            f"{len(points)} initial points for normals from {neighbours} neighbours",
            f"at least {least}",
            "Give the data manager more points, or lower field.normal_neighbours",
        )
    positions = points.detach().cpu().double().numpy()
    if at is None:
        _, nearest = cKDTree(positions).query(positions, k=neighbours + 1, workers=-1)
        nearest = np.asarray(nearest)[:, 1:]
    else:
        _, nearest = cKDTree(positions).query(at.detach().cpu().double().numpy(), k=neighbours, workers=-1)
    around = torch.from_numpy(positions[np.asarray(nearest)].reshape(-1, neighbours, 3))
    around = around - around.mean(1, keepdim=True)
    _, axes = torch.linalg.eigh(around.mT @ around)  # eigenvalues ascend
    return axes[:, :, 0].to(points)
