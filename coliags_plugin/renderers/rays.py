"""Places along rays at which a radiance field is evaluated, and compositing of the samples."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.core.tensors import sent

#: Added to every weight, so that no stretch of a ray is left out for good.
WEIGHT_FLOOR = 1e-5


def even_places(
    near: Float[Tensor, ""] | float,
    far: Float[Tensor, ""] | float,
    count: int,
    rays: Float[Tensor, "P 3"],
    generator: torch.Generator | None,
) -> Float[Tensor, "P S"]:
    """One place in each of ``count`` equal intervals between two ends, for as many rays, in their dtype and device.

    The generator draws a place within each interval; None takes the midpoints.
    """
    return near + (far - near) * _shares(len(rays), count, rays, generator)


def refined_places(
    places: Float[Tensor, "P S"], weights: Float[Tensor, "P S"], count: int, generator: torch.Generator | None
) -> Float[Tensor, "P S+N"]:
    """The places, in order and at least three, and ``count`` more, distributed like the weights; sorted.

    The distribution is NeRF's: constant between the midpoints of neighbouring places, where it is the weight of the
    place between them plus :data:`WEIGHT_FLOOR`; the first and the last weight are not used. The generator draws a
    number within each of ``count`` equal intervals of [0, 1], which the inverse of the cumulative distribution makes a
    place; None takes the midpoints.
    """
    edges = 0.5 * (places[:, 1:] + places[:, :-1])
    mass = weights[:, 1:-1] + WEIGHT_FLOOR
    cumulative = (mass / mass.sum(1, keepdim=True)).cumsum(1)
    cumulative = torch.cat([torch.zeros_like(cumulative[:, :1]), cumulative[:, :-1]], dim=1)  # at the lower edges
    shares = _shares(len(places), count, places, generator)
    interval = torch.searchsorted(cumulative, shares, right=True) - 1
    start = cumulative.gather(1, interval)
    within = (shares - start) * mass.sum(1, keepdim=True) / mass.gather(1, interval)
    below, above = edges.gather(1, interval), edges.gather(1, interval + 1)
    return torch.cat([places, below + within.clamp(0.0, 1.0) * (above - below)], dim=1).sort(dim=1).values


def _shares(rows: int, count: int, like: Tensor, generator: torch.Generator | None) -> Float[Tensor, "P S"]:
    """One number in each of ``count`` equal intervals of [0, 1], in order."""
    index = torch.arange(count, dtype=like.dtype, device=like.device)
    if generator is None:
        return ((index + 0.5) / count).expand(rows, -1).contiguous()
    return (index + sent(torch.rand(rows, count, generator=generator, dtype=like.dtype), like.device)) / count


@dataclass(frozen=True)
class CompositedRays:
    """Samples along rays: z-depths in scene units, RGB, which is None where only depths are asked for, and weights.

    ``transmittance`` is that before every sample and behind the last.
    """

    depths: Float[Tensor, "P S"]
    transmittance: Float[Tensor, "P S+1"]
    colors: Float[Tensor, "P S 3"] | None

    @property
    def weights(self) -> Float[Tensor, "P S"]:
        """Weights of the samples. [P, S]"""
        return self.transmittance[:, :-1] - self.transmittance[:, 1:]

    def output(self, name: str, background: Float[Tensor, "3"]) -> Float[Tensor, "P 1 *C"]:
        """An output of ``core.render_output`` by its name, normals excepted; rgb needs colours. [P, 1] or [P, 1, 3]"""
        alpha = 1.0 - self.transmittance[:, -1:]
        if name == "alpha":
            return alpha
        if name == "rgb" and self.colors is not None:
            rgb = (self.weights[..., None] * self.colors).sum(1) + (1.0 - alpha) * background
            return rgb[:, None]
        if name == "inverse_depth_accumulated":
            return (self.weights / self.depths).sum(1, keepdim=True)
        if name == "depth_median":
            reached = self.transmittance[:, 1:] <= 0.5
            first = self.depths.gather(1, reached.to(torch.int8).argmax(1, keepdim=True))
            return torch.where(reached.any(1, keepdim=True), first, 0.0).detach()
        accumulated = (self.weights * self.depths).sum(1, keepdim=True)
        if name == "depth_accumulated":
            return accumulated
        total = self.weights.sum(1, keepdim=True)
        return torch.where(total > 0, accumulated / torch.where(total > 0, total, 1.0), 0.0)


def transmittances(
    density: Float[Tensor, "P S"], lengths: Float[Tensor, "P S"], opaque_end: bool
) -> Float[Tensor, "P S+1"]:
    """Transmittance before every sample and behind the last, from densities per scene unit and lengths in scene units.

    With ``opaque_end`` the last stretch has no end: it lets nothing through where its density is above 0.
    """
    absorbed = density * lengths
    if opaque_end:
        absorbed = torch.cat([absorbed[:, :-1], torch.where(density[:, -1:] > 0, torch.inf, 0.0)], dim=1)
    return torch.exp(-torch.cat([torch.zeros_like(absorbed[:, :1]), absorbed.cumsum(1)], dim=1))
