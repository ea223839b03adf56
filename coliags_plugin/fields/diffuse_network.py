"""Network of PR-Endo that corrects the diffuse reflection."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from coliags_plugin.fields.mlp import linear_layers


class DiffuseNetwork(nn.Module):
    """MLP: albedo, lamp distance, normal, direction to the lamp and their cosine -> factor of each channel.

    Its last biases start at 1, so that a new network changes little (docs/rivals/pr-endo.md).

    Args:
        hidden: Units of each hidden layer.
        depth: Hidden layers.
        generator: Of the initial weights.
    """

    INPUTS = 11

    def __init__(self, hidden: int, depth: int, generator: torch.Generator) -> None:
        super().__init__()
        self.layers = nn.ModuleList(linear_layers((self.INPUTS, *[hidden] * depth, 3), generator))
        last: Any = self.layers[-1]
        nn.init.ones_(last.bias)

    def forward(
        self,
        albedos: Float[Tensor, "N 3"],
        distances: Float[Tensor, "N 1"],
        normals: Float[Tensor, "N 3"],
        lamps: Float[Tensor, "N 3"],
    ) -> Float[Tensor, "N 3"]:
        """Factors, of any sign. [N, 3]

        Args:
            albedos: Linear RGB. [N, 3]
            distances: To the lamp, in extents of the scene. [N, 1]
            normals: Unit vectors, on the side of the camera. [N, 3]
            lamps: Unit vectors to the lamp. [N, 3]
        """
        cosines = (normals * lamps).sum(1, keepdim=True)
        values = torch.cat([albedos, distances, normals, lamps, cosines], dim=1)
        *hidden, last = self.layers
        for layer in hidden:
            values = torch.relu_(layer(values))
        factors: Tensor = last(values)
        return factors
