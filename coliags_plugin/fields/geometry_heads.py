"""Geometry heads: anchor feature and viewing direction -> opacity, scale and rotation of every child."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from typing_extensions import TypeVar

from coliags_plugin.contracts import GeometryHead
from coliags_plugin.core.settings import Settings
from coliags_plugin.fields.mlp import cosine_embedding, first_layer, mlp


class PlainGeometrySettings(Settings):
    """Options of the plain geometry head."""

    hidden: int = Field(default=32, ge=1)  # units of each hidden layer


#: Settings of a geometry head.
GeometryT = TypeVar("GeometryT", bound=PlainGeometrySettings, default=PlainGeometrySettings)


class PlainGeometryHead(GeometryHead[GeometryT]):
    """Geometry head of Scaffold-GS (docs/methods.md 3.6)."""

    Settings: ClassVar[type[Settings]] = PlainGeometrySettings

    def __init__(self, settings: GeometryT, features: int, children: int, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        self.children_per_anchor = children
        inputs = features + self.embed(torch.zeros(1, 3)).shape[1]
        self.opacity_mlp = mlp(inputs, settings.hidden, children, generator)
        self.covariance_mlp = mlp(inputs, settings.hidden, 7 * children, generator)

    def embed(self, directions: Float[Tensor, "V 3"]) -> Float[Tensor, "V E"]:
        """Encoding of the viewing direction."""
        return directions

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The two MLPs."""
        return {
            "opacity_mlp": list(self.opacity_mlp.parameters()),
            "covariance_mlp": list(self.covariance_mlp.parameters()),
        }

    def forward(
        self, features: Float[Tensor, "V F"], directions: Float[Tensor, "V 3"]
    ) -> tuple[Float[Tensor, "V K"], Float[Tensor, "V K 7"]]:
        """Decode the children of the visible anchors."""
        # Both MLPs read the same input: one product for both first layers.
        mlps = (self.opacity_mlp, self.covariance_mlp)
        weight, bias = (torch.cat([mlp.get_parameter(name) for mlp in mlps]) for name in ("0.weight", "0.bias"))
        opacity_hidden, covariance_hidden = (
            first_layer(features, self.embed(directions), weight, bias).relu().chunk(2, dim=1)
        )
        covariances = self.covariance_mlp[2](covariance_hidden).view(len(features), self.children_per_anchor, 7)
        return self.opacity_mlp[2](opacity_hidden).tanh(), covariances


class IMVEGeometrySettings(PlainGeometrySettings):
    """Options of IMVE."""

    frequencies: int = Field(default=10, ge=0)  # of gamma, per component of the direction


class IMVEGeometryHead(PlainGeometryHead[IMVEGeometrySettings]):
    """Improved geometry Modelling with View Embedding: gamma(v) in place of v (paper, Eq. 7; docs/methods.md 3.4)."""

    Settings: ClassVar[type[Settings]] = IMVEGeometrySettings

    def embed(self, directions: Float[Tensor, "V 3"]) -> Float[Tensor, "V E"]:
        """gamma(v), 63 numbers at ten frequencies."""
        return cosine_embedding(directions, self.settings.frequencies)
