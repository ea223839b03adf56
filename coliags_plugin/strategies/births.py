"""Selection of positions of new anchors: at most one per grid cell without an anchor."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Births:
    """New anchors.

    Attributes:
        positions: Scene units. [B, 3]
        candidates: For each, the candidate with the largest gradient in its cell. [B]
    """

    positions: Float[Tensor, "B 3"]
    candidates: Int[Tensor, "B"]

    def __len__(self) -> int:
        return len(self.positions)


def one_per_free_cell(
    anchors: Float[Tensor, "M 3"],
    positions: Float[Tensor, "C 3"],
    gradients: Float[Tensor, "C"],
    cell: float,
    limit: int,
) -> Births:
    """The strongest candidate of every cell without an anchor, the strongest cells first.

    Args:
        anchors: Existing anchors, scene units. [M, 3]
        positions: Candidates, scene units. [C, 3]
        gradients: Gradient statistic of each candidate. [C]
        cell: Edge of a cell, scene units.
        limit: Largest number of new anchors.
    """
    taken = torch.unique(torch.round(anchors / cell), dim=0)
    cells, member_of = torch.unique(torch.round(positions / cell), dim=0, return_inverse=True)
    _, place = torch.unique(torch.cat([taken, cells]), dim=0, return_inverse=True)
    occupied = torch.zeros(len(taken) + len(cells), dtype=torch.bool, device=cells.device)
    occupied[place[: len(taken)]] = True
    free = ~occupied[place[len(taken) :]]
    # Sorted by gradient; the first of each cell is kept.
    order = torch.argsort(gradients, descending=True, stable=True)
    order = order[free[member_of[order]]]
    first = torch.full((len(cells),), len(order), device=cells.device)
    first.scatter_reduce_(0, member_of[order], torch.arange(len(order), device=cells.device), "amin")
    chosen = order[first[first < len(order)].sort().values[:limit]]
    return Births(positions[chosen], chosen)
