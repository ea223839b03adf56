"""Appearance heads: anchor feature and viewing geometry -> colour of every child."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from coliags_plugin.contracts import AppearanceHead
from coliags_plugin.core.settings import Settings
from coliags_plugin.fields.embedding import cosine_embedding
from coliags_plugin.fields.mlp import first_layer, mlp


class AppearanceSettings(Settings):
    """Options common to all appearance heads.

    ``bias_init`` initialises the biases of hidden units with the distance as an input: "scene_distances" spreads the
    units' kinks over the distances of the scene (docs/methods.md 3.4), "pytorch" is PyTorch's default, as in the paper.
    """

    hidden: int = Field(default=32, ge=1)  # units of each hidden layer
    bias_init: Literal["scene_distances", "pytorch"] = "scene_distances"  # see above


class PlainAppearanceSettings(AppearanceSettings):
    """Options of the plain appearance head."""

    distance: bool = False  # Scaffold-GS's add_color_dist: distance as a further input


class PlainAppearanceHead(AppearanceHead):
    """Appearance head of Scaffold-GS, optionally with distance as an input (docs/methods.md 3.6)."""

    Settings: ClassVar[type[Settings]] = PlainAppearanceSettings

    def __init__(self, settings: Any, features: int, children: int, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        self.children_per_anchor = children
        self.features = features
        seen = torch.zeros(1, self.direction_channels)
        embedded = self.embed(seen, torch.zeros(1, 1), torch.zeros(1, 1)).shape[1]
        self.color_mlp = mlp(features + embedded, settings.hidden, 3 * children, generator)

    def embed_direction(
        self, features: Float[Tensor, "V F"], directions: Float[Tensor, "V 3"], normals: Float[Tensor, "V 3"] | None
    ) -> Float[Tensor, "V D"]:
        """Encoding of the viewing direction that the MLP gets; arguments as of :meth:`forward`."""
        return directions

    @property
    def direction_channels(self) -> int:
        """Channels of :meth:`embed_direction`, which lie between the feature and the distance."""
        return 3

    def embed(
        self, seen: Float[Tensor, "V D"], distances: Float[Tensor, "V 1"], cosines: Float[Tensor, "V 1"]
    ) -> Float[Tensor, "V E"]:
        """Inputs of the MLP besides the feature, of which the embedded direction comes first."""
        return torch.cat([seen, distances], dim=1) if self.sees_distance else seen

    @property
    def sees_distance(self) -> bool:
        """Whether the distance is among the inputs."""
        return bool(self.settings.distance)

    @property
    def knows_lamp(self) -> bool:
        """True where the distance to the lamp is an input of the MLP."""
        return self.sees_distance

    @torch.no_grad()
    def init_from_distances(self, distances: Float[Tensor, "D"]) -> None:
        """Initialise the biases so that each hidden unit's kink is at a distance of the scene (docs/methods.md 3.4).

        Drawn about zero, units see millimetres that outweigh all other inputs: those with a negative weight for the
        distance, about half, are never active and never learn.

        Args:
            distances: From cameras to anchors in their view, scene units. [D]
        """
        if not self.sees_distance or self.settings.bias_init == "pytorch" or len(distances) == 0:
            return
        first: Any = self.color_mlp[0]
        units = first.out_features
        places = (torch.arange(units, device=distances.device) * 2 + 1) * len(distances) // (2 * units)
        kinks = distances.sort().values[places]
        first.bias -= first.weight[:, self.features + self.direction_channels] * kinks

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The MLP."""
        return {"color_mlp": list(self.color_mlp.parameters())}

    def forward(
        self,
        features: Float[Tensor, "V F"],
        directions: Float[Tensor, "V 3"],
        distances: Float[Tensor, "V 1"],
        cosines: Float[Tensor, "V 1"],
        normals: Float[Tensor, "V 3"] | None,
    ) -> Float[Tensor, "V K 3"]:
        """Decode the children's colours."""
        layers: list[Any] = list(self.color_mlp)
        first, activation, last = layers
        embedded = self.embed(self.embed_direction(features, directions, normals), distances, cosines)
        hidden = activation(first_layer(features, embedded, first.weight, first.bias))
        return last(hidden).view(len(features), self.children_per_anchor, 3).sigmoid()


class IMIAAppearanceSettings(AppearanceSettings):
    """Options of IMIA."""

    frequencies: int = Field(default=5, ge=0)  # of gamma, for the cosine


class IMIAAppearanceHead(PlainAppearanceHead):
    """Improved appearance Modelling with Illumination Attenuation (paper, Eq. 8; docs/methods.md 3.4).

    The MLP sees v, the distance d to the lamp and gamma(cos theta), the angle to the optical axis in which light
    spread and vignetting merge.
    """

    Settings: ClassVar[type[Settings]] = IMIAAppearanceSettings

    @property
    def sees_distance(self) -> bool:
        """Always."""
        return True

    def embed(
        self, seen: Float[Tensor, "V D"], distances: Float[Tensor, "V 1"], cosines: Float[Tensor, "V 1"]
    ) -> Float[Tensor, "V E"]:
        """v, d and gamma(cos theta): 3 + 1 + 11 numbers with five frequencies."""
        return torch.cat([seen, distances, cosine_embedding(cosines, self.settings.frequencies)], dim=1)
