"""Light that the parts of a wall reflect onto each other."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

#: Approximate number of patches, and the nearest of them that tell how large one is.
_PATCHES, _NEIGHBOURS = 600, 8
#: Reflections that count; at an albedo of .4 the rest is below 1 %.
_BOUNCES = 5


@dataclass(frozen=True)
class Cavity:
    """Radiosity model of a Lambertian wall: patches of one albedo and the form factors between them.

    Occlusion is neglected: patches that face each other see each other.

    Attributes:
        every: Stride over the points at which patches are centred.
        between: Form factors from each patch to every patch. [K, K]
        onto_points: Form factors from each point to every patch. [P, K]
    """

    every: int
    between: Float[Tensor, "K K"]
    onto_points: Float[Tensor, "P K"]

    @classmethod
    def of(cls, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]) -> Cavity:
        """The wall that points lie on, scene units, spread evenly; unit normals point away from it."""
        every = max(1, len(points) // _PATCHES)
        centres, outward = points[::every], normals[::every]
        nearest = torch.cdist(centres, centres).topk(min(_NEIGHBOURS + 1, len(centres)), largest=False).values
        areas = math.pi * nearest[:, -1].square() / max(1, nearest.shape[1] - 1)
        between = _form_factors(centres, outward, centres, outward, areas)
        return cls(every, between, _form_factors(points, normals, centres, outward, areas))

    def indirect(self, direct: Float[Tensor, "K F"], albedo: float) -> Float[Tensor, "P F"]:
        """Irradiance of the points by a wall of an albedo, by radiosity; direct: of the patches by the lamp."""
        total = direct
        for _ in range(_BOUNCES - 1):
            total = direct + albedo * (self.between @ total)
        return albedo * (self.onto_points @ total)


def _form_factors(
    points: Float[Tensor, "P 3"],
    normals: Float[Tensor, "P 3"],
    centres: Float[Tensor, "K 3"],
    outward: Float[Tensor, "K 3"],
    areas: Float[Tensor, "K"],
) -> Float[Tensor, "P K"]:
    """Form factors of discs seen from points; those of a point sum to 1 at most."""
    rays = centres[None] - points[:, None]
    squares = rays.square().sum(-1)
    lengths = squares.sqrt().clamp_min(1e-9)
    leaving = -(rays * outward[None]).sum(-1) / lengths
    arriving = (rays * normals[:, None]).sum(-1) / lengths
    factors = leaving.clamp_min(0.0) * arriving.clamp_min(0.0) * areas / (math.pi * squares + areas).clamp_min(1e-12)
    return factors / factors.sum(1, keepdim=True).clamp_min(1.0)
