"""Reflectance of rough dielectric surfaces: a Lambert and a Cook-Torrance term, of cosines.

Of unit vectors to the viewer V and to the lamp L, the half vector H = (V + L) / |V + L| and the normal N
(docs/rivals/pr-endo.md; Cook and Torrance 1982, with GGX and Schlick's approximations).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Cosines:
    """Cosines between the directions at N points; those with the normal in [0, 1].

    Attributes:
        normal_view: <N, V>. [N]
        normal_lamp: <N, L>. [N]
        normal_half: <N, H>. [N]
        half_view: <H, V> = <H, L>; None where V = L, where it is 1. [N]
    """

    normal_view: Float[Tensor, "N"]
    normal_lamp: Float[Tensor, "N"]
    normal_half: Float[Tensor, "N"]
    half_view: Float[Tensor, "N"] | None = None

    @classmethod
    def of(cls, normals: Float[Tensor, "N 3"], views: Float[Tensor, "N 3"], lamps: Float[Tensor, "N 3"]) -> Cosines:
        """Cosines between unit vectors."""
        halves = torch.nn.functional.normalize(views + lamps, dim=-1)
        pairs = (normals, views), (normals, lamps), (normals, halves), (halves, views)
        return cls(*((a * b).sum(-1).clamp(0.0, 1.0) for a, b in pairs))

    @classmethod
    def retroreflected(cls, cosines: Float[Tensor, "N"]) -> Cosines:
        """The lamp is at the viewer: all cosines with the normal are the same."""
        return cls(cosines, cosines, cosines)


def fresnel(cosines: Cosines, f0: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """Share of the light that the surface reflects, by Schlick's approximation; f0: that at normal incidence."""
    if cosines.half_view is None:
        return f0
    return f0 + (1.0 - f0) * (1.0 - cosines.half_view).pow(5)


def facet_density(normal_half: Float[Tensor, "N"], roughness: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """GGX: density of microfacets with normal H, 1 / sr, whose projected area integrates to 1.

    The square of the roughness, which is above 0, is GGX's alpha.
    """
    squared = roughness.pow(4)
    return squared / (math.pi * (normal_half.square() * (squared - 1.0) + 1.0).square())


def lambert(cosines: Cosines, reflected: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """Diffuse BRDF of albedo 1 beneath the surface, times <N, L>, 1 / sr: what :func:`fresnel` leaves goes in."""
    return (1.0 - reflected) * cosines.normal_lamp / math.pi


def specular(cosines: Cosines, reflected: Float[Tensor, "N"], roughness: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """Cook-Torrance BRDF F D G / (4 <N, V> <N, L>), times <N, L>, 1 / sr; F: :func:`fresnel`.

    With G = G1(<N, V>) G1(<N, L>), G1(t) = t / (t (1 - k) + k), k = (roughness + 1)^2 / 8, whose numerators cancel the
    denominator, so that it is finite at grazing angles.
    """
    k = (roughness + 1.0).square() / 8.0
    masked = torch.lerp(k, torch.ones_like(k), cosines.normal_view)
    shadowed = masked if cosines.half_view is None else torch.lerp(k, torch.ones_like(k), cosines.normal_lamp)
    density = facet_density(cosines.normal_half, roughness)
    return cosines.normal_lamp * reflected * density / (4.0 * masked * shadowed)
