"""Surface normals estimated from initial points, as references for the orientation of Gaussians."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.core.point_normals import point_normals


class ReferenceNormals(nn.Module):
    """Normal of the initial point nearest to each Gaussian when it was added (docs/rivals/gaussian-pancakes.md).

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
        """The references of one Gaussian at each point."""
        references = cls(len(points), len(points))
        references.points.copy_(points)
        references.normals.copy_(point_normals(points, neighbours))
        references.of_rows.copy_(references.normals)
        return references

    def extend(self, means: Float[Tensor, "N 3"]) -> None:
        """Add the references of Gaussians that were appended: ``means`` are the centres of all, scene units."""
        born = means[len(self.of_rows) :]
        _, nearest = cKDTree(self.points.cpu().numpy()).query(born.cpu().numpy(), workers=-1)
        chosen = torch.from_numpy(np.asarray(nearest)).to(self.normals.device)
        self.of_rows = torch.cat([self.of_rows, self.normals[chosen]])

    def keep(self, keep: Bool[Tensor, "N"]) -> None:
        """Keep the references of some Gaussians."""
        self.of_rows = self.of_rows[keep]
