"""Appearance heads: anchor feature and viewing geometry -> colour of every child."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from coliags_plugin.fields.embedding import cosine_embedding
from coliags_plugin.fields.perceptron import perceptron
from coliags_plugin.settings import Settings


class PlainAppearanceSettings(Settings):
    """Options of the plain appearance head."""

    hidden: int = Field(default=32, ge=1)
    distance: bool = False  # Scaffold-GS's add_color_dist: also show the raw distance


class PlainAppearanceHead(nn.Module):
    """Scaffold-GS's: colour from feature and viewing direction, optionally the distance (docs/methods.md 3.6)."""

    Settings: ClassVar[type[Settings]] = PlainAppearanceSettings

    def __init__(self, settings: Any, features: int, children: int, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        self.children_per_anchor = children
        inputs = features + self.embed(torch.zeros(1, 3), torch.zeros(1, 1), torch.zeros(1, 1)).shape[1]
        self.color_mlp = perceptron(inputs, settings.hidden, 3 * children, generator)

    def embed(
        self, directions: Float[Tensor, "V 3"], distances: Float[Tensor, "V 1"], cosines: Float[Tensor, "V 1"]
    ) -> Float[Tensor, "V E"]:
        """What the perceptron sees of where the lamp is."""
        return torch.cat([directions, distances], dim=1) if self.settings.distance else directions

    def forward(
        self,
        features: Float[Tensor, "V F"],
        directions: Float[Tensor, "V 3"],
        distances: Float[Tensor, "V 1"],
        cosines: Float[Tensor, "V 1"],
    ) -> Float[Tensor, "V K 3"]:
        """Decode the children's colours.

        Args:
            features: Anchor features. [V, F]
            directions: Unit vectors from the camera (and lamp) to the anchors, world frame. [V, 3]
            distances: Camera to anchor, scene units (mm), not normalised. [V, 1]
            cosines: Of the angle between optical axis and direction, in [0, 1]. [V, 1]

        Returns:
            RGB in (0, 1). [V, K, 3]
        """
        seen = torch.cat([features, self.embed(directions, distances, cosines)], dim=1)
        return self.color_mlp(seen).view(len(seen), self.children_per_anchor, 3).sigmoid()


class IMIAAppearanceSettings(Settings):
    """Options of IMIA."""

    hidden: int = Field(default=32, ge=1)
    frequencies: int = Field(default=5, ge=0)


class IMIAAppearanceHead(PlainAppearanceHead):
    """Improved appearance Modelling with Illumination Attenuation (paper, Eq. 8; docs/methods.md 3.4).

    The perceptron sees v, the distance d to the lamp and gamma(cos theta), the angle to the optical axis in which light
    spread and vignetting merge.
    """

    Settings: ClassVar[type[Settings]] = IMIAAppearanceSettings

    def embed(
        self, directions: Float[Tensor, "V 3"], distances: Float[Tensor, "V 1"], cosines: Float[Tensor, "V 1"]
    ) -> Float[Tensor, "V E"]:
        """v, d and gamma(cos theta): 3 + 1 + 11 numbers at five frequencies."""
        return torch.cat([directions, distances, cosine_embedding(cosines, self.settings.frequencies)], dim=1)
