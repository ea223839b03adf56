"""Spherical harmonics fitted to colours that Gaussians have in several views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.fields.spherical_harmonics import Y0, basis

#: Added to the normal equations of coefficients above degree 0, whose weights add up to 1: a Gaussian seen along one
#: direction has no information about others, and keeps its mean colour there.
RIDGE = 0.01
#: Gaussians whose normal equations are solved at a time.
_CHUNK = 1 << 16


@dataclass(frozen=True)
class SeenColors:
    """Colours (RGB) of some Gaussians in one view, how much it shows of each, and unit directions from the camera."""

    slots: Int[Tensor, "V"]
    weights: Float[Tensor, "V"]
    directions: Float[Tensor, "V 3"]
    colors: Float[Tensor, "V 3"]

    @classmethod
    def of(cls, gaussians: Gaussians, weights: Float[Tensor, "N"], camera: Camera) -> SeenColors:
        """The colours of those that a view shows."""
        shown = weights > 0
        directions = torch.nn.functional.normalize(gaussians.means[shown] - camera.center, dim=1)
        return cls(gaussians.source_index[shown], weights[shown], directions, gaussians.colors[shown])


def fit_harmonics(
    views: Sequence[SeenColors], kept: Int[Tensor, "N"], mean_colors: Float[Tensor, "N 3"], degree: int
) -> Float[Tensor, "N B 3"]:
    """Coefficients that reproduce the colours best: weighted least squares per Gaussian, ridge above degree 0.

    Of ascending slots, with B = (degree + 1)^2 each; ``mean_colors`` are theirs where no view shows them.
    """
    bases = (degree + 1) ** 2
    rows = torch.full((int(kept[-1]) + 1,), -1, dtype=torch.int64, device=kept.device)
    rows[kept] = torch.arange(len(kept), device=kept.device)
    ridge = torch.full((bases,), RIDGE, device=kept.device)
    ridge[0] = 0.0
    parts = []
    for start in range(0, len(kept), _CHUNK):
        count = min(_CHUNK, len(kept) - start)
        normal = torch.zeros(count, bases, bases, device=kept.device)
        right = torch.zeros(count, bases, 3, device=kept.device)
        total = torch.zeros(count, device=kept.device)
        for view in views:
            row = rows[view.slots.clamp_max(len(rows) - 1)] - start
            here = (view.slots < len(rows)) & (row >= 0) & (row < count)
            row, weights = row[here], view.weights[here]
            values = basis(view.directions[here], degree)
            weighted = weights[:, None] * values
            normal.index_add_(0, row, weighted[:, :, None] * values[:, None])
            right.index_add_(0, row, weighted[:, :, None] * (view.colors[here] - mean_colors[start + row])[:, None])
            total.index_add_(0, row, weights)
        scale = total.clamp_min(1e-12)[:, None, None]
        parts.append(torch.linalg.solve(normal / scale + torch.diag(ridge + 1e-6 * Y0**2), right / scale))
    coefficients = torch.cat(parts)
    coefficients[:, 0] += (mean_colors - 0.5) / Y0
    return coefficients
