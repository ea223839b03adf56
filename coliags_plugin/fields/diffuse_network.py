"""Network of PR-Endo that corrects the diffuse reflection."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from coliags_plugin.fields.mlp import linear_layers
from coliags_plugin.fields.precision import Precision, reduced_dtype

#: Rows of a product of bfloat16 are a multiple of this: oneDNN compiles, and keeps in memory, a kernel for every size.
_ROWS = 8192


class DiffuseNetwork(nn.Module):
    """MLP: albedo, lamp distance, normal, direction to the lamp and their cosine -> factor of each channel.

    Its last biases start at 1, so that a new network changes little (docs/rivals/pr-endo.md).
    """

    INPUTS = 11

    def __init__(self, hidden: int, hidden_layers: int, precision: Precision, generator: torch.Generator) -> None:
        super().__init__()
        self.precision = precision
        layers = linear_layers((self.INPUTS, *[hidden] * hidden_layers, 3), generator)
        nn.init.ones_(layers[-1].bias)
        self.layers = nn.ModuleList(layers)

    def forward(
        self,
        albedos: Float[Tensor, "N 3"],
        distances: Float[Tensor, "N 1"],
        normals: Float[Tensor, "N 3"],
        lamps: Float[Tensor, "N 3"],
        in_training: bool,
    ) -> Float[Tensor, "N 3"]:
        """Factors, of any sign.

        Albedos are linear RGB, distances in extents of the scene, normals on the side of the camera, and lamps unit
        vectors to the lamp; only in training may products be of the reduced precision.
        """
        cosines = (normals * lamps).sum(1, keepdim=True)
        inputs = torch.cat([albedos, distances, normals, lamps, cosines], dim=1)
        dtype = reduced_dtype(self.precision, inputs) if in_training else inputs.dtype
        *hidden, (last_weight, last_bias) = (
            (layer.get_parameter("weight"), layer.get_parameter("bias")) for layer in self.layers
        )
        values = inputs.to(dtype)
        if dtype == torch.bfloat16:
            values = nn.functional.pad(values, (0, 0, 0, -len(values) % _ROWS))
        for weight, bias in hidden:
            values = torch.relu_(nn.functional.linear(values, weight.to(dtype), bias.to(dtype)))
        # The bias, near 1, is added to the small rest in full precision.
        rest = nn.functional.linear(values, last_weight.to(dtype))[: len(inputs)]
        return rest.to(inputs.dtype) + last_bias
