"""Surface normals estimated from initial points, as references for the orientation of Gaussians."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.core.errors import InputError


class ReferenceNormals(nn.Module):
    """Normal of the initial point nearest to each Gaussian when it was added (docs/rivals/gaussian-pancakes.md).

    Args:
        points: Number of initial points.
        rows: Number of Gaussians.

    Attributes:
        points: Initial points, scene units. [P, 3]
        normals: Their unit normals, of either sign. [P, 3]
        of_rows: Reference of each Gaussian. [N, 3]
    """

    points: Tensor
    normals: Tensor
    of_rows: Tensor

    def __init__(self, points: int, rows: int) -> None:
        super().__init__()
        self.register_buffer("points", torch.zeros(points, 3))
        self.register_buffer("normals", torch.zeros(points, 3))
        self.register_buffer("of_rows", torch.zeros(rows, 3))

    @classmethod
    def of_points(cls, points: Float[Tensor, "P 3"], neighbours: int) -> Self:
        """The references of one Gaussian at each point.

        Raises:
            InputError: There are not enough points.
        """
        references = cls(len(points), len(points))
        references.points.copy_(points)
        references.normals.copy_(point_normals(points, neighbours))
        references.of_rows.copy_(references.normals)
        return references

    def extend(self, means: Float[Tensor, "N 3"]) -> None:
        """Add the references of Gaussians that were appended.

        Args:
            means: Centres of all Gaussians, scene units. [N, 3]
        """
        born = means[len(self.of_rows) :]
        _, nearest = cKDTree(self.points.cpu().numpy()).query(born.cpu().numpy(), workers=-1)
        chosen = torch.from_numpy(np.asarray(nearest)).to(self.normals.device)
        self.of_rows = torch.cat([self.of_rows, self.normals[chosen]])

    def keep(self, keep: Bool[Tensor, "N"]) -> None:
        """Keep the references of some Gaussians. [N]"""
        self.of_rows = self.of_rows[keep]


def point_normals(points: Float[Tensor, "P 3"], neighbours: int) -> Float[Tensor, "P 3"]:
    """Unit normals of points, of either sign: the direction in which each point's nearest neighbours vary least.

    Args:
        points: Scene units. [P, 3]
        neighbours: Of each point, itself excluded.

    Raises:
        InputError: There are not enough points.
    """
    if len(points) <= neighbours:
        raise InputError(
            f"{len(points)} initial points for normals from {neighbours} neighbours",
            f"at least {neighbours + 1}",
            "Give the data manager more points, or lower field.normal_neighbours",
        )
    positions = points.detach().cpu().double().numpy()
    _, nearest = cKDTree(positions).query(positions, k=neighbours + 1, workers=-1)
    around = torch.from_numpy(positions[np.asarray(nearest)[:, 1:]])
    around = around - around.mean(1, keepdim=True)
    _, axes = torch.linalg.eigh(around.mT @ around)  # eigenvalues ascend
    return axes[:, :, 0].to(points)
