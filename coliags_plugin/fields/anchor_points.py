"""Initial anchor positions: voxelization of the point cloud."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene

#: Floor of the mean squared neighbour distance, scene units squared (docs/methods.md 2.2).
MIN_SQUARED_DISTANCE = 1e-7


def initial_positions(scene: Scene) -> Float[Tensor, "N 3"]:
    """Positions of the scene's initial points, scene units; refuses scenes without."""
    if len(scene.points) == 0:
        raise InputError(
            "the scene has no initial points",
            "at least one",
            "Give the data manager points or depth; coliags depth estimate makes depth from posed images",
        )
    return scene.points.positions


def voxelize(points: Float[Tensor, "N 3"], size: float) -> Float[Tensor, "M 3"]:
    """One point, round(x / size) size, at the centre of every voxel that holds any; sorted (docs/methods.md 3.1)."""
    return torch.unique(torch.round(points / size), dim=0) * size


def neighbour_log_scales(points: Float[Tensor, "M 3"]) -> Float[Tensor, "M"]:
    """Log of the root mean squared distance to the three nearest neighbours (docs/methods.md 2.2, 3.1).

    With fewer than four points, those that there are; a lone point gets the floor.
    """
    neighbours = min(3, len(points) - 1)
    if neighbours == 0:
        return torch.full((len(points),), 0.5 * torch.log(torch.tensor(MIN_SQUARED_DISTANCE)).item())
    positions = points.detach().cpu().numpy()
    distances, _ = cKDTree(positions).query(positions, k=neighbours + 1, workers=-1)
    squared = torch.from_numpy(np.asarray(distances)[:, 1:]).square().mean(dim=1).clamp_min(MIN_SQUARED_DISTANCE)
    return (0.5 * squared.log()).to(points.dtype).to(points.device)
