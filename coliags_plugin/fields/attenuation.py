"""Attenuation of the light by a law: a factor on the colours of any appearance head."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from coliags_plugin.config.components import AppearanceHeadNode
from coliags_plugin.contracts import AppearanceHead
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.lamps import HeldLight
from coliags_plugin.core.photometry import fit_light
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Settings

#: Largest distance of the lamp from the optical centre along each camera axis, scene units (mm).
MAX_OFFSET = 20.0
#: Smallest distance to the lamp, as a share of the reference distance, and smallest cosine that the law is computed at.
_MIN_DISTANCE, _MIN_COSINE = 0.02, 0.05
#: Largest b that a fit may start with: cos^9 in linear light.
_LARGEST_EXPONENT = 4.0


class AttenuatedAppearanceSettings(Settings):
    """Options of the attenuation; the initial exponents are those of an inverse-square law at gamma 2.2."""

    head: AppearanceHeadNode  # decoder of the colours that are attenuated
    distance_exponent: float = -0.9  # initial a
    cosine_exponent: float = 0.3  # initial b where it is not fitted
    initial: Literal["given", "points"] = "given"  # b: as above, or fitted to surface points (docs/methods.md 4.8)
    channels: Literal[1, 3] = (
        3  # exponents for each colour, or one pair for all: red falls off slower (docs/methods.md 3.7)
    )


class AttenuatedAppearanceHead(AppearanceHead):
    """The colours of another head times (d / d_0)^a cos(theta)^b, a law of all Gaussians (docs/methods.md 3.7).

    d is the distance of a Gaussian, not of its anchor, to a lamp whose offset from the optical centre is learned;
    theta is its angle to the optical axis. d_0, the median distance of the scene, fixes the unit of the colours.

    Attributes:
        exponents: a and b of each channel. [C, 2]
        lamp_offset: Of the lamp in camera axes, before it is bounded to +-:data:`MAX_OFFSET`, scene units. [3]
        reference: d_0, scene units. []
    """

    Settings: ClassVar[type[Settings]] = AttenuatedAppearanceSettings

    reference: Tensor

    def __init__(self, settings: Any, features: int, children: int, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        self.head: AppearanceHead = settings.head.target(settings.head.settings, features, children, generator)
        initial = torch.tensor([settings.distance_exponent, settings.cosine_exponent])
        self.exponents = nn.Parameter(initial.repeat(settings.channels, 1))
        self.lamp_offset = nn.Parameter(torch.zeros(3))
        self.register_buffer("reference", torch.ones(()))

    @torch.no_grad()
    def expect(self, distances: Float[Tensor, "D"]) -> None:
        """Take the median distance as the reference."""
        self.head.expect(distances)
        if len(distances):
            self.reference.copy_(distances.median())

    @torch.no_grad()
    def prepare(self, scene: Scene) -> None:
        """Start at the fall-off over the angle of the scene's surface points, if the settings say so."""
        self.head.prepare(scene)
        fitted = fit_light(scene) if self.settings.initial == "points" else None
        if fitted is not None:
            found = fitted.cosine_exponents.clamp(0.0, _LARGEST_EXPONENT)
            self.exponents[:, 1] = found.mean() if self.settings.channels == 1 else found

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Those of the head, the exponents, and the offset of the lamp, which needs a rate in scene units."""
        return {
            **self.head.parameter_groups(),
            "attenuation": [self.exponents],
            "lamp_offset": [self.lamp_offset],
        }

    def forward(
        self,
        features: Float[Tensor, "V F"],
        directions: Float[Tensor, "V 3"],
        distances: Float[Tensor, "V 1"],
        cosines: Float[Tensor, "V 1"],
    ) -> Float[Tensor, "V K 3"]:
        """The colours before attenuation."""
        colors: Tensor = self.head(features, directions, distances, cosines)
        return colors

    @property
    def offset(self) -> Float[Tensor, "3"]:
        """Position of the lamp in camera axes, scene units. [3]"""
        return MAX_OFFSET * torch.tanh(self.lamp_offset / MAX_OFFSET)

    def law(self, distances: Float[Tensor, "N"], cosines: Float[Tensor, "N"]) -> Float[Tensor, "N C"]:
        """The law's factor. [N, C]

        Args:
            distances: To the lamp, scene units. [N]
            cosines: Of the angle to the optical axis. [N]
        """
        relative = (distances / self.reference).clamp_min(_MIN_DISTANCE)
        logs = torch.stack([relative.log(), cosines.clamp_min(_MIN_COSINE).log()], dim=1)
        return (logs @ self.exponents.T).exp()

    def attenuation(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N C"]:
        """See :meth:`AppearanceHead.attenuation`."""
        distances = (points - self.offset).norm(dim=1)
        return self.law(distances, points[:, 2] / points.norm(dim=1).clamp_min(1e-9))

    def lit(
        self,
        colors: Float[Tensor, "N 3"],
        positions: Float[Tensor, "N 3"],
        camera: Camera,
        light: HeldLight | None,
    ) -> Float[Tensor, "N 3"]:
        """The colours under the lamp, which does not move Gaussians: positions get no gradient from it."""
        positions = positions.detach()
        if light is not None:
            return colors * self.law(*light.incidence(positions))
        return colors * self.attenuation((positions - camera.center) @ camera.camera_to_world[:3, :3])

    @property
    def learned(self) -> dict[str, Any]:
        """The law's numbers."""
        distance, cosine = self.exponents.detach().T.tolist()
        return {
            "distance_exponent": distance,
            "cosine_exponent": cosine,
            "lamp_offset": self.offset.detach().tolist(),
            "reference_distance": float(self.reference),
        }
