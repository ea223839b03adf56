"""Network of a neural radiance field: density from the position, colour also from directions."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from coliags_plugin.fields.embedding import cosine_embedding
from coliags_plugin.fields.mlp import first_layer, glorot_linear


class RadianceMLP(nn.Module):
    """NeRF's network, whose colour layer may also see where the light is.

    Args:
        settings: Widths and numbers of frequencies: :class:`coliags_plugin.fields.reim_nerf.ReimNerfFieldSettings`.
        generator: Draws the initial weights.
    """

    def __init__(self, settings: Any, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        embedded = embedding_size(settings.position_frequencies)
        width, inputs = settings.width, [embedded] + (settings.layers - 1) * [settings.width]
        if settings.skip is not None:
            inputs[settings.skip] += embedded
        self.trunk = nn.ModuleList([glorot_linear(size, width, generator) for size in inputs])
        self.density = glorot_linear(width, 1, generator)
        self.feature = glorot_linear(width, width, generator)
        seen = embedding_size(settings.direction_frequencies)
        if settings.light:
            seen += embedding_size(settings.light_frequencies)
        self.color = glorot_linear(width + seen, settings.color_width, generator)
        self.rgb = glorot_linear(settings.color_width, 3, generator)

    def hidden(self, positions: Float[Tensor, "P S 3"]) -> Float[Tensor, "P*S W"]:
        """Output of the trunk. [P*S, W]

        Args:
            positions: Normalised coordinates. [P, S, 3]
        """
        embedded = cosine_embedding(positions.flatten(0, 1), self.settings.position_frequencies)
        hidden = embedded
        layer: Any
        for index, layer in enumerate(self.trunk):
            again = index == self.settings.skip
            hidden = first_layer(hidden, embedded, layer.weight, layer.bias) if again else layer(hidden)
            hidden = hidden.relu_()
        return hidden

    def raw_density(self, hidden: Float[Tensor, "P*S W"], rays: int) -> Float[Tensor, "P S"]:
        """Density before ReLU, in normalised units. [P, S]

        Args:
            hidden: Of :meth:`hidden`. [P*S, W]
            rays: P.
        """
        return functional.linear(hidden, self.density.weight, self.density.bias).view(rays, -1)

    def colors(
        self, hidden: Float[Tensor, "P*S W"], directions: Float[Tensor, "P 3"], light: Float[Tensor, "3"]
    ) -> Float[Tensor, "P S 3"]:
        """Colours in [0, 1].

        What is the same all along a ray enters the colour layer once per ray. The feature layer has no activation, so
        its product with the colour layer is one smaller matrix.

        Args:
            hidden: Of :meth:`hidden`. [P*S, W]
            directions: Unit vectors. [P, 3]
            light: Position of the light, normalised coordinates. [3]
        """
        settings = self.settings
        seen = cosine_embedding(directions, settings.direction_frequencies)
        if settings.light:
            lamp = cosine_embedding(light, settings.light_frequencies)
            seen = torch.cat([seen, lamp.expand(len(seen), -1)], dim=1)
        from_feature, from_ray = self.color.weight[:, : settings.width], self.color.weight[:, settings.width :]
        constant = self.color.bias + from_feature @ self.feature.bias
        of_ray = functional.linear(seen, from_ray, constant)
        of_point = functional.linear(hidden, from_feature @ self.feature.weight)
        mixed = (of_point.view(len(seen), -1, settings.color_width) + of_ray[:, None]).relu_()
        return functional.linear(mixed, self.rgb.weight, self.rgb.bias).sigmoid()


def embedding_size(frequencies: int) -> int:
    """Length of the embedding of three coordinates."""
    return 3 * (1 + 2 * frequencies)
