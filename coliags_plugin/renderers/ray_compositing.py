"""Compositing of samples along rays."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class CompositedRays:
    """Samples along rays and their weights.

    Attributes:
        depths: z-depths of the samples, scene units. [P, S]
        transmittance: Before every sample and behind the last. [P, S+1]
        colors: RGB of the samples; None where only depths are asked for. [P, S, 3]
    """

    depths: Float[Tensor, "P S"]
    transmittance: Float[Tensor, "P S+1"]
    colors: Float[Tensor, "P S 3"] | None

    @property
    def weights(self) -> Float[Tensor, "P S"]:
        """What each sample contributes. [P, S]"""
        return self.transmittance[:, :-1] - self.transmittance[:, 1:]

    def output(self, name: str, background: Float[Tensor, "3"]) -> Float[Tensor, "P 1 *C"]:
        """An output by its name in :data:`coliags_plugin.core.render_output.OUTPUTS`, normals excepted.

        Args:
            name: For ``rgb`` there must be colours.
            background: RGB behind the last sample. [3]
        """
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
    """Transmittance before every sample and behind the last.

    Args:
        density: Per scene unit. [P, S]
        lengths: Of the stretches of ray that the samples stand for, scene units. [P, S]
        opaque_end: The last stretch has no end: it lets nothing through where its density is above 0.
    """
    absorbed = density * lengths
    if opaque_end:
        absorbed = torch.cat([absorbed[:, :-1], torch.where(density[:, -1:] > 0, torch.inf, 0.0)], dim=1)
    return torch.exp(-torch.cat([torch.zeros_like(absorbed[:, :1]), absorbed.cumsum(1)], dim=1))
